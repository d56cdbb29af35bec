"""Zenoh sessions: who listens, who connects, and nothing that finds peers by itself.

One process of a run listens as a router and the others connect to it as clients.
Multicast scouting and gossip are off: a run reaches exactly the endpoints that it was
given. Without encryption only loopback addresses are accepted unless the user says
`--insecure`.

Settings that were measured to matter:

- `connect/retry` from 50 ms: sessions are back 0.3 s after a service's restart
  instead of 1.5 s;
- Zenoh's own shared memory is off: a process that is killed leaves its pool of 16 MB
  behind for as long as the service lives, and large batches of rows go by
  `replay.arena` or `replay.stream_frames`, with less CPU time;
- room for 16 batches of 64 KB to be sent per link instead of 2: whoever answers with
  512 KB does not wait for the socket seven times. A draw of 64 rows of 8 KB by TCP
  takes a quarter less CPU time;
- a service's process has two arenas of glibc's: with one for each of Zenoh's threads,
  every client that is killed leaves 16 to 37 KB of fragments behind, with two 3 to 6;
- `wait_before_close` and the lease at 60 s: a peer that stalls for seconds (a
  compilation, a debugger) otherwise loses its link and all that was queued on it.
"""

import ipaddress
import json
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from replay.allocator import ARENA_MAX, tell_malloc
from replay.spec import ReplayError

STALL_S = 60.0
_ARENAS = 2
_RETRY = {
    "period_init_ms": 50,
    "period_max_ms": 500,
    "period_increase_factor": 1.5,
}


_SEPARATE: set[str] = set()  # the sessions that were opened without shared memory


class ConnectError(ReplayError):
    """A session cannot be opened; one line says which endpoint and what to do."""


def _host_of(endpoint: str) -> str:
    """The host of `proto/host:port[?meta][#config]`; raises if it is not one."""
    protocol, slash, rest = endpoint.partition("/")
    address = rest.split("?")[0].split("#")[0]
    host, colon, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (slash and protocol in {"tcp", "tls", "quic"} and colon and host):
        raise ConnectError(
            f"endpoint {endpoint!r} is not PROTOCOL/HOST:PORT, e.g. tcp/127.0.0.1:7447"
        )
    if not (port.isdecimal() and int(port) < 65536):
        raise ConnectError(f"endpoint {endpoint!r}: port {port!r} is not 0 to 65535")
    return host


def is_loopback(endpoint: str) -> bool:
    """Whether the endpoint can be reached from this machine alone."""
    host = _host_of(endpoint)
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # another name: it may resolve to anything
        return False


def check_endpoints(endpoints: Sequence[str], insecure: bool) -> None:
    """Refuses addresses other than loopback unless `insecure` allows them."""
    exposed = [endpoint for endpoint in endpoints if not is_loopback(endpoint)]
    if exposed and not insecure:
        raise ConnectError(
            f"{exposed[0]} is not a loopback address and the link is not encrypted; "
            "on a network that you trust, pass --insecure"
        )


def _config(
    *, connect: Sequence[str], listen: Sequence[str], router: bool
) -> zenoh.Config:
    """The session's settings; see the module's docstring for the figures."""
    link = "transport/link/tx"
    settings: dict[str, Any] = {
        "mode": "router" if router else ("peer" if listen else "client"),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "connect/retry": _RETRY,
        "transport/shared_memory/enabled": False,
        f"{link}/queue/size/data": 16,
        f"{link}/lease": int(STALL_S * 1e3),
        f"{link}/queue/congestion_control/block/wait_before_close": int(STALL_S * 1e6),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    router: bool = False,
    shared_memory: bool = True,
    timeout_s: float = 10.0,
) -> zenoh.Session:
    """Opens a session; waits up to `timeout_s` for an endpoint that is not up yet.

    `shared_memory`: answers may come by `replay.arena`, where they can.
    """
    if not connect and not listen:
        raise ConnectError("a session needs an endpoint to connect to or to listen on")
    _share_arenas(router)
    deadline = time.monotonic() + timeout_s
    while True:
        config = _config(connect=connect, listen=listen, router=router)
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            reason = str(error)
        else:
            if not shared_memory:
                _SEPARATE.add(str(session.zid()))
            return session
        if "listener" in reason or "in use" in reason:
            raise ConnectError(_listen_message(listen, reason)) from None
        if time.monotonic() > deadline:
            raise ConnectError(
                f"cannot reach {', '.join(connect)} within {timeout_s:g} s; is the "
                "run's replay service up, and is the address right?"
            )
        # Zenoh offers no event for "someone listens now"; a refused connection
        # returns in milliseconds, so trying again is the wait.
        time.sleep(0.05)


def _share_arenas(is_service: bool) -> None:
    """Before Zenoh's threads are there: who has an arena keeps it."""
    if is_service:
        tell_malloc(ARENA_MAX, _ARENAS)


def shares_memory(session: zenoh.Session) -> bool:
    """Whether the session was opened with shared memory allowed."""
    return str(session.zid()) not in _SEPARATE


def undeclare(*entities: Any) -> None:  # noqa: ANN401 (Zenoh has no common type)
    """Ends publishers, subscribers and queryables, whose stubs are untyped here."""
    for entity in entities:
        entity.undeclare()


def direct(
    callback: Callable[[Any], None], end: Callable[[], None] | None = None
) -> "zenoh.handlers.Callback[Any]":
    """A handler that runs on Zenoh's own thread: it may enqueue and nothing else.

    Zenoh's default starts a Python thread for every query and waits until it runs:
    a quarter of a millisecond of CPU time, and another hop for every answer.
    """
    return zenoh.handlers.Callback(callback, end, indirect=False)


def _listen_message(listen: Sequence[str], reason: str) -> str:
    """One line for a listener that could not be made."""
    endpoint = next((e for e in listen if e.split("/", 1)[1] in reason), listen[0])
    if "in use" in reason:
        return f"{endpoint}: port in use; stop what uses it or choose another port"
    return f"cannot listen on {endpoint}: is it an address of this machine?"


def ask(
    session: zenoh.Session, key: str, payload: bytes = b"", *, timeout_s: float
) -> bytes | None:
    """One query, one answer; None if nobody answers (also when access is denied)."""
    answers: list[bytes] = []
    ended = threading.Event()

    def on_reply(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            answers.append(reply.ok.payload.to_bytes())

    session.get(
        key,
        direct(on_reply, ended.set),
        payload=payload,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
        timeout=timeout_s,
    )
    # Zenoh ends the query at its timeout; the margin covers a loaded machine.
    ended.wait(timeout_s + 5.0)
    return answers[0] if answers else None
