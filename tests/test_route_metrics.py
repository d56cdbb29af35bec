"""The route metrics: by hand, and against the polylines as recorded."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import route_metrics
from sim.bank import BankFile
from sim.lane_paths import OFF, ON
from sim.procedural import generate_many
from sim.route_metrics import LanePosition
from sim.scene import LanePath, Polyline, RoadKind, Scene
from tests import route_oracle, scenes


@jax.jit
def _positions(bank, scene, index, xy) -> LanePosition:
    """For points [n, 2] of objects [n]."""
    over = jax.vmap(route_metrics.lane_position, in_axes=(None, None, 0, 0, 0))
    return over(bank, scene, index, xy[:, 0], xy[:, 1])


def positions(
    file: BankFile, scene: int, index: np.ndarray, xy: np.ndarray
) -> LanePosition:
    """The same as NumPy arrays, in rounds of 128, which compile once."""
    rounds = -(-len(xy) // 128) * 128
    index = np.resize(index.astype(np.int32), rounds)
    points = np.resize(xy.astype(np.float32), (rounds, 2))
    parts = [
        _positions(
            file.bank, jnp.int32(scene), index[at : at + 128], points[at : at + 128]
        )
        for at in range(0, rounds, 128)
    ]
    return LanePosition(
        *(np.concatenate(v)[: len(xy)] for v in zip(*parts, strict=True))
    )


def check(found: LanePosition, parts: list[route_oracle.Part], xy: np.ndarray) -> None:
    """Compares positions relative to one object's paths with the oracle's."""
    if not parts:
        assert not (found.on_distance.any() or found.lane_distance.any())
        return
    distance, arc, flags = route_oracle.distances(parts, xy)
    on = np.where(flags & ON > 0, distance, np.inf)
    off = np.where(flags & OFF > 0, distance, route_metrics.FAR).min(1)
    nearest = on.min(1)
    np.testing.assert_allclose(found.on_distance, nearest, atol=0.0101)
    np.testing.assert_allclose(found.off_distance, off, atol=0.0101)
    np.testing.assert_allclose(found.lane_distance, distance.min(1), atol=0.0101)
    # Of a bend all is about as near from its centre: any point as near to 2 cm will do.
    # Points are up to a metre apart.
    tied = on <= nearest[:, None] + 0.021
    error = np.where(tied, np.abs(arc - found.along[:, None]), np.inf).min(1)
    assert error.max() < 0.5


def check_scene(
    file: BankFile, scene: Scene, row: int, points: list[np.ndarray]
) -> int:
    """Compares `points` of every object; how many there are that have paths."""
    lengths = [len(xy) for xy in points]
    index = np.repeat(np.arange(scene.objects), lengths)
    found = positions(file, row, index, np.concatenate(points))
    every = route_oracle.raw_paths(scene, np.array(file.origins[row]))
    cuts = np.cumsum(lengths)[:-1]
    parts = zip(*(np.split(value, cuts) for value in found), strict=True)
    for own, paths, xy in zip(parts, every, points, strict=True):
        if len(xy):
            check(LanePosition(*own), paths, xy)
    return sum(len(xy) for xy, paths in zip(points, every, strict=True) if paths)


def test_the_real_logs_against_the_recorded_polylines(real) -> None:
    """Every valid (object, step) of every real scene."""
    recorded, file = real
    compared = 0
    for row, scene in enumerate(recorded):
        local = scene.position[..., :2] - np.array(file.origins[row])[:2]
        points = [local[i, scene.valid[i]] for i in range(scene.objects)]
        compared += check_scene(file, scene, row, points)
    assert compared > 10_000


def around(
    rng: np.random.Generator, scene: Scene, origin: np.ndarray, count: int
) -> np.ndarray:
    """Random points [m] within some 10 m of a scene's lanes."""
    points = np.concatenate(route_oracle.raw_lanes(scene, origin))
    chosen = points[rng.integers(len(points), size=count)]
    return (chosen + rng.normal(0, 5, (count, 2))).astype(np.float32).astype(float)


def test_random_poses_around_the_lanes_of_real_scenes(real) -> None:
    recorded, file = real
    rng = np.random.default_rng(0)
    for row, scene in enumerate(recorded):
        origin = np.array(file.origins[row])
        points = [around(rng, scene, origin, 50) for _ in range(scene.objects)]
        assert check_scene(file, scene, row, points) >= 250


def test_random_poses_around_the_lanes_of_procedural_scenes(tmp_path: Path) -> None:
    made = list(generate_many(5, 4))
    file = scenes.bank_of(made, tmp_path)
    rng = np.random.default_rng(1)
    for row, scene in enumerate(made):
        origin = np.array(file.origins[row])
        points = [around(rng, scene, origin, 200) for _ in range(scene.objects)]
        assert check_scene(file, scene, row, points) > 1000


def test_a_real_log_is_on_its_route_and_ends_it(real) -> None:
    """Playback of whatever is on a lane: never off-route, progression ends at 1.

    Arc length grows with the way driven, whatever lanes it leads over.
    """
    recorded, file = real
    moving = 0
    for row, scene in enumerate(recorded):
        acts = scene.valid & (np.arange(scene.steps) >= scene.current_step)
        index, steps = np.nonzero(acts)
        xy = scene.position[index, steps, :2] - np.array(file.origins[row])[:2]
        found = positions(file, row, index, xy)
        assert not np.asarray(jax.vmap(route_metrics.off_route)(found)).any()
        has = (file.arrays["path_flags"][row] & ON > 0).any(-1)
        for own in np.flatnonzero(has[: scene.objects] & acts.any(1)):
            rows = np.flatnonzero(index == own)
            driven = way(xy[rows])
            if driven < 5.0:
                continue
            moving += 1
            ends = found.along[rows[[0, -1]]]
            logged = [file.arrays[f"path_{end}"][row, own] for end in ("start", "end")]
            np.testing.assert_allclose(ends, logged, atol=2e-3)
            assert ends[1] - ends[0] == pytest.approx(driven, rel=0.05, abs=4.0)
    assert moving > 100


def way(xy: np.ndarray) -> float:
    """Length of a log [m] less the jitter of standing."""
    kept = [xy[0]]
    for point in xy:
        if np.hypot(*(point - kept[-1])) > 1.0:
            kept.append(point)
    return float(np.hypot(*np.diff(kept, axis=0).T).sum())


def lane(*points: tuple[float, float], name: int, exits: tuple[int, ...] = ()):
    """A street's lane through points."""
    heights = np.zeros((len(points), 1))
    return Polyline(
        RoadKind.LANE_STREET,
        np.concatenate([np.array(points, float), heights], 1),
        feature_id=name,
        exit_lanes=exits,
    )


@pytest.fixture(scope="module")
def fork(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    """A road along x that forks at x = 30; the log drives from 8 to 40."""
    roads = (
        lane((-10, 0), (30, 0), name=1, exits=(2, 3)),
        lane((30, 0), (60, 0), name=2),
        lane((30, 0), (60, 30), name=3),
    )
    scene = scenes.scene_of(
        [scenes.driver(speed=20.0, steps=21), scenes.driver(y=60.0, steps=21)],
        roads=roads,
    )
    return scenes.bank_of([scene], tmp_path_factory.mktemp("fork"))


def at(file: BankFile, x: float, y: float, index: int = 0) -> LanePosition:
    """The position of one point of the map."""
    local = np.array([[x, y]]) - np.array(file.origins[0])[:2]
    found = positions(file, 0, np.array([index]), local)
    return LanePosition(*(float(value[0]) for value in found))


def metrics(file: BankFile, x: float, y: float) -> tuple[float, float]:
    """Wrong-way and off-route there."""
    position = LanePosition(*map(jnp.float32, at(file, x, y)))
    return (
        float(route_metrics.wrong_way(position)),
        float(route_metrics.off_route(position)),
    )


def test_distances_at_a_fork(fork: BankFile) -> None:
    """Before the fork the lane is part of both; behind it the ways part."""
    before = at(fork, 20.0, 2.0)
    assert before.on_distance == pytest.approx(2.0, abs=1e-3)
    assert before.off_distance == pytest.approx(2.0, abs=1e-3)
    assert before.along == pytest.approx(12.0, abs=1e-3)  # it acts at x = 8
    aside = at(fork, 50.0, 6.0)
    assert aside.on_distance == pytest.approx(6.0, abs=1e-3)
    assert aside.off_distance == pytest.approx(14.0 / np.sqrt(2), abs=1e-3)
    assert aside.lane_distance == pytest.approx(6.0, abs=1e-3)


@pytest.mark.parametrize(
    ("x", "y", "wrong", "off"),
    [
        (20.0, 3.4, 0.0, 0.0),
        (20.0, 3.6, 3.6, 0.0),
        (20.0, -4.9, 4.9, 0.0),
        (20.0, -5.1, 5.1, 5.1),
        (36.0, 6.0, 0.0, 6.0),  # on the other branch
        (33.0, 2.2, 0.0, 0.0),  # 0.57 m from the other branch: 1.6 m nearer
        (33.0, 2.7, 0.0, 2.7),  # 0.21 m from it: 2.5 m nearer
        (64.0, 0.0, 4.0, 0.0),  # behind the end
    ],
)
def test_thresholds(fork: BankFile, x, y, wrong, off) -> None:
    assert metrics(fork, x, y) == pytest.approx((wrong, off), abs=1e-3)


def test_progression_is_of_the_log_from_the_current_step(fork: BankFile) -> None:
    def progression(x: float, index: int = 0) -> float:
        along = jnp.float32(at(fork, x, 0.5, index).along)
        found = route_metrics.progression(
            fork.bank, jnp.int32(0), jnp.int32(index), along
        )
        return float(found)

    assert progression(8.0) == pytest.approx(0.0, abs=1e-4)
    assert progression(40.0) == pytest.approx(1.0, abs=1e-4)
    assert progression(24.0) == pytest.approx(0.5, abs=1e-4)
    assert progression(56.0) == pytest.approx(1.5, abs=1e-4)
    assert np.isnan(progression(8.0, index=1))  # on no lane


def test_what_has_no_paths_is_not_judged(fork: BankFile) -> None:
    position = at(fork, 500.0, 500.0, index=1)
    assert position == (0.0, route_metrics.FAR, 0.0, 0.0)
    judged = LanePosition(*map(jnp.float32, position))
    assert float(route_metrics.wrong_way(judged)) == 0.0
    assert float(route_metrics.off_route(judged)) == 0.0


def test_path_samples_stand_for_the_sdcs_paths(tmp_path: Path) -> None:
    """Shared points are there once; the on-route sample gives the arc length."""
    shared = [(x, 0.0, 0.0) for x in range(-20, 31)]
    straight = LanePath(np.array([*shared, *((x, 0, 0) for x in range(31, 90))]), True)
    left = LanePath(np.array([*shared, *((30, y, 0) for y in range(1, 60))]), False)
    scene = scenes.scene_of(
        [scenes.driver(), scenes.driver(y=3.0)],
        roads=(lane((-10, 3), (90, 3), name=1),),
    )
    scene = dataclasses.replace(scene, sdc_paths=(left, straight))
    file = scenes.bank_of([scene], tmp_path)
    position = at(file, 10.0, 1.0)
    assert position.on_distance == position.off_distance == pytest.approx(1.0, abs=1e-3)
    assert position.along == pytest.approx(30.0, abs=1e-3)
    assert metrics(file, 32.0, 20.0) == (0.0, pytest.approx(20.0, abs=1e-3))
    assert at(file, 30.0, 20.0).off_distance == pytest.approx(0.0, abs=1e-3)
    other = at(file, 10.0, 0.0, index=1)  # its paths are the lane graph's
    assert other.on_distance == pytest.approx(3.0, abs=1e-3)
    # Straight lines decimate to one segment: three stretches, a chunk each.
    assert (file.arrays["path_flags"][0, 0] > 0).sum() == 3


def test_positions_do_not_depend_on_the_batch(real) -> None:
    """Alone and among others, to the bit."""
    recorded, file = real
    rng = np.random.default_rng(2)
    xy = around(rng, recorded[0], np.array(file.origins[0]), 64)
    index = np.arange(64) % recorded[0].objects
    together = positions(file, 0, index, xy)
    for row in range(0, 64, 9):
        one = positions(file, 0, index[row : row + 1], xy[row : row + 1])
        for value, single in zip(together, one, strict=True):
            assert value[row] == single[0]
