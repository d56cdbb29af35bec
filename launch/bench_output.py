"""What a benchmark leaves behind: a JSON report, and figures as PNG and SVG.

Whether they can be written is tried before anything is measured, by writing: a folder's
permissions do not tell it (root may write anywhere, but not to /proc). Files are
written at the end, each whole or not at all.
"""

import importlib.util
import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from launch.config import write_atomically
from launch.errors import LaunchError

Figures = Callable[[Mapping[str, Any]], Mapping[str, bytes]]


def check_outputs(json_path: str, plot: str = "") -> None:
    """Refuses what could not be written, before minutes of measuring."""
    if json_path and json_path != "-":
        path = Path(json_path)
        if path.is_dir():
            raise LaunchError(f"--json {path}: is a folder; name a file")
        _check_writable(path.parent, f"--json {path}")
    if plot:
        _check_writable(Path(plot), f"--plot {plot}")
        if importlib.util.find_spec("matplotlib") is None:
            raise LaunchError(
                "--plot needs matplotlib, which is not installed; "
                "pip install 'slipstream[learner]'"
            )


def _check_writable(folder: Path, what: str) -> None:
    """Whether files can be made in a folder, or where it would be made."""
    there = folder.absolute()
    while not there.exists():
        there = there.parent
    if not there.is_dir():
        raise LaunchError(f"{what}: {there} is not a folder; choose another path")
    try:
        with tempfile.NamedTemporaryFile(dir=there, prefix=".slipstream-"):
            pass
    except OSError as error:
        raise LaunchError(
            f"{what}: {there} cannot be written ({error.strerror}); choose another path"
        ) from None


def write_report(
    report: Mapping[str, Any],
    *,
    json_path: str,
    plot: str = "",
    figures: Figures | None = None,
) -> None:
    """The report to a file or (-) standard output, its figures to a folder."""
    if plot and figures is not None:
        folder = Path(plot)
        drawn = figures(report)
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in drawn.items():
            write_atomically(folder / name, data)
    text = json.dumps(report, indent=1)
    if json_path == "-":
        print(text)
    elif json_path:
        Path(json_path).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(Path(json_path), (text + "\n").encode())
