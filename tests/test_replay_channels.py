"""Keys, sessions, weights, status, frames, the call to stop, files."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zenoh

from replay.channels import (
    ControlSubscriber,
    FramePublisher,
    FrameSubscriber,
    StatusPublisher,
    StatusSubscriber,
    send_stop,
)
from replay.control import FileRequest, encode
from replay.files import FileError, FileServer, fetch_file
from replay.keys import RunKeys
from replay.session import ConnectError, ask, check_endpoints, open_session
from replay.spec import ReplayError
from replay.weights import WeightsPublisher, WeightsSubscriber
from tests.replay_parts import KEYS, eventually, free_endpoint, session_to


@pytest.fixture
def sessions() -> object:
    """A router and two clients."""
    endpoint = free_endpoint()
    router = open_session(listen=[endpoint], router=True)
    with session_to(endpoint) as one, session_to(endpoint) as two:
        yield one, two
    router.close()


Pair = tuple[zenoh.Session, zenoh.Session]


def test_wildcard_keys_include_the_concrete_ones() -> None:
    everything = zenoh.KeyExpr(KEYS.everything)
    concrete = [
        KEYS.insert,
        KEYS.sample,
        KEYS.fetch,
        KEYS.stats,
        KEYS.weights,
        KEYS.control,
        KEYS.status("actor-3"),
        KEYS.frames(3),
        KEYS.file("train.bank"),
    ]
    assert len(set(concrete)) == len(concrete)
    for key in concrete:
        assert everything.includes(zenoh.KeyExpr(key))
        assert not zenoh.KeyExpr(RunKeys("other").everything).intersects(key)
    assert zenoh.KeyExpr(KEYS.all_status).includes(KEYS.status("actor-3"))
    assert zenoh.KeyExpr(KEYS.all_frames).includes(KEYS.frames(12))
    assert zenoh.KeyExpr(KEYS.all_files).includes(KEYS.file("train.bank"))
    assert not zenoh.KeyExpr(KEYS.all_files).includes(KEYS.status("x"))


@pytest.mark.parametrize(
    "bad", ["", "a/b", "*", "**", "a*", "$x", "é", "a" * 65, "a b"]
)
def test_run_ids_and_roles_are_plain_chunks(bad: str) -> None:
    for make in (RunKeys, KEYS.status, KEYS.file):
        with pytest.raises(ReplayError, match="cannot be part of a key"):
            make(bad)


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        ("tcp/10.0.0.1:7447", "pass --insecure"),
        ("tcp/[::]:7447", "pass --insecure"),
        ("tcp/example.org:7447", "pass --insecure"),
        ("127.0.0.1:7447", "is not PROTOCOL/HOST:PORT"),
        ("tcp/127.0.0.1", "is not PROTOCOL/HOST:PORT"),
        ("tcp/127.0.0.1:70000", "is not 0 to 65535"),
    ],
)
def test_endpoints_are_checked(endpoint: str, why: str) -> None:
    with pytest.raises(ConnectError, match=why):
        check_endpoints(["tcp/127.0.0.1:1", endpoint], False)
    check_endpoints(["tcp/127.0.0.1:1", "tcp/[::1]:1", "tcp/localhost:1"], False)
    check_endpoints(["tcp/10.0.0.1:7447"], True)


def test_sessions_that_cannot_open_say_why_in_one_line() -> None:
    endpoint = free_endpoint()
    tries: list[tuple[Callable[[], object], str]] = [
        (lambda: open_session(connect=[endpoint], timeout_s=0.1), "cannot reach"),
        (lambda: open_session(listen=[endpoint], router=True), "port in use"),
        (lambda: open_session(listen=["tcp/192.0.2.1:1"]), "cannot listen on"),
        (lambda: open_session(), "needs an endpoint"),
    ]
    for index, (make, why) in enumerate(tries):
        router = open_session(listen=[endpoint], router=True) if index == 1 else None
        with pytest.raises(ConnectError, match=why) as caught:
            make()
        assert "\n" not in str(caught.value)
        if router is not None:
            router.close()


def test_weights_reach_those_who_wait_and_those_who_join_late(sessions: Pair) -> None:
    early = WeightsSubscriber(session=sessions[1], keys=KEYS)
    assert early.wait(0.05) is None
    publisher = WeightsPublisher(session=sessions[0], keys=KEYS)
    publisher.publish(3, "abc", np.arange(1000, dtype=np.float32))
    first = early.wait(20.0)
    assert first is not None
    assert (first.version, first.layout_hash) == (3, "abc")
    publisher.publish(4, "abc", np.full(1_000_000, 4, np.float32))
    late = WeightsSubscriber(session=sessions[1], keys=KEYS)
    got = late.wait(20.0)
    assert got is not None
    assert got.version == 4
    assert (got.vector == 4).all()
    for version in range(5, 40):
        publisher.publish(version, "abc", np.full(1000, version, np.float32))
    for subscriber in (early, late):
        assert eventually(lambda s=subscriber: s.latest().version == 39)
        assert (subscriber.latest().vector == 39).all()
        subscriber.close()
    publisher.close()


def test_weights_that_cannot_be_read_are_an_error(sessions: Pair) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"rubbish")

    queryable = sessions[0].declare_queryable(KEYS.weights, answer)
    subscriber = WeightsSubscriber(session=sessions[1], keys=KEYS)
    with pytest.raises(ReplayError, match="WEIGHTS: 7 bytes"):
        subscriber.wait(20.0)
    queryable.undeclare()


def test_status_is_told_per_role(sessions: Pair) -> None:
    console = StatusSubscriber(sessions[1], KEYS)
    roles = [StatusPublisher(sessions[0], KEYS, f"actor-{i}") for i in (0, 1)]

    def told() -> bool:
        for number, publisher in enumerate(roles):
            publisher.put({"steps": number, "state": "up"})
        return len(console.latest()) == 2

    assert eventually(told)
    assert console.latest()["actor-1"][1] == {"steps": 1, "state": "up"}
    sessions[0].put(KEYS.status("actor-9"), b"rubbish")
    assert eventually(lambda: console.refused == 1)
    assert "actor-9" not in console.latest()
    for publisher in roles:
        publisher.close()
    console.close()


def test_frames_are_made_only_when_wanted_and_the_oldest_are_dropped(
    sessions: Pair,
) -> None:
    publisher = FramePublisher(sessions[0], KEYS, 7)
    assert not publisher.wanted
    viewer = FrameSubscriber(sessions[1], KEYS, depth=3)
    assert eventually(lambda: publisher.wanted)
    for number in range(10):
        publisher.put(bytes([number]))
    assert eventually(lambda: viewer.dropped == 7)
    frames = iter(viewer)
    assert [next(frames) for _ in range(3)] == [(7, b"\7"), (7, b"\x08"), (7, b"\t")]
    assert viewer.get(0.01) is None
    viewer.close()
    assert list(frames) == []
    assert eventually(lambda: not publisher.wanted)
    publisher.close()


def test_the_call_to_stop_reaches_everyone(sessions: Pair) -> None:
    listeners = [ControlSubscriber(session, KEYS) for session in sessions]
    probe = FramePublisher(sessions[0], KEYS, 0)
    viewer = FrameSubscriber(sessions[1], KEYS)
    # Declared later on the same links: once this is known, so are the listeners.
    assert eventually(lambda: probe.wanted)
    sessions[0].put(KEYS.control, b"rubbish")
    assert not any(listener.stop.is_set() for listener in listeners)
    send_stop(sessions[0], KEYS, "learnt")
    for listener in listeners:
        assert listener.stop.wait(20.0)
        assert listener.reason == "learnt"
        listener.close()
    viewer.close()
    probe.close()


def test_files_arrive_whole_or_not_at_all(sessions: Pair, tmp_path: Path) -> None:
    data = np.random.default_rng(0).bytes(9_500_000)  # three parts
    source, empty = tmp_path / "train.bank", tmp_path / "empty"
    source.write_bytes(data)
    empty.write_bytes(b"")
    server = FileServer(
        session=sessions[0], keys=KEYS, files={"train.bank": source, "empty": empty}
    )
    # What one client declares and what the other asks go to the router by two links.
    key, request = KEYS.file("empty"), encode(FileRequest(offset=0, length=0))
    assert eventually(
        lambda: ask(sessions[1], key, request, timeout_s=10.0) is not None
    )
    copy = tmp_path / "there" / "copy.bank"
    digest = fetch_file(sessions[1], KEYS, "train.bank", copy)
    assert digest == hashlib.sha256(data).hexdigest()
    assert copy.read_bytes() == data
    fetch_file(sessions[1], KEYS, "empty", tmp_path / "there" / "nothing")
    assert (tmp_path / "there" / "nothing").read_bytes() == b""

    source.write_bytes(data[:-1] + b"\0")
    with pytest.raises(FileError, match="changed after it was offered"):
        fetch_file(sessions[1], KEYS, "train.bank", tmp_path / "there" / "bad")
    with pytest.raises(FileError, match="nobody serves"):
        fetch_file(sessions[1], KEYS, "other", tmp_path / "there" / "bad")
    assert sorted(path.name for path in copy.parent.iterdir()) == [
        "copy.bank",
        "nothing",
    ]
    with pytest.raises(FileError, match="cannot be offered"):
        FileServer(session=sessions[0], keys=KEYS, files={"x": tmp_path / "missing"})
    with pytest.raises(FileError, match="cannot write"):
        fetch_file(sessions[1], KEYS, "empty", source / "below-a-file")
    server.close()
