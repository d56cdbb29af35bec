"""The brute-force metrics: cases worked by hand, and the counts on real scenes."""

from pathlib import Path

import numpy as np
import pytest

from sim.formats import read_scenes
from sim.womd import parse_scenario
from tests import oracle, records

_SQUARE = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [0, 0, 0]], float)


def _wrong(points: list[list[float]], edge: np.ndarray, z: float = 0.0) -> list[bool]:
    heights = np.full(len(points), z)
    return oracle.corners_offroad(np.array(points), heights, [edge]).tolist()


def test_left_of_an_edge_is_the_road() -> None:
    edge = np.array([[0, 0, 0], [10, 0, 0]], float)
    assert _wrong([[5, 1], [5, -1]], edge) == [False, True]


def test_a_ring_driven_anticlockwise_holds_the_road_inside() -> None:
    points = [[5.0, 5.0], [-1.0, -1.0], [11.0, 5.0], [0.5, 0.5], [11.0, 11.0]]
    assert _wrong(points, _SQUARE) == [False, True, True, False, True]


def test_a_ring_driven_clockwise_is_an_island() -> None:
    points = [[5.0, 5.0], [-1.0, -1.0], [11.0, 5.0], [-1.0, 0.5]]
    assert _wrong(points, _SQUARE[::-1]) == [True, False, False, False]


def test_at_a_right_turn_left_of_either_segment_is_the_road() -> None:
    # Beyond a hairpin's tip: right of the first segment, left of the second.
    hairpin = np.array([[0, 0, 0], [10, 0, 0], [0, -1, 0]], float)
    assert _wrong([[11.0, -0.05], [9.0, -0.05]], hairpin) == [False, True]


def test_at_a_left_turn_only_left_of_both_segments_is_the_road() -> None:
    # Beyond a hairpin's tip: left of the first segment, right of the second.
    hairpin = np.array([[0, 0, 0], [10, 0, 0], [0, 1, 0]], float)
    assert _wrong([[11.0, 0.05], [9.0, 0.05]], hairpin) == [True, False]


def test_the_edge_of_a_bridge_is_not_this_roads_edge() -> None:
    below = np.array([[0, 0, 0], [10, 0, 0]], float)
    bridge = np.array([[10, 1.5, 6], [0, 1.5, 6]], float)
    points = np.array([[5.0, 2.0]])
    # Left of the road's edge, but right of the bridge's, which runs the other way.
    for height, expected in ((0.0, False), (6.0, True)):
        wrong = oracle.corners_offroad(points, np.array([height]), [below, bridge])
        assert wrong.tolist() == [expected]


def test_repeated_points_make_no_segment() -> None:
    edge = np.array([[0, 0, 0], [5, 0, 0], [5, 0, 0], [10, 0, 0]], float)
    assert _wrong([[5, 1], [5, -1]], edge) == [False, True]


def test_no_edge_no_offroad() -> None:
    assert not oracle.corners_offroad(np.zeros((2, 2)), np.zeros(2), []).any()


def test_boxes_overlap_at_full_size() -> None:
    centre = np.array([[0, 0], [4.4, 0], [0, 3.2], [20, 0]], float)
    yaw = np.array([0, 0, np.pi / 4, 0])
    boxes = oracle.corners(centre, yaw, np.full(4, 4.5), np.full(4, 2.0))
    # The turned box reaches (4.5 + 2) / 2 / sqrt(2) = 2.298 m down to y = 0.902.
    assert oracle.boxes_overlap(boxes).any(1).tolist() == [True, True, True, False]
    boxes[2] += [0.0, 0.2]
    assert oracle.boxes_overlap(boxes).any(1).tolist() == [True, True, False, False]


def test_kinematic_infeasibility_by_hand() -> None:
    # Speed before and after, and the heading of the velocity after; yaw is 0.
    cases = ((5.0, 7.0, 0.0), (1.0, 1.0, 0.05), (1.0, 1.0, 0.02), (0.5, 0.5, 3.0))
    message = records.scenario(objects=len(cases), steps=4)
    message.current_time_index = 0
    for track, (before, after, heading) in zip(message.tracks, cases, strict=True):
        track.states[1].velocity_x = 100.0  # an invalid state, which decides nothing
        track.states[2].velocity_x = before
        track.states[3].velocity_x = after * np.cos(heading)
        track.states[3].velocity_y = after * np.sin(heading)
    found = oracle.kinematic(parse_scenario(message.SerializeToString(), source="-"))
    # 20 m/s^2; 0.5 1/m; 0.2 1/m; too slow for the heading to mean anything.
    assert found[:, 3].tolist() == [True, True, False, False]
    assert not found[:, :3].any()


@pytest.mark.parametrize(
    ("scenario", "objects", "valid", "counts", "kinematic"),
    [
        ("ef3a8f65142f41ac", 62, 3751, (2533, 75), {79}),
        # One step's acceleration is 10.4 to within rounding.
        ("db4edc9bd0c9d18c", 81, 4802, (2552, 98), {265, 266}),
    ],
)
def test_counts_on_real_scenes(
    scenes_data: Path,
    scenario: str,
    objects: int,
    valid: int,
    counts: tuple[int, int],
    kinematic: set[int],
) -> None:
    (scene,) = read_scenes([scenes_data / "gpudrive" / f"{scenario}.json"])
    assert (scene.objects, int(scene.valid.sum())) == (objects, valid)
    assert (oracle.offroad(scene).sum(), oracle.overlap(scene).sum()) == counts
    assert int(oracle.kinematic(scene).sum()) in kinematic
