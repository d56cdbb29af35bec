"""Converts scenes in several processes, into work files from which it can go on.

The caller's process finds the places and hands them out; workers read, parse and
convert, and put each scene into a work file, whose name is a hash of the place's key,
the options and this package's own source: what has changed in the meantime is
converted anew, all else is found again. At most a few scenes per worker wait, so that
memory does not grow with the number of scenes (but for a few hundred bytes each).

Where a worker is killed (as for want of memory), what waited then is converted again,
one scene at a time, which tells whose fault it was; the others go on.

Workers end when the pipe that they hold the reading end of is closed, which the kernel
does when the caller's process is killed: none outlives it, and none is waited for.
"""

import fcntl
import hashlib
import itertools
import multiprocessing
import os
import shutil
import signal
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import NamedTuple

from sim.parts import Part, is_whole, part_of, read_part, write_failure, write_part
from sim.places import AbstractPlace, Found
from sim.scene import SceneError
from sim.slots import keep_nearest

FEW = 12  # scenes: for fewer, starting processes costs more than it saves
_WAITING = 8  # scenes per worker
_MOST_KILLED = 3  # processes: more, and it is not the scenes


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """How scenes are converted."""

    folder: Path  # of the work files
    slots: int = 0  # objects a scene keeps at most; 0: all
    workers: int = 1  # processes


class Outcome(NamedTuple):
    """What became of a place."""

    result: Part | SceneError
    found: bool  # whether an earlier conversion had got it
    killed: bool = False  # whether the process was that converted it


_Waiting = tuple[Found, Outcome | Future[str] | None]


def work_folder(path: Path) -> Path:
    """Where the work files of a bank are, beside it."""
    return path.with_name(f"{path.name}.parts")


@contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Holds a folder for work files, for one process at a time.

    It stays if the block fails, for the next time, and is removed if it does not.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    with ExitStack() as stack:
        stack.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise SceneError(
                f"{folder}: another process converts into this bank; wait for it"
            ) from error
        yield
        shutil.rmtree(folder)


def converted(places: Iterable[Found], conversion: Conversion) -> Iterator[Outcome]:
    """Converts what is not converted yet; outcomes come in the places' order.

    The caller's main module must be guarded by `if __name__ == "__main__"`: it is
    imported by the workers.
    """
    settled = ((place, _done(place, conversion)) for place in places)
    first = list(itertools.islice(settled, FEW))
    if conversion.workers < 2 or len(first) < FEW:
        for place, outcome in itertools.chain(first, settled):
            yield outcome or _outcome(place, _convert(place, conversion), conversion)
        return
    places_left = itertools.chain(first, settled)
    waiting: deque[_Waiting] = deque()
    killed = 0
    while True:
        try:
            yield from _in_processes(places_left, waiting, conversion)
            return
        except BrokenProcessPool:
            # Whichever of them it was that was killed: one by one they tell.
            while waiting:
                outcome = _alone(*waiting.popleft(), conversion)
                killed += outcome.killed
                if killed > _MOST_KILLED:
                    raise SceneError(str(outcome.result)) from None
                yield outcome


def _in_processes(
    places: Iterator[tuple[Found, Outcome | None]],
    waiting: deque[_Waiting],
    conversion: Conversion,
) -> Iterator[Outcome]:
    """Several at once; if a process is killed, `waiting` has what is open."""
    with _pool(conversion.workers) as pool:
        for place, outcome in places:
            waiting.append((place, outcome))
            if outcome is None:
                waiting[-1] = (place, _submitted(pool, place, conversion))
            if len(waiting) > _WAITING * conversion.workers:
                yield _awaited(waiting, conversion)
        while waiting:
            yield _awaited(waiting, conversion)


def _awaited(waiting: deque[_Waiting], conversion: Conversion) -> Outcome:
    """The first one's outcome; it waits no longer once there is one."""
    place, outcome = waiting[0]
    if isinstance(outcome, Future):
        outcome = _outcome(place, outcome.result(), conversion)
    assert outcome is not None  # only between two lines of `_in_processes`
    waiting.popleft()
    return outcome


def _alone(
    place: Found, outcome: Outcome | Future[str] | None, conversion: Conversion
) -> Outcome:
    """One that waited when a process was killed, converted in a process of its own."""
    if isinstance(outcome, Outcome):
        return outcome
    known = _done(place, conversion)  # it may have been got ready
    if known is not None:
        return known._replace(found=False)
    assert isinstance(place, AbstractPlace)
    try:
        with _pool(1) as pool:
            problem = _submitted(pool, place, conversion).result()
    except BrokenProcessPool:
        return Outcome(
            SceneError(
                f"{place.name}: the process that converted it was killed, perhaps for "
                "want of memory; give the same command again, with fewer --workers"
            ),
            found=False,
            killed=True,
        )
    return _outcome(place, problem, conversion)


def _file_of(place: AbstractPlace, conversion: Conversion) -> Path:
    """The work file of a place. Hidden: a folder of scenes may hold the bank."""
    text = f"{place.key}\n{conversion.slots}\n{_program()}"
    return conversion.folder / f".{hashlib.sha256(text.encode()).hexdigest()[:40]}"


@cache
def _program() -> str:
    """A hash of what converts: another version may convert differently."""
    found = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


def _done(place: Found, conversion: Conversion) -> Outcome | None:
    """What can be said without converting."""
    if isinstance(place, SceneError):
        return Outcome(place, False)
    path = _file_of(place, conversion)
    part = read_part(path)
    return Outcome(part, True) if part is not None and is_whole(path) else None


def _convert(place: Found, conversion: Conversion) -> str:
    """Makes the work file of a place; what went wrong, if it was not the scene."""
    assert isinstance(place, AbstractPlace)  # errors were settled by `_done`
    path = _file_of(place, conversion)
    try:
        scene = place.read()
        kept = scene
        if conversion.slots:
            first = (*scene.tracks_to_predict, *scene.objects_of_interest)
            kept = keep_nearest(scene, slots=conversion.slots, keep=first)
        part = part_of(kept, dropped=scene.objects - kept.objects)
    except SceneError as error:
        write_failure(path, error)
        return ""
    except Exception as error:
        # One strange scene must not cost the others. It may have been for want of
        # memory: there is no work file, so that the next time it is tried again.
        return f"{place.name}: cannot be converted ({type(error).__name__}: {error})"
    write_part(path, part._replace(source=place.name))
    return ""


def _outcome(place: Found, problem: str, conversion: Conversion) -> Outcome:
    assert isinstance(place, AbstractPlace)
    path = _file_of(place, conversion)
    part = SceneError(problem) if problem else read_part(path)
    return Outcome(part or SceneError(f"{path}: is gone; start again"), False)


def _submitted(
    pool: ProcessPoolExecutor, place: Found, conversion: Conversion
) -> Future[str]:
    """Hands a place out. A process that is started for it does not see Ctrl-C.

    The terminal sends that to all processes, and each would print a traceback; the
    caller's ends them. Blocked and not ignored, as no Ctrl-C must be lost meanwhile.
    Other threads may still take it, whereupon Python interrupts the main one: half
    started, a process would complain, so it is put off until it has been started.
    """
    if threading.current_thread() is not threading.main_thread():
        return pool.submit(_convert, place, conversion)
    handler = signal.getsignal(signal.SIGINT)
    came: list[tuple[int, FrameType | None]] = []
    if callable(handler):
        signal.signal(signal.SIGINT, lambda *told: came.append(told))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(_convert, place, conversion)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if callable(handler):
            signal.signal(signal.SIGINT, handler)
            for told in came[:1]:
                handler(*told)


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end at once when the block or this process does."""
    # Spawned, not forked: JAX's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    reading, writing = context.Pipe(duplex=False)
    with ExitStack() as stack:
        pool = ProcessPoolExecutor(
            workers, mp_context=context, initializer=_follow, initargs=(reading,)
        )
        stack.callback(pool.shutdown, cancel_futures=True)
        stack.callback(reading.close)
        stack.callback(writing.close)
        yield pool


def _follow(reading: Connection) -> None:
    """In a worker: ends it when the writing end is closed."""

    def wait() -> None:
        try:
            reading.recv_bytes()
        except (EOFError, OSError):
            os._exit(0)

    threading.Thread(target=wait, name="follow", daemon=True).start()
