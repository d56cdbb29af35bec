"""Rerun's viewer in the browser: its server as a child process, and a file server.

The SDK's own servers bind every interface; the program `rerun` can be told an address
(`--bind`), so that is what runs. The `rerun` on the PATH is a wrapper whose death
orphans the program: the program itself is started. Given a file it spins a core while
idle, given the address of one it does not: a recording is served over HTTP from here.
"""

import ctypes
import functools
import http.server
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final
from urllib.parse import quote

from replay.session import check_endpoints

_START_S: Final = 30.0
_POLL_S: Final = 0.05


class ViewError(Exception):
    """Nothing can be shown; the message says why and what to do."""


@dataclass(frozen=True, kw_only=True)
class WebConfig:
    """Where the viewer is served."""

    host: str = "127.0.0.1"
    """Address to bind; others than loopback need `insecure`."""
    web_port: int = 9090
    """Port of the page to open in a browser."""
    data_port: int = 9876
    """Port that the page gets its data from (gRPC if live, HTTP if recorded)."""
    server_memory: str = "128MB"
    """What is kept for browsers that join late; the oldest is dropped first."""
    insecure: bool = False
    """Allows an address that others can reach; nothing is encrypted."""


def check_port(host: str, port: int, option: str) -> None:
    """Raises `ViewError` if the port cannot be bound."""
    if not 0 < port < 65536:
        raise ViewError(f"{option} {port}: a port is 1 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ViewError(
                f"port {port} of {host} cannot be used ({error.strerror}): "
                f"choose another with {option}"
            ) from error


def _check(config: WebConfig, *, live: bool) -> None:
    """Refuses ports in use and addresses that need `--insecure`."""
    check_endpoints([f"tcp/{_bracketed(config.host)}:1"], config.insecure)
    if config.web_port == config.data_port:
        raise ViewError(f"web port and data port are both {config.web_port}")
    check_port(config.host, config.web_port, "--web-port")
    if live:  # a recording's server has the port already
        check_port(config.host, config.data_port, "--data-port")


_prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
_PR_SET_PDEATHSIG: Final = 1


def _end_with(parent: int) -> None:
    """In the child, between fork and exec: it shall not outlive the viewer."""
    if _prctl is not None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the line above
        os._exit(1)


def _program() -> Path:
    """The program `rerun` of the installed SDK."""
    found = importlib.util.find_spec("rerun_cli")
    if found is None or found.origin is None:
        raise ViewError("the web viewer is missing: install rerun-sdk")
    return Path(found.origin).parent / "rerun"


def _bracketed(host: str) -> str:
    """The host as it stands in a URL."""
    return f"[{host}]" if ":" in host else host


def _reachable(host: str) -> str:
    """The host as a browser would call it: 'all interfaces' is no address to go to."""
    return socket.gethostname() if host in {"0.0.0.0", "::"} else _bracketed(host)


@final
class WebViewer:
    """The program `rerun` serving its web viewer; a context manager.

    Without `source` it also takes logs and serves them live, at `grpc_url`.
    """

    def __init__(self, config: WebConfig, source: str | None = None) -> None:
        """Checks the ports; nothing runs before `__enter__`."""
        _check(config, live=source is None)
        self._config = config
        address = f"{_reachable(config.host)}:{config.data_port}"
        local = f"{_bracketed(config.host)}:{config.data_port}"
        self.grpc_url = f"rerun+http://{local}/proxy"
        """Where to log to."""
        shown = source or f"rerun+http://{address}/proxy"
        page = f"http://{_reachable(config.host)}:{config.web_port}"
        # Nothing persists: a layout that a browser remembers would hide the run's own.
        options = "theme=dark&hide_welcome_screen=1&persist=0"
        self.url = f"{page}/?url={quote(shown, safe='')}&{options}"
        """What to open in a browser."""
        self._command = [
            str(_program()),
            *("--serve-web", "--bind", config.host),
            *("--web-viewer-port", str(config.web_port)),
            *("--port", str(config.data_port)),
            *("--server-memory-limit", config.server_memory),
            *("--cors-allow-origin", page),
            "--newest-first",
            *([source] if source else []),
        ]
        self._live = source is None
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "WebViewer":
        """Starts the program and waits until it listens."""
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=functools.partial(_end_with, os.getpid()),
        )
        ports = [self._config.web_port]
        if self._live:
            ports.append(self._config.data_port)
        try:
            for port in ports:
                self._wait_for(port)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        """Ends the program."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def check(self) -> None:
        """Raises `ViewError` if the program has ended."""
        code = self._process.poll() if self._process is not None else None
        if code is not None:
            raise ViewError(
                f"the web viewer has ended with code {code}: is port "
                f"{self._config.web_port} or {self._config.data_port} in use?"
            )

    def _wait_for(self, port: int) -> None:
        """Until the program listens: a refused connection returns at once."""
        deadline = time.monotonic() + _START_S
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(
            self._config.host, self._config.host
        )
        while True:
            self.check()
            try:
                socket.create_connection((host, port), timeout=1.0).close()
            except OSError:
                if time.monotonic() > deadline:
                    raise ViewError(
                        f"the web viewer does not listen on port {port} after "
                        f"{_START_S:.0f} s"
                    ) from None
                time.sleep(_POLL_S)
            else:
                return


@final
class _OneFile(http.server.BaseHTTPRequestHandler):
    """Serves one file to the page of one origin; every other path is refused."""

    def __init__(
        self, path: Path, origin: str, *connection: object, **options: object
    ) -> None:
        """`connection` is what the server hands over."""
        self._path = path
        self._origin = origin
        http.server.BaseHTTPRequestHandler.__init__(
            self,
            *connection,  # type: ignore[arg-type]
            **options,  # type: ignore[arg-type]
        )

    def do_GET(self) -> None:
        """Sends the file."""
        if self.path != f"/{quote(self._path.name)}":
            self.send_error(404)
            return
        content = self._path.read_bytes()
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Access-Control-Allow-Origin", self._origin)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


@final
class FileServer:
    """Serves a recording over HTTP from a thread; a context manager."""

    def __init__(self, path: Path, config: WebConfig) -> None:
        """Binds the data port."""
        page = f"http://{_reachable(config.host)}:{config.web_port}"
        handler = functools.partial(_OneFile, path, page)
        try:
            self._server = http.server.ThreadingHTTPServer(
                (config.host, config.data_port), handler
            )
        except OSError as error:
            raise ViewError(
                f"port {config.data_port} of {config.host} cannot be used "
                f"({error.strerror}): choose another with --data-port"
            ) from error
        self._server.daemon_threads = True
        address = f"{_reachable(config.host)}:{config.data_port}"
        self.url = f"http://{address}/{quote(path.name)}"
        """Where the file is."""
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="recording", daemon=True
        )

    def __enter__(self) -> "FileServer":
        """Starts to serve."""
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stops and frees the port."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
