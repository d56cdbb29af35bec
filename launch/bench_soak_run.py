"""The processes of the soak: who is killed when, and what is seen of them and of rows.

Every row is looked at once, in the order of their ids, as it comes.
"""

import contextlib
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import psutil

from launch.bench_soak_roles import KEYS, SPEC, are_whole
from launch.join import free_port
from replay.client import fetch_rows, fetch_stats
from replay.session import open_session
from replay.spec import ReplayError

Look = dict[str, Any]
KEPT: Final = ("writer 0", "reader 0", "reader 1")  # never killed
WAYS: Final = ("memory", "stream")  # by which rows come to a reader
_LOOK_S: Final = 2.0
_MARK_S: Final = 0.2
_KILL_S: Final = 6.0  # on average, between kills
_END_S: Final = 60.0  # for a process to end when asked


@final
class Child:
    """A process of the soak; the last line that it printed."""

    def __init__(self, role: str, *arguments: object, log: Path) -> None:
        """Begins at once; what it complains of is added to `log`."""
        self.began = time.monotonic()
        self.told: list[int] = [0]
        with log.open("ab") as words:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "launch.bench_soak_roles", role]
                + [str(argument) for argument in arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=words,
                text=True,
                start_new_session=True,  # Ctrl-C is the bench's to handle
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
            kinds = ("RssAnon:", "RssShmem:")
            held = [int(status.partition(kind)[2].split()[0]) for kind in kinds]
            return {
                "age_s": time.monotonic() - self.began,
                "resident": self._watched.memory_info().rss,
                # Not the pages of the table's files: the machine may take them back.
                "own": 1024 * sum(held),
                "files": self._watched.num_fds(),
                "threads": self._watched.num_threads(),
            }

    def end(self, *, kill: bool) -> None:
        """kill -9, or SIGTERM and a minute."""
        if not kill:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_S)
        self._process.kill()
        self._process.wait()
        self._thread.join()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()


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
            self.take(page.ids, page.rows)
            if len(page.ids) < 4096:
                return  # what came while the others were read can wait

    def take(self, ids: np.ndarray, rows: np.ndarray) -> None:
        """A page, in the order of ids."""
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
    """Starts, kills and looks."""

    def __init__(
        self, folder: Path, *, seconds: float, writers: int, seed: int
    ) -> None:
        """Starts everything."""
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._folder = folder
        self._seconds = seconds
        self._chance = random.Random(seed)
        self._lives: dict[str, int] = {}
        self.acknowledged: dict[tuple[int, int], int] = {}
        self.received = [0, 0]  # rows by readers, and how many of them were damaged
        self.answers = dict.fromkeys(WAYS, 0)  # that came to a reader its way
        self.marks: list[tuple[int, int]] = []  # the service's (inserts, samples)
        self.kills = {"service": 0, "writer": 0, "reader": 0}
        self.rows = Rows()
        self._children: dict[str, Child] = {}
        names = [f"writer {n}" for n in range(writers)]
        try:
            for name in ["service", *names, "reader 0", "reader 1", "reader 2"]:
                self._start(name)
            self._session: Any = open_session(
                connect=[self._endpoint], timeout_s=_END_S
            )
        except BaseException:
            self.abandon()
            raise

    def _start(self, name: str) -> None:
        life = self._lives[name] = self._lives.get(name, 0) + 1
        role, *number = name.split()
        more: dict[str, list[object]] = {
            "service": [self._folder / "replay"],
            "writer": [*number, life],
            "reader": [self._way(name)],
        }
        log = self._folder / "log"
        self._children[name] = Child(role, self._endpoint, *more[role], log=log)

    def _way(self, name: str) -> str:
        """A reader's; of one that is killed, each of its lives another."""
        turn = int(name.split()[-1]) if name in KEPT else self._lives[name]
        return WAYS[turn % len(WAYS)]

    def _end(self, name: str, *, kill: bool) -> None:
        child = self._children.pop(name)
        child.end(kill=kill)
        role, *number = name.split()
        if role == "writer":
            self.acknowledged[int(number[0]), self._lives[name]] = child.told[0]
        elif role == "reader" and len(child.told) == 3:
            self.received[0] += child.told[0]
            self.received[1] += child.told[1]
            self.answers[self._way(name)] += child.told[2]

    def _kill_one(self, *, service: bool) -> None:
        """kill -9 of one that may be, and a new one in its place."""
        kept = {*KEPT} | (set() if service else {"service"})
        names = sorted(self._children.keys() - kept)
        # Each role as often as the others, however many processes it has.
        role = self._chance.choice(sorted({name.split()[0] for name in names}))
        name = self._chance.choice([n for n in names if n.split()[0] == role])
        self._end(name, kill=True)
        self._start(name)
        self.kills[role] += 1

    def run(self) -> Iterator[Look]:
        """A look every two seconds."""
        began = looked = time.monotonic()
        kill_at, mark_at = began + 3 * _KILL_S, began
        while (now := time.monotonic()) < began + self._seconds:
            if now > kill_at:
                kill_at = now + self._chance.expovariate(1.0 / _KILL_S)
                self._kill_one(service=now < began + self._seconds / 2)
            with contextlib.suppress(ReplayError):  # the service is being restarted
                self.rows.look(self._session)
                if now > mark_at:
                    mark_at = now + _MARK_S
                    self._mark(fetch_stats(self._session, KEYS, timeout=2.0))
            if now > looked + _LOOK_S:
                looked = now
                yield {"seconds": now - began, **self._look()}
            time.sleep(0.05)

    def _mark(self, stats: dict[str, Any]) -> None:
        self.marks.append((stats["inserts"], stats["samples"]))

    def _look(self) -> Look:
        files = (self._folder / "replay").rglob("*")
        stats = [path.stat() for path in files if path.is_file()]
        look: Look = {
            "processes": {
                f"{name}, life {self._lives[name]}": child.look()
                for name, child in self._children.items()
            },
            "disk_bytes": 512 * sum(stat.st_blocks for stat in stats),
            "kills": dict(self.kills),
        }
        with contextlib.suppress(ReplayError):
            told = fetch_stats(self._session, KEYS, timeout=2.0)
            self._mark(told)
            for name in ("inserts", "samples", "debt", "tolerance"):
                look[name] = told[name]
        return look

    def finish(self) -> dict[str, Any]:
        """Ends the clients, looks at the last rows, ends the service; its counters."""
        for name in sorted(self._children.keys() - {"service"}, reverse=True):
            self._end(name, kill=False)
        deadline = time.monotonic() + _END_S
        stats = fetch_stats(self._session, KEYS, timeout=20.0)
        self._mark(stats)
        while self.rows.next_id < stats["inserts"] and time.monotonic() < deadline:
            self.rows.look(self._session)
        self._session.close()
        self._end("service", kill=False)
        return stats

    def abandon(self) -> None:
        """Kills what still runs; harmless after `finish`."""
        for name in list(self._children):
            self._end(name, kill=True)
