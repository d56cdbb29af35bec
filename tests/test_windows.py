"""Rows of n steps, recomputed by their definition from every step of a log."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.acting import Transitions
from actors.rows import row_spec
from actors.windows import Windows

HISTORY = 2
GAMMA = 0.5


class Log(NamedTuple):
    """Whether each step of each object is there, ends its episode, and how."""

    present: np.ndarray  # [steps, environments, slots]
    over: np.ndarray
    terminal: np.ndarray


@st.composite
def logs(draw: st.DrawFn) -> Log:
    """Episodes of random lengths, ended either way, with gaps in between."""
    steps, environments, slots = (draw(st.integers(1, most)) for most in (12, 2, 3))
    shape = (steps, environments, slots)
    present, over, terminal = (np.zeros(shape, bool) for _ in range(3))
    for environment in range(environments):
        for slot in range(slots):
            step = draw(st.integers(0, 2))
            while step < steps:
                end = step + draw(st.integers(1, 6))
                lane = (slice(step, end), environment, slot)
                present[lane] = True
                if end <= steps:
                    over[end - 1, environment, slot] = True
                    terminal[end - 1, environment, slot] = draw(st.booleans())
                step = end + draw(st.integers(0, 2))
    return Log(present, over, terminal)


def transitions_of(log: Log) -> Transitions:
    """States say their lane and time, actions number the transitions."""
    shape = log.present.shape
    steps, environments, slots = shape
    lane = np.arange(environments * slots).reshape(environments, slots)
    time = np.arange(steps)[:, None] + np.arange(-HISTORY, 1)  # of s_{t-H} to s_t
    states = np.zeros((*shape, HISTORY + 1, 5), np.float32)
    states[..., 0] = time[:, None, None]
    states[..., 1] = lane[None, :, :, None]
    count = np.arange(log.present.size, dtype=np.int32).reshape(shape)
    none = np.zeros(shape, np.float32)
    return Transitions(
        scene=np.zeros(shape[:2], np.int32),
        step=np.broadcast_to(np.arange(steps)[:, None], shape[:2]).astype(np.int32),
        controlled=np.broadcast_to(lane, shape).astype(np.int32),
        states=states,
        valid=(states[..., 0].astype(int) + lane[None, :, :, None]) % 2 == 0,
        action=count,
        reward=(count % 7).astype(np.float32) - 2,
        discount=1 - log.terminal.astype(np.float32),
        overlap=log.terminal,
        offroad=log.terminal,
        present=log.present,
        over=log.over,
        score=none,
        failed=log.terminal,
        progress=none,
        q_values=np.zeros((steps, 0, 3), np.float32),
    )


def expected(every: Transitions, n_step: int) -> dict[int, tuple]:
    """The definition: action -> (span, return, discount), of windows that are whole."""
    rows = {}
    for step, environment, slot in np.argwhere(every.present):
        span, total, discount, at = 0, 0.0, 1.0 / GAMMA, step
        while at < len(every.scene):
            total += GAMMA**span * every.reward[at, environment, slot]
            discount *= GAMMA * every.discount[at, environment, slot]
            span += 1
            if span == n_step or every.over[at, environment, slot]:
                action = int(every.action[step, environment, slot])
                rows[action] = (span, total, discount)
                break
            at += 1
    return rows


@settings(max_examples=40, deadline=None)
@given(log=logs(), n_step=st.integers(1, 5), data=st.data())
def test_rows_are_those_of_the_definition(log: Log, n_step: int, data) -> None:
    """However the log is cut into scans: none is lost and none crosses an episode."""
    every = transitions_of(log)
    windows = Windows(n_step=n_step, discount=GAMMA, actor=3)
    parts, first, scan = [], 0, 0
    while first < len(log.present):
        last = first + data.draw(st.integers(1, len(log.present)))
        cut = Transitions(*(values[first:last] for values in every))
        parts.append(windows.add(cut, version=scan))
        first, scan = last, scan + 1
    rows = np.concatenate(parts)
    wanted = expected(every, n_step)
    assert sorted(rows["action"].tolist()) == sorted(wanted)
    assert (rows["serial"] == np.arange(len(rows))).all()
    for row in rows:
        span, total, discount = wanted[int(row["action"])]
        assert row["reward"] == pytest.approx(total)
        assert row["discount"] == pytest.approx(discount)
        check_states(row, span, every)


def check_states(row: np.void, span: int, every: Transitions) -> None:
    """From H steps before the first to the last one's s_t, of all objects."""
    step, environment, slot = np.argwhere(every.action == row["action"])[0]
    assert row["step"] == step + span - 1
    assert row["controlled"] == every.controlled[step, environment, slot]
    times = np.arange(step - HISTORY, step + span)
    own = [(row["controlled"], row["states"], row["valid"])]
    beside = []
    if "others" in row.dtype.names:
        parts = (row["others"], row["others_states"], row["others_valid"])
        beside = [*zip(*parts, strict=True)]
        lanes = set(every.controlled[step, environment]) - {row["controlled"]}
        assert set(row["others"]) == lanes
    for lane, states, valid in own + beside:
        assert (states[: len(times), 0] == times).all()
        assert (states[: len(times), 1] == lane).all()
        assert (valid[: len(times)] == ((times + lane) % 2 == 0)).all()
        assert not states[len(times) :].any()
        assert not valid[len(times) :].any()


def test_by_hand() -> None:
    """Three steps of 1, 2 and 4 at gamma 0.5, terminal or truncated, with n = 2."""
    shape = (3, 1, 1)
    for terminal, last in ((True, 0.0), (False, 1.0)):
        ends = np.array([False, False, True]).reshape(shape)
        every = transitions_of(Log(np.ones(shape, bool), ends, ends & terminal))
        every = every._replace(
            reward=np.array([1, 2, 4], np.float32).reshape(shape),
        )
        rows = Windows(n_step=2, discount=0.5, actor=0).add(every, version=1)
        assert rows["reward"].tolist() == [2.0, 4.0, 4.0]
        assert rows["discount"].tolist() == [0.5, 0.5 * last, last]
        assert rows["span"].tolist() == [2, 2, 1]


def test_a_row_says_which_weights_chose_its_action() -> None:
    shape = (2, 1, 1)
    log = Log(np.ones(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool))
    windows = Windows(n_step=3, discount=0.5, actor=0)
    assert len(windows.add(transitions_of(log), version=7)) == 0
    assert windows.add(transitions_of(log), version=8)["weights_version"].tolist() == [
        7,
        7,
    ]


def test_batches_are_of_one_size() -> None:
    """What fills no batch waits: the replay's limiter is checked for one size."""
    shape = (3, 2, 1)
    log = Log(np.ones(shape, bool), np.ones(shape, bool), np.zeros(shape, bool))
    windows = Windows(n_step=1, discount=0.5, actor=0)
    sizes = [
        [len(rows) for rows in windows.batches(transitions_of(log), 0, 4)]
        for _ in range(4)
    ]
    assert sizes == [[4], [4, 4], [4], [4, 4]]


def test_batches_are_of_the_replays_layout() -> None:
    shape = (6, 2, 2)
    log = Log(np.ones(shape, bool), np.zeros(shape, bool), np.zeros(shape, bool))
    windows = Windows(n_step=2, discount=0.5, actor=0)
    batches = windows.batches(transitions_of(log), 0, 3)
    batches += windows.batches(transitions_of(log), 0, 3)
    spec = row_spec(HISTORY, n_step=2, others=1)
    assert {spec.check(rows).dtype for rows in batches} == {spec.dtype}
    assert spec.dtype.itemsize > sum(
        np.dtype(spec.dtype[name]).itemsize for name in spec.dtype.names
    )


def test_no_step_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="n_step=0 must be at least 1"):
        Windows(n_step=0, discount=0.5, actor=0)
