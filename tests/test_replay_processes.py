"""Writers and services that are processes of their own, and kill -9."""

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import zenoh

from replay.client import Writer, fetch_rows, fetch_stats
from replay.spec import ReplayError
from tests.replay_parts import (
    KEYS,
    OPEN,
    SPEC,
    eventually,
    free_endpoint,
    make_rows,
    service,
    session_to,
)

ROOT = Path(__file__).parent.parent


@contextlib.contextmanager
def role(*arguments: object) -> Iterator["subprocess.Popen[str]"]:
    """A process of `tests.replay_roles`; killed at the end if it still runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.replay_roles", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def read_until(process: "subprocess.Popen[str]", acknowledged: int) -> int:
    """Reads the writer's reports until it has told of that many rows."""
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= acknowledged:
            return int(line)
    raise AssertionError("the writer ended early")


def numbers_of(session: zenoh.Session, writer: int) -> list[int]:
    """All stored numbers of a writer, in the order of insertion."""
    rows = np.concatenate(
        [p.rows for p in fetch_rows(session=session, keys=KEYS, spec=SPEC)]
    )
    return [int(n) for n in rows["number"][rows["writer"] == writer]]


def test_a_killed_writer_stores_every_acknowledged_row_exactly_once() -> None:
    """kill -9 in mid-stream, twice; then a life that ends by itself."""
    with service(OPEN) as running:
        told: dict[int, int] = {}
        for epoch in (0, 1):
            with role("writer", running.endpoint, 3, epoch, 500_000) as process:
                told[epoch] = read_until(process, 500)
                process.kill()
                process.wait()
                assert process.stdout is not None
                told[epoch] = max([told[epoch], *map(int, process.stdout)])
        with role("writer", running.endpoint, 3, 2, 1000) as process:
            output, _ = process.communicate(timeout=60)
            assert output.splitlines()[-1] == "all 1000"
        told[2] = 1000
        numbers = numbers_of(running.client, 3)
        for epoch, acknowledged in told.items():
            life = [n - epoch * 10**6 for n in numbers if n // 10**6 == epoch]
            # In order, without a hole or a repeat, and at least what was confirmed;
            # what was stored but not confirmed is at most the window.
            assert life == list(range(len(life)))
            assert acknowledged <= len(life)
        (stats,) = fetch_stats(running.client, KEYS)["writers"]
        assert (stats["epoch"], stats["next_sequence"]) == (2, 100)
        assert stats["rows"] == len(numbers)


def wait_for_service(process: "subprocess.Popen[str]") -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"


def has_rows(session: zenoh.Session, count: int) -> bool:
    """Whether a service answers and holds that many rows."""
    try:
        return bool(fetch_stats(session, KEYS)["inserts"] >= count)
    except ReplayError:
        return False


def test_a_writer_outlives_a_killed_service() -> None:
    """The service comes back empty; nothing that it then holds is twice or missing."""
    endpoint = free_endpoint()
    stop, appended = threading.Event(), [0]
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(role("service", endpoint))
        wait_for_service(first)
        session = stack.enter_context(session_to(endpoint))
        writer = Writer(
            session=session, keys=KEYS, spec=SPEC, writer=4, epoch=9, batch_rows=10
        )

        def write() -> None:
            while not stop.is_set():
                # Fewer than the table holds by far: nothing is pushed out.
                stop.wait(0.001)
                writer.append(make_rows(appended[0], 10, writer=4))
                appended[0] += 10

        thread = threading.Thread(target=write)
        thread.start()
        try:
            assert eventually(lambda: has_rows(session, 300))
            first.kill()
            first.wait()
            # Answers that were on the way have been read once a query has failed.
            assert eventually(lambda: writer.resent >= 1)
            before = writer.acknowledged
            second = stack.enter_context(role("service", endpoint))
            wait_for_service(second)
            assert eventually(lambda: has_rows(session, 300))
        finally:
            stop.set()
            thread.join()
        assert writer.close(30.0)
        assert writer.acknowledged == appended[0] > before
        assert writer.resent >= 1
        numbers = numbers_of(session, 4)
        # The second service begins where the first one's acknowledgements end, or
        # one batch earlier, if the last acknowledgement did not get through.
        assert numbers == list(range(numbers[0], appended[0]))
        assert numbers[0] <= before
        assert second.poll() is None
        second.terminate()
        assert second.wait(timeout=20) == 0


def test_the_client_side_does_not_import_torch_or_jax() -> None:
    modules = (
        "replay.client, replay.writer, replay.weights, replay.channels, replay.files,"
        "replay.server, replay.local"
    )
    code = f"import {modules}, sys; print(*({{'torch', 'jax'}} & set(sys.modules)))"
    got = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True
    )
    assert (got.stdout.strip(), got.returncode) == ("", 0), got.stderr
