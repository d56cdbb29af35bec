"""The recording of an evaluation, read back; and the scenes it is drawn from."""

import dataclasses
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from actors.evaluation import Evaluation, Trace
from actors.frames import FrameBatch, make_frames
from launch.bank_view import bank_scenes, chained, labels_of
from launch.map_view import dashes, line_strips, stripes, surface_mesh
from launch.recording import (
    PAUSE,
    RecordingConfig,
    RecordingError,
    record_evaluation,
    rollouts_of,
)
from launch.scene_view import ViewScene, view_scene_of
from launch.view import check_recording
from launch.web import ViewError
from sim import bank, bank_writer, procedural
from sim.bank import BankFile
from sim.dynamics import ActionConfig
from sim.scene import RoadKind

rr.set_strict_mode(True)  # a warning of Rerun's is an entity that is not shown

STEPS = 20
ACTIONS = ActionConfig().count


@pytest.fixture(scope="module")
def bank_file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    path = tmp_path_factory.mktemp("banks") / "three.bank"
    bank_writer.write_bank(procedural.generate_many(5, 3), path)
    return bank.open_bank(path)


def rollout_of(file: BankFile, scene: int, failing: int = 0) -> tuple[str, FrameBatch]:
    """The log itself as a rollout; its last `failing` steps are off-road."""
    steps = np.arange(11, 11 + STEPS)
    sdc = int(file.arrays["sdc"][scene])
    log = file.arrays["log"][scene, steps, sdc]
    frames = make_frames(
        STEPS,
        scene=scene,
        step=steps,
        controlled=sdc,
        state=log[:, [0, 1, 3, 4, 5]],
        action=scene,
        reward=1.0,
        progress=np.linspace(0, 1, STEPS),
        overlap=0,
        offroad=np.arange(STEPS) >= STEPS - failing,
    )
    q_values = np.random.default_rng(scene).normal(size=(STEPS, ACTIONS))
    batch = FrameBatch(
        actor=0,
        environment=0,
        actor_steps=0,
        weights_version=4,
        frames=frames,
        q_values=q_values.astype(np.float32),
    )
    return f"scene {scene}", batch


def read(path: Path) -> dict[str, dict[str, list[tuple[int | None, Any]]]]:
    """Per entity and component: rows of (step, value), in order; static: step None."""
    rows: dict[str, dict[str, list[tuple[int | None, Any]]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for chunk in RrdReader(path).stream().to_chunks():
        record = chunk.to_record_batch()
        names = record.schema.names
        steps = (
            record.column("step").cast(pa.int64()).to_pylist()
            if "step" in names
            else [None] * record.num_rows
        )
        for name in names:
            if ":" in name:
                values = record.column(name).to_pylist()
                rows[chunk.entity_path][name].extend(zip(steps, values, strict=True))
    return rows


def at(rows: list[tuple[int | None, Any]], step: int) -> Any:
    """The last value of a step."""
    return [value for row, value in rows if row == step][-1]


@pytest.fixture(scope="module")
def recorded(
    bank_file: BankFile, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, dict[str, list[tuple[int | None, Any]]]]:
    path = tmp_path_factory.mktemp("recording") / "evaluation.rrd"
    result = record_evaluation(
        path,
        scene_of=bank_scenes(bank_file),
        rollouts=[rollout_of(bank_file, scene, failing=3) for scene in range(3)],
        actions=labels_of(ActionConfig()),
    )
    assert (result.rollouts, result.frames) == (3, 3 * STEPS)
    assert result.size == path.stat().st_size
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    check_recording(path)
    return read(path)


def test_rollouts_follow_one_another(recorded: Any) -> None:
    expected = [
        rollout * (STEPS + PAUSE) + step
        for rollout in range(3)
        for step in range(STEPS)
    ]
    for entity in ("ego", "objects", "marks", "camera", "about", "trail", "route"):
        component = next(iter(recorded[f"/evaluation/{entity}"].values()))
        assert [step for step, _ in component] == expected, entity


def test_every_entity_is_there(recorded: Any) -> None:
    names = {path.removeprefix("/evaluation/") for path in recorded}
    assert names >= {
        *("camera", "ego", "objects", "marks", "recorded", "trail", "route", "about"),
        *("map/surface", "map/lane_lines", "map/road_edges", "map/crosswalks"),
        *("map/lane_centres", "map/stop_signs", "map/speed_bumps", "lights"),
        *(f"plots/{n}" for n in ("speed", "reward", "progress", "failures", "action")),
        *("q_values", "q_bars/all", "q_bars/chosen"),
    }


def test_a_map_begins_with_its_rollout(recorded: Any) -> None:
    for kind in ("road_edges", "lane_lines", "speed_bumps"):
        rows = recorded[f"/evaluation/map/{kind}"]["LineStrips3D:strips"]
        assert [step for step, _ in rows] == [0, STEPS + PAUSE, 2 * (STEPS + PAUSE)]
    edges = recorded["/evaluation/map/road_edges"]["LineStrips3D:strips"]
    assert edges[0][1] != edges[1][1]


def test_boxes_are_true_size_and_where_the_log_is(
    recorded: Any, bank_file: BankFile
) -> None:
    step, scene = 13, 1
    row = STEPS + PAUSE + step - 11
    valid = bank_file.arrays["log_valid"][scene, step].copy()
    sdc = int(bank_file.arrays["sdc"][scene])
    log = bank_file.arrays["log"][scene, step]
    ego = recorded["/evaluation/ego"]
    half = np.array(at(ego["Boxes3D:half_sizes"], row))
    np.testing.assert_allclose(2 * half[:, :2], log[[sdc], 6:8], rtol=1e-6)
    valid[sdc] = False
    boxes = recorded["/evaluation/objects"]
    half = np.array(at(boxes["Boxes3D:half_sizes"], row))
    np.testing.assert_allclose(2 * half[:, :2], log[valid, 6:8], rtol=1e-6)
    centres = np.array(at(boxes["Boxes3D:centers"], row))
    np.testing.assert_allclose(centres[:, :2], log[valid, :2], rtol=1e-6)
    x, y, z, w = np.array(at(boxes["Boxes3D:quaternions"], row)).T
    assert not x.any() and not y.any()
    turned = np.angle(np.exp(1j * (2 * np.arctan2(z, w) - log[valid, 3])))
    np.testing.assert_allclose(turned, 0.0, atol=1e-5)


def test_a_failing_ego_is_red(recorded: Any) -> None:
    colours = recorded["/evaluation/ego"]["Boxes3D:colors"]
    reds = [step for step, value in colours if value[0] >> 24 == 255]
    assert reds == [r * (STEPS + PAUSE) + s for r in range(3) for s in (17, 18, 19)]


def test_the_trail_grows_and_starts_anew(recorded: Any) -> None:
    trails = recorded["/evaluation/trail"]["LineStrips3D:strips"]
    assert [len(value[0]) for _, value in trails] == 3 * list(range(1, STEPS + 1))


def test_scalars_and_q_values(recorded: Any, bank_file: BankFile) -> None:
    reward = recorded["/evaluation/plots/reward"]["Scalars:scalars"]
    last = STEPS + PAUSE + STEPS - 1
    assert at(reward, last) == [1.0, STEPS]
    gap = next(value for step, value in reward if step == STEPS + PAUSE)
    assert np.isnan(gap).all()
    q_values = rollout_of(bank_file, 1)[1].q_values
    rows = recorded["/evaluation/q_values"]["BarChart:values"]
    stored = at(rows, last)[0]["buffer"]
    np.testing.assert_array_equal(np.array(stored, np.float32), q_values[-1])
    chosen = recorded["/evaluation/q_bars/chosen"]
    assert at(chosen["BarChart:abscissa"], last)[0]["buffer"] == [1.0]
    bar = at(chosen["BarChart:values"], last)[0]["buffer"][0]
    assert bar == pytest.approx(q_values[-1, 1] - q_values[-1].min(), rel=1e-6)


def test_words_say_which_scenario_and_action(
    recorded: Any, bank_file: BankFile
) -> None:
    texts = recorded["/evaluation/about"]["TextDocument:text"]
    text = at(texts, 2 * (STEPS + PAUSE))[0]
    assert bank_file.scenario_ids[2] in text
    assert "Rollout 3: scene 2" in text
    assert "acceleration [m/s²] | -6 " in text
    assert "**off-road**" in at(texts, STEPS - 1)[0]


def test_the_size_is_bounded(bank_file: BankFile, tmp_path: Path) -> None:
    limit = 900_000
    result = record_evaluation(
        tmp_path / "small.rrd",
        scene_of=bank_scenes(bank_file),
        rollouts=(rollout_of(bank_file, index % 3) for index in range(1000)),
        config=RecordingConfig(max_bytes=limit, max_rollouts=1000),
    )
    assert 2 <= result.rollouts < 1000
    assert limit / 3 < result.size <= limit


def test_the_number_of_rollouts_is_bounded(bank_file: BankFile, tmp_path: Path) -> None:
    result = record_evaluation(
        tmp_path / "two.rrd",
        scene_of=bank_scenes(bank_file),
        rollouts=(rollout_of(bank_file, index) for index in range(3)),
        config=RecordingConfig(max_rollouts=2),
    )
    assert result.rollouts == 2


def test_an_unwritable_folder_is_one_line(bank_file: BankFile, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"No such file .*: choose a folder"):
        record_evaluation(
            tmp_path / "missing" / "a.rrd",
            scene_of=bank_scenes(bank_file),
            rollouts=[],
        )


def test_a_rollout_that_breaks_leaves_nothing(
    bank_file: BankFile, tmp_path: Path
) -> None:
    path = tmp_path / "evaluation.rrd"
    path.write_bytes(b"the one before")
    _, batch = rollout_of(bank_file, 0)
    batch.frames["scene"] = 99
    with pytest.raises(IndexError, match="scene 99 of a bank of 3"):
        record_evaluation(
            path, scene_of=bank_scenes(bank_file), rollouts=[("lost", batch)]
        )
    assert path.read_bytes() == b"the one before"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_truncated_recording_is_refused(bank_file: BankFile, tmp_path: Path) -> None:
    path = tmp_path / "evaluation.rrd"
    record_evaluation(
        path,
        scene_of=bank_scenes(bank_file),
        rollouts=[rollout_of(bank_file, 0)],
    )
    check_recording(path)
    whole = path.read_bytes()
    for size in (4, 1000, len(whole) // 2, len(whole) - 1000, len(whole) - 16):
        path.write_bytes(whole[:size])
        with pytest.raises(ViewError, match=f"truncated at byte {size}"):
            check_recording(path)
    path.write_bytes(b"hello")
    with pytest.raises(ViewError, match="no Rerun recording"):
        check_recording(path)


def trace_of(file: BankFile, steps: int, counted: int) -> Trace:
    """An evaluation's trace of the SDC; the first `counted` steps count."""
    scenes = file.scenes
    axes = (scenes, steps, 1)
    counts = np.zeros(axes, bool)
    counts[:, :counted] = True
    numbers = np.arange(scenes * steps, dtype=np.float32).reshape(axes)
    return Trace(
        states=np.repeat(numbers[..., None], 5, -1),
        action=np.full(axes, 2, np.int32),
        q_values=np.zeros((*axes, 4), np.float32),
        reward=numbers,
        overlap=counts,
        offroad=np.zeros(axes, bool),
        infeasible=np.zeros(axes, bool),
        displacement=np.zeros(axes, np.float32),
        progress=np.full(axes, np.nan, np.float32),
        wrong_way=np.zeros(axes, bool),
        off_route=np.zeros(axes, bool),
        progression=np.full(axes, np.nan, np.float32),
        counts=counts,
        step=np.tile(np.arange(11, 11 + steps), (scenes, 1)),
    )


def test_rollouts_of_an_evaluation(bank_file: BankFile) -> None:
    trace = trace_of(bank_file, 8, 6)
    evaluation = Evaluation(agent="trained", scenes=[], trace=trace)
    rollouts = list(rollouts_of(evaluation, bank_file))
    assert [title for title, _ in rollouts] == 3 * ["trained"]
    frames = rollouts[1][1].frames
    np.testing.assert_array_equal(frames["step"], np.arange(11, 17))
    np.testing.assert_array_equal(frames["state"][:, 0], 8 + np.arange(6))
    assert (frames["scene"] == 1).all() and frames["overlap"].all()
    assert (frames["controlled"] == bank_file.arrays["sdc"][1]).all()
    silent = dataclasses.replace(evaluation, trace=None)
    with pytest.raises(RecordingError, match="kept no trace"):
        next(rollouts_of(silent, bank_file))


def test_a_bank_scene_is_the_scene(bank_file: BankFile) -> None:
    """The same picture but for the origin, heights and the map's decimation."""
    index = 1
    scene = list(procedural.generate_many(5, 3))[index]
    direct = view_scene_of(scene)
    stored = bank_scenes(bank_file)(index)
    shift = (
        np.asarray(bank_file.origins[index])
        - scene.position[scene.sdc_index, int(np.argmax(scene.valid[scene.sdc_index]))]
    )
    np.testing.assert_array_equal(stored.valid, direct.valid)
    there = stored.position[stored.valid][:, :2] + shift[:2]
    np.testing.assert_allclose(there, direct.position[direct.valid][:, :2], atol=1e-3)
    counts = [len(length_by_kind(view)) for view in (stored, direct)]
    assert counts[0] > 2
    lengths = length_by_kind(direct)
    for kind, length in length_by_kind(stored).items():
        assert length == pytest.approx(lengths[kind], rel=0.02), kind


def length_by_kind(scene: ViewScene) -> dict[RoadKind, float]:
    """Total length of the polylines of every kind, m."""
    lengths: dict[RoadKind, float] = defaultdict(float)
    for kind, points in scene.polylines:
        moves = np.diff(points[:, :2], axis=0)
        lengths[kind] += float(np.linalg.norm(moves, axis=1).sum())
    return {kind: length for kind, length in lengths.items() if length > 0}


def test_segments_are_chained() -> None:
    segments = np.array(
        [
            *([0, 0, 1, 0], [1, 0, 2, 1]),  # one line
            *([5, 5, 6, 6],),  # another
            *([0, 0, 1, 0], [1, 0, 1, 1], [1, 1, 0, 0]),  # a polygon
            *([0, 0, 3, 0], [3, 0, 3, 3], [3, 3, 0, 0]),  # one from the same corner
            *([7, 7, 7, 7],),  # a sign
        ],
        np.float32,
    )
    crosswalk = int(RoadKind.CROSSWALK)
    kinds = np.array([15, 15, 15, *6 * [crosswalk], int(RoadKind.STOP_SIGN)], np.int8)
    lines = chained(segments, kinds)
    assert [(int(kind), len(points)) for kind, points in lines] == [
        (15, 3),
        (15, 2),
        (crosswalk, 3),
        (crosswalk, 3),
        (17, 1),
    ]


def test_paint() -> None:
    line = np.array([[0.0, 0, 0], [20.0, 0, 0]])
    spans = [(part[0, 0], part[-1, 0]) for part in dashes(line)]
    assert spans == [(0, 3), (9, 12), (18, 20)]
    double = line_strips(RoadKind.LINE_SOLID_DOUBLE_YELLOW, line)
    assert [part[0, 1] for part in double] == [-0.15, 0.15]
    bands = stripes(np.array([[0.0, 0, 0], [4, 0, 0], [4, 10, 0], [0, 10, 0]]))
    assert len(bands) == 8
    assert all(abs(band[0, 0] - band[1, 0]) == pytest.approx(4.0) for band in bands)


def test_the_surface_is_as_wide_as_a_lane() -> None:
    line = np.array([[0.0, 0, 0], [10.0, 0, 0], [20.0, 0, 0]])
    vertices, triangles = surface_mesh([line, line])
    assert vertices.shape == (12, 3) and triangles.shape == (8, 3)
    assert np.ptp(vertices[:, 1]) == pytest.approx(3.7)
    a, b, c = vertices[triangles].swapaxes(0, 1)
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert np.abs(areas).sum() == pytest.approx(2 * 20 * 3.7)
