"""A day in ten minutes: the durable replay at full rate, and random kills.

    python -m launch.bench_soak --seconds 600 --json soak.json

A service, writers and two readers, each a process. In the first half one of them is
killed every few seconds; in the second half only writers and readers are, so that the
service lives long enough for a leak to show. One writer and one reader are never
killed: they live through all reconnections. Every row is looked at once as it comes.

What must hold, and is said line by line at the end:

    rows      ids without a gap, every row as written, numbers of each writer's life
              from 0 on in order, and all that were told to be acknowledged
    ratio     the samples owed never exceed the limiter's tolerance, either way
    memory    of each life longer than a third of the half: the line of least squares
              after its warm-up grows by at most 6% and 4 MiB
    handles   open files and threads of such a life: at most 4 more at its end
    storage   the replay's folder and the shared memory that the soak's own processes
              have mapped grow no more once the ring is full
"""

import argparse
import contextlib
import json
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import psutil

from launch.bench_soak_roles import CONFIG, KEYS, SPEC, are_whole
from replay.client import fetch_rows, fetch_stats
from replay.session import open_session
from replay.spec import ReplayError

_LOOK_S: Final = 2.0
_KILL_S: Final = 6.0  # on average, between kills
_MARGIN: Final = 4 << 20  # bytes a life may grow beside 6%
_SHARED: Final = "/dev/shm/"


@final
class Child:
    """A process of the soak; the last line that it printed."""

    def __init__(self, role: str, *arguments: object) -> None:
        """Begins at once."""
        self.role = role
        self.began = time.monotonic()
        self.told: list[int] = [0]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "launch.bench_soak_roles", role.split()[0]]
            + [str(argument) for argument in arguments],
            stdout=subprocess.PIPE,
            text=True,
        )
        self._watched = psutil.Process(self._process.pid)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.endswith("\n") and line[:1].isdigit():
                self.told = [int(word) for word in line.split()]

    def look(self) -> dict[str, float]:
        """Memory in bytes, files and threads."""
        with self._watched.oneshot():
            status = Path(f"/proc/{self._process.pid}/status").read_text()
            anonymous = status.partition("RssAnon:")[2].split()[0]
            return {
                "age_s": time.monotonic() - self.began,
                "resident": self._watched.memory_info().rss,
                # Not the pages of the table's files: the machine may take them back.
                "own": 1024 * int(anonymous),
                "files": self._watched.num_fds(),
                "threads": self._watched.num_threads(),
            }

    def segments(self) -> set[str]:
        """Named shared memory that it has mapped, also what others made."""
        maps = Path(f"/proc/{self._process.pid}/maps").read_text().split()
        return {word for word in maps if word.startswith(_SHARED)}

    def end(self, *, kill: bool) -> None:
        """kill -9, or SIGTERM and a minute."""
        if not kill:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(60.0)
        self._process.kill()
        self._process.wait()
        self._thread.join()


@final
@dataclass
class Rows:
    """Looks at every row once, in the order of their ids."""

    next_id: int = 0
    unseen: int = 0  # pushed out before they were looked at
    damaged: int = 0
    misplaced: int = 0  # not the next number of their writer's life
    counts: dict[tuple[int, int], int] = field(default_factory=dict)

    def look(self, session: Any) -> None:  # noqa: ANN401 (Zenoh stays in replay)
        """Takes in all that came since."""
        pages = fetch_rows(
            session=session,
            keys=KEYS,
            spec=SPEC,
            first_id=self.next_id,
            page_rows=16384,
        )
        for page in pages:
            if len(page.ids) < 4096:
                # The last page: what came while the others were read can wait.
                self._take(page.ids, page.rows)
                return
            self._take(page.ids, page.rows)

    def _take(self, ids: np.ndarray, rows: np.ndarray) -> None:
        skipped = int(ids[0]) - self.next_id
        self.unseen += skipped
        # Within a page an id cannot be skipped but by losing a row.
        self.misplaced += int(ids[-1]) - int(ids[0]) + 1 - len(ids)
        self.next_id = int(ids[-1]) + 1
        self.damaged += int((~are_whole(rows)).sum())
        lives = np.stack([rows["writer"], rows["life"]], axis=1)
        for writer, life in np.unique(lives, axis=0):
            numbers = rows["number"][(lives == (writer, life)).all(axis=1)]
            key = (int(writer), int(life))
            first = int(numbers[0]) if skipped else self.counts.get(key, 0)
            expected = np.arange(first, first + len(numbers))
            self.misplaced += int((numbers != expected).sum())
            self.counts[key] = int(numbers[-1]) + 1


@final
class Soak:
    """The processes, who is killed when, and what was seen."""

    def __init__(
        self, folder: Path, *, seconds: float, writers: int, seed: int
    ) -> None:
        """Starts everything; writer 0 and reader 0 are never killed."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self._folder = folder
        self._seconds = seconds
        self._chance = random.Random(seed)
        self._lives: dict[str, int] = {}
        self.acknowledged: dict[tuple[int, int], int] = {}
        self.received_damaged = 0
        self.kills: dict[str, int] = {"service": 0, "writer": 0, "reader": 0}
        self.rows = Rows()
        names = ["service", *(f"writer {n}" for n in range(writers))]
        self._children: dict[str, Child] = {}
        for name in [*names, "reader 0", "reader 1"]:
            self._start(name)
        self._session: Any = open_session(connect=[self._endpoint], timeout_s=60.0)

    def _start(self, name: str) -> None:
        life = self._lives[name] = self._lives.get(name, 0) + 1
        arguments: dict[str, list[object]] = {
            "service": [self._endpoint, self._folder],
            "writer": [self._endpoint, *name.split()[1:], life],
            "reader": [self._endpoint],
        }
        self._children[name] = Child(name, *arguments[name.split()[0]])

    def _end(self, name: str, *, kill: bool) -> None:
        child = self._children.pop(name)
        child.end(kill=kill)
        role, *number = name.split()
        if role == "writer":
            self.acknowledged[int(number[0]), self._lives[name]] = child.told[0]
        elif role == "reader":
            self.received_damaged += child.told[-1] if len(child.told) == 2 else 0

    def _kill_one(self, *, service: bool) -> None:
        """kill -9 of one that may be, and a new one in its place."""
        kept = {"writer 0", "reader 0"} | (set() if service else {"service"})
        names = sorted(self._children.keys() - kept)
        # Each role as often as the others, however many processes it has.
        role = self._chance.choice(sorted({name.split()[0] for name in names}))
        name = self._chance.choice([n for n in names if n.split()[0] == role])
        self._end(name, kill=True)
        self._start(name)
        self.kills[role] += 1

    def run(self) -> Iterator[dict[str, Any]]:
        """A look every two seconds."""
        began = looked = time.monotonic()
        kill_at = began + 3 * _KILL_S
        while (now := time.monotonic()) < began + self._seconds:
            if now > kill_at:
                kill_at = now + self._chance.expovariate(1.0 / _KILL_S)
                self._kill_one(service=now < began + self._seconds / 2)
            with contextlib.suppress(ReplayError):  # the service is being restarted
                self.rows.look(self._session)
            if now > looked + _LOOK_S:
                looked = now
                yield {"seconds": now - began, **self._look()}
            time.sleep(0.05)

    def _look(self) -> dict[str, Any]:
        files = [path.stat() for path in self._folder.rglob("*") if path.is_file()]
        look: dict[str, Any] = {
            "processes": {
                f"{name}, life {self._lives[name]}": child.look()
                for name, child in self._children.items()
            },
            "disk_bytes": 512 * sum(stat.st_blocks for stat in files),
            "shared_bytes": self._shared_bytes(),
        }
        with contextlib.suppress(ReplayError):
            stats = fetch_stats(self._session, KEYS, timeout=2.0)
            for name in ("inserts", "samples", "debt", "tolerance", "insert_rate"):
                look[name] = stats[name]
        return look

    def _shared_bytes(self) -> int:
        segments = [child.segments() for child in self._children.values()]
        taken = 0
        for name in set().union(*segments):
            with contextlib.suppress(FileNotFoundError):  # unmapped meanwhile
                taken += 512 * Path(name).stat().st_blocks
        return taken

    def close(self) -> dict[str, Any]:
        """Ends the clients, looks at the last rows, ends the service."""
        stats: dict[str, Any] = {}
        try:
            for name in sorted(self._children.keys() - {"service"}, reverse=True):
                self._end(name, kill=False)
            deadline = time.monotonic() + 60.0
            stats = fetch_stats(self._session, KEYS, timeout=20.0)
            while self.rows.next_id < stats["inserts"]:
                self.rows.look(self._session)
                if time.monotonic() > deadline:
                    break
        finally:
            self._session.close()
            for name in list(self._children):
                self._end(name, kill=False)
        return stats


def growth(ages: np.ndarray, values: np.ndarray) -> float:
    """What the line of least squares rises over the time, as a number of bytes."""
    slope = np.polyfit(ages, values, 1)[0]
    return float(slope * (ages[-1] - ages[0]))


def _lives(looks: list[dict[str, Any]], least_s: float) -> dict[str, list[Any]]:
    """What was seen of each long life after its warm-up, a quarter of it."""
    lives: dict[str, list[Any]] = {}
    for look in looks:
        for name, seen in look["processes"].items():
            lives.setdefault(name, []).append(seen)
    for name, seen in list(lives.items()):
        oldest = seen[-1]["age_s"]
        lives[name] = [one for one in seen if one["age_s"] > oldest / 4]
        if oldest < least_s or len(lives[name]) < 4:
            del lives[name]
    return lives


def _storage_faults(looks: list[dict[str, Any]]) -> list[str]:
    """Disk and shared memory, from a third of the time on."""
    faults, later = [], looks[len(looks) // 3 :]
    for name in ("disk_bytes", "shared_bytes"):
        values = np.array([look[name] for look in later], float)
        rise = growth(np.array([look["seconds"] for look in later]), values)
        if rise > 0.06 * values.mean() + _MARGIN:
            faults.append(f"storage: {name} grew by {rise / 2**20:.1f} MiB")
    return faults


def _life_faults(name: str, seen: list[Any], rise: float) -> list[str]:
    """A long life's memory, open files and threads."""
    faults, own = [], np.mean([one["own"] for one in seen])
    if rise > 0.06 * own + _MARGIN:
        faults.append(f"memory: {name} grew by {rise / 2**20:.1f} MiB")
    third = max(1, len(seen) // 3)
    for what in ("files", "threads"):
        early = max(one[what] for one in seen[:third])
        if min(one[what] for one in seen[-third:]) > early + 4:
            faults.append(f"handles: {name} has more and more {what}")
    return faults


def _row_faults(soak: Soak, stats: dict[str, Any]) -> list[str]:
    """What was not there, not once, or not as written."""
    rows, faults = soak.rows, []
    for key, told in soak.acknowledged.items():
        if rows.counts.get(key, 0) < told:
            faults.append(f"rows: {told} acknowledged of {key}, not all there")
    if rows.damaged or rows.misplaced or soak.received_damaged:
        faults.append(
            f"rows: {rows.damaged} damaged, {rows.misplaced} misplaced, "
            f"{soak.received_damaged} damaged in samples"
        )
    if stats["inserts"] != rows.next_id:
        faults.append(f"rows: {stats['inserts']} counted, {rows.next_id} there")
    return faults


def verdict(
    looks: list[dict[str, Any]], soak: Soak, stats: dict[str, Any], seconds: float
) -> dict[str, Any]:
    """What did not hold, and the figures."""
    faults, growths = _storage_faults(looks) + _row_faults(soak, stats), {}
    for name, seen in _lives(looks, seconds / 6).items():
        ages = np.array([one["age_s"] for one in seen])
        growths[name] = growth(ages, np.array([one["own"] for one in seen], float))
        faults += _life_faults(name, seen, growths[name])
    owed = [abs(look["debt"]) / look["tolerance"] for look in looks if "debt" in look]
    if not owed or max(owed) > 1.0:
        faults.append(f"ratio: at most {max(owed, default=0):.3f} tolerances owed")
    return {
        "verdict": "held" if not faults else "failed",
        "faults": faults,
        "inserts": stats["inserts"],
        "samples": stats["samples"],
        "ratio": stats["samples"] / max(1, stats["inserts"] - CONFIG.min_size),
        "most_owed_of_tolerance": max(owed, default=None),
        "unseen_rows": soak.rows.unseen,
        "kills": soak.kills,
        "growth_bytes": growths,
        "shared_bytes": [
            look["shared_bytes"] for look in looks[:: max(1, len(looks) // 20)]
        ],
    }


def soak(
    seconds: float, *, writers: int = 4, seed: int = 0
) -> Iterator[dict[str, Any]]:
    """Yields a look every two seconds and the verdict at the end."""
    looks: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        running = Soak(
            Path(name) / "replay", seconds=seconds, writers=writers, seed=seed
        )
        try:
            for look in running.run():
                looks.append(look)
                yield look
        finally:
            stats = running.close()
        yield verdict(looks, running, stats, seconds)


def main() -> int:
    """Prints a line per look and the verdict; 1 if something did not hold."""
    parser = argparse.ArgumentParser(description="soak of the replay with random kills")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--writers", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args()
    seen: list[dict[str, Any]] = []
    for look in soak(options.seconds, writers=options.writers, seed=options.seed):
        seen.append(look)
        if "seconds" in look:
            print(
                f"{look['seconds']:6.0f} s  {look.get('inserts', 0):>10} rows  "
                f"{look.get('insert_rate', 0.0):8.0f}/s  "
                f"debt {look.get('debt', 0):6.0f}",
                flush=True,
            )
    print(json.dumps(seen[-1], indent=1))
    if options.json is not None:
        options.json.write_text(json.dumps(seen))
    return int(seen[-1]["verdict"] != "held")


if __name__ == "__main__":
    sys.exit(main())
