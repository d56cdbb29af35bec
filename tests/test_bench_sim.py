"""`bench sim`: its oracle, its timing, its tables and the command itself."""

import dataclasses
import itertools
import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from launch import (
    bench_child,
    bench_figures,
    bench_oracle,
    bench_programs,
    bench_steps,
)
from launch.bench_bicycle import bicycle, errors, pairs_of
from launch.bench_paper import TABLE_6, paper_row
from launch.bench_scenes import (
    PROCEDURAL,
    padded,
    road_points,
    sized,
    source_of,
    tiled,
)
from launch.bench_sim import ALL
from launch.bench_table6 import (
    YARDSTICK,
    Work,
    agreement,
    beside_oracle,
    configuration,
    table6,
)
from launch.bench_targets import targets
from launch.bench_timing import (
    matrix_product_gflops,
    side_by_side,
    timed,
    yardsticks,
)
from launch.main import main
from sim import episodes
from sim.procedural import generate
from sim.scene import Scene
from tests import scenes
from tests.oracle import corners_offroad


@pytest.fixture(scope="module")
def scene() -> Scene:
    return generate(4)


@pytest.fixture(scope="module")
def work(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Work:
    """The smallest sizes on a procedural scene."""
    return Work(
        scene=scene,
        folder=tmp_path_factory.mktemp("banks"),
        objects=(8,),
        batches=(1,),
        steps=((2, 3),),
        environments=(2,),
        scale_objects=(8,),
        seconds=0.01,
        say=lambda _: None,
    )


@pytest.fixture(scope="module")
def own(work: Work) -> dict[str, bench_programs.Program]:
    """Our programs, compiled once for all tests."""
    file = work.sized(8).file
    return bench_programs.ours(file.bank, 1, configuration(file.dt))


@pytest.fixture(scope="module")
def rows(work: Work, own: dict) -> dict[str, list[dict]]:
    """Results of the sections on the scene."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_programs, "ours", lambda *_: own)
        return {
            "table6": list(table6(work)),
            "oracle": [beside_oracle(work, 8, [YARDSTICK])],
            "bicycle": list(bicycle([work.scene])),
        }


@pytest.fixture(scope="module")
def oracle_row(rows: dict[str, list[dict]]) -> dict:
    return rows["oracle"][0]


@pytest.fixture(scope="module")
def table6_row(rows: dict[str, list[dict]]) -> dict:
    return rows["table6"][0]


def test_the_oracle_judges_as_the_simulator_does(oracle_row: dict) -> None:
    agreed = oracle_row["agreement"]
    assert agreed["pairs"] > 500
    for name in ("overlap", "offroad", "kinematic_infeasibility"):
        assert agreed[name] == 1.0, name
    assert agreed["log_divergence_largest_difference_m"] < 1e-5


def test_the_oracle_is_beside_ours(work: Work, oracle_row: dict) -> None:
    variant = oracle_row["oracle"][YARDSTICK]
    assert variant["points"] == road_points(work.scene)
    for program in ("metrics", "rollout"):
        found = variant[program]
        ratio = found["oracle"]["median_ms"] / found["ours"]["median_ms"]
        assert found["ratio"] == pytest.approx(ratio)
        assert 0 < found["ours"]["least_ms"] <= found["ours"]["median_ms"]


def dense(*points: tuple[float, float]) -> np.ndarray:
    """A line through points with a vertex every 0.5 m and at each of them."""
    parts = [
        np.linspace(a, b, int(np.hypot(*np.subtract(b, a)) / 0.5), endpoint=False)
        for a, b in itertools.pairwise(points)
    ]
    return np.concatenate([*parts, np.array([points[-1]])])


@pytest.mark.parametrize("rows", [False, True])
def test_the_oracle_takes_the_nearest_of_all_edge_points(rows: bool) -> None:
    """Held to the tests' own oracle, which searches segments in float64."""
    bend = dense((-30.0, -5.0), (10.0, -5.0), (10.0, 25.0))
    line = dense((0.0, 25.0), (0.0, 5.0), (-30.0, 5.0))
    roads = [scenes.edge(*bend), scenes.edge(*line)]
    road = scenes.scene_of([scenes.driver()], roads=roads)
    points = bench_oracle.road_points(road, (0.0, 0.0, 0.0))
    rng = np.random.default_rng(1)
    at = rng.uniform(-25, 20, (400, 2)).astype(np.float32)
    height = np.zeros(400, np.float32)
    on = jax.vmap(lambda corner, z: bench_oracle.on_road(points, corner, z, rows=rows))(
        jnp.asarray(at), jnp.asarray(height)
    )
    edges = [line.points for line in roads]
    expected = corners_offroad(at.astype(float), height.astype(float), edges)
    assert 0.1 < expected.mean() < 0.9
    np.testing.assert_array_equal(~np.asarray(on), expected)


def test_the_oracle_counts_heights_twice() -> None:
    """A bridge's edge 3 m above, 4 m aside, does not hide this road's, 5 m aside."""
    above = scenes.edge((50.0, 4.0, 3.0), (-50.0, 4.0, 3.0))
    below = scenes.edge((-50.0, -5.0), (50.0, -5.0))
    road = scenes.scene_of([scenes.driver()], roads=[above, below])
    points = bench_oracle.road_points(road, (0.0, 0.0, 0.0))
    origin = jnp.zeros(2)
    for z, nearest in ((0.0, -5.0), (3.0, 4.0)):
        index = bench_oracle.nearest_point(
            points, origin.at[0].set(50.0), jnp.float32(z), rows=False
        )
        assert float(points.y[index]) == nearest


def test_a_map_without_edges_is_all_road() -> None:
    road = scenes.scene_of([scenes.driver()], roads=[])
    points = bench_oracle.road_points(road, (0.0, 0.0, 0.0))
    zero = jnp.zeros(())
    assert bool(bench_oracle.on_road(points, jnp.zeros(2), zero, rows=False))


def test_agreement_counts_only_what_was_recorded() -> None:
    no, yes = np.zeros((1, 4), bool), np.ones((1, 4), bool)
    valid = np.array([[True, True, True, False]])
    zero = np.zeros((1, 4), np.float32)
    one = bench_programs.Step(zero, no, no, zero, no, valid)
    other = one._replace(overlap=np.array([[True, False, False, True]]), offroad=~yes)
    found = agreement(one, other)
    assert found["pairs"] == 3
    assert found["overlap"] == pytest.approx(2 / 3)
    assert found["offroad"] == 1.0


def test_table_6_stands_beside_the_papers(table6_row: dict) -> None:
    assert table6_row["paper"]["metrics"] == 0.773
    assert set(table6_row["programs"]) == {"reset", "transition", "metrics", "rollout"}
    memory = [f["peak_bytes"] for f in table6_row["programs"].values()]
    assert table6_row["peak_memory_bytes"] == max(memory) > 10_000
    assert min(f["median_ms"] for f in table6_row["programs"].values()) > 0


def test_the_papers_table_is_whole() -> None:
    sizes = {(row.device, row.batch, row.objects) for row in TABLE_6}
    assert len(sizes) == len(TABLE_6) == 2 * 2 * 5
    found = paper_row("cpu", 16, 128)
    assert found is not None and found.memory == 125.151
    assert paper_row("cpu", 1, 256) is None


def test_a_rollout_drives_the_log(own: dict) -> None:
    """The expert of the procedural log neither fails nor strays."""
    result = jax.device_get(own["rollout"].call())
    assert result.reward.shape == (80, 8)
    assert result.valid.all()
    assert not result.overlap.any() and not result.offroad.any()
    assert result.log_divergence.max() < 1.0


def test_slots_without_an_object_are_never_valid(scene: Scene, tmp_path: Path) -> None:
    more = scene.objects + 5
    assert not padded(scene, more).valid[scene.objects :].any()
    copies = tiled(scene, more)
    np.testing.assert_array_equal(copies.position[scene.objects], scene.position[0])
    assert copies.valid[scene.objects :].any()
    assert len(set(copies.object_ids.tolist())) == more
    for slots in (4, more):
        found = sized(scene, slots, tmp_path)
        assert found.file.arrays["log"].shape[2] == slots
        assert found.objects == min(slots, scene.objects)


def test_a_timing_is_of_one_call() -> None:
    calls = []
    found = timed(lambda: calls.append(None), seconds=0.01)
    assert 0 < found.least_ms <= found.median_ms < 1.0
    assert found.calls <= len(calls)
    ours, theirs = side_by_side(
        lambda: calls.append(None), lambda: sum(range(20_000)), seconds=0.01
    )
    assert theirs.least_ms > ours.least_ms
    assert matrix_product_gflops(seconds=0.01, size=64) > 0.001


def test_one_step_errors_are_those_of_the_model() -> None:
    """Straight drives are inverted exactly; in a turn the heading lags the path."""
    straight = scenes.scene_of([scenes.driver(yaw=0.7)])
    pairs = pairs_of(straight)
    assert len(pairs) == scenes.STEPS - 1
    assert errors(pairs, 0.1)["bicycle"].max() < 1e-5
    aside = pairs.copy()
    aside[:, 1, :2] += 0.2
    found = errors(aside, 0.1)
    np.testing.assert_allclose(found["bicycle"], np.hypot(0.2, 0.2), atol=1e-4)
    assert found["delta"].max() < 1e-5


def test_standing_vehicles_and_people_do_not_count() -> None:
    scene = scenes.scene_of([scenes.driver(speed=0.3), scenes.driver()])
    scene.object_types[1] = 2
    assert len(pairs_of(scene)) == 0


def image_size(data: bytes) -> tuple[int, int]:
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    return struct.unpack(">II", data[16:24])


def test_the_command_prints_and_writes(
    rows: dict[str, list[dict]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sections = {**rows, "yardsticks": [yardsticks(seconds=0.001)]}
    asked = []

    def run(section: str, request: dict, *, one_core: bool) -> Iterator[dict]:
        asked.append((section, one_core))
        return iter(json.loads(json.dumps(sections[section])))

    monkeypatch.setattr(bench_child, "run", run)
    words = ["bench", "sim", "--scenes", PROCEDURAL, "--plot", str(tmp_path / "plots")]
    words += ["--sections", "table6", "oracle", "bicycle"]
    assert main([*words, "--json", str(tmp_path / "sim.json")]) == 0
    expected = [("yardsticks", True), ("table6", True), ("oracle", True)]
    assert asked == [*expected, ("bicycle", False)]
    shown = capsys.readouterr().out
    assert "procedural scene" in shown and "road points" in shown
    for word in ("GFLOP/s", "Table 6", "oracle / ours", "Bicycle", "Targets", "[ms]"):
        assert word in shown
    report = json.loads((tmp_path / "sim.json").read_text())
    assert report["format"] == 1
    assert report["sections"] == json.loads(json.dumps(rows))
    assert report["yardsticks"]["matrix_product_gflops"] > 0.1
    assert report["scene"]["road_points"] > report["scene"]["road_edge_points"] > 0
    assert {row["target"] for row in report["targets"]} >= {"Reset, 8 [ms]"}
    names = {path.name for path in (tmp_path / "plots").iterdir()}
    figures = ("figure4", "figure5", "oracle")
    assert names == {f"{name}.{kind}" for name in figures for kind in ("png", "svg")}
    assert main([*words[:4], "--sections", "bicycle", "--json", "-"]) == 0
    assert set(json.loads(capsys.readouterr().out)["sections"]) == {"bicycle"}


def test_a_section_is_measured_in_a_process_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = dataclasses.asdict(source_of((PROCEDURAL,)))
    found = list(bench_child.run("bicycle", {"source": source}, one_core=True))
    assert found[-1]["scene"] == "all" and found[-1]["bicycle"]["p99_m"] < 0.1
    monkeypatch.setattr(bench_child.sys, "executable", "/bin/false")
    with pytest.raises(RuntimeError, match="section bicycle"):
        list(bench_child.run("bicycle", {}))


@pytest.mark.slow
def test_every_section_is_measured_and_drawn(tmp_path: Path) -> None:
    words = ["bench", "sim", "--quick", "--scenes", PROCEDURAL]
    words += ["--json", str(tmp_path / "sim.json"), "--plot", str(tmp_path / "plots")]
    assert main(words) == 0
    sections = json.loads((tmp_path / "sim.json").read_text())["sections"]
    assert set(sections) == set(ALL)
    axes = [row["axis"] for row in sections["scale"]]
    assert axes == ["environments", "environments", "objects", "objects"]
    assert [row["scenes"] for row in sections["banks"]] == [1, 2]
    for row in sections["banks"]:
        assert 0 < row["open_ms"] < 1000 and row["random_reset_us"] > 0
        assert row["loaded_bytes"] < row["file_bytes"]
    drawn = {path.stem for path in (tmp_path / "plots").glob("*.png")}
    assert drawn == {"figure4", "figure5", "oracle", "scale", "banks"}
    for path in (tmp_path / "plots").glob("*.png"):
        assert min(image_size(path.read_bytes())) > 600


@pytest.mark.slow
def test_whole_steps_go_on_past_the_end_of_episodes(work: Work) -> None:
    file = work.sized(8).file
    config = configuration(file.dt)
    batch = bench_steps.running(file.bank, 3, episodes.NearestToSdc(2), config)
    state, _, seen = batch.step()
    assert seen.road.shape[:3] == (3, 2, 64)
    assert bench_steps.bytes_of(seen) == 6 * batch.observation_bytes
    steps = {int(batch.step()[0].step[0]) for _ in range(100)}
    assert int(file.arrays["current_step"][0]) in steps  # it began again
    held = bench_steps.state_bytes(file.bank, episodes.NearestToSdc(2), config)
    assert bench_steps.bytes_of(state) == 3 * held
    assert bench_steps.recorded_share(file, 2) == 1.0


def test_figures_show_ours_and_the_papers(table6_row: dict) -> None:
    rows = [table6_row, {**table6_row, "slots": 16}]
    drawn = bench_figures.figures({"sections": {"table6": rows}})
    for name in ("figure4", "figure5"):
        width, height = image_size(drawn[f"{name}.png"])
        assert width > 800 and height > 600
        assert len(set(drawn[f"{name}.png"])) == 256  # not blank
        text = drawn[f"{name}.svg"].decode()
        assert len(re.findall("Slipstream|EPYC 7B12", text)) >= 2


def test_targets_follow_from_what_was_measured(oracle_row: dict) -> None:
    assert targets({"oracle": [oracle_row]}) == []
    large = {**oracle_row, "slots": 128}
    rates = {"controlled": 1, "environments": 512, "slots": 128}
    rates["agent_steps_per_s"] = 10.0
    assert [row["met"] for row in targets({"steps": [rates]})] == [False]
    found = targets({"oracle": [large]})
    assert [row["at least"] for row in found] == [150, 200]
    assert all(row["met"] == (row["measured"] >= row["at least"]) for row in found)


def test_what_cannot_be_written_is_refused_before_measuring(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.touch()
    for words in (["--json", str(file / "x")], ["--plot", str(file)]):
        assert main(["bench", "sim", "--scenes", PROCEDURAL, *words]) == 2
        shown = capsys.readouterr()
        assert "is not a folder; choose another path" in shown.err
        assert shown.err.count("\n") == 1 and not shown.out
    assert main(["bench", "sim", "--json", str(tmp_path)]) == 2
    assert "is a folder; name a file" in capsys.readouterr().err


def test_a_bank_has_no_points_for_the_oracle(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = sized(scene, 8, tmp_path).file.path
    assert main(["bench", "sim", "--scenes", str(path)]) == 2
    assert "is a bank, which holds no road points" in capsys.readouterr().err


def test_without_data_the_scene_is_procedural(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SLIPSTREAM_DATA", raising=False)
    assert source_of(()).kind == "procedural"
    monkeypatch.setenv("SLIPSTREAM_DATA", "/nowhere/at/all")
    assert source_of((PROCEDURAL,)).kind == "procedural"


def test_of_the_data_the_flat_example_is_measured(scenes_data: Path) -> None:
    source = source_of(())
    assert source.kind == "recorded"
    assert bench_oracle.road_points(source.scene(), (0.0, 0.0, 0.0)).x.shape == (20000,)
    assert len(source.scenes()) >= 5
