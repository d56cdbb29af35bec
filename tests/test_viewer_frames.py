"""Frames on the wire: what goes in comes out, and nothing else is read."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from actors.frames import (
    FRAME_DTYPE,
    MAX_FRAMES,
    FrameBatch,
    FrameError,
    decode_frames,
    encode_frames,
    make_frames,
)


def batch_of(steps: int, actions: int, seed: int = 0, **changes: Any) -> FrameBatch:
    """Random frames."""
    random = np.random.default_rng(seed)
    values: dict[str, Any] = {
        "scene": random.integers(0, 9, steps),
        "step": random.integers(0, 91, steps),
        "controlled": random.integers(0, 5, steps),
        "state": random.normal(size=(steps, 5)),
        "action": random.integers(0, actions, steps) if actions else np.full(steps, -1),
        "reward": random.normal(size=steps),
        "progress": random.uniform(size=steps),
        "overlap": random.integers(0, 2, steps),
        "offroad": random.integers(0, 2, steps),
    }
    return FrameBatch(
        actor=3,
        environment=1,
        actor_steps=12_800,
        weights_version=77,
        frames=make_frames(steps, **(values | changes)),
        q_values=random.normal(size=(steps, actions)).astype(np.float32),
    )


@given(steps=st.integers(1, 40), actions=st.integers(0, 30), seed=st.integers(0, 99))
def test_frames_come_back_as_they_were(steps: int, actions: int, seed: int) -> None:
    batch = batch_of(steps, actions, seed)
    result = decode_frames(encode_frames(batch))
    for name in ("actor", "environment", "actor_steps", "weights_version"):
        assert getattr(result, name) == getattr(batch, name)
    np.testing.assert_array_equal(result.frames, batch.frames)
    np.testing.assert_array_equal(result.q_values, batch.q_values)
    assert len(result) == steps


def test_a_frame_is_small() -> None:
    """64 actions: 0.3 KB a step, so 8 steps of a watched environment cost nothing."""
    assert FRAME_DTYPE.itemsize == 46
    assert len(encode_frames(batch_of(8, 64))) < 8 * (46 + 4 * 64) + 200


def test_progress_may_be_unknown() -> None:
    batch = batch_of(2, 3, progress=[np.nan, 0.5])
    assert np.isnan(decode_frames(encode_frames(batch)).frames["progress"][0])


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("scene", -1, "negative scene"),
        ("step", -5, "negative scene, step"),
        ("controlled", -1, "controlled object"),
        ("action", -2, "below -1"),
        ("action", 4, "outside the 4 Q-values"),
        ("state", np.inf, "not finite"),
        ("reward", np.nan, "not finite"),
        ("progress", -np.inf, "not finite"),
    ],
)
def test_what_cannot_be_shown_is_not_sent(
    field: str, value: float, message: str
) -> None:
    with pytest.raises(FrameError, match=message):
        encode_frames(batch_of(3, 4, **{field: value}))


def test_a_q_value_must_be_finite() -> None:
    batch = batch_of(2, 3)
    batch.q_values[1, 1] = np.nan
    with pytest.raises(FrameError, match="not finite"):
        encode_frames(batch)


def test_counters_must_not_be_negative() -> None:
    batch = dataclasses.replace(batch_of(2, 3), environment=-1)
    with pytest.raises(FrameError, match="negative actor, environment"):
        encode_frames(batch)


def test_a_message_is_bounded() -> None:
    with pytest.raises(FrameError, match=f"expected 1 to {MAX_FRAMES}"):
        encode_frames(batch_of(MAX_FRAMES + 1, 1))
    with pytest.raises(FrameError, match="0 steps"):
        encode_frames(batch_of(0, 1))


def test_every_field_is_required() -> None:
    with pytest.raises(FrameError, match="reward"):
        make_frames(1, scene=[0])


def altered(**changes: Any) -> bytes:
    """A valid message with some of its parts replaced."""
    message = msgspec.msgpack.decode(encode_frames(batch_of(4, 3)))
    return msgspec.msgpack.encode(message | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 9}, "version 9, expected 1"),
        ({"frames": b"\0" * 47}, "47 bytes are no whole frames"),
        ({"frames": b""}, "bytes of Q-values, expected 0"),
        ({"q_values": b"\0" * 5}, "5 bytes of Q-values, expected 48"),
        ({"actions": -1}, "no whole frames"),
        ({"actions": 2**40}, "no whole frames"),
        ({"actions": "3"}, "Expected `int`"),
        ({"actor": -1}, "negative actor"),
        ({"frames": b"\xff" * 46 * 4}, "negative scene"),
        ({"type": "rows"}, "Invalid value"),
    ],
)
def test_a_hostile_message_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FrameError, match=message):
        decode_frames(altered(**changes))


def test_no_part_of_a_message_is_a_message() -> None:
    payload = encode_frames(batch_of(4, 3))
    for size in range(len(payload)):
        with pytest.raises(FrameError):
            decode_frames(payload[:size])


@given(st.binary(max_size=300))
@example(b"\xde\x00\x01\xa1\x80")  # a field whose name is not UTF-8
def test_noise_is_refused(noise: bytes) -> None:
    with pytest.raises(FrameError):
        decode_frames(noise)
