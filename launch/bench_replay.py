"""`slipstream bench replay`: the replay service against its peers, on this machine.

Sections, each of which can be had alone:

    throughput   samples/s and CPU time per sample of 8 KB rows, over TCP and by shared
                 memory, ours, torchrl's buffer behind our wire, and Reverb's
    rows         the project's own rows of 128 bytes, and rendering their observations
    memory       what a row takes in the service's memory, and on the wire
    scale        shards, writers, and the model of a larger run (`bench_replay_model`)
    soak         ten minutes at full rate with random kills (`bench_soak`); only where
                 it is asked for

Contestants take turns, repetition by repetition, so that what else the machine does
hits all alike; ratios are within a repetition, then their median and least are told.
Processes are real ones (`launch.bench_replay_runs`).
"""

import contextlib
import dataclasses
import datetime
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from launch import bench_replay_print, bench_replay_sections
from launch.bench import machine
from launch.bench_output import check_outputs, write_report
from launch.bench_replay_memory import memory
from launch.bench_replay_runs import Contestant
from launch.bench_replay_scale import scale
from launch.bench_replay_sections import Sizes
from launch.bench_soak import soak
from launch.bench_timing import processor_name
from launch.errors import LaunchError
from launch.tables import printer

FORMAT: Final = 1
PEER: Final = "reverb"
PROBE_S: Final = 120.0  # for another Python to import TensorFlow
Section = Literal["throughput", "rows", "memory", "scale", "soak"]
ALL: Final[tuple[Section, ...]] = get_args(Section)
DEFAULT: Final = ALL[:-1]  # without the soak, which takes ten minutes
SECTIONS: Final[
    dict[str, Callable[[Sizes, Contestant | None], Iterator[dict[str, Any]]]]
] = {
    "throughput": bench_replay_sections.throughput,
    "rows": bench_replay_sections.rows,
    "memory": memory,
    "scale": scale,
    "soak": soak,
}


@dataclass(frozen=True, kw_only=True)
class ReplayBenchConfig:
    """Measures the replay service."""

    sections: tuple[Section, ...] = DEFAULT
    """What is measured."""
    against: str = ""
    """A peer that is not installed beside this: reverb=PYTHON, an interpreter whose
    environment has dm-reverb and its TensorFlow."""
    repetitions: int = 3
    """How often each contestant takes its turn."""
    seconds: float = 3.0
    """How long each turn is measured."""
    batches_per_reply: int = 16
    """Batches in one reply of our service; section throughput measures 1 as well."""
    soak_seconds: float = 600.0
    """How long the section soak lasts."""
    quick: bool = False
    """The smallest sizes, once, briefly: tries everything, measures nothing well."""
    json: str = ""
    """Writes everything to this file, or to standard output by -."""
    plot: str = ""
    """Writes the figures to this folder, as PNG and SVG."""

    def __post_init__(self) -> None:
        """Refuses sizes of nothing."""
        if self.repetitions < 1 or not 0 < self.seconds < float("inf"):
            raise ValueError(
                f"--repetitions {self.repetitions} must be at least 1 and --seconds "
                f"{self.seconds} above 0"
            )
        if not 0 < self.soak_seconds < float("inf"):
            raise ValueError(f"--soak-seconds {self.soak_seconds} must be above 0")
        if self.batches_per_reply < 1:
            raise ValueError(
                f"--batches-per-reply {self.batches_per_reply} must be at least 1"
            )

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        if self.quick:
            return Sizes(
                repetitions=1,
                seconds=0.3,
                capacity=256,
                min_size=128,
                batches_per_reply=self.batches_per_reply,
                scenes=1,
                memory_rows=((8192, 1 << 13), (128, 1 << 16)),
                shards=(1, 2),
                writers=(1, 4),
                soak_seconds=self.soak_seconds,
            )
        return Sizes(
            repetitions=self.repetitions,
            seconds=self.seconds,
            batches_per_reply=self.batches_per_reply,
            soak_seconds=self.soak_seconds,
        )


def replay_command(options: ReplayBenchConfig) -> int:
    """`slipstream bench replay`."""
    check_outputs(options.json, options.plot)
    peer = reverb_of(options.against)
    sizes = options.sizes
    report: dict[str, Any] = {
        "format": FORMAT,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "machine": {**machine(), "processor": processor_name()},
        "load_average": list(os.getloadavg()),
        "sizes": dataclasses.asdict(sizes),
        "sections": {},
    }
    console, held = printer(), True
    with _interruptible():
        for name in ALL:
            if name not in options.sections:
                continue
            found = report["sections"][name] = list(SECTIONS[name](sizes, peer))
            held &= all(row.get("held", True) for row in found)
            if options.json != "-":
                for table in bench_replay_print.tables(name, found):
                    console.print(table)
    write_report(report, json_path=options.json, plot=options.plot, figures=_figures)
    return int(not held)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM ends as Ctrl-C does: no process and no file stays behind."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def reverb_of(against: str) -> Contestant | None:
    """The peer that was asked for, after a look whether it can be run."""
    if not against:
        return None
    name, _, python = against.partition("=")
    if name != PEER or not python:
        raise LaunchError(
            f"--against {against}: write {PEER}=PYTHON, an interpreter that has "
            "dm-reverb; see docs/replay_benchmarks.md"
        )
    if shutil.which(python) is None:
        raise LaunchError(f"--against {against}: {python} is no program; check it")
    try:
        tried = subprocess.run(
            [python, "-c", "import reverb, tensorflow"],
            capture_output=True,
            text=True,
            timeout=PROBE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise LaunchError(
            f"--against {against}: did not import reverb within {PROBE_S:g} s"
        ) from None
    if tried.returncode:
        words = tried.stderr.strip().splitlines() or [f"code {tried.returncode}"]
        raise LaunchError(
            f"--against {against}: cannot import reverb and tensorflow ({words[-1]}); "
            "install 'dm-reverb[tensorflow]==0.14.0' there, on Python 3.11"
        )
    return Contestant(name="reverb", python=python)


def _figures(report: Mapping[str, Any]) -> dict[str, bytes]:
    from launch.bench_replay_figures import figures  # matplotlib, only where wanted

    return figures(report)
