"""What the simulator's speed is held to, of what a run of `bench sim` measured.

Ratios hold on any machine; times and rates are those of a quiet 2-core machine, so a
loaded or slower one misses them.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from launch.bench_print import TITLES
from launch.bench_table6 import YARDSTICK

Row = Mapping[str, Any]
Target = dict[str, Any]

RATIOS: Final = (("metrics", "Metrics", 150), ("rollout", "RolloutExpert", 200))
AGENT_STEPS: Final = {(32, 16): 300_000, (1, 512): 200_000}  # per second, one core
STATE_BYTES: Final = 16 * 1024  # of an environment of 64 objects
LABELS: Final = {**TITLES, "rollout": "RolloutExpert"}
MILLISECONDS: Final = {"reset": 0.1, "transition": 0.1}  # batch 1, any size
SIZED: Final[dict[int, dict[str, float]]] = {
    8: {"metrics": 0.1, "rollout": 5.0},
    128: {"metrics": 0.8, "rollout": 60.0},
}


def targets(sections: Mapping[str, Sequence[Row]]) -> list[Target]:
    """Each with what was wanted, what was measured, and whether it was met."""
    return [
        *_ratios(sections.get("oracle", ())),
        *_times(sections.get("table6", ())),
        *_rates(sections.get("steps", ())),
    ]


def _at_least(name: str, wanted: float, measured: float) -> Target:
    met = bool(measured >= wanted)
    return {"target": name, "at least": wanted, "measured": measured, "met": met}


def _at_most(name: str, wanted: float, measured: float) -> Target:
    met = bool(measured <= wanted)
    return {"target": name, "at most": wanted, "measured": measured, "met": met}


def _ratios(rows: Sequence[Row]) -> Iterator[Target]:
    for row in rows:
        if row["slots"] != 128:
            continue
        for program, label, wanted in RATIOS:
            ratio = row["oracle"][YARDSTICK][program]["ratio"]
            yield _at_least(f"{label}, 128: oracle / ours", wanted, ratio)


def _times(rows: Sequence[Row]) -> Iterator[Target]:
    for row in rows:
        if row["device"] != "cpu" or row["batch"] != 1:
            continue
        limits = {**MILLISECONDS, **SIZED.get(row["slots"], {})}
        for program, limit in limits.items():
            label = f"{LABELS[program]}, {row['slots']} [ms]"
            yield _at_most(label, limit, row["programs"][program]["median_ms"])


def _rates(rows: Sequence[Row]) -> Iterator[Target]:
    for row in rows:
        size = (row["controlled"], row["environments"])
        if size in AGENT_STEPS:
            label = f"agent-steps/s, {size[0]} x {size[1]}, {row['slots']} objects"
            yield _at_least(label, AGENT_STEPS[size], row["agent_steps_per_s"])
        if row["slots"] == row["controlled"] == 64:
            state = row["state_bytes_per_environment"]
            yield _at_most("state, 64 objects [B]", STATE_BYTES, state)
