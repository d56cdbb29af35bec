"""Frames: what a watched environment lived through, for whoever looks on.

A frame describes one step as the simulator left it, so that a terminal state is seen
before the environment resets itself:

    s_t   `state` of the controlled object at step `step` of the log, map frame
    a_tm1 `action`, the index that led there, and `q_values` that it was chosen by
    r_t   `reward`; `overlap`, `offroad` and `progress` are those of s_t

`progress` is the distance along the log's route over the route's length (1: arrived;
NaN: the log has no route to speak of).
One message carries consecutive steps of one environment; an auto-reset may lie
between two of them, and shows as another scene or a step that does not follow.

On the wire a message is one msgpack map of small integers and two packed
little-endian arrays. It is untrusted: lengths, ranges and finiteness are checked
before anything is used, and a message is read whole or refused.
"""

from dataclasses import dataclass
from typing import final

import msgspec
import numpy as np
from jaxtyping import Float, Shaped

FRAMES_VERSION = 1
MAX_FRAMES = 4096  # of a message; bounds what a reader allocates
MAX_ACTIONS = 65_536

FRAME_DTYPE = np.dtype(
    [
        ("scene", "<i4"),  # index into the bank
        ("step", "<i4"),  # t of s_t
        ("controlled", "<i4"),  # row of the controlled object
        ("state", "<f4", (5,)),  # x, y [m], yaw [rad], v_x, v_y [m/s]
        ("action", "<i4"),  # a_tm1; -1 where no index was chosen (a scripted agent)
        ("reward", "<f4"),
        ("progress", "<f4"),
        ("overlap", "u1"),
        ("offroad", "u1"),
    ]
)


class FrameError(Exception):
    """Frames cannot be sent or read; the message says what is wrong with them."""


class _Message(msgspec.Struct, frozen=True, tag="frames"):
    """The wire form of `FrameBatch`."""

    version: int
    actor: int
    environment: int
    actor_steps: int
    weights_version: int
    actions: int
    frames: bytes
    q_values: bytes


@final
@dataclass(frozen=True, kw_only=True)
class FrameBatch:
    """Consecutive steps of one watched environment."""

    actor: int
    environment: int  # index among the actor's environments
    actor_steps: int  # environment steps that the actor has taken, all environments
    weights_version: int  # of the policy that acted; -1 where there is none
    frames: Shaped[np.ndarray, " steps"]  # of `FRAME_DTYPE`
    q_values: Float[np.ndarray, "steps actions"]  # no columns where there are none

    def __len__(self) -> int:
        """Number of steps."""
        return int(self.frames.shape[0])


def make_frames(steps: int, **columns: object) -> Shaped[np.ndarray, " steps"]:
    """Builds frames from one array per field of `FRAME_DTYPE`; all are required."""
    missing = set(FRAME_DTYPE.names or ()) ^ set(columns)
    if missing:
        raise FrameError(f"frames: fields missing or unknown: {sorted(missing)}")
    frames = np.zeros(steps, FRAME_DTYPE)
    for name, values in columns.items():
        frames[name] = values
    return frames


def _check(batch: FrameBatch) -> None:
    """Refuses what a viewer could not show, sent or received."""
    steps, actions = batch.q_values.shape
    if not 0 < steps <= MAX_FRAMES or actions > MAX_ACTIONS:
        raise FrameError(
            f"frames: {steps} steps of {actions} actions, expected 1 to {MAX_FRAMES} "
            f"steps and at most {MAX_ACTIONS} actions"
        )
    if min(batch.actor, batch.environment, batch.actor_steps) < 0:
        raise FrameError("frames: negative actor, environment or step counter")
    frames = batch.frames
    if min(int(frames[name].min()) for name in ("scene", "step", "controlled")) < 0:
        raise FrameError("frames: negative scene, step or controlled object")
    if int(frames["action"].min()) < -1:
        raise FrameError("frames: action index below -1")
    if actions and int(frames["action"].max()) >= actions:
        raise FrameError(f"frames: action index outside the {actions} Q-values")
    floats = [frames["state"], frames["reward"], batch.q_values]
    finite = all(np.isfinite(values).all() for values in floats)
    if not finite or np.isinf(frames["progress"]).any():
        raise FrameError("frames: a value is not finite")


def encode_frames(batch: FrameBatch) -> bytes:
    """Packs a batch; raises `FrameError` for what a reader would refuse."""
    if batch.frames.dtype != FRAME_DTYPE or len(batch) != batch.q_values.shape[0]:
        raise FrameError("frames: not of FRAME_DTYPE, or as many as rows of Q-values")
    _check(batch)
    message = _Message(
        version=FRAMES_VERSION,
        actor=batch.actor,
        environment=batch.environment,
        actor_steps=batch.actor_steps,
        weights_version=batch.weights_version,
        actions=int(batch.q_values.shape[1]),
        frames=batch.frames.tobytes(),
        q_values=batch.q_values.astype("<f4").tobytes(),
    )
    return msgspec.msgpack.encode(message)


def decode_frames(payload: bytes) -> FrameBatch:
    """Reads a message whole; raises `FrameError` for anything else."""
    try:
        message = msgspec.msgpack.decode(payload, type=_Message)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FrameError(f"frames: {error}") from error
    if message.version != FRAMES_VERSION:
        raise FrameError(
            f"frames of version {message.version}, expected {FRAMES_VERSION}"
        )
    steps, rest = divmod(len(message.frames), FRAME_DTYPE.itemsize)
    if rest or not 0 <= message.actions <= MAX_ACTIONS:
        raise FrameError(f"frames: {len(message.frames)} bytes are no whole frames")
    if len(message.q_values) != 4 * steps * message.actions:
        raise FrameError(
            f"frames: {len(message.q_values)} bytes of Q-values, expected "
            f"{4 * steps * message.actions}"
        )
    q_values = np.frombuffer(message.q_values, "<f4").reshape(steps, message.actions)
    batch = FrameBatch(
        actor=message.actor,
        environment=message.environment,
        actor_steps=message.actor_steps,
        weights_version=message.weights_version,
        frames=np.frombuffer(message.frames, FRAME_DTYPE),
        q_values=q_values,
    )
    _check(batch)
    return batch
