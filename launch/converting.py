"""Scenes into a bank before the eyes of a person: progress, reports and a summary.

What cannot be read is reported, by file and offset, and passed over; so are scenes
that came before under the same id, and scenes of another step length than the bank's,
which is the first scene's or the one that was asked for. None of it is silent: the
summary counts them, and the objects for which there was no slot.

While it goes on, work files lie beside the bank in BANK.parts; a conversion that was
killed or ran out of disk goes on from them when the same command is given again. They
need as much room as the bank itself, which is written from them at the end.
"""

import dataclasses
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from launch.errors import LaunchError
from sim.bank import BankError
from sim.bank_writer import write_parts
from sim.conversion import Conversion, converted, working_in
from sim.parts import Part
from sim.places import Found
from sim.scene import SceneError

_PLAIN_S: Final = 10.0  # between two lines where nobody looks at a screen

Places = Callable[[], Iterator[Found]]


def say(line: str) -> None:
    """For a person; standard output is kept for results."""
    print(line, file=sys.stderr, flush=True)


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0))


def _counted(count: int, noun: str) -> str:
    """A number and what it counts."""
    return f"{count} {noun}{'s' if count != 1 else ''}"


@dataclass(frozen=True, kw_only=True)
class Tally:
    """What became of the records."""

    records: int = 0  # that there are
    scenes: int = 0  # in the bank
    bad: int = 0  # records that could not be read or converted
    repeated: int = 0  # scenes whose id came before
    other_dt: int = 0  # scenes of another step length
    cut: int = 0  # scenes with more objects than slots
    dropped: int = 0  # their objects without a slot
    left_out: int = 0  # map features of unknown kinds or without points
    resumed: int = 0  # records that an earlier conversion had converted

    @property
    def settled(self) -> int:
        """Records that have been dealt with."""
        return self.scenes + self.bad + self.repeated + self.other_dt

    @property
    def complete(self) -> bool:
        """Whether every scene that was named is in the bank."""
        return not self.bad and not self.other_dt

    def words(self) -> str:
        """What a summary adds to the number of scenes, if anything."""
        said = (
            (self.bad, f"{_counted(self.bad, 'record')} could not be read"),
            (self.repeated, f"{_counted(self.repeated, 'scene')} repeated"),
            (
                self.other_dt,
                f"{_counted(self.other_dt, 'scene')} of another step length",
            ),
            (
                self.cut,
                f"{_counted(self.dropped, 'object')} of {_counted(self.cut, 'scene')} "
                "without a slot",
            ),
            (
                self.left_out,
                f"{_counted(self.left_out, 'map feature')} could not be used",
            ),
            (self.resumed, f"{_counted(self.resumed, 'record')} converted before"),
        )
        return "".join(f"; {words}" for count, words in said if count)


@final
class _Shown:
    """Progress: a bar on a terminal, else a line every few seconds."""

    def __init__(self, stack: ExitStack, name: str) -> None:
        """Shows until the stack is closed."""
        self._name, self._total = name, 0
        self._said = time.monotonic()
        console = Console(stderr=True)
        self._task: TaskID | None = None
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=console,
            transient=True,
        )
        if console.is_terminal:
            stack.enter_context(self._bar)
            self._task = self._bar.add_task(name, total=None)

    def begin(self, what: str, total: int) -> None:
        """From here on `what` is counted."""
        self._total, self._what = total, what
        if self._task is not None:
            name = f"{self._name}: {what}"
            self._bar.update(self._task, description=name, total=total, completed=0)

    def at(self, count: int) -> None:
        """So many have been dealt with."""
        if self._task is not None:
            self._bar.update(self._task, completed=count)
        elif time.monotonic() - self._said > _PLAIN_S:
            self._said = time.monotonic()
            say(f"{self._name}: {self._what} {count} of {self._total}")

    def say(self, line: str) -> None:
        """A line above the bar."""
        if self._task is not None:
            self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        else:
            say(line)


@final
class Gathered:
    """The converted scenes of a folder of work files."""

    def __init__(self, shown: _Shown, folder: Path) -> None:
        """Nothing has been gathered."""
        self.parts: list[Part] = []
        self.tally = Tally()
        self._shown, self._folder = shown, folder
        self._first: dict[str, str] = {}  # where a scene's id came from
        self._held: list[str] = []  # reports from before the first scene

    def gather(
        self, places: Places, conversion: Conversion, dt: float | None = None
    ) -> None:
        """Converts all scenes; LaunchError if there is none."""
        self._count(records=sum(1 for _ in places()))
        self._shown.begin("record", self.tally.records)
        try:
            for outcome in converted(places(), conversion):
                self._count(resumed=self.tally.resumed + outcome.found)
                self._take(outcome.result, dt)
                self._shown.at(self.tally.settled)
        except OSError as error:
            raise self._stopped(str(error.strerror or error)) from error
        if not self.parts:
            raise self._nothing()

    def write(self, path: Path, parts: Sequence[Part]) -> None:
        """Makes a bank of some of the parts."""
        self._shown.begin("written", len(parts))
        try:
            write_parts(parts, path, progress=self._shown.at)
        except BankError as error:
            raise self._stopped(str(error)) from error

    def _stopped(self, why: str) -> LaunchError:
        return LaunchError(
            f"{why}; {self.tally.settled} of {self.tally.records} records are "
            f"converted in {self._folder}, the same command goes on from there"
        )

    def _nothing(self) -> LaunchError:
        """Every record was bad, or there was none."""
        first, *others = self._held or ["holds no scene; name a file or folder of them"]
        for line in others:
            self._shown.say(line)
        more = f" (nor could the {len(others)} other records be read)" if others else ""
        return LaunchError(first.removeprefix("passed over: ") + more)

    def _take(self, result: Part | SceneError, dt: float | None) -> None:
        if isinstance(result, SceneError):
            self._count(bad=self.tally.bad + 1)
            self._report(str(result))
            return
        expected = dt or (self.parts[0].dt if self.parts else result.dt)
        if abs(result.dt - expected) > 1e-6:
            self._count(other_dt=self.tally.other_dt + 1)
            self._report(
                f"{result.source}: steps of {result.dt:g} s, the bank's are "
                f"{expected:g} s; make a bank of its own, with --dt {result.dt:g}"
            )
        elif result.scenario_id in self._first:
            self._count(repeated=self.tally.repeated + 1)
            first = self._first[result.scenario_id]
            self._report(
                f"{result.source}: scenario {result.scenario_id} was in {first}"
            )
        else:
            self._keep(result)

    def _keep(self, part: Part) -> None:
        for line in self._held:
            self._shown.say(line)
        self._held = []
        self.parts.append(part)
        self._first[part.scenario_id] = part.source
        self._count(
            scenes=len(self.parts),
            cut=self.tally.cut + (part.dropped > 0),
            dropped=self.tally.dropped + part.dropped,
            left_out=self.tally.left_out + part.left_out,
        )

    def _report(self, line: str) -> None:
        """Until there is a scene a report is held: a single one becomes the error."""
        line = f"passed over: {line}"
        if self.parts:
            self._shown.say(line)
        else:
            self._held.append(line)

    def _count(self, **counts: int) -> None:
        self.tally = dataclasses.replace(self.tally, **counts)


@contextmanager
def gathering(folder: Path, *, keep: bool) -> Iterator[Gathered]:
    """Work files in a folder, removed once the block has ended well.

    `keep` says whether they stay for another time if it has not.
    """
    with ExitStack() as stack:
        if not keep:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
        stack.enter_context(working_in(folder))
        shown = stack.enter_context(ExitStack())
        gathered = Gathered(_Shown(shown, folder.name.removesuffix(".parts")), folder)
        try:
            yield gathered
        except LaunchError:
            if not gathered.parts:  # there is nothing to go on from
                shutil.rmtree(folder, ignore_errors=True)
            raise
        except KeyboardInterrupt:
            if keep and gathered.tally.settled:
                tally = gathered.tally
                say(
                    f"{tally.settled} of {tally.records} records are converted; the "
                    "same command goes on from there"
                )
            raise
