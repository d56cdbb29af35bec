"""The viewer role: frames from Zenoh to Rerun, live in the browser.

Actors live through hundreds of steps a second; a person can follow about ten. So
the viewer plays episodes whole at a pace of its own: while enough of an environment's
past waits to be shown, its episodes that come are dropped from their first frame to
their last. The timeline `step` counts what was shown, over all environments alike.

Nothing here can slow a run: frames are published to be dropped, the queue between
Zenoh and this process drops its oldest, and what arrives unreadable is counted.
Columns are sent a few times a second. The page follows the newest row (`following`),
so that one which joins late, or renders slowly, shows the present.
"""

import itertools
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Protocol, final, runtime_checkable

import numpy as np
import rerun as rr
from jaxtyping import Bool, Shaped

from actors.frames import FrameBatch, FrameError, decode_frames
from launch.blueprint import layout, new_recording
from launch.frame_view import EnvironmentView, Piece
from launch.scene_view import SceneSource
from launch.web import WebConfig, WebViewer
from launch.words import ActionLabels


@dataclass(frozen=True, kw_only=True)
class ViewerConfig:
    """What is shown, how fast and where."""

    environments: int = 2
    """Environments shown; the first that send frames."""
    frames_per_second: float = 10.0
    """Pace of the playback; 10 is the scenes' own."""
    buffer_s: float = 0.5
    """Frames are sent to the browser this often."""
    backlog_s: float = 2.0
    """An episode is skipped while this much of its environment waits to be shown."""
    web: WebConfig = field(default_factory=WebConfig)
    """Where the viewer is served."""

    def __post_init__(self) -> None:
        """Refuses what could show nothing."""
        if not 1 <= self.environments <= 16:
            raise ValueError(f"environments={self.environments} must be 1 to 16")
        if not (self.frames_per_second > 0 and self.buffer_s > 0):
            raise ValueError("frames_per_second and buffer_s must be positive")


@runtime_checkable
class FrameSource(Protocol):
    """What `replay.channels.FrameSubscriber` offers."""

    def get(self, timeout: float | None = None) -> tuple[int, bytes] | None:
        """The oldest message kept, as (actor, bytes); None if none comes in time."""


@dataclass(frozen=True)
class _Part:
    """Frames of one episode that came in one message."""

    batch: FrameBatch
    begins: bool


def begins_episode(
    frames: Shaped[np.ndarray, " frames"], last: Shaped[np.ndarray, " one"] | None
) -> Bool[np.ndarray, " frames"]:
    """Which frames begin an episode; `last` is the frame before, if there was one.

    An episode goes on while scene and controlled object stay and the step rises.
    """
    before = np.roll(frames, 1)
    if last is not None:
        before[:1] = last
    same = (frames["scene"] == before["scene"]) & (
        frames["controlled"] == before["controlled"]
    )
    begins = ~(same & (frames["step"] > before["step"]))
    if last is None:
        begins[0] = True
    return begins


@final
class Playlist:
    """One environment's frames that wait to be shown: whole episodes, a bounded lot."""

    def __init__(self, *, backlog: int) -> None:
        """`backlog` is the number of frames from which on episodes are skipped."""
        self._backlog = backlog
        self._parts: deque[_Part] = deque()
        self._last: Shaped[np.ndarray, " one"] | None = None
        self._keeping = True
        self.waiting = 0
        """Frames that wait."""
        self.skipped = 0
        """Frames dropped so far."""

    def offer(self, batch: FrameBatch) -> None:
        """Takes the frames that are to be shown of those that came."""
        begins = begins_episode(batch.frames, self._last)
        self._last = batch.frames[-1:]
        cuts = sorted({0, *np.flatnonzero(begins).tolist(), len(batch)})
        for first, last in itertools.pairwise(cuts):
            if begins[first]:
                self._keeping = self.waiting < self._backlog
            # An episode without an end must not grow without one either.
            self._keeping &= self.waiting < 64 * self._backlog
            if self._keeping:
                part = _slice(batch, first, last)
                self._parts.append(_Part(part, bool(begins[first])))
                self.waiting += last - first
            else:
                self.skipped += last - first

    def take(self, count: int) -> list[_Part]:
        """Removes up to `count` frames, oldest first."""
        taken: list[_Part] = []
        while count and self._parts:
            part = self._parts.popleft()
            size = len(part.batch)
            if size > count:
                rest = _Part(_slice(part.batch, count, size), False)
                self._parts.appendleft(rest)
                part = _Part(_slice(part.batch, 0, count), part.begins)
            taken.append(part)
            count -= len(part.batch)
            self.waiting -= len(part.batch)
        return taken


def _slice(batch: FrameBatch, first: int, last: int) -> FrameBatch:
    """Frames `first` to `last` (excluded) of a batch."""
    return FrameBatch(
        actor=batch.actor,
        environment=batch.environment,
        actor_steps=batch.actor_steps,
        weights_version=batch.weights_version,
        frames=batch.frames[first:last],
        q_values=batch.q_values[first:last],
    )


@final
class LiveView:
    """Logs the watched environments to a recording; no clock, no sockets."""

    def __init__(
        self,
        *,
        recording: rr.RecordingStream,
        scene_of: SceneSource,
        actions: ActionLabels | None,
        config: ViewerConfig,
    ) -> None:
        """Shows an empty place until frames come."""
        self._recording = recording
        self._scene_of = scene_of
        self._actions = actions
        self._config = config
        self._places: dict[tuple[int, int], int] = {}
        self._playlists: list[Playlist] = []
        self._views: list[EnvironmentView] = []
        self._next = 0
        self.refused = 0
        """Messages that could not be read or shown."""
        self._send_layout(["/environment_1"])

    @property
    def shown(self) -> int:
        """Rows of the timeline so far."""
        return self._next

    def offer(self, payload: bytes) -> None:
        """Takes a message as it came from the network."""
        try:
            batch = decode_frames(payload)
        except FrameError:
            self.refused += 1
            return
        place = self._place(batch)
        if place is not None:
            self._playlists[place].offer(batch)

    def show(self, count: int) -> int:
        """Logs the next `count` frames of every environment; how many it could."""
        longest = 0
        for playlist, view in zip(self._playlists, self._views, strict=True):
            at = self._next
            for part in playlist.take(count):
                at += self._show_part(view, part, at)
            longest = max(longest, at - self._next)
        self._next += longest
        return longest

    def _show_part(self, view: EnvironmentView, part: _Part, at: int) -> int:
        """Logs frames from row `at` on; how many rows they took."""
        batch = part.batch
        try:
            scene = self._scene_of(int(batch.frames["scene"][0]))
        except IndexError:  # of another bank
            self.refused += 1
            return 0
        if int(batch.frames["controlled"].max()) >= len(scene.valid):
            self.refused += 1
            return 0
        title = f"Actor {batch.actor}, weights {batch.weights_version}"
        piece = Piece(
            frames=batch.frames,
            q_values=batch.q_values,
            at=np.arange(at, at + len(batch)),
            begins=part.begins,
            title=title,
        )
        view.log(scene, piece)
        return len(batch)

    def _place(self, batch: FrameBatch) -> int | None:
        """The environment's place on the screen; None where all are taken."""
        key = (batch.actor, batch.environment)
        if key in self._places:
            return self._places[key]
        place = len(self._places)
        if place == self._config.environments:
            return None
        self._places[key] = place
        roots = [f"/environment_{number + 1}" for number in range(place + 1)]
        backlog = self._config.backlog_s * self._config.frames_per_second
        self._playlists.append(Playlist(backlog=max(1, round(backlog))))
        self._views.append(
            EnvironmentView(
                recording=self._recording, root=roots[-1], actions=self._actions
            )
        )
        self._send_layout(roots)
        return place

    def _send_layout(self, roots: list[str]) -> None:
        """Makes room for the environments."""
        pace = self._config.frames_per_second
        blueprint = layout(roots, play_state="following", frames_per_second=pace)
        self._recording.send_blueprint(blueprint)


def play(
    view: LiveView, source: FrameSource, config: ViewerConfig, stop: threading.Event
) -> None:
    """Takes frames as they come and shows them at the configured pace until `stop`."""
    count = max(1, round(config.frames_per_second * config.buffer_s))
    due = time.monotonic() + config.buffer_s
    while not stop.is_set():
        message = source.get(timeout=max(0.0, due - time.monotonic()))
        if message is not None:
            view.offer(message[1])
        now = time.monotonic()
        if now >= due:
            view.show(count)
            # A viewer that was held up goes on from here; it does not catch up.
            due = max(due + config.buffer_s, now)


@final
class Viewer:
    """The role: serves the page and shows what a run's actors publish."""

    def __init__(
        self,
        *,
        source: FrameSource,
        scene_of: SceneSource,
        actions: ActionLabels | None,
        config: ViewerConfig,
        name: str,
    ) -> None:
        """Checks the ports; `name` is the run's."""
        self._source = source
        self._config = config
        self._web = WebViewer(config.web)
        self._recording = new_recording(name)
        self._scene_of = scene_of
        self._actions = actions

    @property
    def url(self) -> str:
        """What to open in a browser."""
        return self._web.url

    def run(self, stop: threading.Event, started: threading.Event) -> None:
        """Serves until `stop`; sets `started` when the page can be opened."""
        with self._web:
            self._recording.connect_grpc(self._web.grpc_url)
            view = LiveView(
                recording=self._recording,
                scene_of=self._scene_of,
                actions=self._actions,
                config=self._config,
            )
            started.set()
            guard = _Guarded(self._source, self._web)
            play(view, guard, self._config, stop)
            self._recording.disconnect()


@final
class _Guarded:
    """A source that ends with an error when the page's server has ended."""

    def __init__(self, source: FrameSource, web: WebViewer) -> None:
        """Both are the caller's."""
        self._source = source
        self._web = web

    def get(self, timeout: float | None = None) -> tuple[int, bytes] | None:
        """The source's next message."""
        self._web.check()
        return self._source.get(timeout)
