"""The frames of one watched environment as Rerun entities.

    ROOT/camera             transform that keeps the controlled object in the middle
    ROOT/objects            recorded objects, true size, coloured by type
    ROOT/marks              windscreens and rear windows: which way a box faces
    ROOT/ego                the controlled object; red while it overlaps or is off-road
    ROOT/recorded           outline of where the log has the controlled object
    ROOT/trail, ROOT/route  where it has been; the log's route ahead of it
    ROOT/plots/...          scalars: speed, reward, progress, failures, action
    ROOT/q_values           the Q-values of all actions
    ROOT/q_bars/{all,chosen}   the same above their lowest, the chosen action in colour
    ROOT/about              scenario, step, policy and action in words

The other objects replay the log (a frame carries the controlled object's state only).
Columns are sent for a whole piece of an episode at once: about 40 us a frame, against
1.5 ms for a logging call per entity and step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import rerun as rr
from jaxtyping import Bool, Float, Int, Shaped

from launch.bars import bar_colour, vectors
from launch.map_view import log_map
from launch.scene_view import Colour, ViewScene, log_lights, send
from launch.words import ActionLabels, describe
from sim.scene import ObjectType

EGO: Colour = (38, 166, 255, 255)
FAILED: Colour = (255, 59, 48, 255)
TRAIL: Colour = (38, 166, 255, 210)
ROUTE: Colour = (60, 200, 110, 255)
RECORDED: Colour = (235, 238, 242, 255)
VEHICLE: Colour = (170, 178, 189, 255)
PEDESTRIAN: Colour = (255, 179, 71, 255)
CYCLIST: Colour = (198, 134, 255, 255)
GLASS: Colour = (38, 43, 51, 255)

_SMALL = {int(ObjectType.PEDESTRIAN): PEDESTRIAN, int(ObjectType.CYCLIST): CYCLIST}
# Windscreen and rear window: centre and length along the car over its length, and
# width over its width. Seen from above they say where a box's front is.
_WINDOWS = ((0.17, 0.11, 0.80), (-0.40, 0.06, 0.72))
_MAX_TRAIL = 400  # points; a longer trail forgets its beginning
# Metres at which lines lie above the recorded ground, so that none hides another.
_ROUTE_HEIGHT, _TRAIL_HEIGHT = 0.05, 0.12

Boxes = tuple[
    Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"], Float[np.ndarray, " _"]
]
"""Centres, sizes and yaws."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """Consecutive frames of one episode, and where they stand on the timeline."""

    frames: Shaped[np.ndarray, " frames"]  # of `FRAME_DTYPE`
    q_values: Float[np.ndarray, "frames actions"]
    at: Int[np.ndarray, " frames"]  # rows of the timeline `step`
    begins: bool  # whether the first frame begins an episode
    title: str  # who drives, for the text panel


def quaternions(yaw: Float[np.ndarray, " boxes"]) -> Float[np.ndarray, "boxes 4"]:
    """Rotations about z as (x, y, z, w)."""
    zeros = np.zeros_like(yaw)
    return np.stack([zeros, zeros, np.sin(yaw / 2), np.cos(yaw / 2)], axis=-1)


def windows_of(boxes: Boxes) -> Boxes:
    """Flat dark boxes on the roofs, one windscreen and one rear window a box."""
    centres, sizes, yaws = boxes
    heading = np.stack([np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)], axis=-1)
    all_centres, all_sizes = [], []
    for along, length, width in _WINDOWS:
        at = centres + along * sizes[:, :1] * heading
        at[:, 2] += sizes[:, 2] / 2
        all_centres.append(at)
        flat = np.full(len(sizes), 0.04, np.float32)
        all_sizes.append(
            np.stack([length * sizes[:, 0], width * sizes[:, 1], flat], axis=-1)
        )
    count = len(_WINDOWS)
    return np.concatenate(all_centres), np.concatenate(all_sizes), np.tile(yaws, count)


def _send_boxes(
    recording: rr.RecordingStream,
    entity: str,
    at: Int[np.ndarray, " frames"],
    frames: Sequence[tuple[Boxes, list[Colour]]],
    fill: rr.components.FillMode = rr.components.FillMode.Solid,
) -> None:
    """Sends boxes and their colours for each frame."""
    lengths = [len(boxes[0]) for boxes, _ in frames]
    centres, sizes, yaws = (
        np.concatenate([boxes[part] for boxes, _ in frames]) for part in range(3)
    )
    columns = rr.Boxes3D.columns(
        centers=centres,
        half_sizes=sizes / 2,
        quaternions=quaternions(yaws),
        colors=[colour for _, colours in frames for colour in colours],
        fill_mode=[fill] * sum(lengths),
        radii=np.full(sum(lengths), 0.08, np.float32),
    )
    send(recording, entity, at, columns.partition(lengths))


def _send_lines(
    recording: rr.RecordingStream,
    entity: str,
    at: Int[np.ndarray, " frames"],
    lines: Sequence[Float[np.ndarray, "_ 3"]],
    style: tuple[Colour, float],
) -> None:
    """Sends one polyline for each frame; `style` is its colour and radius [m]."""
    colour, radius = style
    columns = rr.LineStrips3D.columns(
        strips=list(lines), colors=[colour] * len(lines), radii=[radius] * len(lines)
    )
    send(recording, entity, at, columns.partition([1] * len(lines)))


@final
class EnvironmentView:
    """Logs one environment below `root`; remembers the episode that it is in."""

    def __init__(
        self,
        *,
        recording: rr.RecordingStream,
        root: str,
        actions: ActionLabels | None = None,
    ) -> None:
        """Logs what stays the same: the plots' names and colours."""
        self._recording = recording
        self._root = root
        self._actions = actions
        self._trail = np.zeros((0, 3), np.float32)
        self._return = 0.0
        self._log_styles()

    def log(self, scene: ViewScene, piece: Piece) -> None:
        """Logs frames; the map and the traffic lights too where an episode begins."""
        if piece.begins:
            self._trail = np.zeros((0, 3), np.float32)
            self._return = 0.0
            log_map(self._recording, self._root, scene, int(piece.at[0]))
        if piece.begins or len(scene.light_points):
            steps = piece.frames["step"]
            log_lights(self._recording, self._root, scene, steps, piece.at)
        self._log_objects(scene, piece)
        self._log_paths(scene, piece)
        self._log_plots(scene, piece)
        self._log_text(scene, piece)

    def _log_objects(self, scene: ViewScene, piece: Piece) -> None:
        """Boxes of everyone, with their windows."""
        steps = np.clip(piece.frames["step"], 0, scene.valid.shape[1] - 1)
        windowed = ~np.isin(scene.object_types, list(_SMALL))
        colours = [_SMALL.get(int(kind), VEHICLE) for kind in scene.object_types]
        shown: dict[str, list[tuple[Boxes, list[Colour]]]] = {
            name: [] for name in ("objects", "ego", "marks", "recorded")
        }
        for frame, step in zip(piece.frames, steps.tolist(), strict=True):
            present = scene.valid[:, step].copy()
            only = np.zeros_like(present)
            only[frame["controlled"]] = present[frame["controlled"]]
            present[frame["controlled"]] = False
            ego = _ego_box(scene, frame, step)
            failed = bool(frame["overlap"]) or bool(frame["offroad"])
            windows = windows_of(
                _joined([_boxes(scene, step, present & windowed), ego])
            )
            objects = _boxes(scene, step, present)
            shown["objects"].append(
                (objects, [colours[row] for row in np.flatnonzero(present)])
            )
            shown["ego"].append((ego, [FAILED if failed else EGO]))
            shown["marks"].append((windows, [GLASS] * len(windows[0])))
            shown["recorded"].append(
                (_boxes(scene, step, only), [RECORDED] * int(only.sum()))
            )
        for name, frames in shown.items():
            outline = name == "recorded"
            fill = rr.components.FillMode
            _send_boxes(
                self._recording,
                f"{self._root}/{name}",
                piece.at,
                frames,
                fill.MajorWireframe if outline else fill.Solid,
            )

    def _log_paths(self, scene: ViewScene, piece: Piece) -> None:
        """Camera, trail and route."""
        last = scene.valid.shape[1] - 1
        trails, routes, centres = [], [], []
        for frame in piece.frames:
            centre, size, _ = _ego_box(scene, frame, min(int(frame["step"]), last))
            ground = centre[0] - np.array([0, 0, size[0, 2] / 2], np.float32)
            centres.append(ground)
            raised = ground + np.array([0, 0, _TRAIL_HEIGHT], np.float32)
            self._trail = np.concatenate([self._trail, raised[None]])[-_MAX_TRAIL:]
            trails.append(self._trail)
            routes.append(_route_ahead(scene, int(frame["controlled"]), ground))
        camera = rr.Transform3D.columns(translation=np.stack(centres))
        send(self._recording, f"{self._root}/camera", piece.at, camera)
        recording, root, at = self._recording, self._root, piece.at
        _send_lines(recording, f"{root}/trail", at, trails, (TRAIL, 0.3))
        _send_lines(recording, f"{root}/route", at, routes, (ROUTE, 0.3))

    def _log_plots(self, scene: ViewScene, piece: Piece) -> None:
        """Scalars and Q-values."""
        frames = piece.frames
        returns = self._return + np.cumsum(frames["reward"], dtype=np.float64)
        self._return = float(returns[-1])
        steps = np.clip(frames["step"], 0, scene.valid.shape[1] - 1)
        controlled = frames["controlled"]
        logged = np.where(
            scene.valid[controlled, steps], scene.speed[controlled, steps], np.nan
        )
        driven = np.linalg.norm(frames["state"][:, 3:], axis=1)
        action = frames["action"][:, None].astype(np.float64)
        if self._actions is not None:
            action = self._actions.values[np.maximum(frames["action"], 0)]
        series = {
            # To cm/s: a plot scales itself to the noise of a standing car otherwise.
            "speed": np.round(np.stack([driven, logged], axis=-1), 2),
            "reward": np.stack([frames["reward"], returns], axis=-1),
            "progress": frames["progress"][:, None],
            "failures": np.stack([frames["overlap"], frames["offroad"]], axis=-1),
            "action": action,
        }
        for name, values in series.items():
            self._send_scalars(name, values.astype(np.float64), piece)
        if piece.q_values.shape[1]:
            self._log_q_values(piece)

    def _send_scalars(
        self, name: str, values: Float[np.ndarray, "frames lines"], piece: Piece
    ) -> None:
        """One plot's lines: as many values a frame."""
        at, lines = piece.at, values.shape[1]
        if piece.begins:  # a gap, or the lines would join two episodes
            values = np.concatenate([np.full((1, lines), np.nan), values])
            at = np.concatenate([at[:1], at])
        columns = rr.Scalars.columns(scalars=values.ravel())
        entity = f"{self._root}/plots/{name}"
        send(self._recording, entity, at, columns.partition([lines] * len(at)))

    def _log_q_values(self, piece: Piece) -> None:
        """Q-values as they are, and as bars.

        The bars start at the lowest: what tells actions apart is small beside what
        they have in common.
        """
        root, at, q_values = self._root, piece.at, piece.q_values
        send(self._recording, f"{root}/q_values", at, [vectors("values", q_values)])
        above = q_values - q_values.min(axis=1, keepdims=True)
        send(self._recording, f"{root}/q_bars/all", at, [vectors("values", above)])
        chosen = np.maximum(piece.frames["action"], 0)
        bar = vectors("values", above[np.arange(len(at)), chosen][:, None])
        where = vectors("abscissa", chosen.astype(np.float32)[:, None])
        send(self._recording, f"{root}/q_bars/chosen", at, [bar, where])

    def _log_text(self, scene: ViewScene, piece: Piece) -> None:
        """The panel of words."""
        texts = []
        for frame, q in zip(piece.frames, piece.q_values, strict=True):
            texts.append(describe(scene, frame, q, (piece.title, self._actions)))
        columns = rr.TextDocument.columns(
            text=texts, media_type=["text/markdown"] * len(texts)
        )
        send(self._recording, f"{self._root}/about", piece.at, columns)

    def _log_styles(self) -> None:
        """Names and colours of the plots' lines."""
        plots = f"{self._root}/plots"
        styles: dict[str, tuple[tuple[str, Colour], ...]] = {
            "speed": (("driven [m/s]", EGO), ("recorded [m/s]", (150, 156, 166, 255))),
            "reward": (("reward", (255, 190, 40, 255)), ("return", ROUTE)),
            "progress": (("progress", ROUTE),),
            "failures": (("overlap", FAILED), ("off-road", (255, 140, 60, 255))),
        }
        names = self._actions.names if self._actions is not None else ("index",)
        colours: tuple[Colour, ...] = (EGO, (255, 190, 40, 255), CYCLIST)
        styles["action"] = tuple(zip(names, colours, strict=False))
        for name, lines in styles.items():
            style = rr.SeriesLines(
                names=[label for label, _ in lines],
                colors=[colour for _, colour in lines],
                widths=[2.0] * len(lines),
            )
            self._recording.log(f"{plots}/{name}", style, static=True)
        bars = f"{self._root}/q_bars"
        for name, colour in (("all", (104, 114, 128, 255)), ("chosen", EGO)):
            self._recording.log(f"{bars}/{name}", bar_colour(colour), static=True)


def _boxes(scene: ViewScene, step: int, chosen: Bool[np.ndarray, " objects"]) -> Boxes:
    """The chosen objects' boxes at a step of the log."""
    return (
        scene.position[chosen, step],
        scene.size[chosen, step],
        scene.yaw[chosen, step],
    )


def _joined(parts: Sequence[Boxes]) -> Boxes:
    """Several sets of boxes as one."""
    centres, sizes, yaws = zip(*parts, strict=True)
    return np.concatenate(centres), np.concatenate(sizes), np.concatenate(yaws)


def _ego_box(scene: ViewScene, frame: np.void, step: int) -> Boxes:
    """The controlled object's simulated box, of its recorded size and height.

    Where the log lacks the step, the nearest recorded one stands in for those two.
    """
    row = int(frame["controlled"])
    recorded = np.flatnonzero(scene.valid[row])
    nearest = int(recorded[np.abs(recorded - step).argmin()]) if recorded.size else step
    x, y, yaw = frame["state"][:3]
    centre = np.array([[x, y, scene.position[row, nearest, 2]]], np.float32)
    return centre, scene.size[row, nearest][None], np.array([yaw], np.float32)


def _route_ahead(
    scene: ViewScene, row: int, ground: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "_ 3"]:
    """The controlled object's recorded path, from its nearest point to where it is."""
    path = scene.position[row, scene.valid[row]].astype(np.float32)
    if not len(path):
        return np.zeros((0, 3), np.float32)
    ahead = path[int(np.linalg.norm(path[:, :2] - ground[:2], axis=1).argmin()) :]
    lifted = ahead.copy()
    lifted[:, 2] = ground[2] + _ROUTE_HEIGHT
    return lifted
