"""The curves, quick checks and traffic under the procedural scenes."""

from collections.abc import Callable

import numpy as np
import pytest

from sim.procedural import follow, generate_many
from sim.procedural_checks import EdgeMap, overlaps
from sim.procedural_crossing import crossing
from sim.procedural_geometry import STEP, decimate, integrate, turn
from sim.procedural_map import Layout
from sim.procedural_merge import merge
from sim.procedural_population import populate
from sim.procedural_roads import curved_road
from sim.procedural_traffic import simulate
from tests import oracle


def test_turn_meets_both_rays_and_its_curvature_is_continuous() -> None:
    """A quarter turn to the right from x to -y with tangents of 8 m."""
    start, end = np.array([-20.0, 0.0]), np.array([0.0, -12.0])
    points = turn(start, 0.0, end, -np.pi / 2, 8.0)
    np.testing.assert_allclose(points[0], start)
    np.testing.assert_allclose(points[-1], end)
    assert (points[:, 0] <= 1e-9).all() and (points[:, 1] <= 1e-9).all()
    delta = np.diff(points, axis=0)[1:-1]
    yaw = np.arctan2(delta[:, 1], delta[:, 0])
    curvature = np.diff(yaw) / np.hypot(*delta[1:].T)
    assert curvature.max() <= 1e-9
    assert -0.25 < curvature.min() < -1 / 8.0
    assert np.abs(np.diff(curvature)).max() < 0.02


def test_constant_curvature_is_a_circle() -> None:
    """A full turn of radius 40 m ends where it began, to the midpoint rule's error."""
    steps = round(2 * np.pi * 40.0 / STEP)
    circle = integrate(np.full(steps + 1, 2 * np.pi / (steps * STEP)))
    assert np.hypot(*circle.points[-1]) < 0.01
    centre = np.array([0.0, steps * STEP / (2 * np.pi)])
    np.testing.assert_allclose(
        np.hypot(*(circle.points - centre).T), centre[1], atol=0.01
    )
    few = decimate(circle.points)
    assert len(few) < len(circle.points)
    middle = 0.5 * (few[1:] + few[:-1])
    np.testing.assert_allclose(np.hypot(*(middle - centre).T), centre[1], atol=0.01)


def test_quick_checks_agree_with_the_oracle() -> None:
    """On random poses about the road, except near the edge; boxes exactly."""
    rng = np.random.default_rng(0)
    for scene in generate_many(17, 12):
        edges = [edge[:, :2] for edge in oracle.road_edges(scene)]
        flat = [np.pad(edge, ((0, 0), (0, 1))) for edge in edges]
        quick = EdgeMap(
            np.concatenate([e[:-1] for e in edges]),
            np.concatenate([e[1:] for e in edges]),
        )
        anchor = np.concatenate([e for e in edges])
        points = anchor[rng.integers(0, len(anchor), 400)]
        points = points + rng.normal(0, 6.0, points.shape)
        truth = oracle.corners_offroad(points, np.zeros(len(points)), flat)
        far = oracle.edge_distance(points, np.zeros(len(points)), flat) > 0.05
        assert (quick.outside(points) == truth)[far].mean() > 0.99, scene.scenario_id
    pose = np.stack(
        [rng.normal(0, 3, 60), rng.normal(0, 3, 60), rng.uniform(-4, 4, 60)]
    )
    size = np.stack([rng.uniform(1, 5, 60), rng.uniform(0.5, 2.5, 60)], -1)
    boxes = oracle.corners(pose[:2].T, pose[2], size[:, 0], size[:, 1])
    mine = overlaps(pose.T[:, None], size, np.ones((60, 1), dtype=bool), 0.0)
    np.testing.assert_array_equal(mine, oracle.boxes_overlap(boxes))


@pytest.mark.parametrize("family", [curved_road, crossing, merge])
def test_hardly_anybody_has_to_be_removed(family: Callable[..., Layout]) -> None:
    """The traffic itself keeps apart; the final check is a safety net.

    Objects a scene that meet another: 0 to 0.1 here; without yielding 0.7 on
    crossings, without the zipper rule 1.2 on merges.
    """
    meetings = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        layout = family(rng, 111)
        fleet = populate(rng, layout)
        objects = follow(layout, fleet, simulate(layout, fleet, 20, 91))
        meet = overlaps(objects.pose, objects.size[:, :2], objects.valid, 0.3)
        meetings.append(int(meet.any(axis=1).sum()))
    assert np.mean(meetings) < 0.4, meetings
