"""What a larger run's replay needs, from measured CPU time: a linear model.

    CPU seconds per second of a process kind
        = sum over its terms of (microseconds per unit of the term) x (units per second)

with the terms of `TERMS`: rows inserted and sampled, and the queries that carry them.
Rows and queries can be told apart only if points differ in batch size, inserts and
samples only if they differ in samples per insert: `fit` refuses points that leave a
cost open. Costs are >= 0 and fitted to relative errors, so that a small point counts
as much as a large one. Every second point is fitted; the others check the result.

`needs` multiplies out: cores by kind, services, bytes per second on each link.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from launch.errors import LaunchError

# What each kind of process spends time on; `status` and the like are not in it.
TERMS: Final[Mapping[str, tuple[str, ...]]] = {
    "service": ("insert_rows", "insert_queries", "sample_rows", "sample_queries"),
    "writers": ("insert_rows", "insert_queries"),
    "reader": ("sample_rows", "sample_queries"),
}
HEADER_BYTES: Final = 64  # of each message, see `replay.wire`
SAMPLE_BYTES: Final = 16  # beside each sampled row: id, probability
UPDATE_BYTES: Final = 16  # of each priority


@dataclass(frozen=True, kw_only=True)
class Point:
    """One measurement."""

    rates: Mapping[str, float]  # units of each term per second
    cores: Mapping[str, float]  # CPU seconds per second of each kind of process


Costs = Mapping[str, Mapping[str, float]]  # kind, term: microseconds per unit


def fit(points: Sequence[Point]) -> dict[str, dict[str, float]]:
    """The costs that explain the points best; refuses points that cannot tell them."""
    costs: dict[str, dict[str, float]] = {}
    for kind, terms in TERMS.items():
        units = np.array([[point.rates[term] for term in terms] for point in points])
        spent = np.array([point.cores[kind] for point in points])
        if len(points) < len(terms) or _rank(units) < len(terms):
            raise LaunchError(
                f"{len(points)} points cannot tell the costs of {', '.join(terms)} "
                "apart: measure more batch sizes and more samples per insert"
            )
        # Divided by what was spent: residuals are then relative errors.
        found = _least_squares(units / spent[:, None], np.ones(len(points)))
        costs[kind] = dict(zip(terms, (found * 1e6).tolist(), strict=True))
    return costs


def _rank(units: Float[np.ndarray, "points terms"]) -> int:
    """Of the points as directions, whatever the units of the terms."""
    scaled = units / np.linalg.norm(units, axis=0, keepdims=True).clip(1e-300)
    return int(np.linalg.matrix_rank(scaled, tol=1e-2))


def _least_squares(
    units: Float[np.ndarray, "points terms"], spent: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " terms"]:
    """The best costs >= 0: of every choice of terms that may be 0, the best.

    There are at most four terms: trying all choices is exact and needs no solver.
    """
    terms = units.shape[1]
    best, least = np.zeros(terms), math.inf
    for choice in range(1, 1 << terms):
        used = [term for term in range(terms) if choice >> term & 1]
        found = np.zeros(terms)
        found[used] = np.linalg.lstsq(units[:, used], spent, rcond=None)[0]
        left = float(np.square(units @ found - spent).sum())
        if (found >= 0.0).all() and left < least:
            best, least = found, left
    return best


def predicted(costs: Costs, rates: Mapping[str, float]) -> dict[str, float]:
    """Cores by kind."""
    return {
        kind: sum(cost * rates[term] for term, cost in terms.items()) / 1e6
        for kind, terms in costs.items()
    }


def errors(costs: Costs, points: Sequence[Point]) -> dict[str, float]:
    """Median relative error by kind, and of the cores of all kinds together."""
    guesses = [predicted(costs, point.rates) for point in points]
    found = {}
    for kind in TERMS:
        off = [
            abs(guess[kind] / point.cores[kind] - 1.0)
            for guess, point in zip(guesses, points, strict=True)
        ]
        found[kind] = float(np.median(off))
    sums = [
        abs(sum(guess.values()) / sum(point.cores[kind] for kind in TERMS) - 1.0)
        for guess, point in zip(guesses, points, strict=True)
    ]
    return {**found, "all": float(np.median(sums)), "all_largest": max(sums)}


def checked_fit(points: Sequence[Point]) -> dict[str, Any]:
    """Fitted on every second point, checked against the others."""
    costs = fit(points[::2])
    return {
        "costs_us": costs,
        "fitted_points": len(points[::2]),
        "checked_points": len(points[1::2]),
        "relative_error_fitted": errors(costs, points[::2]),
        "relative_error_checked": errors(costs, points[1::2]),
    }


@dataclass(frozen=True, kw_only=True)
class Run:
    """A run that the model is asked about."""

    actors: int = 10_000
    samples_per_s: float = 130_000.0
    samples_per_insert: float = 8.0
    insert_batch: int = 64  # rows of a query
    sample_batch: int = 64
    row_bytes: int = 128
    weights_bytes: int = 2_000_000
    weights_every_s: float = 10.0  # how often every actor gets them
    shard_load: float = 0.7  # of the highest rate measured of one shard


def rates_of(run: Run) -> dict[str, float]:
    """Units of each term per second."""
    inserts = run.samples_per_s / run.samples_per_insert
    return {
        "insert_rows": inserts,
        "insert_queries": inserts / run.insert_batch,
        "sample_rows": run.samples_per_s,
        "sample_queries": run.samples_per_s / run.sample_batch,
    }


def needs(costs: Costs, run: Run, *, shard_samples_per_s: float) -> dict[str, Any]:
    """Cores, services and bytes per second; `shard_...`: the highest rate measured."""
    rates = rates_of(run)
    inserted = rates["insert_rows"] * run.row_bytes
    acknowledged = 2 * HEADER_BYTES * rates["insert_queries"]
    drawn = run.samples_per_s * (run.row_bytes + SAMPLE_BYTES)
    asked = run.samples_per_s * UPDATE_BYTES
    headers = 2 * HEADER_BYTES * rates["sample_queries"]
    weights = run.actors * run.weights_bytes / run.weights_every_s
    return {
        "rates": rates,
        "cores": predicted(costs, rates),
        "shards": math.ceil(run.samples_per_s / (run.shard_load * shard_samples_per_s)),
        "batches_per_actor_and_s": rates["insert_queries"] / run.actors,
        "bytes_per_s": {
            "actors_to_services": inserted + acknowledged,
            "services_and_learner": drawn + asked + headers,
            "weights_to_actors": weights,
        },
    }
