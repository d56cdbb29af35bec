"""A user's mistakes: one line on standard error and exit code 2, never a traceback.

Every part raises its own exception class for them. They are looked up by name among
the modules that are loaded: naming the classes would import torch to print that a
file is missing, and what is not imported cannot have raised.
"""

import sys
from typing import Final

USER_ERROR: Final = 2
INTERRUPTED: Final = 130  # as shells report a Ctrl-C

_CLASSES: Final = {
    "actors.controlled": "ControlledError",
    "actors.frames": "FrameError",
    "actors.policy": "PolicyError",
    "launch.recording": "RecordingError",
    "launch.web": "ViewError",
    "learner.checkpoint": "CheckpointError",
    "learner.curves": "CurvesError",
    "replay.spec": "ReplayError",
    "replay.wire": "WireError",
    "sim.bank": "BankError",
    "sim.scene": "SceneError",
}


class LaunchError(Exception):
    """A command cannot do what it was asked; one line says why and what to do."""


def user_message(error: BaseException) -> str | None:
    """The line for a user's mistake; None for what is a bug."""
    classes: tuple[type[BaseException], ...] = (LaunchError, *_loaded_classes())
    if isinstance(error, classes):
        return " ".join(str(error).split())
    if isinstance(error, OSError) and error.filename is not None:
        # Whatever part it comes from: a file or folder named by the user.
        return f"{error.filename}: {error.strerror}; check the path and its permissions"
    return None


def _loaded_classes() -> tuple[type[BaseException], ...]:
    found: list[type[BaseException]] = [
        getattr(sys.modules[module], name)
        for module, name in _CLASSES.items()
        if module in sys.modules
    ]
    return tuple(found)
