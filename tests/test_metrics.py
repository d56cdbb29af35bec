"""Overlap, feasibility, divergence and progress against brute force and by hand."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sim import metrics
from sim.bank import BankFile
from sim.dynamics import ObjectState
from tests import oracle, scenes

BOXES = 6

_overlaps = jax.jit(jax.vmap(metrics.overlap, in_axes=(0, None, None)))
_logged_overlaps = jax.jit(
    jax.vmap(jax.vmap(metrics.overlap, in_axes=(0, None, None)), in_axes=(None, 0, 0))
)
_infeasible = jax.jit(
    jax.vmap(metrics.kinematic_infeasibility, in_axes=(0, 0, None)), static_argnums=2
)
_position = jax.jit(metrics.route_position)
_progress = jax.jit(metrics.progress)


def overlaps(boxes: np.ndarray, valid: np.ndarray | None = None) -> np.ndarray:
    """`metrics.overlap` of each of the boxes (x, y, yaw, length, width)."""
    count = len(boxes)
    valid = np.ones(count, bool) if valid is None else valid
    box = metrics.Box(*(jnp.asarray(column, jnp.float32) for column in boxes.T))
    return np.asarray(_overlaps(jnp.arange(count), box, jnp.asarray(valid)))


def corners_of(boxes: np.ndarray) -> np.ndarray:
    """The oracle's corners of boxes (x, y, yaw, length, width)."""
    return oracle.corners(boxes[:, :2], boxes[:, 2], boxes[:, 3], boxes[:, 4])


def scaled(boxes: np.ndarray, by: float) -> np.ndarray:
    """The boxes with their sides longer by so much [m]."""
    return boxes + np.array([0, 0, 0, by, by])


BOX = st.tuples(
    st.floats(-6, 6, width=32),
    st.floats(-6, 6, width=32),
    st.floats(-3.125, 3.125, width=32),
    st.floats(0.5, 8, width=32),
    st.floats(0.5, 3, width=32),
)


@given(st.lists(BOX, min_size=BOXES, max_size=BOXES), st.integers(0, 2**BOXES - 1))
@settings(max_examples=300, deadline=None)
def test_overlap_is_the_brute_forces(rows, mask) -> None:
    boxes = np.array(rows, np.float64)
    valid = np.array([bool(mask >> bit & 1) for bit in range(BOXES)])
    expected = np.zeros(BOXES, bool)
    expected[valid] = oracle.boxes_overlap(corners_of(boxes[valid])).any(1)
    # Within a tenth of a millimetre of touching, rounding may decide either way.
    for by in (-2e-4, 2e-4):
        near = oracle.boxes_overlap(corners_of(scaled(boxes[valid], by))).any(1)
        assume((near == expected[valid]).all())
    np.testing.assert_array_equal(overlaps(boxes, valid), expected)


def test_boxes_that_touch_overlap() -> None:
    pair = np.array([[0, 0, 0, 4, 2], [4, 0, 0, 4, 2]], float)
    assert overlaps(pair).tolist() == [True, True]
    pair[1, 0] = 4.001
    assert overlaps(pair).tolist() == [False, False]
    pair[1, :2] = 0, 2
    assert overlaps(pair).tolist() == [True, True]
    pair[1, 1] = 2.001
    assert overlaps(pair).tolist() == [False, False]


def test_a_box_within_another_overlaps() -> None:
    pair = np.array([[0, 0, 0.3, 10, 6], [0.5, 0.5, 1, 1, 1]])
    assert overlaps(pair).tolist() == [True, True]


def test_corner_to_side_by_hand() -> None:
    """The turned box reaches (4.5 + 2) / 2 / sqrt(2) = 2.298 m from its centre."""
    pair = np.array([[0, 0, 0, 4.5, 2], [0, 3.29, np.pi / 4, 4.5, 2]])
    assert overlaps(pair).tolist() == [True, True]
    pair[1, 1] = 3.31
    assert overlaps(pair).tolist() == [False, False]


def test_padding_overlaps_nothing() -> None:
    three = np.array([[0, 0, 0, 4, 2]] * 3, float)
    valid = np.array([True, False, False])
    assert overlaps(three, valid).tolist() == [False] * 3
    valid[1] = True
    assert overlaps(three, valid).tolist() == [True, True, False]


@given(BOX)
@settings(max_examples=50, deadline=None)
def test_corners_are_the_oracles(row) -> None:
    box = np.array([row])
    found = jax.jit(metrics.corners)(
        metrics.Box(*(jnp.float32(value) for value in row))
    )
    np.testing.assert_allclose(found, corners_of(box)[0], atol=1e-5)


def test_overlap_of_every_logged_object_of_the_real_scenes(real) -> None:
    recorded, file = real
    for index, scene in enumerate(recorded):
        log = jnp.asarray(file.arrays["log"][index])
        valid = jnp.asarray(file.arrays["log_valid"][index])
        box = metrics.Box(*(log[..., column] for column in (0, 1, 3, 6, 7)))
        found = _logged_overlaps(jnp.arange(log.shape[1]), box, valid)
        found = np.asarray(found).T
        np.testing.assert_array_equal(
            found[: scene.objects, : scene.steps], oracle.overlap(scene)
        )
        assert not found[scene.objects :].any()


def test_kinematic_infeasibility_of_the_real_scenes(real) -> None:
    recorded, file = real
    counts = {}
    for index, scene in enumerate(recorded):
        log = jnp.asarray(file.arrays["log"][index, : scene.steps, : scene.objects])
        states = [log[..., column] for column in (0, 1, 3, 4, 5)]
        before = ObjectState(*(value[:-1].ravel() for value in states))
        after = ObjectState(*(value[1:].ravel() for value in states))
        found = np.asarray(_infeasible(before, after, 0.1))
        found = found.reshape(scene.steps - 1, scene.objects).T
        found = found & scene.valid[:, 1:] & scene.valid[:, :-1]
        differs = found != oracle.kinematic(scene)[:, 1:]
        assert differs.sum() <= 1, scene.scenario_id  # by rounding
        counts[scene.scenario_id] = int(found.sum())
    assert counts["ef3a8f65142f41ac"] == 79
    assert counts["db4edc9bd0c9d18c"] in (265, 266)


def test_log_divergence_is_the_distance() -> None:
    found = metrics.log_divergence(
        jnp.float32(3), jnp.float32(5), jnp.float32(0), jnp.float32(1)
    )
    assert float(found) == 5.0


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """20 steps at 10 m/s along x: 4 m before the current step, 15 m after it.

    Beside it: a car that stands, and one that is never recorded.
    """
    drivers = [scenes.driver(), scenes.driver(y=3, speed=0), scenes.driver(y=30)]
    valid = np.ones((3, scenes.STEPS), bool)
    valid[2] = False
    scene = scenes.scene_of(drivers, valid=valid)
    return scenes.bank_of([scene], tmp_path_factory.mktemp("straight"))


def position(file: BankFile, x: float, y: float, index: int = 0) -> tuple[float, float]:
    """Along and aside of a point of the map."""
    found = _position(
        file.bank,
        jnp.int32(0),
        jnp.int32(index),
        jnp.float32(x - file.origins[0][0]),
        jnp.float32(y - file.origins[0][1]),
    )
    return float(found.along), float(found.aside)


@given(st.floats(0, 55), st.floats(-5, 5))
@settings(max_examples=50, deadline=None)
def test_route_position_on_a_straight(straight, x, y) -> None:
    """The route begins at the log's first point and goes on 80 m past its last."""
    along, aside = position(straight, x, y)
    assert along == pytest.approx(x, abs=1e-3)
    assert aside == pytest.approx(abs(y), abs=1e-3)


def test_route_position_past_the_ends(straight) -> None:
    assert position(straight, -3, 4) == pytest.approx((0, 5), abs=1e-3)
    assert position(straight, 19 + 80 + 3, 4) == pytest.approx((99, 5), abs=1e-3)


def test_progress_is_of_the_log_from_the_current_step(straight) -> None:
    def progress(along: float, index: int = 0) -> float:
        found = _progress(
            straight.bank, jnp.int32(0), jnp.int32(index), jnp.float32(along)
        )
        return float(found)

    assert progress(4.0) == pytest.approx(0.0, abs=1e-5)
    assert progress(19.0) == pytest.approx(1.0, abs=1e-5)
    assert progress(34.0) == pytest.approx(2.0, abs=1e-4)
    assert progress(1.0) == pytest.approx(-0.2, abs=1e-5)
    assert np.isnan(progress(0.0, index=1))  # it stood
    assert np.isnan(progress(0.0, index=2))  # it never was


def test_routes_follow_the_log_round_a_bend(tmp_path: Path) -> None:
    """A quarter circle of 20 m radius: chords of a metre are 0.01% shorter."""
    angle = np.linspace(0, np.pi / 2, scenes.STEPS)
    states = np.zeros((scenes.STEPS, 5))
    states[:, 0], states[:, 1] = 20 * np.sin(angle), 20 * (1 - np.cos(angle))
    states[:, 2] = angle
    file = scenes.bank_of([scenes.scene_of([states])], tmp_path)
    for step in range(0, scenes.STEPS, 3):
        along, aside = position(file, states[step, 0], states[step, 1])
        assert along == pytest.approx(20 * angle[step], abs=0.05)
        assert aside < 0.05
    assert float(file.arrays["route_end"][0, 0]) == pytest.approx(10 * np.pi, abs=0.05)
