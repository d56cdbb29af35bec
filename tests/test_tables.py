"""Off-road by the scene's tables against the brute force over all edges."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim import metrics
from sim.bank import BankFile
from sim.formats import read_scenes
from sim.procedural import generate_many
from sim.scene import Polyline, RoadKind, Scene
from tests import oracle, scenes

NEAR = 0.01  # m: closer to an edge, rounding may decide either way

_offroad = jax.jit(jax.vmap(metrics.offroad, in_axes=(None, None, 0, 0)))


def judged(file: BankFile, scene: int, boxes: np.ndarray, z: np.ndarray) -> np.ndarray:
    """`metrics.offroad` of boxes (x, y, yaw, length, width) at heights z, local."""
    box = metrics.Box(*(jnp.asarray(value, jnp.float32) for value in boxes.T))
    return np.asarray(
        _offroad(file.bank, jnp.int32(scene), box, jnp.asarray(z, jnp.float32))
    )


def by_definition(
    edges: Sequence[np.ndarray], boxes: np.ndarray, z: np.ndarray
) -> np.ndarray:
    """The oracle's verdict on the same boxes."""
    points = corners_of(boxes)
    wrong = oracle.corners_offroad(points, np.repeat(z.astype(np.float64), 4), edges)
    return wrong.reshape(-1, 4).any(1)


def too_near(edges: Sequence[np.ndarray], boxes: np.ndarray) -> np.ndarray:
    """Which boxes have a corner so near to an edge that rounding decides."""
    near = scenes.planar_distance(corners_of(boxes), edges) < NEAR
    return near.reshape(-1, 4).any(1)


def corners_of(boxes: np.ndarray) -> np.ndarray:
    """Four points of each box."""
    boxes = boxes.astype(np.float64)
    corners = oracle.corners(boxes[:, :2], boxes[:, 2], boxes[:, 3], boxes[:, 4])
    return corners.reshape(-1, 2)


def assert_agree(
    file: BankFile, scene: int, edges: Sequence[np.ndarray], count: int
) -> None:
    """Random boxes around the scene's edges: the same verdicts."""
    rng = np.random.default_rng(scene)
    boxes, z = scenes.poses_around_edges(rng, edges, count)
    expected = by_definition(edges, boxes, z)
    assert 0.1 < expected.mean() < 0.9  # both answers are asked for
    differ = np.flatnonzero(judged(file, scene, boxes, z) != expected)
    wrong = differ[~too_near(edges, boxes[differ])]
    assert not len(wrong), (boxes[wrong][:3], z[wrong][:3])


def points_judged(file: BankFile, points: Sequence, z: float = 0.0) -> list[bool]:
    """Verdicts on (nearly) points, given in the map's frame, in the first scene."""
    local = np.array(points, float) - np.array(file.origins[0][:2])
    boxes = np.concatenate([local, np.full((len(local), 3), 1e-4)], 1)
    height = np.full(len(local), z - file.origins[0][2])
    return judged(file, 0, boxes, height).tolist()


def bank_with(folder: Path, *roads: Polyline) -> BankFile:
    """A bank of one scene with these roads and one car far from being in the way."""
    return scenes.bank_of([scenes.scene_of([scenes.driver()], roads=roads)], folder)


def assert_logged_agree(recorded: Sequence[Scene], file: BankFile, every: int) -> None:
    """All objects of the real scenes, each so many steps."""
    pairs = 0
    for index, scene in enumerate(recorded):
        scene = every_nth(scene, every)
        log = file.arrays["log"][index, ::every][: scene.steps, : scene.objects]
        boxes = log[..., [0, 1, 3, 6, 7]].transpose(1, 0, 2).reshape(-1, 5)
        found = judged(file, index, boxes, log[..., 2].T.ravel())
        found = found.reshape(scene.valid.shape) & scene.valid
        np.testing.assert_array_equal(found, oracle.offroad(scene))
        pairs += int(scene.valid.sum())
    assert pairs > 20000 / every


def every_nth(scene: Scene, every: int) -> Scene:
    """The scene with fewer steps."""
    return dataclasses.replace(
        scene,
        **{
            name: getattr(scene, name)[:, ::every]
            for name in ("position", "yaw", "velocity", "size", "valid")
        },
    )


def test_logged_objects_of_the_real_scenes(real) -> None:
    assert_logged_agree(*real, every=15)


@pytest.mark.slow
def test_every_logged_object_of_the_real_scenes(real) -> None:
    assert_logged_agree(*real, every=1)


@pytest.mark.slow
def test_many_random_boxes_around_the_edges_of_the_real_scenes(
    scenes_data: Path, tmp_path: Path
) -> None:
    recorded = list(read_scenes([scenes_data]))
    file = scenes.bank_of(recorded, tmp_path)
    for index, scene in enumerate(recorded):
        edges = scenes.local_edges(scene, file.origins[index])
        assert_agree(file, index, edges, 100_000)


def test_random_boxes_around_the_edges_of_the_real_scenes(real) -> None:
    recorded, file = real
    for index, scene in enumerate(recorded):
        edges = scenes.local_edges(scene, file.origins[index])
        assert_agree(file, index, edges, 300)


def test_random_boxes_around_the_edges_of_procedural_scenes(tmp_path: Path) -> None:
    made = list(generate_many(5, 4))
    file = scenes.bank_of(made, tmp_path)
    for index, scene in enumerate(made):
        edges = scenes.local_edges(scene, file.origins[index])
        assert_agree(file, index, edges, 300)


def test_boxes_anywhere_on_the_grid(tmp_path: Path) -> None:
    """Also far from every edge, where whole squares of cells share one verdict."""
    made = next(generate_many(8, 1))
    file = scenes.bank_of([made], tmp_path)
    edges = scenes.local_edges(made, file.origins[0])
    every = np.concatenate(edges)
    rng = np.random.default_rng(0)
    low, high = every[:, :2].min(0) - 9, every[:, :2].max(0) + 9
    boxes = np.zeros((1000, 5), np.float32)
    boxes[:, :2] = rng.uniform(low, high, (1000, 2))
    boxes[:, 2] = rng.uniform(-3, 3, 1000)
    boxes[:, 3:] = 4.5, 2.0
    nearest = [
        np.square(every[:, :2] - place).sum(1).argmin() for place in boxes[:, :2]
    ]
    z = (every[nearest, 2] + 0.8).astype(np.float32)
    expected, near = by_definition(edges, boxes, z), too_near(edges, boxes)
    np.testing.assert_array_equal(judged(file, 0, boxes, z)[~near], expected[~near])


def test_a_map_of_random_polylines(tmp_path: Path) -> None:
    """No road looks like this: crossings, sharp turns, steps of all lengths."""
    rng = np.random.default_rng(4)
    roads = []
    for _ in range(12):
        count = int(rng.integers(2, 30))
        steps = rng.normal(0, rng.choice([0.3, 2.0, 8.0]), (count, 2))
        points = rng.uniform(-40, 40, 2) + np.cumsum(steps, 0)
        roads.append(scenes.edge(*points.tolist()))
    file = bank_with(tmp_path, *roads)
    edges = [road.points - np.array(file.origins[0]) for road in roads]
    assert_agree(file, 0, edges, 2000)


def test_finely_sampled_edges(tmp_path: Path) -> None:
    """A thin, wavy median with a point every 5 cm: more candidates than are kept.

    The nearest to the cell's centre are, so what is lost can matter close to an edge
    only: measured, 5 points of 20,000 beyond 1 cm, the farthest at 5 cm.
    """
    x = np.arange(0, 30, 0.05)
    y = 0.4 * np.sin(x)
    there = np.stack([x, y + 0.15], -1)
    back = np.stack([x, y - 0.15], -1)[::-1]
    roads = [scenes.edge(*there.tolist()), scenes.edge(*back.tolist())]
    file = bank_with(tmp_path, *roads)
    edges = [road.points - np.array(file.origins[0]) for road in roads]
    rng = np.random.default_rng(2)
    boxes = np.full((1000, 5), 1e-4, np.float32)
    boxes[:, :2] = np.stack(
        [rng.uniform(1, 29, 1000), rng.uniform(-0.8, 0.8, 1000)], -1
    ) - np.array(file.origins[0][:2])
    z = np.zeros(1000, np.float32)
    expected = by_definition(edges, boxes, z)
    differs = judged(file, 0, boxes, z) != expected
    distance = scenes.planar_distance(boxes[:, :2].astype(np.float64), edges)
    assert not differs[distance > 0.1].any()
    assert differs[distance > NEAR].sum() <= 2


def test_the_left_of_an_edge_is_the_road(tmp_path: Path) -> None:
    file = bank_with(tmp_path, scenes.edge((0, 0), (10, 0)))
    assert points_judged(file, [(5, 1), (5, -1)]) == [False, True]


def test_a_box_is_off_the_road_by_one_corner(tmp_path: Path) -> None:
    file = scenes.bank_of([scenes.scene_of([scenes.driver()])], tmp_path)
    place = np.array([[30.0, 0.0, 0.0, 4.0, 2.0]] * 4)
    place[:, 1] = [3.9, 4.1, 0.0, 3.9]
    place[3, 2] = 0.2  # its front left corner reaches 2 sin + 1 cos = 1.38 m aside
    found = judged(file, 0, place - [*file.origins[0][:2], 0, 0, 0], np.zeros(4))
    assert found.tolist() == [False, True, False, True]


def test_at_a_left_turn_only_left_of_both_is_the_road(tmp_path: Path) -> None:
    file = bank_with(tmp_path, scenes.edge((0, 0), (10, 0), (0, 1)))
    assert points_judged(file, [(11.0, 0.05), (9.0, 0.05)]) == [True, False]


def test_at_a_right_turn_left_of_either_is_the_road(tmp_path: Path) -> None:
    file = bank_with(tmp_path, scenes.edge((0, 0), (10, 0), (0, -1)))
    assert points_judged(file, [(11.0, -0.05), (9.0, -0.05)]) == [False, True]


SQUARE = ((0, 0), (10, 0), (10, 10), (0, 10), (0, 0))


def test_a_closed_edge_decides_at_its_seam_too(tmp_path: Path) -> None:
    file = bank_with(tmp_path, scenes.edge(*SQUARE))
    points = [(5, 5), (-1, -1), (11, 5), (0.5, 0.5), (-1, 0.5), (0.5, -1)]
    assert points_judged(file, points) == [False, True, True, False, True, True]


def test_a_closed_edge_the_other_way_round_is_an_island(tmp_path: Path) -> None:
    file = bank_with(tmp_path, scenes.edge(*SQUARE[::-1]))
    points = [(5, 5), (-1, -1), (11, 5), (-0.1, -0.1), (-1, 0.5)]
    assert points_judged(file, points) == [True, False, False, False, False]


def test_an_edge_far_from_the_origin_is_closed_only_where_it_meets(
    tmp_path: Path,
) -> None:
    """8 cm apart at a map coordinate of 10 km are two ends, not one."""
    far = 10_000.0
    ring = np.array([(0, 0), (10, 0), (10, 10), (0, 10), (0, 0.08)]) + far
    road = scenes.edge(*ring.tolist())
    scene = scenes.scene_of([scenes.driver(x=far, y=far)], roads=[road])
    file = scenes.bank_of([scene], tmp_path)
    rng = np.random.default_rng(0)
    boxes = np.full((2000, 5), 1e-4, np.float32)
    local = np.array([far, far]) - file.origins[0][:2]
    boxes[:, :2] = local + rng.uniform(-0.5, 0.5, (2000, 2))
    edges = [road.points - np.array(file.origins[0])]
    z = np.zeros(2000, np.float32)
    expected, near = by_definition(edges, boxes, z), too_near(edges, boxes)
    np.testing.assert_array_equal(judged(file, 0, boxes, z)[~near], expected[~near])


def test_an_overpass_is_not_the_road_below(tmp_path: Path) -> None:
    """A bridge along y over a road along x, whose edges cross in the plane."""
    road = scenes.corridor(half=5.0, start=-40, end=40)
    bridge = (
        scenes.edge((4, -40, 6), (4, 40, 6)),
        scenes.edge((-4, 40, 6), (-4, -40, 6)),
    )
    file = bank_with(tmp_path, *road, *bridge)
    # On the road below; beside the road; on the bridge; beside the bridge.
    assert points_judged(file, [(4.5, 0), (20, 0), (0, 7)], z=0.7) == [
        False,
        False,
        True,
    ]
    assert points_judged(file, [(0, 7), (0, 0), (4.5, 0), (20, 7)], z=6.7) == [
        False,
        False,
        True,
        True,
    ]
    edges = [line.points - np.array(file.origins[0]) for line in (*road, *bridge)]
    assert_agree(file, 0, edges, 2000)


def test_without_edges_everything_is_road(tmp_path: Path) -> None:
    lane = Polyline(RoadKind.LANE_STREET, np.array([[0, 0, 0], [50, 0, 0]], float))
    for number, roads in enumerate(((), (lane,))):
        scene = scenes.scene_of([scenes.driver()], roads=roads)
        file = scenes.bank_of([scene], tmp_path, f"bare{number}")
        assert points_judged(file, [(0, 0), (30, 3), (500, 500)]) == [False] * 3


def test_beyond_the_grid_the_nearest_cells_edges_decide(tmp_path: Path) -> None:
    """Exact on the grid only; outside, an edge goes on as a line."""
    file = scenes.bank_of([scenes.scene_of([scenes.driver()])], tmp_path)
    outside = [(1000.0, 0.0), (-900.0, 0.0), (50.0, 800.0), (50.0, -800.0)]
    assert points_judged(file, outside) == [False, False, True, True]


def test_offroad_compiles_once(tmp_path: Path) -> None:
    file = scenes.bank_of(list(generate_many(2, 2)), tmp_path)
    bank = file.bank
    offroad, traces = scenes.counted(metrics.offroad)
    for index in range(2):
        box = metrics.Box(*(jnp.float32(value) for value in (index, 0, 0, 4, 2)))
        offroad(bank, jnp.int32(index), box, jnp.float32(0))
    assert len(traces) == 1
