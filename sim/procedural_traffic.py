"""Joint traffic of a procedural scene: everyone drives along a path, none overlaps.

Longitudinal law, every `CONTROL` s, with the accelerations held in between:

    a = min(free, a_0 (1 - (s* / gap)^2))
    s* = s_0 + max(0, v T + v dv / (2 sqrt(a_0 b)))

the Intelligent Driver Model (Treiber, Hennecke, Helbing, Phys. Rev. E 62, 2000) with
a free term that also tracks a falling speed profile. The gap is the smallest to:

- a leader: whoever's box reaches into the own path's corridor ahead;
- a stop line: the light asks to stop, or a stop sign was not honoured yet;
- a crossing or joining path's zone, where somebody with the right of way is inside,
  or would be at the same time (rank decides; at stop signs the order of arrival);
- where paths join in turn (`Layout.zipper`), the one who is nearer to the zone.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from sim.procedural_geometry import nearest
from sim.procedural_map import DrivingPath, Layout, Signal
from sim.scene import ObjectType

DT = 0.1  # s
CONTROL = 2  # steps that an acceleration is held
_GRID = 2.0  # m between the samples of the path-to-path tables
_CLEARANCE = 2.7  # m between two paths' centre lines that counts as apart
_FAR = 1e6
_HARDEST = 5.5  # m/s^2, braking
_CHANGE = (1.6, 0.8)  # m/s^2 by which an acceleration may fall, rise per control step


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """Road users that follow paths, before the first step."""

    kind: Int[np.ndarray, " n"]  # `ObjectType`
    path: Int[np.ndarray, " n"]  # index into `Layout.paths`
    station: Float[np.ndarray, " n"]  # m along the path
    speed: Float[np.ndarray, " n"]  # m/s
    size: Float[np.ndarray, "n 3"]  # m
    lateral: Float[np.ndarray, " n"]  # m left of the path
    desired: Float[np.ndarray, " n"]  # factor on the path's speed profile
    cap: Float[np.ndarray, " n"]  # m/s that this one never exceeds
    gap: Float[np.ndarray, " n"]  # m, s_0
    headway: Float[np.ndarray, " n"]  # s, T
    slow_from: Float[np.ndarray, " n"]  # s, start of a while of slowness
    slow_until: Float[np.ndarray, " n"]  # s
    slow_factor: Float[np.ndarray, " n"]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The simulated steps."""

    station: Float[np.ndarray, "n steps"]  # m
    speed: Float[np.ndarray, "n steps"]  # m/s
    alive: Bool[np.ndarray, "n steps"]  # False once past the path's end


@dataclass(frozen=True, kw_only=True)
class PathTables:
    """For path p and the k-th sample of path q, where q's sample lies along p."""

    near: Float[np.ndarray, "p q k 4"]  # station, left, cos and sin of yaw difference
    enter: Float[np.ndarray, "p q"]  # station on p where q's zone begins, or far
    leave: Float[np.ndarray, "p q"]  # and where it ends
    speed: Float[np.ndarray, "p k"]  # m/s, the path's profile


def tabulate(paths: tuple[DrivingPath, ...]) -> PathTables:
    """Relates all paths pairwise (see `PathTables`)."""
    count = len(paths)
    stride = [max(1, round(_GRID / path.step)) for path in paths]
    longest = max(
        len(path.yaw[::every]) for path, every in zip(paths, stride, strict=True)
    )
    x, y, yaw, speed = np.stack(
        [
            _padded(path, every, longest)
            for path, every in zip(paths, stride, strict=True)
        ]
    ).transpose(1, 0, 2)
    near = np.zeros((count, count, longest, 4))
    apart = np.zeros((count, count, longest))
    flat_x, flat_y, flat_yaw = x.ravel(), y.ravel(), yaw.ravel()
    flat = np.stack([flat_x, flat_y], axis=-1)
    for p, path in enumerate(paths):
        real = len(path.yaw[:: stride[p]])
        px, py, pyaw = x[p, :real], y[p, :real], yaw[p, :real]
        k = nearest(flat, np.stack([px, py], axis=-1))
        rx, ry = flat_x - px[k], flat_y - py[k]
        cos, sin = np.cos(pyaw[k]), np.sin(pyaw[k])
        along, left = rx * cos + ry * sin, ry * cos - rx * sin
        station = k * path.step * stride[p] + along
        turn = flat_yaw - pyaw[k]
        beyond = np.maximum(np.abs(along) - 1.5 * _GRID, 0.0)
        near[p] = np.stack([station, left, np.cos(turn), np.sin(turn)], -1).reshape(
            count, longest, 4
        )
        apart[p] = np.hypot(left, beyond).reshape(count, longest)
    enter, leave = _zones(paths, apart)
    return PathTables(near=near, enter=enter, leave=leave, speed=speed)


def _padded(path: DrivingPath, every: int, longest: int) -> Float[np.ndarray, "4 k"]:
    """x, y, yaw and speed every `_GRID` metres, the last sample repeated."""
    rows = np.stack([*path.points[::every].T, path.yaw[::every], path.speed[::every]])
    return np.pad(rows, ((0, 0), (0, longest - rows.shape[1])), mode="edge")


def _zones(
    paths: tuple[DrivingPath, ...], apart: Float[np.ndarray, "p q k"]
) -> tuple[Float[np.ndarray, "p q"], Float[np.ndarray, "p q"]]:
    """Stations on p between which it is too near to q, if both start apart."""
    inside = apart < _CLEARANCE
    first = inside.argmax(axis=-1)
    last = inside.shape[-1] - 1 - inside[..., ::-1].argmax(axis=-1)
    none = ~inside.any(axis=-1) | (first == 0)
    none |= none.T
    step = np.array([path.step * max(1, round(_GRID / path.step)) for path in paths])
    # apart[p, q] walks along q: its zone's ends are stations on q.
    enter = np.where(none, _FAR, step[None, :] * (first - 0.5)).T
    leave = np.where(none, -_FAR, step[None, :] * (last + 0.5)).T
    return enter, leave


@final
class _Drive:
    """One simulation; holds what does not change from step to step."""

    def __init__(self, layout: Layout, fleet: Fleet) -> None:
        """Gathers the per-vehicle and per-pair constants."""
        self.fleet = fleet
        used, own = np.unique(fleet.path, return_inverse=True)
        self.tables = tabulate(tuple(layout.paths[p] for p in used))
        self.own = own
        paths = [layout.paths[p] for p in fleet.path]
        self.signals = layout.signals
        self.zipper = layout.zipper
        self.signal = np.array([path.signal for path in paths])
        self.stop = np.array([path.stop for path in paths])
        self.end = np.array([path.length for path in paths])
        self.grid = np.array([p.step * max(1, round(_GRID / p.step)) for p in paths])
        self.rank = np.array([1000.0 * p.rank for p in paths])
        self.rank += 0.001 * np.arange(len(paths))
        self.sign = np.array([path.must_stop for path in paths])
        self.pending = self.sign.copy()
        self.arrival = np.full(len(paths), np.inf)
        self.length, self.width = fleet.size[:, 0], fleet.size[:, 1]
        self.row, self.column = own[:, None], own[None, :]
        self.enter = self.tables.enter[self.row, self.column]
        self.leave = self.tables.leave[self.row, self.column]
        self.crosses = bool((self.enter < _FAR).any())
        self.reach = np.minimum(self.leave, self.enter + 12.0)
        self.walker = fleet.kind == ObjectType.PEDESTRIAN
        self.itself = np.eye(len(paths), dtype=bool)

    def acceleration(
        self,
        step: int,
        s: Float[np.ndarray, " n"],
        v: Float[np.ndarray, " n"],
        alive: Bool[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:
        """What everybody wants, before the limits on its change."""
        wanted = self._free(step, s, v)
        gap, lead = self._leaders(s, v, alive)
        wanted = np.minimum(wanted, self._follow(v, gap, lead))
        line, held = self._stop_lines(step, s, v)
        wanted = np.minimum(wanted, self._follow(v, line, np.zeros_like(v)))
        if self.crosses and self.zipper:
            gap, lead = self._zip(s, v, alive)
            wanted = np.minimum(wanted, np.maximum(self._follow(v, gap, lead), -2.5))
        elif self.crosses:
            gap = self._yield(s, v, alive, held)
            wanted = np.minimum(wanted, self._follow(v, gap, np.zeros_like(v)))
        return np.where(self.walker, 0.0, wanted)

    def _free(
        self, step: int, s: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Tracks the speed profile half a second ahead."""
        fleet = self.fleet
        k = ((s + 0.5 * v) / self.grid).astype(np.int64)
        k = np.minimum(k, self.tables.speed.shape[1] - 1)
        slow = (fleet.slow_from <= step * DT) & (step * DT < fleet.slow_until)
        desired = self.tables.speed[self.own, k] * fleet.desired
        desired = np.minimum(desired, fleet.cap)
        desired = desired * np.where(slow, fleet.slow_factor, 1.0)
        below = 1.8 * (1 - (v / np.maximum(desired, 0.1)) ** 4)
        return np.where(v <= desired, below, np.maximum((desired - v) / 0.6, -2.5))

    def _follow(
        self,
        v: Float[np.ndarray, " n"],
        gap: Float[np.ndarray, " n"],
        lead: Float[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:
        """IDM's interaction with the nearest thing ahead."""
        fleet = self.fleet
        closing = v * (v - lead) / (2 * np.sqrt(1.8 * 2.2))
        target = fleet.gap + np.maximum(0.0, v * fleet.headway + closing)
        return 1.8 * (1 - (target / np.maximum(gap, 0.3)) ** 2)

    def _leaders(
        self,
        s: Float[np.ndarray, " n"],
        v: Float[np.ndarray, " n"],
        alive: Bool[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Free space to, and speed of, the nearest box in the own corridor."""
        k = np.minimum((s / self.grid).astype(np.int64), self.tables.speed.shape[1] - 1)
        rest = s - k * self.grid
        near = self.tables.near[self.row, self.column, k[None, :]]
        cos, sin = near[..., 2], near[..., 3]
        station = near[..., 0] + cos * rest
        left = near[..., 1] + sin * rest
        long, wide = self.length[None, :] / 2, self.width[None, :] / 2
        aside = np.abs(sin) * long + np.abs(cos) * wide + self.width[:, None] / 2 + 0.35
        ahead = station - s[:, None]
        seen = (np.abs(left) < aside) & (ahead > 0.3) & alive[None, :] & ~self.itself
        gap = ahead - self.length[:, None] / 2 - np.abs(cos) * long - np.abs(sin) * wide
        gap = np.where(seen, gap, _FAR)
        first = gap.argmin(axis=1)
        i = np.arange(len(s))
        return gap[i, first], np.maximum(v[first] * cos[i, first], 0.0)

    def _stop_lines(
        self, step: int, s: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
        """Distance to a line to stop at, and who is held by one."""
        front = self.stop - s - self.length / 2
        need = v**2 / (2 * np.maximum(front, 0.1))
        before = front > -0.5
        there = self.pending & (front < 3.4) & (v < 0.4)
        self.arrival[there & np.isinf(self.arrival)] = step
        self.pending &= step - self.arrival < 6
        held = before & self.pending
        if len(self.signals):
            state = np.where(self.signal >= 0, self.signals[self.signal, step], 0)
            held |= before & (state == Signal.STOP) & (need < 7)
            held |= before & (state == Signal.CAUTION) & (need < 3)
        return np.where(held, np.maximum(front, 0.3) + 1.0, _FAR), held

    def _zip(
        self,
        s: Float[np.ndarray, " n"],
        v: Float[np.ndarray, " n"],
        alive: Bool[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Where paths join, follows whoever is nearer to the junction."""
        mine = self.enter - s[:, None]
        theirs = mine.T
        lengths = (self.length[:, None] + self.length[None, :]) / 2
        seen = (theirs < mine) & (mine < 80) & (theirs > -15) & alive[None, :]
        seen &= self.enter < _FAR
        gap = np.where(seen, mine - theirs - lengths, _FAR)
        first = gap.argmin(axis=1)
        return gap[np.arange(len(s)), first], v[first]

    def _yield(
        self,
        s: Float[np.ndarray, " n"],
        v: Float[np.ndarray, " n"],
        alive: Bool[np.ndarray, " n"],
        held: Bool[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:
        """Distance to the first zone that somebody else goes through before."""
        half = self.length[:, None] / 2
        entry = self.enter - s[:, None] - half
        clear = self.reach - s[:, None] + half
        early, late = _arrive(entry, v), _arrive(clear, v)
        # The one with the right of way may be slower than it could be.
        latest = np.maximum(clear, 0.0) / np.maximum(v, 2.5)[:, None]
        meet = (early < latest.T + 1.2) & (early.T < late + 1.2)
        order = self.rank + np.minimum(self.arrival, 500.0)
        goes = (order[None, :] < order[:, None]) & ~held[None, :]
        inside = (entry.T <= 0) & (clear.T > 0)
        possible = v[:, None] ** 2 < 2 * 5.0 * np.maximum(entry - 0.3, 0.01)
        may = meet & (clear.T > 0) & (entry > 0) & possible
        may &= alive[None, :] & (self.enter < _FAR)
        # At a stop sign one waits at the line until the whole way is free; who waits
        # there for somebody on foot lets the others go meanwhile.
        front = self.stop - s - self.length / 2
        waits = self.sign & (front > -0.5)
        aside = waits & (may & self.walker[None, :]).any(axis=1)
        must = may & ((goes & ~aside[None, :]) | inside)
        gap = np.where(must, entry, _FAR).min(axis=1)
        line = np.where(waits & (gap < _FAR), np.maximum(front, 0.3), _FAR)
        return np.minimum(gap, line) + 1.0


def _arrive(
    distance: Float[np.ndarray, "n n"], v: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n n"]:
    """Seconds to cover a distance when speeding up gently."""
    rate, square = 1.2, (v**2)[:, None]
    ahead = np.clip(distance, 0.0, 1e4)
    return (np.sqrt(square + 2 * rate * ahead) - v[:, None]) / rate


def simulate(layout: Layout, fleet: Fleet, warm_up: int, steps: int) -> Motion:
    """Drives everybody `warm_up + steps` steps and returns the last `steps`."""
    drive = _Drive(layout, fleet)
    s, v = fleet.station.copy(), fleet.speed.copy()
    a = np.zeros_like(s)
    station = np.zeros((len(s), warm_up + steps))
    speed = np.zeros_like(station)
    for step in range(warm_up + steps):
        station[:, step], speed[:, step] = s, v
        if step % CONTROL == 0:
            wanted = drive.acceleration(step, s, v, s < drive.end)
            wanted = np.clip(wanted, a - _CHANGE[0], a + _CHANGE[1])
            a = np.clip(wanted, -_HARDEST, 2.0)
        faster = np.maximum(v + a * DT, 0.0)
        s = s + 0.5 * (v + faster) * DT
        v = faster
    alive = station < (drive.end - drive.length / 2)[:, None]
    return Motion(
        station=station[:, warm_up:],
        speed=speed[:, warm_up:],
        alive=alive[:, warm_up:],
    )
