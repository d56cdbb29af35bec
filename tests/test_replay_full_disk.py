"""A full disk, a real one: a tmpfs of a few megabytes."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from replay.client import Sampler, Writer, fetch_rows, fetch_stats
from replay.local import LocalReplay, ReplayConfig
from replay.spec import ReplayError
from tests.replay_durable_parts import CHECKED, checked_rows
from tests.replay_parts import KEYS, eventually, service

CONFIG = ReplayConfig(
    capacity=1 << 16,  # 8 MB of rows
    min_size=100,
    samples_per_insert=1.0,
    tolerance=1e6,
    sampler="uniform",
    durable=True,
    preallocate=False,
)


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path]:
    """A file system of that size; skipped where it may not be mounted."""
    folder.mkdir()
    size = f"size={megabytes}m"
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no right to mount a file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def fill(path: Path) -> None:
    """Takes what is left of the disk."""
    with path.open("wb") as file:
        with contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 14))
                file.flush()


def test_what_does_not_fit_is_refused_at_the_start(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 8) as disk:
        whole = ReplayConfig(capacity=1 << 16, durable=True)
        with pytest.raises(ReplayError, match=r"needs 11\.\d MB on the disk.*capacity"):
            LocalReplay(spec=CHECKED, config=whole, seed=0, folder=disk / "replay")


def test_what_was_taken_at_the_start_cannot_run_out(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 16) as disk:
        whole = ReplayConfig(
            capacity=1 << 16,
            min_size=1 << 16,
            tolerance=1.0,
            sampler="uniform",
            durable=True,
        )
        replay = LocalReplay(spec=CHECKED, config=whole, seed=0, folder=disk / "replay")
        fill(disk / "other")
        assert os.statvfs(disk).f_bavail == 0
        rows = CHECKED.as_bytes(checked_rows(0, 1 << 12, writer=1))
        for _ in range(16):
            assert replay.durable is not None
            replay.durable.wait()
            assert replay.may_insert(len(rows))
            replay.insert_bytes(rows)
        replay.durable.sync()
        assert replay.fault == ""
        replay.close()


def test_a_full_disk_stops_inserts_loses_nothing_and_goes_on_with_space(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        small_disk(tmp_path / "disk", 8) as disk,
        service(CONFIG, spec=CHECKED, folder=disk / "replay") as running,
    ):
        writer = Writer(
            session=running.client,
            keys=KEYS,
            spec=CHECKED,
            writer=2,
            epoch=1,
            batch_rows=64,
            hold_s=0.1,
        )
        sampler = Sampler(
            session=running.client, keys=KEYS, spec=CHECKED, batch_size=32, hold_s=0.3
        )
        start = 0

        def write(count: int) -> None:
            nonlocal start
            for _ in range(count):
                assert writer.append(checked_rows(start, 64, writer=2), 10.0)
                start += 64

        write(10)
        fill(disk / "other")
        rows = checked_rows(start, 64, writer=2)
        while writer.append(rows, 3.0):
            start += 64
            rows = checked_rows(start, 64, writer=2)
        # What did not fit is in the writer, whole.
        stats = fetch_stats(running.client, KEYS)
        assert "no room for more rows (No space left on device)" in stats["fault"]
        assert stats["inserts"] == writer.acknowledged < start
        for _ in range(5):
            assert len(sampler.sample(10.0).ids) == 32
        (disk / "other").unlink()
        assert eventually(lambda: fetch_stats(running.client, KEYS)["fault"] == "")
        start += 64
        write(10)
        assert writer.close(20.0)
        pages = list(fetch_rows(session=running.client, keys=KEYS, spec=CHECKED))
        got = np.concatenate([page.rows for page in pages])
        np.testing.assert_array_equal(got, checked_rows(0, start, writer=2))
    told = capfd.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in told] == ["inserts stop", "inserts go on"]


def test_a_limit_on_file_sizes_is_told(tmp_path: Path) -> None:
    """`ulimit -f`, in a process of its own."""
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (4 << 20,) * 2);"
        "from pathlib import Path; from replay.local import *;"
        "from tests.replay_durable_parts import CHECKED;"
        "LocalReplay(spec=CHECKED, config=ReplayConfig(capacity=65536, durable=True),"
        f" seed=0, folder=Path({str(tmp_path)!r}))"
    )
    got = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
    )
    assert "rows.bin: cannot be mapped: File too large" in got.stderr
