"""Shared memory between a client and a service: what is believed, and for how long."""

import contextlib
import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from replay.arena import HEAD_BYTES, IDLE_S, MAX_MAPPED, Arena, Arenas
from replay.client import Sampler, Writer
from replay.local import ReplayConfig
from replay.places import MemoryPlace
from replay.session import ask, open_session
from replay.wire import SampleReply, SampleRequest, body_bytes
from tests.replay_parts import KEYS, SPEC, Service, eventually, make_rows, service

ROOT = Path(__file__).parent.parent
PARTS, PART_BYTES = 3, 1000
SIZE = HEAD_BYTES + PARTS * 1024
FREE = ReplayConfig(
    capacity=1000,
    min_size=1000,
    samples_per_insert=1e6,
    tolerance=1.0,
    priority_exponent=0.0,
)


@pytest.fixture
def place() -> Iterator[MemoryPlace]:
    arena = Arena(parts=PARTS, part_bytes=PART_BYTES)
    taken = arena.take()
    assert taken is not None
    yield taken
    arena.close()


ARENA = Arena(parts=PARTS, part_bytes=PART_BYTES)
GOOD = ARENA.take()


@settings(deadline=None, max_examples=200)
@given(
    pid=st.sampled_from([os.getpid(), 0, 1, 2**22 - 1, 2**32 - 1]),
    fd=st.one_of(st.just(GOOD.fd), st.integers(0, 40), st.just(2**32 - 1)),
    offset=st.one_of(
        st.integers(0, SIZE + 100).map(lambda n: n & ~63), st.integers(0, 2**64 - 1)
    ),
    length=st.one_of(st.integers(0, SIZE), st.integers(0, 2**40)),
    token=st.sampled_from([GOOD.token, bytes(16), GOOD.token[::-1]]),
)
def test_only_the_owners_memory_is_written_to(
    pid: int, fd: int, offset: int, length: int, token: bytes
) -> None:
    """The definition: its process, its file, its token, aligned, inside."""
    part = Arenas().part(
        MemoryPlace(pid=pid, fd=fd, offset=offset, token=token), length
    )
    right = (pid, fd, token) == (os.getpid(), GOOD.fd, GOOD.token)
    inside = HEAD_BYTES <= offset and offset + length <= SIZE and offset % 64 == 0
    assert (part is not None) == (right and inside)
    assert part is None or len(part) == length


def test_what_the_service_writes_the_client_sees(place: MemoryPlace) -> None:
    arenas = Arenas()
    part = arenas.part(place, 5)
    assert part is not None
    part[:] = b"hello"
    again = arenas.part(place, PART_BYTES)
    assert again is not None and bytes(again[:5]) == b"hello"
    assert len(arenas) == 1


@pytest.mark.parametrize("fault", ["unsealed", "hollow", "small", "pipe", "file"])
def test_other_files_are_not_mapped(
    fault: str, place: MemoryPlace, tmp_path: Path
) -> None:
    """Each could stop the service in the middle of a write, or is none of this."""
    spare: list[int] = []
    if fault == "pipe":
        spare += os.pipe()
    elif fault == "file":
        (tmp_path / "memfd:slipstream").write_bytes(place.token + bytes(SIZE))
        spare.append(os.open(tmp_path / "memfd:slipstream", os.O_RDWR))
    else:
        flags = os.MFD_ALLOW_SEALING
        spare.append(os.memfd_create("slipstream", flags))
        size = HEAD_BYTES if fault == "small" else SIZE
        os.truncate(spare[0], size)
        if fault != "hollow":
            os.posix_fallocate(spare[0], 0, size)
        os.pwrite(spare[0], place.token, 0)
        seals = fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
        if fault != "unsealed":
            seals |= fcntl.F_SEAL_SHRINK
        fcntl.fcntl(spare[0], fcntl.F_ADD_SEALS, seals)
    try:
        assert Arenas().part(replace(place, fd=spare[0]), 0) is None
    finally:
        for fd in spare:
            os.close(fd)


def test_nobody_can_change_the_size(place: MemoryPlace) -> None:
    for size in (SIZE - 1, SIZE + 1):
        with pytest.raises(PermissionError):
            os.truncate(place.fd, size)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_another_users_memory_is_not_written_to(place: MemoryPlace) -> None:
    assert Arenas().part(place, 64) is not None
    os.fchown(place.fd, 65534, 65534)
    assert Arenas().part(place, 64) is None


def test_a_process_that_is_gone() -> None:
    """It is not found any more; but what is mapped stays, as a write may go on."""
    code = (
        "from replay.arena import Arena; a = Arena(parts=1, part_bytes=64)\n"
        "p = a.take(); print(p.pid, p.fd, p.offset, p.token.hex(), flush=True)\n"
        "input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as other:
        assert other.stdout is not None
        pid, fd, offset, token = other.stdout.readline().split()
        theirs = MemoryPlace(
            pid=int(pid), fd=int(fd), offset=int(offset), token=bytes.fromhex(token)
        )
        arenas = Arenas()
        assert arenas.part(theirs, 64) is not None
        other.kill()
    assert Arenas().part(theirs, 64) is None
    part = arenas.part(theirs, 64)
    assert part is not None
    part[:] = bytes(64)


def test_a_part_is_free_when_nobody_looks_at_it() -> None:
    arena = Arena(parts=1, part_bytes=PART_BYTES)
    place = arena.take()
    assert place is not None and arena.take() is None
    rows = np.frombuffer(arena.view(place, 640), "<u8").reshape(8, 10)[2:4, 1]
    assert not rows.flags.writeable
    assert arena.take() is None  # a view of a view of it is left
    kept = memoryview(rows)
    del rows
    assert arena.take() is None
    del kept
    assert arena.take() == place
    arena.give_back(place)
    assert arena.take() == place
    left = arena.view(place, 8)
    arena.close()
    del arena
    assert bytes(left) == bytes(8)  # outlives its arena


def test_mappings_are_let_go_of() -> None:
    """When they are idle, and when there are too many."""
    arenas, owners = Arenas(), [Arena(parts=1, part_bytes=64) for _ in range(3)]
    for owner in owners:
        place = owner.take()
        assert place is not None and arenas.part(place, 64) is not None
    arenas.let_go(time.monotonic())
    assert len(arenas) == 3
    arenas.let_go(time.monotonic() + IDLE_S)
    assert len(arenas) == 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("replay.arena.MAX_MAPPED", 2)
        for owner in owners:
            owner.give_back(place)
            taken = owner.take()
            assert taken is not None and arenas.part(taken, 64) is not None
        assert len(arenas) == 2 < MAX_MAPPED


# Through a service


@contextlib.contextmanager
def filled() -> Iterator[Service]:
    with service(FREE) as running:
        writer = Writer(session=running.client, keys=KEYS, spec=SPEC, writer=0, epoch=1)
        writer.append(make_rows(0, 1000))
        assert writer.close(20.0)
        yield running


def test_rows_come_through_shared_memory_or_not_and_are_the_same() -> None:
    with filled() as running:
        separate = open_session(connect=[running.endpoint], shared_memory=False)
        samplers = [
            Sampler(session=session, keys=KEYS, spec=SPEC, batch_size=16, in_flight=2)
            for session in (running.client, separate)
        ]
        for sampler in samplers:
            kept = [
                sampler.sample(20.0) for _ in range(20)
            ]  # more than there are parts
            for batch in kept:
                rows = make_rows(0, 1000)[batch.rows["number"]]
                assert (batch.rows == rows).all()
                assert (batch.ids == batch.rows["number"]).all()
            del batch, kept
            for _ in range(10):
                sampler.sample(20.0)
        assert 10 <= samplers[0].placed < 30 and samplers[1].placed == 0
        separate.close()


def test_a_place_that_is_not_there_is_answered_as_if_there_was_none(
    place: MemoryPlace,
) -> None:
    with filled() as running:
        for wrong in (replace(place, token=bytes(16)), replace(place, pid=2**32 - 1)):
            request = SampleRequest(
                batch_size=2,
                batches=2,
                hold_ms=100,
                ids=np.zeros(0, np.uint64),
                priorities=np.zeros(0),
                place=wrong,
            )
            payload = ask(
                running.client, KEYS.sample, request.encode(SPEC), timeout_s=20.0
            )
            assert payload is not None
            assert len(payload) == 64 + body_bytes(SPEC, 4)
            reply = SampleReply.decode(payload, SPEC)
            assert reply.sample is not None and len(reply.sample.ids) == 4


@contextlib.contextmanager
def reader(
    endpoint: str, batches: int, *before: str
) -> Iterator["subprocess.Popen[str]"]:
    process = subprocess.Popen(
        [
            *before,
            *(sys.executable, "-m", "tests.replay_roles"),
            *("reader", endpoint, str(batches)),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_a_process_of_another_container_gets_the_rows_sent() -> None:
    """Its process number means another process, or none, to the service."""
    namespace = ("unshare", "--pid", "--fork", "--kill-child", "--mount-proc")
    if subprocess.run([*namespace, "true"], capture_output=True).returncode:
        pytest.skip("this machine makes no process namespaces")
    with filled() as running:
        # Answers to what was asked for ahead may have come too.
        for before, placed in (((), {100, 101, 102}), (namespace, {0})):
            with reader(running.endpoint, 100, *before) as process:
                output, _ = process.communicate(timeout=60)
            word, count = output.splitlines()[-1].split()
            assert word == "placed" and int(count) in placed


@pytest.mark.slow
def test_readers_killed_while_they_are_answered_do_no_harm() -> None:
    with filled() as running:
        for _ in range(4):
            with reader(running.endpoint, 10**9) as process:
                assert process.stdout is not None
                assert process.stdout.readline() == "reading\n"
                process.kill()
        sampler = Sampler(session=running.client, keys=KEYS, spec=SPEC, batch_size=8)
        for _ in range(100):
            sampler.sample(20.0)
        assert 100 <= sampler.placed <= 102  # those asked for ahead may have come too
        arenas = running.server._arenas
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("replay.arena.IDLE_S", 0.2)
            assert eventually(lambda: len(arenas) == 0)
