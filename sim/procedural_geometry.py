"""Plane curves for the procedural maps: clothoid-like roads, turns, offsets.

A curve is an array of points [n, 2] in metres, walked from first to last. Offsets
are positive to the left of the walk. Roads come from a curvature profile kappa(u),

    yaw(u) = integral of kappa,   (x, y)(u) = integral of (cos yaw, sin yaw),

by the midpoint rule every `STEP` metres; turns through a junction have a trapezoid
of curvature (clothoid, arc, clothoid), so that steering never jumps.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

STEP = 0.5  # m between the samples of a driving path
_RAMP = 0.35  # share of a turn's length on which the curvature rises, and falls


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A road's reference line, every `STEP` metres."""

    points: Float[np.ndarray, "n 2"]  # m
    yaw: Float[np.ndarray, " n"]  # rad, not wrapped

    @property
    def length(self) -> float:
        """Arc length in metres."""
        return STEP * (len(self.yaw) - 1)

    def stations(self) -> Float[np.ndarray, " n"]:
        """Arc length at every sample in metres."""
        return STEP * np.arange(len(self.yaw))

    def offset(self, left: Float[np.ndarray, " n"] | float) -> Float[np.ndarray, "n 2"]:
        """The curve at this distance to the left of every sample."""
        normal = np.stack([-np.sin(self.yaw), np.cos(self.yaw)], axis=-1)
        lateral = np.broadcast_to(np.asarray(left, np.float64), self.yaw.shape)
        return self.points + lateral[:, None] * normal

    def span(
        self,
        left: Float[np.ndarray, " n"] | float,
        low: float = 0.0,
        high: float = np.inf,
    ) -> Float[np.ndarray, "m 2"]:
        """The offset curve between two stations, rounded to samples."""
        first = round(max(low, 0.0) / STEP)
        last = round(min(high, self.length) / STEP)
        return self.offset(left)[first : last + 1]


def integrate(
    curvature: Float[np.ndarray, " n"], yaw: float = 0.0, x: float = 0.0, y: float = 0.0
) -> Reference:
    """The curve of a curvature profile given every `STEP` metres."""
    turned = yaw + STEP * np.concatenate([[0.0], np.cumsum(curvature[:-1])])
    middle = turned[:-1] + 0.5 * STEP * curvature[:-1]
    steps = STEP * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    start = np.array([[x, y]])
    points = np.concatenate([start, start + np.cumsum(steps, axis=0)])
    return Reference(points=points, yaw=turned)


def smooth(values: Float[np.ndarray, " n"], metres: float) -> Float[np.ndarray, " n"]:
    """Two moving averages: piecewise constant curvature becomes clothoid-like."""
    width = max(1, round(metres / STEP))
    kernel = np.ones(width) / width
    for _ in range(2):
        padded = np.pad(values, (width // 2, width - 1 - width // 2), mode="edge")
        values = np.convolve(padded, kernel, mode="valid")
    return values


def smoothstep(value: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Rises from 0 to 1 on [0, 1] with zero first and second derivatives."""
    t = np.clip(value, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t**2)


def headings(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Unwrapped direction of the walk at every point, by central differences."""
    delta = np.gradient(points, axis=0)
    return np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))


def resample(
    points: Float[np.ndarray, "n 2"], step: float = STEP
) -> Float[np.ndarray, "m 2"]:
    """The same curve with samples equally far apart, `step` as nearly as fits."""
    station = stations_of(points)
    count = max(2, round(station[-1] / step) + 1)
    at = np.linspace(0.0, station[-1], count)
    return np.stack([np.interp(at, station, points[:, k]) for k in (0, 1)], axis=-1)


def stations_of(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Arc length from the first point."""
    gaps = np.hypot(*np.diff(points, axis=0).T)
    return np.concatenate([[0.0], np.cumsum(gaps)])


def nearest(
    points: Float[np.ndarray, "n 2"], samples: Float[np.ndarray, "m 2"]
) -> Int[np.ndarray, " n"]:
    """Index of the sample nearest to each point, or of one as near as 0.1 m^2.

    |p - q|^2 less |p|^2 is one product, in float32. Blocks are small enough for the
    cache, and for BLAS to stay on one thread: with several generators on a machine,
    threads for such small products made a scene take three times as long.
    """
    x, y = samples[:, 0], samples[:, 1]
    right = np.stack([-2 * x, -2 * y, x**2 + y**2]).astype(np.float32)
    left = np.ones((len(points), 3), np.float32)
    left[:, :2] = points
    rows = max(1, 80_000 // len(samples))
    result = np.empty(len(points), np.int64)
    for first in range(0, len(points), rows):
        block = left[first : first + rows]
        result[first : first + rows] = (block @ right).argmin(axis=1)
    return result


def decimate(
    points: Float[np.ndarray, "n 2"], bend: float = 0.02, longest: float = 10.0
) -> Float[np.ndarray, "m 2"]:
    """Drops points so that a chord bends by `bend` radians or is `longest` metres.

    The chord is then at most `bend` * length / 8 from the curve: millimetres.
    """
    delta = np.diff(points, axis=0)
    length = np.hypot(delta[:, 0], delta[:, 1])
    real = length > 1e-6
    points = points[np.concatenate([[True], real])]
    delta, length = delta[real], length[real]
    yaw = np.arctan2(delta[:, 1], delta[:, 0])
    turned = np.abs((np.diff(yaw) + np.pi) % (2 * np.pi) - np.pi)
    # A point is kept where the budget of bend and length overflows.
    spent = np.floor(np.cumsum(turned / bend + length[1:] / longest))
    kept = np.diff(spent, prepend=0.0) > 0
    return points[np.concatenate([[True], kept, [True]])]


def _unit_turn(angle: float) -> Float[np.ndarray, "n 2"]:
    """A turn by `angle` of length 1 from the origin along x."""
    t = np.linspace(0.0, 1.0, 65)
    shape = np.minimum(np.minimum(t, 1 - t) / _RAMP, 1.0)
    middle = 0.5 * (shape[1:] + shape[:-1])
    yaw = angle * np.concatenate([[0.0], np.cumsum(middle)]) / middle.sum()
    halfway = 0.5 * (yaw[1:] + yaw[:-1])
    steps = np.stack([np.cos(halfway), np.sin(halfway)], axis=-1) / (len(t) - 1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _straight(
    start: Float[np.ndarray, "2"], end: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n 2"]:
    """Samples about every `STEP` metres from one point to another."""
    count = max(1, round(float(np.hypot(*(end - start))) / STEP))
    return np.linspace(start, end, count + 1)


def turn(
    start: Float[np.ndarray, "2"],
    start_yaw: float,
    end: Float[np.ndarray, "2"],
    end_yaw: float,
    longest_tangent: float = np.inf,
) -> Float[np.ndarray, "n 2"]:
    """Joins two rays: straight, clothoid, arc, clothoid, straight.

    The rays must meet ahead of `start` and behind `end`. The bend takes up the
    shorter of the two distances to their meeting point, or `longest_tangent`.
    """
    angle = float((end_yaw - start_yaw + np.pi) % (2 * np.pi) - np.pi)
    forward = np.array([np.cos(start_yaw), np.sin(start_yaw)])
    onward = np.array([np.cos(end_yaw), np.sin(end_yaw)])
    if abs(np.sin(angle)) < 1e-3:
        return _straight(start, end)
    gap = end - start
    cross = forward[0] * onward[1] - forward[1] * onward[0]
    to_corner = float(gap[0] * onward[1] - gap[1] * onward[0]) / cross
    from_corner = float(forward[0] * gap[1] - forward[1] * gap[0]) / cross
    tangent = min(to_corner, from_corner, longest_tangent)
    unit = _unit_turn(angle)
    unit_tangent = unit[-1, 0] - unit[-1, 1] / np.tan(angle)
    rotation = np.array([forward, [-forward[1], forward[0]]])
    begin = start + (to_corner - tangent) * forward
    bend = begin + (tangent / unit_tangent) * unit @ rotation
    joined = np.concatenate([_straight(start, begin), bend, _straight(bend[-1], end)])
    keep = np.hypot(*np.diff(joined, axis=0).T) > 1e-6
    return joined[np.concatenate([[True], keep])]
