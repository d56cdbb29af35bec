"""What the roles say of themselves, and the sums of it."""

from collections.abc import Mapping
from typing import Final

import numpy as np

STATUS_S: Final = 1.0
"""Seconds between two reports of a role."""


def actor_rates(
    latest: Mapping[str, tuple[float, Mapping[str, float | int | str]]],
) -> dict[str, float]:
    """Mean over the actors of what they say about their episodes."""
    found: dict[str, list[float]] = {}
    for role, (_, values) in latest.items():
        for name in ("failure_rate", "return", "progress"):
            if role.startswith("actor-") and name in values:
                found.setdefault(name, []).append(float(values[name]))
    return {name: float(np.mean(values)) for name, values in found.items()}
