"""Intervals over scenes against their definitions and published values."""

import dataclasses

import numpy as np
import pytest

from actors.results import NONE, SceneResult, bootstrap, figures_of, wilson

SCENE = SceneResult(
    id="a",
    objects=1,
    valid=80,
    overlap=0,
    offroad=0,
    kinematic_infeasibility=0,
    wrong_way=0,
    off_route=0,
    failed=False,
    failure_objects=0,
    overlap_objects=0,
    offroad_objects=0,
    wrong_way_objects=0,
    off_route_objects=0,
    log_displacement=1.0,
    progress=0.5,
    progression=None,
)


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    [  # Newcombe, Statistics in Medicine 17 (1998), table I, method 3
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilsons_interval_is_the_published_one(hits, count, low, high) -> None:
    found = wilson(hits, count)
    assert found.value == pytest.approx(hits / count)
    assert (found.low, found.high) == pytest.approx((low, high), abs=5e-5)


def test_wilsons_interval_turns_with_the_rate() -> None:
    one, other = wilson(3, 10), wilson(7, 10)
    assert (one.low, one.high) == pytest.approx((1 - other.high, 1 - other.low))
    assert np.isnan(wilson(0, 0)).all()


def test_the_bootstrap_of_a_mean_is_near_the_normal_interval() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 400)
    found = bootstrap(values, np.ones(400))
    half = 1.96 * values.std() / 20
    assert found.value == pytest.approx(values.mean())
    assert found.low == pytest.approx(values.mean() - half, abs=0.03)
    assert found.high == pytest.approx(values.mean() + half, abs=0.03)
    assert found == bootstrap(values, np.ones(400))


def test_what_has_no_interval() -> None:
    assert np.isnan(bootstrap(np.zeros(0), np.zeros(0))).all()
    one = bootstrap(np.array([3.0]), np.array([4.0]))
    assert one.value == 0.75
    assert np.isnan([one.low, one.high]).all()


def test_figures_are_over_scenes_and_over_objects() -> None:
    two = dataclasses.replace(
        SCENE,
        objects=4,
        valid=240,
        kinematic_infeasibility=32,
        failure_objects=3,
        overlap_objects=3,
        wrong_way_objects=1,
        log_displacement=3.0,
        progress=None,
        progression=0.9,
    )
    nobody = dataclasses.replace(SCENE, objects=0, valid=0)
    found = figures_of([SCENE, two, nobody])
    assert found["failure_rate"] == wilson(1, 2)  # the empty scene does not count
    assert found["offroad_rate"].value == 0.0
    assert found["object_failure_rate"].value == pytest.approx(3 / 5)
    assert found["object_wrong_way_rate"].value == pytest.approx(1 / 5)
    assert found["kinematic_infeasibility"].value == pytest.approx(0.1)
    assert found["log_displacement"].value == pytest.approx(2.0)
    assert found["progress"].value == 0.5
    assert found["progression"].value == 0.9
    assert "object_failure_rate" not in figures_of([SCENE])
    assert np.isnan(figures_of([nobody])["failure_rate"]).all()
    assert np.isnan(NONE).all()
