"""The best checkpoint of a run, kept aside: `RUN/best`, in the layout of checkpoints.

    best/000012000/      hard links to the checkpoint's files (copies, where the file
                         system has no links), and judged.json: how it drove
    best/latest          names it

A checkpoint is taken aside before it is judged, for the learner removes old ones. It
comes under its name by a rename, and `latest` is replaced after that: killed at any
moment, the older best is in force.
"""

import contextlib
import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, final

import msgspec

from actors.policy import BEST, LATEST
from launch.config import write_atomically

JUDGED: Final = "judged.json"
_ASIDE: Final = ".candidate"


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """How a checkpoint drove, and how well it knows the expert."""

    updates: int
    scenes: int  # driven
    failure_rate: float
    log_displacement: float  # m
    log_likelihood: float | None = None  # nats, of cloned policies

    def better_than(self, other: "Judgement | None") -> bool:
        """By failure rate, then log displacement, then log-likelihood."""
        return other is None or self._order() < other._order()

    def _order(self) -> tuple[float, float, float]:
        return self.failure_rate, self.log_displacement, -(self.log_likelihood or 0.0)


@final
class BestCheckpoint:
    """`RUN/best`; belongs to one process."""

    def __init__(self, run: Path) -> None:
        """Takes up what an earlier process kept."""
        self._folder = run / BEST
        self.judgement = self._read()

    def take_aside(self, checkpoint: Path) -> Path | None:
        """A checkpoint's files under another name; None: it is being removed."""
        aside = self._folder / _ASIDE
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        try:
            # The descriptor stays at this directory, whatever takes its name.
            source = os.open(checkpoint, os.O_RDONLY)
        except FileNotFoundError:
            return None
        try:
            for name in os.listdir(source):
                _link(name, source, aside / name)
        except FileNotFoundError:
            return None
        finally:
            os.close(source)
        return aside

    def offer(self, aside: Path, judgement: Judgement) -> bool:
        """Keeps what was taken aside if it is better than all before."""
        if not judgement.better_than(self.judgement):
            shutil.rmtree(aside)
            return False
        name = f"{judgement.updates:09d}"
        text = json.dumps(asdict(judgement), indent=1) + "\n"
        write_atomically(aside / JUDGED, text.encode())
        shutil.rmtree(self._folder / name, ignore_errors=True)
        os.rename(aside, self._folder / name)
        write_atomically(self._folder / LATEST, name.encode())
        self.judgement = judgement
        for other in self._folder.iterdir():
            if other.name.isdigit() and other.name != name:
                shutil.rmtree(other)
        return True

    def _read(self) -> Judgement | None:
        """What the checkpoint in force was judged; None where there is none."""
        with contextlib.suppress(OSError, ValueError, msgspec.DecodeError):
            name = (self._folder / LATEST).read_text().strip()
            data = (self._folder / name / JUDGED).read_bytes()
            return msgspec.json.decode(data, type=Judgement)
        return None


def _link(name: str, source: int, to: Path) -> None:
    """Links a file of an open directory, or copies it."""
    try:
        os.link(name, to, src_dir_fd=source)
    except FileNotFoundError:
        raise
    except OSError:
        opened = os.open(name, os.O_RDONLY, dir_fd=source)
        with os.fdopen(opened, "rb") as read, to.open("wb") as write:
            shutil.copyfileobj(read, write)
            write.flush()
            os.fsync(write.fileno())
