"""From a `Scene` to the rows of the bank (`sim.bank.Bank` says what each means)."""

import itertools
import multiprocessing
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sim import edge_table, routes, tables
from sim.scene import Scene, SceneError

Converted = dict[str, Any]  # one scene's part of every array of the bank

LOG_FIELDS = ("x", "y", "z", "yaw", "v_x", "v_y", "length", "width")
LIGHT_THROUGH = 15.0  # m behind a light's line at which lanes that part are apart
ROWS = 64  # road segments kept per cell
FEW = 12  # scenes
MAX_CANDIDATES = 64  # edges per fine cell; measured: 12 to 30 at the 99th percentile


def origin_of(scene: Scene) -> Float[np.ndarray, "3"]:
    """The point of the map that the bank subtracts: the SDC's where it first acts."""
    valid = np.flatnonzero(scene.valid[scene.sdc_index])
    after = valid[valid >= scene.current_step]
    step = after[0] if len(after) else valid[0] if len(valid) else 0
    return np.round(scene.position[scene.sdc_index, step])


def convert(scene: Scene) -> Converted:
    """The scene's own part of every array of the bank, positions local."""
    origin = origin_of(scene)
    log, valid = _log(scene, origin)
    grid = tables.grid_of(scene)
    ground = np.concatenate([line.points for line in scene.roads] or [np.zeros((1, 3))])
    segments, kinds = tables.row_segments(scene.roads)
    _check_small(scene, "road segments", len(segments), 2**16)
    row_of, rows, counts = tables.row_table(grid, segments, ROWS)
    edges = edge_table.edges_of(scene.roads)
    state, candidates = edge_table.edge_table(grid, edges, ground)
    fine, fine_edges = _candidate_rows(state, candidates)
    cell_edges, fine_state = _nested(fine.reshape(grid.fine.shape))
    return {
        "current_step": np.int32(scene.current_step),
        "steps": np.int32(scene.steps),
        "objects": np.int32(scene.objects),
        "sdc": np.int32(scene.sdc_index),
        "tracks": np.array(scene.tracks_to_predict, np.int32),
        "log": log,
        "log_valid": valid,
        "object_type": scene.object_types.astype(np.int8),
        **routes.routes_of(scene, origin),
        "light_position": (scene.lights.stop_points - origin)[:, :2].astype(np.float32),
        "light_through": (_lights_through(scene) - origin[:2]).astype(np.float32),
        "light_state": scene.lights.states.T.astype(np.int8),
        "grid_origin": (grid.origin - origin[:2]).astype(np.float32),
        "grid_shape": np.array(grid.shape, np.int32),
        "segments": (segments - np.tile(origin[:2], 2)).astype(np.float32),
        "segment_kind": kinds,
        "cell_row": row_of,
        "rows": rows,
        "row_count": counts,
        "cell_edges": cell_edges,
        "fine_state": fine_state,
        "fine_edges": fine_edges,
        "edges": _moved(edges, origin).packed(),
    }


def convert_all(scenes: Iterable[Scene], *, workers: int) -> Iterator[Converted]:
    """Converts scenes in order, several at once in processes of their own.

    The processes start only when `FEW` scenes have come: until then they cost more than
    they save. At most a few scenes per process wait, however many there are.
    """
    source = iter(scenes)
    first = list(itertools.islice(source, FEW))
    if workers < 2 or len(first) < FEW:
        yield from map(convert, itertools.chain(first, source))
        return
    # Spawned, not forked: JAX's threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        pending: deque[Future[Converted]] = deque()
        for scene in itertools.chain(first, source):
            pending.append(pool.submit(convert, scene))
            if len(pending) > 4 * workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def _check_small(scene: Scene, what: str, count: int, limit: int) -> None:
    if count > limit:
        raise SceneError(
            f"{scene.source or scene.scenario_id}: {count} {what}, at most {limit}; "
            "crop the map"
        )


def _moved(edges: edge_table.Edges, origin: Float[np.ndarray, "3"]) -> edge_table.Edges:
    return edge_table.Edges(
        edges.start - origin, edges.along, edges.previous, edges.following
    )


def _log(
    scene: Scene, origin: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "steps objects 8"], Bool[np.ndarray, "steps objects"]]:
    """The log by step; where an object is not valid it keeps its nearest valid row.

    Keeping a row matters for size and height, which a controlled object that outlives
    its log goes on using; `valid` still says that nothing was recorded.
    """
    fields = np.concatenate(
        [
            scene.position - origin,
            scene.yaw[..., None],
            scene.velocity,
            scene.size[..., :2],
        ],
        -1,
    )
    steps = np.arange(scene.steps)
    before = np.maximum.accumulate(np.where(scene.valid, steps, -1), axis=1)
    first = np.where(scene.valid.any(1), scene.valid.argmax(1), 0)
    nearest = np.where(before >= 0, before, first[:, None])
    filled = np.take_along_axis(fields, nearest[..., None], 1)
    filled[~scene.valid.any(1)] = 0.0
    return (
        np.ascontiguousarray(filled.transpose(1, 0, 2), np.float32),
        np.ascontiguousarray(scene.valid.T),
    )


def _lights_through(scene: Scene) -> Float[np.ndarray, "lights 2"]:
    """Of each light, its lane `LIGHT_THROUGH` m behind the line, or the lane's end.

    Where the map lacks the lane, the line itself: nothing more is known.
    """
    lights = scene.lights
    through = np.array(lights.stop_points[:, :2], np.float64)
    lanes = {line.feature_id: line for line in scene.roads if line.kind.is_lane}
    for row, lane in enumerate(lights.lane_ids):
        if int(lane) not in lanes:
            continue
        points = lanes[int(lane)].points[:, :2]
        first = np.hypot(*(points - through[row]).T).argmin()
        behind = points[first:]
        arc = np.cumsum(np.hypot(*np.diff(behind, axis=0, prepend=behind[:1]).T))
        at = min(LIGHT_THROUGH, arc[-1])
        through[row] = [np.interp(at, arc, behind[:, k]) for k in (0, 1)]
    return through


def _candidate_rows(
    state: Int[np.ndarray, " fine"], candidates: list[Int[np.ndarray, " _"]]
) -> tuple[Int[np.ndarray, " fine"], Int[np.ndarray, "mixed width"]]:
    """A row of candidates per mixed fine cell, and each fine cell's row or verdict.

    A list shorter than the longest repeats its first edge, which changes no minimum.
    """
    mixed = np.flatnonzero(state == edge_table.MIXED)
    state[mixed] = np.arange(len(mixed))
    longest = max((len(candidates[cell]) for cell in mixed), default=1)
    width = min(longest, MAX_CANDIDATES)
    rows = np.zeros((len(mixed), width), np.int32)
    for row, cell in enumerate(mixed):
        near = candidates[cell][:width]
        rows[row] = near[0]
        rows[row, : len(near)] = near
    return state, rows


def _nested(
    fine: Int[np.ndarray, "across along"],
) -> tuple[Int[np.ndarray, " cells"], Int[np.ndarray, "mixed parts"]]:
    """The fine cells as two levels: most cells are of one verdict and need no second.

    The first array holds each cell's verdict, or its row of the second.
    """
    side = tables.FINE
    across, along = fine.shape[0] // side, fine.shape[1] // side
    squares = fine.reshape(across, side, along, side).transpose(0, 2, 1, 3)
    parts = squares.reshape(across * along, side * side)
    cells = parts[:, 0].copy()
    mixed = np.flatnonzero((parts[:, :1] != parts).any(1) | (cells >= 0))
    cells[mixed] = np.arange(len(mixed))
    return cells, parts[mixed]


def stack(scenes: list[Converted]) -> dict[str, np.ndarray]:
    """Joins the scenes: padded where fixed, else one behind the other."""
    steps = max(len(scene["log"]) for scene in scenes)
    objects = max(scene["log"].shape[1] for scene in scenes)
    lights = max(1, max(len(scene["light_position"]) for scene in scenes))
    width = max(scene["fine_edges"].shape[1] for scene in scenes)
    chunks = max(1, max(scene["path_chunk"].shape[1] for scene in scenes))
    stops = max(1, max(len(scene["stop_position"]) for scene in scenes))
    tracks = max(1, max(len(scene["tracks"]) for scene in scenes))
    shapes = {
        "tracks": (tracks,),
        "log": (steps, objects, len(LOG_FIELDS)),
        "log_valid": (steps, objects),
        "object_type": (objects,),
        "route": (objects, routes.ROUTE_POINTS, 2),
        **dict.fromkeys(routes.PER_OBJECT, (objects,)),
        **dict.fromkeys(routes.PER_CHUNK, (objects, chunks)),
        "stop_position": (stops, 2),
        "light_position": (lights, 2),
        "light_through": (lights, 2),
        "light_state": (steps, lights),
    }
    fill = {"route_spacing": 1.0, "tracks": objects}
    arrays = {
        name: np.stack([_padded(s[name], shape, fill.get(name, 0)) for s in scenes])
        for name, shape in shapes.items()
    }
    for name in ("current_step", "steps", "objects", "sdc"):
        arrays[name] = np.array([scene[name] for scene in scenes], np.int32)
    for name in ("grid_origin", "grid_shape"):
        arrays[name] = np.stack([scene[name] for scene in scenes])
    arrays["lights"] = np.array([len(s["light_position"]) for s in scenes], np.int32)
    arrays["stops"] = np.array([len(s["stop_position"]) for s in scenes], np.int32)
    arrays["chunk_start"] = _starts(scenes, "chunks")
    arrays["segment_start"] = _starts(scenes, "segments")
    arrays["cell_start"] = _starts(scenes, "cell_row")
    tables_ = ("segments", "segment_kind", "rows", "row_count", "edges", "chunks")
    for name in tables_:
        arrays[name] = np.concatenate([scene[name] for scene in scenes])
    for name, table in (
        ("cell_row", "rows"),
        ("cell_edges", "fine_state"),
        ("fine_state", "fine_edges"),
    ):
        arrays[name] = np.concatenate(
            [
                np.where(scene[name] >= 0, scene[name] + first, scene[name])
                for scene, first in zip(scenes, _starts(scenes, table), strict=True)
            ]
        ).astype(np.int32)
    arrays["fine_edges"] = np.concatenate(
        [
            _widened(scene["fine_edges"] + first, width)
            for scene, first in zip(scenes, _starts(scenes, "edges"), strict=True)
        ]
    ).astype(np.int32)
    # A gather needs a row to read even where no scene has a map of that kind.
    for name in (*tables_, "fine_state", "fine_edges"):
        if not len(arrays[name]):
            empty = arrays[name]
            arrays[name] = np.zeros((1, *empty.shape[1:]), empty.dtype)
    return arrays


def _starts(scenes: list[Converted], name: str) -> Int[np.ndarray, " scenes"]:
    lengths = [len(scene[name]) for scene in scenes]
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32)


def _padded(array: np.ndarray, shape: tuple[int, ...], value: float) -> np.ndarray:
    """`array` in the corner of a larger one, the rest `value`."""
    pads = [(0, want - have) for want, have in zip(shape, array.shape, strict=True)]
    return np.pad(array, pads, constant_values=value)


def _widened(
    rows: Int[np.ndarray, "rows have"], width: int
) -> Int[np.ndarray, "rows want"]:
    """Rows of candidates filled up with their first, which changes no minimum."""
    fill = np.repeat(rows[:, :1], width - rows.shape[1], 1)
    return np.concatenate([rows, fill], 1)
