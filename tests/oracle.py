"""Brute-force metrics by their definitions: float64, every pair, no grid, no table.

The simulator's fast metrics are held to these. Where both sides of an edge's line are
asked for, a point on the line counts as the wrong side.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from sim.scene import Scene

_CHUNK = 16  # points at a time against all edges: what a cache holds
_HEIGHT_WEIGHT = 2.0  # height differences count double in the distance to an edge
_CLOSED = 1e-3  # m between the ends of an edge that is a ring
MAX_ACCELERATION = 10.4  # m/s^2
MAX_CURVATURE = 0.3  # 1/m
MIN_SPEED = 0.6  # m/s, below which the velocity's heading is noise


class Segments:
    """All edges' segments, and which ones adjoin them (-1 at an open end)."""

    def __init__(self, edges: Sequence[Float[np.ndarray, "points 3"]]) -> None:
        """Cuts the polylines; repeated points make no segment."""
        starts, ends, before, after = [], [], [], []
        first = 0
        for edge in edges:
            moved = np.abs(np.diff(edge[:, :2], axis=0)).max(axis=1) > 0
            points = edge[np.concatenate([[True], moved])]
            count = len(points) - 1
            if count < 1:
                continue
            ring = count > 2 and np.linalg.norm(points[0] - points[-1]) < _CLOSED
            index = np.arange(first, first + count)
            starts.append(points[:-1])
            ends.append(points[1:])
            before.append(np.concatenate([[index[-1] if ring else -1], index[:-1]]))
            after.append(np.concatenate([index[1:], [index[0] if ring else -1]]))
            first += count
        self.count = first
        if first:
            self.start = np.concatenate(starts)
            self.step = np.concatenate(ends) - self.start
            self.before = np.concatenate(before)
            self.after = np.concatenate(after)

    def is_left(
        self, index: np.ndarray, points: Float[np.ndarray, "points 3"]
    ) -> Bool[np.ndarray, " points"]:
        """Whether each point lies left of its segment's line."""
        relative = points[:, :2] - self.start[index, :2]
        step = self.step[index]
        return step[:, 0] * relative[:, 1] - step[:, 1] * relative[:, 0] > 0

    def nearest(
        self, points: Float[np.ndarray, "points 3"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each point's nearest segment, how far along it (0 to 1) and its distance."""
        weight = np.array([1.0, 1.0, _HEIGHT_WEIGHT])
        start, step = self.start * weight, self.step * weight
        relative = points[:, None] * weight - start
        along = (relative * step).sum(-1) / (step**2).sum(-1)
        along = np.clip(along, 0.0, 1.0)
        distance = ((relative - along[..., None] * step) ** 2).sum(-1)
        index = distance.argmin(1)
        row = np.arange(len(points))
        return index, along[row, index], np.sqrt(distance[row, index])


def corners_offroad(
    points: Float[np.ndarray, "points 2"],
    z: Float[np.ndarray, " points"],
    edges: Sequence[Float[np.ndarray, "_ 3"]],
) -> Bool[np.ndarray, " points"]:
    """Whether each point lies on the wrong side of its nearest edge.

    Where the nearest place is a vertex, both adjoining segments decide: in a left turn
    the point must be left of both, in a right turn left of either.
    """
    segments = Segments(edges)
    wrong = np.zeros(len(points), bool)
    if not segments.count:
        return wrong
    positions = np.concatenate([points, z[:, None]], axis=1)
    for begin in range(0, len(points), _CHUNK):
        part = positions[begin : begin + _CHUNK]
        index, along, _ = segments.nearest(part)
        left = segments.is_left(index, part)
        ends = (
            (
                (along <= 0) & (segments.before[index] >= 0),
                segments.before[index],
                index,
            ),
            ((along >= 1) & (segments.after[index] >= 0), index, segments.after[index]),
        )
        for at_vertex, first, second in ends:
            a, b = segments.step[first], segments.step[second]
            left_turn = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
            of_first = segments.is_left(first, part)
            of_second = segments.is_left(second, part)
            both = np.where(left_turn, of_first & of_second, of_first | of_second)
            left = np.where(at_vertex, both, left)
        wrong[begin : begin + _CHUNK] = ~left
    return wrong


def edge_distance(
    points: Float[np.ndarray, "points 2"],
    z: Float[np.ndarray, " points"],
    edges: Sequence[Float[np.ndarray, "_ 3"]],
) -> Float[np.ndarray, " points"]:
    """The distance, m, heights counting double, to the nearest edge."""
    segments = Segments(edges)
    if not segments.count:
        return np.full(len(points), np.inf)
    positions = np.concatenate([points, z[:, None]], axis=1)
    return np.concatenate(
        [
            segments.nearest(positions[begin : begin + _CHUNK])[2]
            for begin in range(0, len(points), _CHUNK)
        ]
        or [np.zeros(0)]
    )


def corners(
    centre: Float[np.ndarray, "*batch 2"],
    yaw: Float[np.ndarray, "*batch"],
    length: Float[np.ndarray, "*batch"],
    width: Float[np.ndarray, "*batch"],
) -> Float[np.ndarray, "*batch 4 2"]:
    """The corners of oriented boxes, in order around each."""
    forward = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    side = np.stack([-np.sin(yaw), np.cos(yaw)], -1)
    return np.stack(
        [
            centre
            + forward * (ahead * length / 2)[..., None]
            + side * (aside * width / 2)[..., None]
            for ahead, aside in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ],
        -2,
    )


def road_edges(scene: Scene) -> list[Float[np.ndarray, "_ 3"]]:
    """The polylines that bound the drivable surface."""
    return [road.points for road in scene.roads if road.kind.is_edge]


def scene_corners(scene: Scene) -> Float[np.ndarray, "objects steps 4 2"]:
    """Every object's box at full size."""
    return corners(
        scene.position[..., :2], scene.yaw, scene.size[..., 0], scene.size[..., 1]
    )


def offroad(scene: Scene) -> Bool[np.ndarray, "objects steps"]:
    """Whether some corner of the box is on the wrong side of its nearest edge.

    Corners take the height of the object's centre.
    """
    points = scene_corners(scene)[scene.valid].reshape(-1, 2)
    heights = np.repeat(scene.position[..., 2][scene.valid], 4)
    result = np.zeros(scene.valid.shape, bool)
    wrong = corners_offroad(points, heights, road_edges(scene))
    result[scene.valid] = wrong.reshape(-1, 4).any(1)
    return result


def boxes_overlap(
    boxes: Float[np.ndarray, "boxes 4 2"],
) -> Bool[np.ndarray, "boxes boxes"]:
    """Which pairs of boxes share a point: no axis of either separates them."""
    axes = np.stack([boxes[:, 0] - boxes[:, 3], boxes[:, 0] - boxes[:, 1]], 1)
    along = np.einsum("jcd,iad->ijac", boxes, axes)  # box j on box i's axes
    own = np.einsum("icd,iad->iac", boxes, axes)[:, None]
    apart = (along.min(-1) > own.max(-1)) | (along.max(-1) < own.min(-1))
    separated = apart.any(-1)
    meets = ~(separated | separated.T)
    np.fill_diagonal(meets, False)
    return meets


def overlap(scene: Scene) -> Bool[np.ndarray, "objects steps"]:
    """Whether the box intersects another valid object's."""
    boxes = scene_corners(scene)
    result = np.zeros(scene.valid.shape, bool)
    for step in range(scene.steps):
        valid = scene.valid[:, step]
        result[valid, step] = boxes_overlap(boxes[valid, step]).any(1)
    return result


def bicycle_actions(
    velocity_tm1: Float[np.ndarray, "*states 2"],
    velocity_t: Float[np.ndarray, "*states 2"],
    yaw_tm1: Float[np.ndarray, "*states"],
    dt: float,
) -> tuple[Float[np.ndarray, "*states"], Float[np.ndarray, "*states"]]:
    """Acceleration and curvature between two states by the inverse bicycle model."""
    before = np.linalg.norm(velocity_tm1, axis=-1)
    now = np.linalg.norm(velocity_t, axis=-1)
    acceleration = (now - before) / dt
    heading = np.arctan2(velocity_t[..., 1], velocity_t[..., 0])
    turned = (heading - yaw_tm1 + np.pi) % (2 * np.pi) - np.pi
    travelled = before * dt + 0.5 * acceleration * dt**2
    moving = (before >= MIN_SPEED) & (now >= MIN_SPEED)
    curvature = np.where(moving, turned / np.where(moving, travelled, 1.0), 0.0)
    return acceleration, curvature


def kinematic(scene: Scene) -> Bool[np.ndarray, "objects steps"]:
    """Whether the step that ends at t needs too much acceleration or curvature.

    By the inverse bicycle model, where both states are valid; False at step 0.
    """
    velocity = scene.velocity
    acceleration, curvature = bicycle_actions(
        velocity[:, :-1], velocity[:, 1:], scene.yaw[:, :-1], scene.dt
    )
    too_much = (np.abs(acceleration) > MAX_ACCELERATION) | (
        np.abs(curvature) > MAX_CURVATURE
    )
    result = np.zeros(scene.valid.shape, bool)
    result[:, 1:] = too_much & scene.valid[:, 1:] & scene.valid[:, :-1]
    return result
