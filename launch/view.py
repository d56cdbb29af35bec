"""`slipstream view RUN|RECORDING`: a run in progress or a recording, in the browser.

A recording is an .rrd file; a run folder stands for its run while that is in progress
(`endpoint.json` says where), else for its `evaluation.rrd`. Recordings are checked
before they are served: a browser shows a broken file as an empty page.
"""

import json
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from launch.viewer import ViewerConfig
from launch.web import FileServer, ViewError, WebConfig, WebViewer

RECORDING: Final = "evaluation.rrd"
ENDPOINT: Final = "endpoint.json"
_MAGIC: Final = b"RRF2"
_FOOTER: Final = b"RRF2FOOT"  # among the last 16 bytes of a file that was finished


@dataclass(frozen=True)
class Endpoint:
    """Where a run in progress can be joined."""

    run_id: str
    connect: tuple[str, ...]  # Zenoh endpoints

    def write(self, run: Path) -> None:
        """Writes the run folder's endpoint file."""
        content = {"run_id": self.run_id, "connect": list(self.connect)}
        (run / ENDPOINT).write_text(json.dumps(content, indent=1) + "\n")

    @staticmethod
    def read(run: Path) -> "Endpoint | None":
        """The run's endpoint; None where it has none, `ViewError` if it is broken."""
        path = run / ENDPOINT
        try:
            content = json.loads(path.read_text())
            run_id, connect = content["run_id"], content["connect"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ViewError(f"{path}: cannot be read ({error}); delete it") from error
        if not isinstance(run_id, str) or not isinstance(connect, list):
            raise ViewError(f"{path}: not what a run writes there; delete it")
        return Endpoint(run_id, tuple(str(endpoint) for endpoint in connect))


def check_recording(path: Path) -> None:
    """Raises `ViewError` unless the file is a finished Rerun recording."""
    try:
        with path.open("rb") as file:
            head = file.read(len(_MAGIC))
            size = file.seek(0, 2)
            file.seek(max(0, size - 16))
            tail = file.read()
    except OSError as error:
        raise ViewError(f"{path}: {error.strerror}: name a recording") from error
    if head != _MAGIC:
        raise ViewError(
            f"{path}: no Rerun recording: name an .rrd file or a run folder"
        )
    if _FOOTER not in tail:
        raise ViewError(f"{path}: truncated at byte {size}: record it again")


def recording_of(target: Path) -> Path:
    """The recording that a file or a run folder stands for, checked."""
    if not target.exists():
        raise ViewError(f"{target}: no such file or folder: name a run or a recording")
    path = target / RECORDING if target.is_dir() else target
    if not path.exists():
        raise ViewError(
            f"{target}: holds no {RECORDING} and no run is in progress there: name a "
            "run folder or a recording"
        )
    check_recording(path)
    return path


def serve_recording(
    path: Path,
    config: WebConfig,
    *,
    stop: threading.Event,
    announce: Callable[[str], None],
) -> None:
    """Serves a recording until `stop`; `announce` gets the address to open."""
    check_recording(path)
    with FileServer(path, config) as files, WebViewer(config, files.url) as web:
        announce(web.url)
        while not stop.wait(1.0):
            web.check()


def is_up(endpoint: str) -> bool:
    """Whether someone listens at a Zenoh endpoint, `tcp/HOST:PORT`."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=2.0).close()
    except (OSError, ValueError):
        return False
    return True


def view(
    target: Path,
    config: ViewerConfig,
    *,
    stop: threading.Event,
    announce: Callable[[str], None],
) -> None:
    """Shows a recording or a run until `stop`.

    A run that was killed leaves its `endpoint.json` behind; where nobody listens any
    more, its recording is what there is to see.
    """
    endpoint = Endpoint.read(target) if target.is_dir() else None
    if endpoint is not None and any(is_up(place) for place in endpoint.connect):
        from launch.join import JoinConfig
        from launch.roles import viewer_role

        join = JoinConfig(
            run_id=endpoint.run_id,
            connect=endpoint.connect,
            insecure=config.web.insecure,
            run=target,
        )
        viewer_role(join, config, stop)
        return
    path = recording_of(target)
    serve_recording(path, config.web, stop=stop, announce=announce)
