"""From a `Scene` to the rows of the bank (`sim.bank.Bank` says what each means)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from sim import edge_table, routes, tables
from sim.scene import Scene, SceneError

Converted = dict[str, np.ndarray]  # one scene's part of every array of the bank

LOG_FIELDS = ("x", "y", "z", "yaw", "v_x", "v_y", "length", "width")
LIGHT_THROUGH = 15.0  # m behind a light's line at which lanes that part are apart
ROWS = 64  # road segments kept per cell
MAX_CANDIDATES = 255  # edges per fine cell (a byte counts them); most found: 80


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
    lists = _candidate_lists(state, candidates)
    cell_edges, fine_state = _nested(lists.state.reshape(grid.fine.shape))
    route = routes.routes_of(scene, origin)
    return {
        "current_step": np.array(scene.current_step, np.int32),
        "steps": np.array(scene.steps, np.int32),
        "objects": np.array(scene.objects, np.int32),
        "sdc": np.array(scene.sdc_index, np.int32),
        "tracks": np.array(scene.tracks_to_predict, np.int32),
        "log": log,
        "log_valid": valid,
        "object_type": scene.object_types.astype(np.int8),
        **route,
        "stops": np.array(len(route["stop_position"]), np.int32),
        "light_position": (scene.lights.stop_points - origin)[:, :2].astype(np.float32),
        "light_through": (_lights_through(scene) - origin[:2]).astype(np.float32),
        "light_state": scene.lights.states.T.astype(np.int8),
        "lights": np.array(len(scene.lights.lane_ids), np.int32),
        "grid_origin": (grid.origin - origin[:2]).astype(np.float32),
        "grid_shape": np.array(grid.shape, np.int32),
        "segments": (segments - np.tile(origin[:2], 2)).astype(np.float32),
        "segment_kind": kinds,
        "segment_rows": tables.segment_rows(
            segments - np.tile(origin[:2], 2), kinds
        ).astype(np.float32),
        "cell_row": row_of,
        "rows": rows,
        "row_count": counts,
        "cell_edges": cell_edges,
        "fine_state": fine_state,
        "list_first": lists.first,
        "list_count": lists.length,
        "list_edges": lists.edges,
        "edges": _moved(edges, origin).packed(),
    }


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


class _Lists(NamedTuple):
    """What `_candidate_lists` finds; a list is a range of `edges`."""

    state: Int[np.ndarray, " fine"]  # each fine cell's verdict or list
    first: Int[np.ndarray, " lists"]  # element of `edges` that a list begins with
    length: UInt[np.ndarray, " lists"]
    edges: Int[np.ndarray, " candidates"]  # rows of the scene's edges


def _candidate_lists(
    state: Int[np.ndarray, " fine"], candidates: list[Int[np.ndarray, " _"]]
) -> _Lists:
    """The candidates of the mixed fine cells, each list of edges once.

    Cells side by side mostly have the same candidates, in another order of distance;
    in the order of their rows they are one list (measured: a third to a half fewer).
    """
    numbers: dict[bytes, int] = {}
    lists: list[Int[np.ndarray, " _"]] = []
    for cell in np.flatnonzero(state == edge_table.MIXED):
        near = np.sort(candidates[cell][:MAX_CANDIDATES]).astype(np.int32)
        state[cell] = numbers.setdefault(near.tobytes(), len(lists))
        if state[cell] == len(lists):
            lists.append(near)
    count = np.array([len(near) for near in lists], np.int64)
    return _Lists(
        state=state,
        first=(np.cumsum(count) - count).astype(np.int32),
        length=count.astype(np.uint8),
        edges=np.concatenate([np.zeros(0, np.int32), *lists]),
    )


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
