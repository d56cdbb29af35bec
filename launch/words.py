"""What the viewer says in words: actions by name, a step as a table."""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from launch.scene_view import ViewScene


@final
@dataclass(frozen=True, kw_only=True)
class ActionLabels:
    """What the indices of a discrete action space mean."""

    names: tuple[str, ...]  # of the dimensions, e.g. "acceleration [m/s2]"
    values: Float[np.ndarray, "actions dimensions"]

    def describe(self, index: int) -> tuple[tuple[str, str], ...]:
        """An action as pairs of a name and a value."""
        if not 0 <= index < len(self.values):
            return ()
        pairs = zip(self.names, self.values[index], strict=True)
        return tuple((name, f"{value:+.3g}") for name, value in pairs)


def _percent(share: float) -> str:
    """A share as a percentage; NaN is none."""
    return "-" if np.isnan(share) else f"{100 * share:.0f} %"


def describe(
    scene: ViewScene,
    frame: np.void,
    q_values: Float[np.ndarray, " actions"],
    who: tuple[str, ActionLabels | None],
) -> str:
    """One step in words, as markdown."""
    title, labels = who
    action = int(frame["action"])
    meaning = labels.describe(action) if labels is not None else ()
    failures = [
        name
        for name, failed in (
            ("overlap", frame["overlap"]),
            ("off-road", frame["offroad"]),
        )
        if failed
    ]
    speed = float(np.hypot(*frame["state"][3:]))
    known = len(q_values) > 0 and action >= 0
    rows = (
        ("scenario", f"`{scene.scenario_id}`"),
        ("---", "---"),
        ("step", f"{int(frame['step'])} ({frame['step'] * scene.dt:.1f} s)"),
        ("speed", f"{speed:.1f} m/s"),
        ("action", str(action) if action >= 0 else "-"),
        *meaning,
        ("Q-value", f"{q_values[action]:.3f}" if known else "-"),
        ("reward", f"{frame['reward']:+.3f}"),
        ("progress", _percent(float(frame["progress"]))),
        ("failures", f"**{' and '.join(failures)}**" if failures else "none"),
    )
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
    return f"#### {title}\n\n{table}\n"
