"""The bounded recording of evaluation rollouts, `evaluation.rrd`.

The rollouts follow one another on one timeline `step`, so that pressing play shows
all of them; the panel of words says which scenario is on. The file is written beside
its destination under a temporary name and renamed when it is whole.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from actors.evaluation import Evaluation
from actors.frames import FrameBatch, make_frames
from launch.blueprint import layout, new_recording
from launch.frame_view import EnvironmentView, Piece
from launch.scene_view import SceneSource
from launch.words import ActionLabels
from sim.bank import BankFile

ROOT = "/evaluation"
PAUSE = 8  # rows of the timeline that the last frame of a rollout stays
_CHUNK = 32  # frames; pieces smaller than a rollout seek faster in a browser
# The file ends with an index of its chunks: measured, 610 bytes for each, and a piece
# makes up to 27.
_FOOTER_PER_PIECE = 16_500


class RecordingError(Exception):
    """A recording cannot be written; the message says why and what to do."""


@dataclass(frozen=True, kw_only=True)
class RecordingConfig:
    """What a recording holds."""

    max_bytes: int = 64_000_000
    """Size that no further rollout may push the file over."""
    max_rollouts: int = 32
    """Rollouts recorded at most."""
    frames_per_second: float = 10.0
    """Speed of playback; 10 is the scenes' own."""


def rollouts_of(
    evaluation: Evaluation, file: BankFile
) -> Iterator[tuple[str, FrameBatch]]:
    """The rollouts of an evaluation that kept its trace: the SDC's, scene by scene.

    A rollout ends with the last step that counts.
    """
    trace = evaluation.trace
    if trace is None:
        raise RecordingError(
            f"the evaluation of {evaluation.agent} kept no trace to record: evaluate "
            "with keep_trace=True"
        )
    for scene in range(file.scenes):
        sdc = int(file.arrays["sdc"][scene])
        column = sdc if trace.counts.shape[2] > 1 else 0
        counts = np.asarray(trace.counts)[scene, :, column]
        if not counts.any():
            continue
        steps = slice(0, int(np.flatnonzero(counts)[-1]) + 1)
        values = {
            name: np.asarray(getattr(trace, name))[scene, steps, column]
            for name in ("states", "action", "reward", "overlap", "offroad", "progress")
        }
        step = np.asarray(trace.step)[scene, steps]
        frames = make_frames(
            len(step),
            scene=scene,
            step=step,
            controlled=sdc,
            state=values.pop("states"),
            **values,
        )
        yield (
            evaluation.agent,
            FrameBatch(
                actor=0,
                environment=0,
                actor_steps=0,
                weights_version=-1,
                frames=frames,
                q_values=np.asarray(trace.q_values)[scene, steps, column],
            ),
        )


@dataclass(frozen=True)
class Recorded:
    """What was written."""

    path: Path
    rollouts: int
    frames: int
    size: int  # bytes


def record_evaluation(
    path: Path,
    *,
    scene_of: SceneSource,
    rollouts: Iterable[tuple[str, FrameBatch]],
    actions: ActionLabels | None = None,
    config: RecordingConfig | None = None,
) -> Recorded:
    """Writes rollouts (who drives, and its frames in one scene) to `path`.

    Stops before the next rollout could exceed the size: rollouts are judged by the
    largest one so far. One rollout is always written.
    """
    config = config or RecordingConfig()
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with temporary.open("wb"):
            pass
    except OSError as error:
        reason = error.strerror or error
        raise RecordingError(
            f"{path}: {reason}: choose a folder that can be written"
        ) from error
    try:
        count, frames = _write(
            temporary, scene_of, rollouts, actions=actions, config=config
        )
        size = temporary.stat().st_size
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return Recorded(path, count, frames, size)


def _write(
    path: Path,
    scene_of: SceneSource,
    rollouts: Iterable[tuple[str, FrameBatch]],
    *,
    actions: ActionLabels | None,
    config: RecordingConfig,
) -> tuple[int, int]:
    """Writes the file; rollouts and frames written."""
    recording = new_recording("evaluation")
    recording.save(path)
    recording.send_blueprint(
        layout([ROOT], play_state="playing", frames_per_second=config.frames_per_second)
    )
    view = EnvironmentView(recording=recording, root=ROOT, actions=actions)
    count, frames, at, pieces = 0, 0, 0, 0
    before, largest = 0, 0
    for title, batch in rollouts:
        recording.flush()
        size = path.stat().st_size + pieces * _FOOTER_PER_PIECE
        largest, before = max(largest, size - before), size
        full = count and size + 1.25 * largest > config.max_bytes
        if full or count >= config.max_rollouts:
            break
        _log_rollout(view, scene_of, (f"Rollout {count + 1}: {title}", batch), at)
        count, frames = count + 1, frames + len(batch)
        at += len(batch) + PAUSE
        pieces += -(-len(batch) // _CHUNK)
    recording.flush()
    recording.disconnect()
    return count, frames


def _log_rollout(
    view: EnvironmentView,
    scene_of: SceneSource,
    rollout: tuple[str, FrameBatch],
    start: int,
) -> None:
    """Logs one rollout in pieces from row `start` of the timeline on."""
    title, batch = rollout
    scene = scene_of(int(batch.frames["scene"][0]))
    for first in range(0, len(batch), _CHUNK):
        part = slice(first, min(first + _CHUNK, len(batch)))
        piece = Piece(
            frames=batch.frames[part],
            q_values=batch.q_values[part],
            at=np.arange(start + part.start, start + part.stop),
            begins=first == 0,
            title=title,
        )
        view.log(scene, piece)
