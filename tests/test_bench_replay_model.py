"""The capacity model of `bench replay`: its fit, its check, its projection."""

import numpy as np
import pytest

from launch.bench_replay_model import (
    TERMS,
    Point,
    Run,
    checked_fit,
    fit,
    needs,
    predicted,
    rates_of,
)
from launch.bench_replay_scale import TICK_S, point_of
from launch.errors import LaunchError

COSTS = {
    "service": {
        "insert_rows": 2.0,
        "insert_queries": 150.0,
        "sample_rows": 4.0,
        "sample_queries": 200.0,
    },
    "writers": {"insert_rows": 3.0, "insert_queries": 100.0},
    "reader": {"sample_rows": 1.0, "sample_queries": 250.0},
}


def points(noise: float = 0.0) -> list[Point]:
    """Made by known costs, over batch sizes and samples per insert."""
    random = np.random.default_rng(0)
    made = []
    for batch in (16, 64, 256):
        for ratio in (2.0, 8.0, 32.0):
            for rate in (5e3, 2e4):
                rates = rates_of(
                    Run(
                        samples_per_s=rate,
                        samples_per_insert=ratio,
                        insert_batch=batch,
                        sample_batch=256 // batch * 16,
                    )
                )
                cores = predicted(COSTS, rates)
                off = 1 + noise * random.standard_normal(len(cores))
                made.append(
                    Point(
                        rates=rates,
                        cores=dict(
                            zip(
                                cores, np.array(list(cores.values())) * off, strict=True
                            )
                        ),
                    )
                )
    return made


def test_known_costs_are_found_again() -> None:
    found = checked_fit(points())
    for kind, terms in TERMS.items():
        for term in terms:
            assert found["costs_us"][kind][term] == pytest.approx(COSTS[kind][term])
    assert found["relative_error_checked"]["all_largest"] < 1e-9
    assert found["fitted_points"] + found["checked_points"] == len(points())


def test_noise_is_told_as_error_and_costs_stay_positive() -> None:
    found = checked_fit(points(noise=0.05))
    assert 0.005 < found["relative_error_checked"]["all"] < 0.1
    costs = [cost for kind in found["costs_us"].values() for cost in kind.values()]
    assert min(costs) >= 0.0


def test_a_cost_that_would_be_negative_is_zero() -> None:
    rates = [point.rates for point in points()]
    cores = [
        {kind: max(1e-6, 1e-6 * rate["sample_rows"]) for kind in TERMS}
        for rate in rates
    ]
    made = [Point(rates=r, cores=c) for r, c in zip(rates, cores, strict=True)]
    assert fit(made)["reader"] == pytest.approx(
        {"sample_rows": 1.0, "sample_queries": 0.0}, abs=1e-6
    )


def test_a_process_whose_time_was_not_seen_counts_a_tick() -> None:
    kinds = dict.fromkeys(TERMS, 0.0)
    found = {
        "seconds": 0.5,
        "inserts_per_s": 8.0,
        "insert_queries_per_s": 1.0,
        "samples_per_s": 64.0,
        "sample_queries_per_s": 1.0,
        "cores": {**kinds, "reader": 0.4},
    }
    point = point_of(found)
    assert point.cores["reader"] == 0.4
    assert point.cores["service"] == 2 * TICK_S > 0.0


def test_points_that_cannot_tell_costs_apart_are_refused() -> None:
    alike = [
        Point(rates=rates_of(Run(samples_per_s=rate)), cores=dict.fromkeys(TERMS, 0.1))
        for rate in (1e3, 1e4, 1e5, 1e6)
    ]
    with pytest.raises(LaunchError, match="cannot tell the costs"):
        fit(alike)


def test_the_projection_multiplies_out() -> None:
    run = Run(weights_bytes=1_000_000)
    told = needs(COSTS, run, shard_samples_per_s=100_000.0)
    assert told["rates"]["insert_rows"] == 16_250.0
    assert told["shards"] == 2  # 130,000 / 70,000
    by_hand = 2.0 * 16_250 + 150.0 * 16_250 / 64 + 4.0 * 130_000 + 200.0 * 130_000 / 64
    assert told["cores"]["service"] == pytest.approx(by_hand / 1e6)
    sent = told["bytes_per_s"]
    assert sent["actors_to_services"] == pytest.approx(16_250 * (128 + 2))
    assert sent["services_and_learner"] == pytest.approx(130_000 * (128 + 16 + 16 + 2))
    assert sent["weights_to_actors"] == 1e9
