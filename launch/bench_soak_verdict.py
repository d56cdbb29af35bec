"""What must hold over a soak, and how it is told that it did not.

    memory    of the service's last life, and of the writer and the readers that are
              never killed: the memory that is its own (anonymous and shared, not the
              pages of the table's files) is flat. Flat means that the slope is at most
              4 MiB in ten minutes with 97.5% confidence, after the ring has come round
              and a quarter of its life has passed. What is too short or too noisy to
              tell is a fault too: "not shown"
    handles   open files and threads of these: at most 4 more at the end
    disk      the replay's folder grows no more once the ring has come round
    ratio     at every look, the first after each recovery and the last one too, the
              samples owed are within the limiter's tolerance: nothing adds up. And
              over windows of 10,000 inserts, samples per insert are within 1%
    rows      ids without a gap, every row as written, numbers of each writer's life
              from 0 on in order, all that were told to be acknowledged, and no more
              samples received than were counted; some received each way

The slope is of least squares through the medians of eight equal parts of the looks. A
leak is steady, so medians keep it; what comes and goes with a kill falls out, and parts
of half a minute are nearly independent, where looks two seconds apart are not: their
error would be told too small. The verdict says how many bytes lost per query would have
been a fault.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from launch.bench_soak_roles import CONFIG, DRAWN, INSERTED
from launch.bench_soak_run import KEPT

Look = Mapping[str, Any]
MOST_BYTES: Final = 4 << 20  # that memory may grow ...
PER_S: Final = 600.0  # ... in so long
WINDOW: Final = 10_000  # inserts
MOST_RATIO_ERROR: Final = 0.01
_PARTS: Final = 8
_STUDENT: Final = 2.447  # 97.5% point of Student's t, _PARTS - 2 degrees of freedom
_MORE_HANDLES: Final = 4


class Slope(NamedTuple):
    """A slope and its error."""

    per_s: float
    error: float  # on either side, 95% of cases within

    @property
    def most(self) -> float:
        """What it is at most."""
        return self.per_s + self.error


def slope_of(ages: np.ndarray, values: np.ndarray) -> Slope | None:
    """Through the medians of equal parts of the looks; None if one has no two."""
    if len(ages) < 2 * _PARTS:
        return None
    # Not equal parts of the time: whoever stops the soak for a while leaves a gap.
    x = np.array([part.mean() for part in np.array_split(ages, _PARTS)])
    y = np.array([np.median(part) for part in np.array_split(values, _PARTS)])
    spread = ((x - x.mean()) ** 2).sum()
    per_s = float(((x - x.mean()) * y).sum() / spread)
    left = y - y.mean() - per_s * (x - x.mean())
    error = _STUDENT * float(np.sqrt((left**2).sum() / (_PARTS - 2) / spread))
    return Slope(per_s, error)


def judged(looks: Sequence[Look], name: str) -> list[Mapping[str, float]]:
    """What was seen of a process's last life once it had settled."""
    came_round = [look for look in looks if look.get("inserts", 0) > CONFIG.capacity]
    full_s = came_round[0]["seconds"] if came_round else float("inf")
    lives = [life for look in looks for life in look["processes"]]
    own = [life for life in lives if life.startswith(f"{name},")]
    seen = [
        {"seconds": look["seconds"], **look["processes"][own[-1]]}
        for look in looks
        if own and own[-1] in look["processes"]
    ]
    last_s = seen[-1]["age_s"] if seen else 0.0
    return [
        one for one in seen if one["age_s"] > last_s / 4 and one["seconds"] > full_s
    ]


def memory_fault(name: str, slope: Slope | None) -> str:
    """Why a process's memory is not flat; empty if it is."""
    if slope is None:
        return f"memory: {name}: not shown, it was seen too briefly once all was full"
    if slope.most * PER_S <= MOST_BYTES:
        return ""
    grown, error = slope.per_s * PER_S / 2**20, slope.error * PER_S / 2**20
    known = "grows" if slope.per_s > slope.error else "not shown to be flat"
    return (
        f"memory: {name}: {known}, {grown:.2f} +- {error:.2f} MiB in ten minutes, at "
        f"most {MOST_BYTES / 2**20:g} are allowed"
    )


def handle_faults(name: str, seen: Sequence[Mapping[str, float]]) -> list[str]:
    """Open files and threads, the last third of the time against the first."""
    third = max(1, len(seen) // 3)
    faults = []
    for what in ("files", "threads"):
        early = max((one[what] for one in seen[:third]), default=0.0)
        late = min((one[what] for one in seen[-third:]), default=0.0)
        if late > early + _MORE_HANDLES:
            faults.append(f"handles: {name} has more and more {what}")
    return faults


def disk_faults(looks: Sequence[Look]) -> list[str]:
    """The folder's size once the ring has come round, when all pages are there."""
    sizes = [
        look["disk_bytes"]
        for look in looks
        if look.get("inserts", 0) > CONFIG.capacity + INSERTED
    ]
    if sizes and max(sizes) > sizes[0] + (1 << 20):
        return [f"disk: grew by {(max(sizes) - sizes[0]) / 2**20:.1f} MiB"]
    return []


def worst_window(marks: Sequence[tuple[int, int]]) -> float | None:
    """The largest error of samples per insert over windows; None without one.

    Marks are (inserts, samples) in the order in which they were so; a window goes from
    a mark to the first one that is at least `WINDOW` inserts later.
    """
    there = np.array([mark for mark in marks if mark[0] > CONFIG.min_size + INSERTED])
    if not len(there):
        return None
    inserts, samples = there.T
    ends = np.searchsorted(inserts, inserts + WINDOW)
    starts = np.flatnonzero(ends < len(inserts))
    if not len(starts):
        return None
    ends = ends[starts]
    wanted = CONFIG.samples_per_insert * (inserts[ends] - inserts[starts])
    return float(np.abs((samples[ends] - samples[starts]) / wanted - 1.0).max())


def most_owed(marks: Sequence[tuple[int, int]]) -> float:
    """The largest debt of either side, in tolerances."""
    limiter = CONFIG.limiter()
    owed = [
        abs(limiter.debt(inserts=inserts, samples=samples))
        for inserts, samples in marks
        if inserts > CONFIG.min_size + INSERTED
    ]
    return max(owed, default=0.0) / limiter.tolerance


def ratio_faults(marks: Sequence[tuple[int, int]]) -> list[str]:
    """Drift, and windows that are off."""
    faults, worst = [], worst_window(marks)
    if (owed := most_owed(marks)) > 1.0:
        faults.append(f"ratio: {owed:.2f} tolerances are owed at one time")
    if worst is None:
        faults.append(f"ratio: not shown, no {WINDOW} inserts were seen")
    elif worst > MOST_RATIO_ERROR:
        faults.append(f"ratio: off by {worst:.2%} over {WINDOW} inserts")
    return faults


def memory_of(looks: Sequence[Look]) -> tuple[dict[str, Any], list[str]]:
    """Slopes and faults of the processes that lived long."""
    figures, faults = {}, []
    for name in ("service", *KEPT):
        seen = judged(looks, name)
        slope = slope_of(
            np.array([one["age_s"] for one in seen]),
            np.array([one["own"] for one in seen], float),
        )
        faults += handle_faults(name, seen)
        if fault := memory_fault(name, slope):
            faults.append(fault)
        if slope is not None:
            figures[name] = {
                "bytes": seen[-1]["own"],
                "seconds": seen[-1]["age_s"] - seen[0]["age_s"],
                "growth_bytes_in_600_s": slope.per_s * PER_S,
                "error_bytes_in_600_s": slope.error * PER_S,
            }
    return figures, faults


def found_bytes_per_query(looks: Sequence[Look]) -> float | None:
    """What, lost at every insert and sample, would have been the fault of a leak."""
    later = [look for look in looks[len(looks) // 2 :] if "inserts" in look]
    if len(later) < 2:
        return None
    first, last = later[0], later[-1]
    queries = (last["inserts"] - first["inserts"]) / INSERTED
    queries += (last["samples"] - first["samples"]) / DRAWN
    passed = last["seconds"] - first["seconds"]
    return float(MOST_BYTES / PER_S * passed / max(queries, 1.0))
