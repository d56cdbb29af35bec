"""The lane graph, what of it an object could take, and which lanes a log took."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim import lane_paths, lanes
from sim.formats import read_scenes
from sim.lane_paths import OFF, ON, Chain, Piece
from sim.lanes import NOWHERE, lane_graph
from sim.scene import Polyline, RoadKind
from tests import route_oracle

ORIGIN = np.zeros(2)


def lane(
    *points: tuple[float, float],
    name: int = -1,
    exits: Sequence[int] = (),
    entries: Sequence[int] = (),
    kind: RoadKind = RoadKind.LANE_STREET,
) -> Polyline:
    """A lane through points."""
    heights = np.zeros((len(points), 1))
    return Polyline(
        kind,
        np.concatenate([np.array(points, float), heights], 1),
        feature_id=name,
        entry_lanes=tuple(entries),
        exit_lanes=tuple(exits),
    )


def test_lanes_join_end_to_start_where_none_is_named() -> None:
    graph = lane_graph(
        (
            lane((0, 0), (10, 0)),
            lane((10.05, 0), (20, 0)),  # on from the first
            lane((10, 0.11), (20, 1)),  # too far aside
            lane((10, 0), (10, 10)),  # a turn on the spot
            lane((10, 0), (12, 1.5), (12, 9)),  # a bend
            lane((20, 0), (30, 0)),  # 0 behind the second, not the third
            lane((50, 0), (50, 9), (50.05, 0)),  # back to its own start
        ),
        ORIGIN,
    )
    assert graph.exits == ((1, 4), (5,), (), (), (), (), ())


def test_lanes_that_name_their_neighbours_are_not_joined() -> None:
    graph = lane_graph(
        (
            lane((0, 0), (10, 0), name=7, exits=(9, 100)),
            lane((10, 0), (20, 0), name=8),
            lane((10, 0), (20, 5), name=9),
            lane((10, 0), (20, -5), name=10, entries=(7, 200)),
        ),
        ORIGIN,
    )
    assert graph.exits == ((2, 3), (), (), ())


def test_joining_finds_the_edges_of_a_real_graph(scenes_data: Path) -> None:
    (scene,) = read_scenes([scenes_data / "womd" / "motion_data_one_scenario.tfrecord"])
    named = lane_graph(scene.roads, ORIGIN)
    lines = [line for line in named.lines]
    joined = lanes._joined(lines)
    edges = {(i, e) for i, exits in enumerate(named.exits) for e in exits}
    found = {(i, e) for i, exits in enumerate(joined) for e in exits}
    assert len(edges) > 150
    assert edges <= found
    assert len(found - edges) <= 1


def test_bike_lanes_are_for_bikes() -> None:
    graph = lane_graph(
        (
            lane((0, 0), (10, 0), name=1, exits=(2, 3)),
            lane((10, 0), (20, 0), name=2, kind=RoadKind.LANE_BIKE),
            lane((10, 0), (20, 5), name=3),
        ),
        ORIGIN,
    )
    along = np.stack([np.arange(1.0, 20.0), np.zeros(19)], -1)
    _, on = lane_paths.object_pieces(graph, along, np.zeros(19))
    assert set(on[11:].tolist()) == {1}
    pieces, on = lane_paths.object_pieces(graph.without_bikes(), along, np.zeros(19))
    assert 1 not in set(on.tolist())
    assert 1 not in flags(pieces)


def drive(*points: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A log with a pose each half metre along some points."""
    knots = np.array(points, float)
    arc = np.r_[0.0, np.cumsum(np.hypot(*np.diff(knots, axis=0).T))]
    at = np.arange(0.0, arc[-1], 0.5)
    xy = np.stack([np.interp(at, arc, knots[:, k]) for k in (0, 1)], -1)
    ahead = np.gradient(xy, axis=0)
    return xy, np.arctan2(ahead[:, 1], ahead[:, 0])


FORK = (
    lane((0, 0), (30, 0), name=0, exits=(1, 2)),
    lane((30, 0), (90, 0), name=1),
    lane((30, 0), (50, 1), (90, 8), name=2),
)


def flags(pieces: list[Piece]) -> dict[int, int]:
    """The lanes' flags; a stretch that was driven off them is -1."""
    return {p.line if isinstance(p.line, int) else -1: p.flags for p in pieces}


def test_behind_a_fork_the_log_is_on_the_lane_that_it_stays_on() -> None:
    """Jittering between both where they overlap."""
    graph = lane_graph(FORK, ORIGIN)
    for points, taken in (
        (((5, 0), (35, 0.3), (40, -0.3), (60, 0)), 1),
        (((5, 0), (35, -0.3), (40, 0.2), (70, 4.5)), 2),
    ):
        pieces, on = lane_paths.object_pieces(graph, *drive(*points))
        assert set(on.tolist()) == {0, taken}
        assert np.flatnonzero(np.diff(on)).size == 1
        assert flags(pieces) == {0: ON | OFF, taken: ON, 3 - taken: OFF}


def test_arc_length_counts_from_where_the_log_starts() -> None:
    graph = lane_graph(FORK, ORIGIN)
    pieces, _ = lane_paths.object_pieces(graph, *drive((5, 0), (60, 0)))
    offsets = {piece.line: piece.offset for piece in pieces if piece.flags & ON}
    assert offsets == pytest.approx({0: -5.0, 1: 25.0}, abs=1e-6)


def test_a_change_of_lane_goes_on_in_arc_length() -> None:
    """The lane left goes on off-route, since it does not lead to the log's lanes."""
    graph = lane_graph(
        (
            lane((0, 0), (50, 0), name=0, exits=(1,)),
            lane((50, 0), (120, 0), name=1),
            lane((0, 3.5), (50, 3.5), name=2, exits=(3,)),
            lane((50, 3.5), (120, 3.5), name=3),
        ),
        ORIGIN,
    )
    xy, yaw = drive((10, 0), (25, 0), (40, 3.5), (80, 3.5))
    pieces, on = lane_paths.object_pieces(graph, xy, yaw)
    assert on[0] == 0 and on[-1] == 3
    assert flags(pieces) == {0: ON | OFF, 1: OFF, 2: ON, 3: ON}
    offsets = {piece.line: piece.offset for piece in pieces}
    assert offsets[0] == pytest.approx(-10.0)
    # The slant is 0.4 m longer than the road.
    assert offsets[2] == pytest.approx(-10.0, abs=0.5)
    assert offsets[3] - offsets[2] == pytest.approx(50.0)


def test_what_was_driven_off_all_lanes_is_on_route() -> None:
    """Out of a car park, along a lane, across a gap of the map, along another."""
    graph = lane_graph(
        (lane((0, 0), (40, 0)), lane((60, 0), (90, 0))),
        ORIGIN,
    )
    xy, yaw = drive((10, -20), (10, -6), (14, 0), (80, 0))
    pieces, on = lane_paths.object_pieces(graph, xy, yaw)
    assert on[0] == NOWHERE and on[-1] == 1
    driven = [piece for piece in pieces if not isinstance(piece.line, int)]
    assert len(driven) == 2
    # No path of the first lane leads to the last: they are off-route ones, too.
    assert flags(pieces) == {-1: ON, 0: ON | OFF, 1: ON}
    offsets = {p.line: p.offset for p in pieces if isinstance(p.line, int)}
    assert offsets[1] - offsets[0] == pytest.approx(60.0, abs=0.1)
    assert driven[0].offset == 0.0


def test_the_log_is_never_off_its_own_route() -> None:
    """It hugs the lane that it does not take, long behind the fork."""
    graph = lane_graph(FORK, ORIGIN)
    xy, yaw = drive((5, 0), (30, 0), (50, 1), (78, 5.5), (84, 2.0), (90, 0.0))
    pieces, on = lane_paths.object_pieces(graph, xy, yaw)
    lines = {i: points for i, points in enumerate(graph.lines)}
    parts = [
        (lines[p.line] if isinstance(p.line, int) else p.line.points, 0.0, p.flags)
        for p in pieces
    ]
    distance, _, marks = route_oracle.distances(parts, xy)
    nearest = distance[:, marks & ON > 0].min(1)
    other = np.where(marks & OFF > 0, distance, np.inf).min(1)
    assert nearest.max() < 5.0
    assert (nearest - other).max() < 2.0
    assert on[-1] == 1


def test_where_a_log_stands_on_two_lanes_both_go_on() -> None:
    """Just behind a fork; a log that drives on decides which is its route."""
    graph = lane_graph(FORK, ORIGIN)
    standing = np.array([[36.0, 0.1]])
    pieces, on = lane_paths.object_pieces(graph, standing, np.zeros(1))
    assert on.tolist() == [1]
    assert flags(pieces) == {1: ON, 2: ON}
    pieces, _ = lane_paths.object_pieces(graph, *drive((36, 0.1), (60, 0)))
    assert flags(pieces) == {1: ON, 2: OFF}


def test_between_two_lanes_either_may_be_taken() -> None:
    graph = lane_graph((lane((0, 0), (90, 0)), lane((0, 3.5), (90, 3.5))), ORIGIN)
    for y, expected in ((1.0, {0: ON}), (1.3, {0: ON, 1: ON})):
        pieces, _ = lane_paths.object_pieces(graph, np.array([[9.0, y]]), np.zeros(1))
        assert flags(pieces) == expected


def test_a_ring_ends() -> None:
    """A roundabout of four lanes with an entry and an exit, gone round 1.35 times."""
    angle = np.linspace(0, 2 * np.pi, 41)
    ring = np.stack([20 * np.cos(angle), 20 * np.sin(angle)], -1)
    quarters = [
        lane(
            *map(tuple, ring[10 * k : 10 * k + 11]),
            name=k,
            exits=((k + 1) % 4, *((5,) if k == 1 else ())),
        )
        for k in range(4)
    ]
    graph = lane_graph(
        (
            *quarters,
            lane((20, -60), (20, 0), name=4, exits=(0,)),
            lane((-20, 0), (-20, -60), name=5),
        ),
        ORIGIN,
    )
    once = drive((20, -30), (20, 0), *map(tuple, ring[1:21]), (-20, -30))
    pieces, _ = lane_paths.object_pieces(graph, *once)
    assert flags(pieces) == {4: 3, 0: 3, 1: 3, 5: ON, 2: OFF, 3: OFF}
    again = drive((20, -30), (20, 0), *map(tuple, ring[1:]), *map(tuple, ring[1:15]))
    pieces, on = lane_paths.object_pieces(graph, *again)
    taken = [piece.line for piece in pieces if piece.flags & ON]
    assert sorted(taken) == [0, 0, 1, 1, 2, 3, 4, 5]  # it went over two twice
    assert set(on.tolist()) == {0, 1, 2, 3, 4}


def test_paths_end_at_the_limit() -> None:
    """A tree of 255 lanes of 15 m."""
    roads = [
        lane((0, i), (15, i), name=i, exits=(2 * i + 1, 2 * i + 2)) for i in range(255)
    ]
    graph = lane_graph(roads, ORIGIN)
    pieces = lane_paths.pieces_of(graph, [Chain((0, 1, 3), (0.0, 15.0, 30.0))], 150.0)
    assert len(pieces) == 255  # eight lanes one behind the other are 120 m
    assert sum(piece.flags & ON > 0 for piece in pieces) == 2 + 63
    short = lane_paths.pieces_of(graph, [Chain((0, 1, 3), (0.0, 15.0, 30.0))], 44.0)
    assert sorted(piece.line for piece in short) == list(range(7))


@st.composite
def graphs(draw: st.DrawFn) -> tuple[list[set[int]], list[int], list[list[int]]]:
    """Successors and lengths of some lanes, rings included; walks that repeat none."""
    count = draw(st.integers(1, 7))
    exits = [draw(st.sets(st.integers(0, count - 1), max_size=3)) for _ in range(count)]
    lengths = [draw(st.integers(1, 40)) for _ in range(count)]
    runs = []
    for _ in range(draw(st.integers(1, 2))):
        walk = [draw(st.integers(0, count - 1))]
        while draw(st.booleans()):
            onward = sorted(exits[walk[-1]] - set(walk))
            if not onward:
                break
            walk.append(draw(st.sampled_from(onward)))
        runs.append(walk)
    return exits, lengths, runs


@given(graphs(), st.integers(0, 120))
@settings(max_examples=300, deadline=None)
def test_flags_are_those_of_all_paths(drawn, extra: int) -> None:
    """Against the definition: every path that repeats no lane, one by one."""
    exits, lengths, runs = drawn
    # That lane 99 leads to all says that the scene has a graph, even without an exit.
    roads = [
        lane((0, i), (length, i), name=i, exits=sorted(exits[i] - {i}), entries=(99,))
        for i, length in enumerate(lengths)
    ]
    graph = lane_graph(roads, ORIGIN)
    chains, ways = [], []
    for run in runs:
        offsets = np.cumsum([0.0, *(lengths[n] for n in run[:-1])])
        chains.append(Chain(tuple(run), tuple(offsets.tolist())))
        ways.append(float(offsets[-1]))
    limit = max(ways) + extra
    pieces = lane_paths.pieces_of(graph, chains, limit)
    found: dict[int, int] = {}
    for piece in pieces:
        found[piece.line] = found.get(piece.line, 0) | piece.flags
    assert found == route_oracle.flags_by_definition(
        graph.exits, lengths, runs, [0.0] * len(runs), limit
    )
