"""Seeded procedural traffic scenes in WOMD's schema: nothing needs a download.

A scene is drawn in five stages: a layout (map, driving paths, lights) of one of the
families; a population; the joint simulation of its traffic; checks, which remove
whoever comes near another or the road edge; and the choice of the recording vehicle.
Scene i of a seed depends on (seed, i) only.

Conventions are WOMD's (`sim.scene`): 91 steps at 10 Hz, step 10 is the first that an
agent acts at; road edges have the drivable side on their left, a median's closed
outline all around; objects' centres are half their height above the ground.

The recording vehicle is valid throughout, moves at the start and drives on a road
that goes on for at least 160 m after step 10. It is preferred to be one that would
fail by driving on with its heading and speed of step 10, in `_HARD_SHARE` of the
scenes (else many scenes would teach nothing but to coast), and in `_TURN_SHARE` one
that turns where somebody does.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from sim.procedural_checks import EdgeMap, box_corners, coasts_into, overlaps
from sim.procedural_crossing import crossing
from sim.procedural_geometry import headings, resample
from sim.procedural_map import Frame, Layout
from sim.procedural_merge import merge
from sim.procedural_population import draw_size, populate
from sim.procedural_roads import curved_road
from sim.procedural_traffic import DT, Fleet, Motion, simulate
from sim.scene import ObjectType, Scene, TrafficLights

STEPS = 91
CURRENT_STEP = 10
_WARM_UP = 20  # steps before the first recorded one
_MARGIN = 0.4  # m that logged boxes stay apart at least
_EDGE_MARGIN = 0.1  # m that logged boxes stay inside the road edges at least
_AHEAD = 160.0  # m of road that the recording vehicle has after `CURRENT_STEP`
_LEAST, _MOST = 8, 24  # objects
_HARD_SHARE = 0.65
_TURN_SHARE = 0.5
_FAMILIES = (curved_road, crossing, merge)
_FAMILY_SHARES = (0.35, 0.4, 0.25)


@dataclass(frozen=True, kw_only=True)
class Objects:
    """The objects of a scene in the layout's frame, one row each."""

    kind: Int[np.ndarray, " a"]  # `ObjectType`
    pose: Float[np.ndarray, "a t 3"]  # x, y, yaw
    speed: Float[np.ndarray, "a t"]  # m/s along yaw
    size: Float[np.ndarray, "a 3"]  # m
    valid: Bool[np.ndarray, "a t"]
    room: Float[np.ndarray, " a"]  # m of path left after `CURRENT_STEP`

    def keep(self, rows: Bool[np.ndarray, " a"] | Int[np.ndarray, " b"]) -> "Objects":
        """Only these rows."""
        return Objects(
            kind=self.kind[rows],
            pose=self.pose[rows],
            speed=self.speed[rows],
            size=self.size[rows],
            valid=self.valid[rows],
            room=self.room[rows],
        )


def generate(seed: int, index: int = 0) -> Scene:
    """One scene of this seed."""
    return _scene(seed, index)


def generate_many(seed: int, count: int) -> Iterator[Scene]:
    """Scenes 0 to `count` - 1 of this seed, one at a time."""
    for index in range(count):
        yield _scene(seed, index)


def _scene(seed: int, index: int) -> Scene:
    """Draws until a scene passes."""
    rng = np.random.default_rng((seed, index))
    family = _FAMILIES[rng.choice(len(_FAMILIES), p=_FAMILY_SHARES)]
    while True:
        layout = family(rng, _WARM_UP + STEPS)
        fleet = populate(rng, layout)
        motion = simulate(layout, fleet, _WARM_UP, STEPS)
        edges = EdgeMap(*layout.map.edges())
        objects = _clean(_gather(rng, layout, fleet, motion), edges)
        sdc = _recorder(rng, objects, edges)
        if sdc is not None and len(objects.kind) >= _LEAST:
            return _finish(rng, layout, objects, sdc, f"{seed}-{index}")


def _gather(
    rng: np.random.Generator, layout: Layout, fleet: Fleet, motion: Motion
) -> Objects:
    """Traffic, parked vehicles and people on the pavement as rows."""
    traffic = follow(layout, fleet, motion)
    parked = layout.parking[rng.random(len(layout.parking)) < rng.uniform(0.4, 0.9)]
    standing = np.tile(parked[:, None], (1, STEPS, 1))
    sizes = [draw_size(rng, ObjectType.VEHICLE, 0.0) for _ in parked]
    people = [
        _stroll(rng, sidewalk)
        for sidewalk in layout.sidewalks
        for _ in range(int(rng.integers(0, 3)))
    ]
    folk = [draw_size(rng, ObjectType.PEDESTRIAN) for _ in people]
    strolls = np.array([pose for pose, _ in people]).reshape(-1, STEPS, 3)
    paces = np.array([pace for _, pace in people])
    extra = len(parked) + len(people)
    speed = np.concatenate([np.zeros(len(parked)), paces])
    return Objects(
        kind=np.concatenate(
            [
                traffic.kind,
                np.full(len(parked), ObjectType.VEHICLE),
                np.full(len(people), ObjectType.PEDESTRIAN),
            ]
        ),
        pose=np.concatenate([traffic.pose, standing, strolls]),
        speed=np.concatenate([traffic.speed, np.tile(speed[:, None], (1, STEPS))]),
        size=np.concatenate([traffic.size, np.array(sizes + folk).reshape(-1, 3)]),
        valid=np.concatenate([traffic.valid, np.ones((extra, STEPS), dtype=bool)]),
        room=np.concatenate([traffic.room, np.zeros(extra)]),
    )


def follow(layout: Layout, fleet: Fleet, motion: Motion) -> Objects:
    """Poses of those who follow paths."""
    pose = np.zeros((*motion.station.shape, 3))
    speed = np.zeros_like(motion.station)
    room = np.zeros(len(fleet.path))
    for row, p in enumerate(fleet.path):
        path = layout.paths[p]
        along = motion.station[row] / path.step
        k = np.minimum(along.astype(np.int64), len(path.yaw) - 2)
        share = (along - k)[:, None]
        table = np.column_stack([path.points, path.yaw, path.curvature])
        x, y, yaw, bend = ((1 - share) * table[k] + share * table[k + 1]).T
        left = fleet.lateral[row]
        pose[row] = np.stack([x - left * np.sin(yaw), y + left * np.cos(yaw), yaw], -1)
        speed[row] = motion.speed[row] * (1 - bend * left)
        room[row] = path.length - motion.station[row, CURRENT_STEP]
    return Objects(
        kind=fleet.kind,
        pose=pose,
        speed=speed,
        size=fleet.size,
        valid=motion.alive,
        room=room,
    )


def _stroll(
    rng: np.random.Generator, sidewalk: Float[np.ndarray, "_ 2"]
) -> tuple[Float[np.ndarray, "t 3"], float]:
    """Somebody walks along a pavement."""
    line = resample(sidewalk)[:: rng.choice([-1, 1])]
    yaw, pace = headings(line), rng.uniform(0.9, 1.6)
    at = rng.uniform(0.1, 0.8) * len(line) + pace * DT / 0.5 * np.arange(STEPS)
    index = np.arange(len(line))
    columns = (line[:, 0], line[:, 1], yaw)
    return np.stack([np.interp(at, index, c) for c in columns], axis=-1), pace


def _clean(objects: Objects, edges: EdgeMap) -> Objects:
    """Removes who leaves the road or comes too near to another."""
    vehicle = objects.kind == ObjectType.VEHICLE
    size = objects.size[:, :2]
    off = np.zeros(len(vehicle), dtype=bool)
    poses = objects.pose[vehicle][:, ::3]
    shape = (*poses.shape[:2], 2)
    corners = box_corners(
        poses, np.broadcast_to(size[vehicle][:, None], shape), _EDGE_MARGIN
    )
    outside = edges.outside(corners.reshape(-1, 2)).reshape(*shape[:2], 4)
    seen = objects.valid[vehicle][:, ::3]
    off[vehicle] = (outside.any(-1) & seen).any(-1)
    objects = objects.keep(~off & objects.valid[:, CURRENT_STEP])
    meet = overlaps(objects.pose, objects.size[:, :2], objects.valid, _MARGIN)
    gone = np.zeros(len(meet), dtype=bool)
    while meet.any():
        worst = int(meet.sum(axis=1).argmax())
        gone[worst] = True
        meet[worst] = meet[:, worst] = False
    return objects.keep(~gone)


def _recorder(rng: np.random.Generator, objects: Objects, edges: EdgeMap) -> int | None:
    """The row of the recording vehicle, or None if nobody will do."""
    driven = objects.speed[:, CURRENT_STEP:].sum(axis=1) * DT
    enough = 30.0 if rng.random() < 0.95 else 12.0
    fit = (objects.kind == ObjectType.VEHICLE) & objects.valid.all(axis=1)
    fit &= (objects.speed[:, 0] > 2.0) & (objects.speed[:, CURRENT_STEP] > 1.0)
    fit &= (driven >= enough) & (objects.room > _AHEAD)
    hard = rng.random() < _HARD_SHARE
    candidates = rng.permutation(np.nonzero(fit)[0])
    if rng.random() < _TURN_SHARE:
        # Whoever turns comes first: on a crossing most go straight on.
        turned = objects.pose[candidates, -1, 2] - objects.pose[candidates, 0, 2]
        candidates = candidates[np.argsort(np.abs(turned) < 0.6, kind="stable")]
    for row in candidates[:8]:
        fails = any(_coast(objects, edges, int(row)))
        if fails == hard:
            return int(row)
    return int(candidates[0]) if len(candidates) else None


def _coast(objects: Objects, edges: EdgeMap, row: int) -> tuple[bool, bool]:
    """How this vehicle fails (overlap, off-road) by keeping heading and speed."""
    start = objects.pose[row, CURRENT_STEP]
    far = objects.speed[row, CURRENT_STEP] * DT * np.arange(STEPS - CURRENT_STEP)
    forward = np.array([np.cos(start[2]), np.sin(start[2]), 0.0])
    return coasts_into(
        edges,
        objects.pose[:, CURRENT_STEP:],
        objects.size[:, :2],
        objects.valid[:, CURRENT_STEP:],
        row,
        start + far[:, None] * forward,
    )


def _finish(
    rng: np.random.Generator, layout: Layout, objects: Objects, sdc: int, name: str
) -> Scene:
    """Keeps the nearest objects and puts everything into the world."""
    here = objects.pose[:, CURRENT_STEP, :2]
    distance = np.hypot(*(here - here[sdc]).T)
    kept = np.sort(distance.argsort(kind="stable")[:_MOST])
    objects = objects.keep(kept)
    sdc = int(np.searchsorted(kept, sdc))
    frame = Frame(
        yaw=rng.uniform(-np.pi, np.pi),
        x=rng.uniform(-1000, 1000),
        y=rng.uniform(-1000, 1000),
        z=rng.uniform(-20, 20),
        slope=(rng.uniform(-0.02, 0.02), rng.uniform(-0.02, 0.02)),
    )
    yaw = (objects.pose[..., 2] + frame.yaw + np.pi) % (2 * np.pi) - np.pi
    position = frame.points(objects.pose[..., :2])
    position[..., 2] += objects.size[:, None, 2] / 2
    direction = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    count = len(kept)
    return Scene(
        scenario_id=f"{layout.family}-{name}",
        dt=DT,
        current_step=CURRENT_STEP,
        sdc_index=sdc,
        object_ids=np.arange(count),
        object_types=objects.kind.astype(np.int64),
        position=position,
        yaw=yaw,
        velocity=objects.speed[..., None] * direction,
        size=np.tile(objects.size[:, None], (1, STEPS, 1)),
        valid=objects.valid,
        roads=layout.map.polylines(frame),
        lights=_lights(layout, frame),
        tracks_to_predict=(sdc,),
        source=f"procedural {name}",
    )


def _lights(layout: Layout, frame: Frame) -> TrafficLights:
    """The recorded part of the signals, as WOMD writes them."""
    shown = layout.signals[:, _WARM_UP:]
    arrow = np.array(layout.signal_arrows, dtype=bool)
    # Signal GO, CAUTION, STOP: GO = 6, 5, 4 or, as arrows, 3, 2, 1.
    states = np.where(arrow[:, None], 3, 6) - shown if len(shown) else shown
    return TrafficLights(
        np.array(layout.signal_lanes, dtype=np.int64),
        frame.points(layout.signal_points),
        states.astype(np.int64),
    )
