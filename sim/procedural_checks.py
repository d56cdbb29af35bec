"""What a procedural scene must satisfy before it is handed out, in plain numpy.

Overlap is the separating-axis test of full-size boxes, grown by a margin. The
off-road test looks up the nearest piece of road edge by the pieces' midpoints and
then decides exactly among it and its neighbours; `sim.metrics` has the definition.
"""

from typing import final

import numpy as np
from jaxtyping import Bool, Float

from sim.procedural_geometry import nearest

_PIECE = 2.0  # m, longest piece of road edge


def box_corners(
    pose: Float[np.ndarray, "*n 3"], size: Float[np.ndarray, "*n 2"], grow: float = 0.0
) -> Float[np.ndarray, "*n 4 2"]:
    """Corners of boxes at (x, y, yaw), grown by `grow` metres on every side."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    long = (size[..., 0] / 2 + grow)[..., None] * np.array([1.0, 1.0, -1.0, -1.0])
    wide = (size[..., 1] / 2 + grow)[..., None] * np.array([1.0, -1.0, -1.0, 1.0])
    x = pose[..., 0, None] + cos[..., None] * long - sin[..., None] * wide
    y = pose[..., 1, None] + sin[..., None] * long + cos[..., None] * wide
    return np.stack([x, y], axis=-1)


def boxes_meet(
    pose: Float[np.ndarray, "n 3"],
    size: Float[np.ndarray, "n 2"],
    other_pose: Float[np.ndarray, "n 3"],
    other_size: Float[np.ndarray, "n 2"],
) -> Bool[np.ndarray, " n"]:
    """Separating-axis test of n pairs of boxes."""
    delta = other_pose[:, :2] - pose[:, :2]
    turn = other_pose[:, 2] - pose[:, 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half, other_half = size / 2, other_size / 2
    meet = np.ones(len(pose), dtype=bool)
    for own, own_half, far_half in (
        (pose, half, other_half),
        (other_pose, other_half, half),
    ):
        c, s = np.cos(own[:, 2]), np.sin(own[:, 2])
        along = np.abs(c * delta[:, 0] + s * delta[:, 1])
        aside = np.abs(c * delta[:, 1] - s * delta[:, 0])
        meet &= along <= own_half[:, 0] + cos * far_half[:, 0] + sin * far_half[:, 1]
        meet &= aside <= own_half[:, 1] + sin * far_half[:, 0] + cos * far_half[:, 1]
    return meet


def overlaps(
    pose: Float[np.ndarray, "a t 3"],
    size: Float[np.ndarray, "a 2"],
    valid: Bool[np.ndarray, "a t"],
    margin: float,
) -> Bool[np.ndarray, "a a"]:
    """Whether two objects ever come within `margin` of each other."""
    centre = pose[..., :2].transpose(1, 0, 2)
    square = (centre**2).sum(-1)
    apart = square[:, :, None] + square[:, None, :]
    apart = apart - 2 * np.einsum("tac,tbc->tab", centre, centre)
    radius = np.hypot(size[:, 0], size[:, 1]) / 2 + margin
    near = apart < (radius[:, None] + radius[None, :]) ** 2 + 1e-6
    near &= valid.T[:, :, None] & valid.T[:, None, :]
    near &= np.triu(np.ones(near.shape[1:], dtype=bool), 1)
    t, a, b = np.nonzero(near)
    grown = size + margin
    hit = boxes_meet(pose[a, t], grown[a], pose[b, t], grown[b])
    result = np.zeros((len(size), len(size)), dtype=bool)
    result[a[hit], b[hit]] = True
    return result | result.T


@final
class EdgeMap:
    """Road edges cut into short pieces, for quick off-road tests."""

    def __init__(
        self,
        starts: Float[np.ndarray, "segments 2"],
        ends: Float[np.ndarray, "segments 2"],
    ) -> None:
        """Cuts the segments."""
        length = np.hypot(*(ends - starts).T)
        count = np.maximum(1, np.ceil(length / _PIECE)).astype(np.int64)
        index = np.repeat(np.arange(len(count)), count)
        part = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
        step = (ends - starts)[index] / count[index, None]
        self._start = starts[index] + part[:, None] * step
        self._step = step
        self._middle = self._start + 0.5 * step

    def outside(self, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether a point lies right of its nearest edge."""
        middle = nearest(points, self._middle)
        last = len(self._step) - 1
        k = np.clip(middle[:, None] + np.array([-1, 0, 1]), 0, last)
        step = self._step[k]
        gap = points[:, None] - self._start[k]
        share = (gap * step).sum(-1) / np.maximum((step**2).sum(-1), 1e-12)
        foot = gap - np.clip(share, 0.0, 1.0)[..., None] * step
        distance = (foot**2).sum(-1)
        left = step[..., 0] * gap[..., 1] - step[..., 1] * gap[..., 0]
        # At a vertex both pieces are equally near: the one that sees the point more
        # squarely (the larger distance to its line) has the right sign.
        square = left**2 / np.maximum((step**2).sum(-1), 1e-12)
        tied = distance <= distance.min(axis=1, keepdims=True) + 1e-9
        best = np.where(tied, square, -1.0).argmax(axis=1)
        return left[np.arange(len(k)), best] <= 0


def coasts_into(
    edges: EdgeMap,
    pose: Float[np.ndarray, "a t 3"],
    size: Float[np.ndarray, "a 2"],
    valid: Bool[np.ndarray, "a t"],
    who: int,
    coasting: Float[np.ndarray, "t 3"],
) -> tuple[bool, bool]:
    """Whether `who`, moved along `coasting`, overlaps others; leaves the road."""
    corners = box_corners(coasting[::3], np.tile(size[who], (len(coasting[::3]), 1)))
    off = bool(edges.outside(corners.reshape(-1, 2)).any())
    others = valid.copy()
    others[who] = False
    a, t = np.nonzero(others)
    mine = np.broadcast_to(size[who], (len(a), 2))
    hit = boxes_meet(pose[a, t], size[a], coasting[t], mine)
    return bool(hit.any()), off
