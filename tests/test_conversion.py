"""Conversion: every record once, nothing lost in silence, and on from where it was."""

import itertools
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import final

import numpy as np
import pytest

from launch.main import main
from sim.bank import open_bank, verify
from sim.bank_writer import write_bank
from sim.conversion import (
    Conversion,
    Outcome,
    converted,
    work_folder,
    working_in,
)
from sim.formats import list_files, read_scenes
from sim.parts import Part
from sim.places import AbstractPlace, places_in, procedural_places
from sim.scene import Scene, SceneError
from tests import records, records_argoverse2

ROOT = Path(__file__).resolve().parent.parent
COMMAND = (sys.executable, "-m", "launch", "scenes", "convert")


def shard(path: Path, *names: str, objects: int = 2) -> list[int]:
    """A TFRecord of scenes with these ids; the offsets of its records."""
    made = [records.scenario(name=name, objects=objects) for name in names]
    return records.write_tfrecord(path, [m.SerializeToString() for m in made])


def damage(path: Path, offset: int) -> None:
    """Flips a bit of the payload that begins about there."""
    content = bytearray(path.read_bytes())
    content[offset + 40] ^= 1
    path.write_bytes(bytes(content))


def convert(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict]:
    """Runs the command in this process: exit code and summary."""
    capsys.readouterr()
    code = main(["scenes", "convert", *map(str, words), "--json", "--workers", "1"])
    out = capsys.readouterr().out
    return code, json.loads(out) if out else {}


def outcomes(
    paths: Sequence[Path], folder: Path, *, slots: int = 0, most: int = 10**6
) -> list[Outcome]:
    """What becomes of the files' records, given up after so many of them."""
    folder.mkdir(exist_ok=True)
    conversion = Conversion(folder=folder, slots=slots)
    every = converted(places_in(list_files(paths)), conversion)
    return list(itertools.islice(every, most))


def ids(made: Sequence[Outcome]) -> list[str]:
    """The scenes' ids."""
    return [o.result.scenario_id for o in made if isinstance(o.result, Part)]


def test_a_folder_of_every_format(tmp_path: Path, capsys) -> None:
    """In sorted order; what is no scene is passed over with a word."""
    folder = tmp_path / "mixed"
    folder.mkdir()
    shard(folder / "a.tfrecord", "one", "two")
    example = records.example() | {"scenario/id": b"three"}
    records.write_tfrecord(folder / "b.tfrecord", [records.encode_example(example)])
    records.write_json(folder / "c.json", records.gpudrive() | {"scenario_id": "four"})
    records_argoverse2.write(folder)
    (folder / "notes.txt").write_text("not a scene")
    out = folder / "all.bank"
    assert main(["scenes", "convert", str(folder), "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert "notes.txt" in captured.err
    assert captured.out.startswith(f"{out}: 5 scenes")
    bank = open_bank(out)
    assert bank.scenario_ids[:4] == ("one", "two", "three", "four")
    assert not work_folder(out).exists()
    direct = tmp_path / "direct.bank"
    write_bank(read_scenes([folder]), direct)
    assert open_bank(direct).content_hash == bank.content_hash
    # Once more, beside the bank that is there now: it is not taken for a scene.
    assert main(["scenes", "convert", str(folder), "--out", str(out)]) == 0
    assert open_bank(out).content_hash == bank.content_hash


def test_bad_records_are_told_and_passed_over(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "a.tfrecord", tmp_path / "a.bank"
    offsets = shard(path, "one", "two", "three", "four")
    damage(path, offsets[1])
    words = ["scenes", "convert", str(path), "--out", str(out)]
    assert main(words) == 1
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert f"{path}: CRC mismatch in the record at byte {offsets[1]}" in captured.err
    assert "3 scenes" in captured.out and "; 1 record could not be read" in captured.out
    assert open_bank(out).scenario_ids == ("one", "three", "four")
    verify(open_bank(out))


def test_a_cut_file_costs_its_end(tmp_path: Path, capsys) -> None:
    cut, whole = tmp_path / "a.tfrecord", tmp_path / "b.tfrecord"
    offsets = shard(cut, "one", "two", "three")
    cut.write_bytes(cut.read_bytes()[: offsets[2] + 20])
    shard(whole, "four")
    code, summary = convert(capsys, cut, whole, "--out", tmp_path / "a.bank")
    assert code == 1
    assert (summary["scenes"], summary["bad"]) == (3, 1)


def test_nothing_but_bad_records_is_an_error(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "a.tfrecord", tmp_path / "a.bank"
    offsets = shard(path, "one", "two")
    for offset in offsets[:2]:
        damage(path, offset)
    assert main(["scenes", "convert", str(path), "--out", str(out)]) == 2
    errors = capsys.readouterr().err
    assert all(f"byte {offset}" in errors for offset in offsets[:2])
    assert "Traceback" not in errors
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tfrecord"]


def test_the_same_scene_is_taken_once(tmp_path: Path, capsys) -> None:
    first, second, out = (tmp_path / name for name in ("a.rec", "b.rec", "a.bank"))
    shard(first, "one", "two")
    shard(second, "two", "three")
    words = ["scenes", "convert", str(first), str(second), str(first)]
    assert main([*words, "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert f"{second}: record 0" in captured.err and f"{first}: record 1" in (
        captured.err
    )
    assert "; 1 scene repeated" in captured.out
    assert open_bank(out).scenario_ids == ("one", "two", "three")


def test_another_step_length_has_a_bank_of_its_own(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "a.tfrecord", tmp_path / "a.bank"
    slow = records.scenario(name="slow")
    slow.timestamps_seconds[:] = [0.2 * step for step in range(12)]
    made = [records.scenario(name="one"), slow, records.scenario(name="two")]
    records.write_tfrecord(path, [m.SerializeToString() for m in made])
    assert main(["scenes", "convert", str(path), "--out", str(out)]) == 1
    captured = capsys.readouterr()
    assert "record 1" in captured.err and "--dt 0.2" in captured.err
    assert open_bank(out).scenario_ids == ("one", "two")
    code, summary = convert(capsys, path, "--out", out, "--dt", 0.2)
    assert (code, summary["scenes"], summary["other_dt"]) == (1, 1, 2)
    assert open_bank(out).dt == 0.2


def test_objects_without_a_slot_are_counted(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "a.tfrecord", tmp_path / "a.bank"
    shard(path, "one", "two", objects=5)
    code, summary = convert(capsys, path, "--out", out, "--slots", 3)
    assert code == 0
    assert (summary["cut"], summary["dropped"]) == (2, 4)
    bank = open_bank(out)
    assert bank.arrays["objects"].tolist() == [3, 3]
    assert bank.header.dropped == (2, 2)
    # The track to predict is row 0, the SDC the last and its neighbour row 3.
    assert bank.arrays["sdc"].tolist() == [2, 2]
    assert main(["scenes", "info", str(out), "--json", "--verify"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["dropped"] == 4 and content["verified"]
    assert [scene["dropped"] for scene in content["scenes"]] == [2, 2]


def test_what_was_converted_is_found_again(tmp_path: Path) -> None:
    first, second, work = tmp_path / "a.rec", tmp_path / "b.rec", tmp_path / "work"
    offsets = shard(first, "one", "two", "three")
    damage(first, offsets[1])
    shard(second, "four", "five")
    assert len(outcomes([first, second], work, most=4)) == 4
    again = outcomes([first, second], work)
    assert [outcome.found for outcome in again] == [True] * 4 + [False]
    assert ids(again) == ["one", "three", "four", "five"]
    assert isinstance(again[1].result, SceneError)
    # Another option, and another file under the same name, are another conversion.
    assert not any(o.found for o in outcomes([first, second], work, slots=1))
    shard(second, "six", "five")
    os.utime(second, ns=(0, 0))
    changed = outcomes([first, second], work)
    assert [outcome.found for outcome in changed] == [True] * 3 + [False] * 2
    assert ids(changed) == ["one", "three", "six", "five"]


def test_a_damaged_work_file_is_made_anew(tmp_path: Path) -> None:
    path, work = tmp_path / "a.rec", tmp_path / "work"
    shard(path, "one", "two", "three", "four")
    assert len(outcomes([path], work)) == 4
    files = sorted(work.iterdir())
    files[0].write_bytes(files[0].read_bytes()[:-9])
    damage(files[1], files[1].stat().st_size // 2)
    files[2].write_bytes(b"")
    again = outcomes([path], work)
    assert [outcome.found for outcome in again].count(True) == 1
    assert all(isinstance(o.result, Part) and o.result.load() for o in again)


def test_map_features_left_out_are_counted(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "a.rec", tmp_path / "a.bank"
    made = records.scenario(name="one")
    made.map_features.add(id=90)  # of a kind that is not known
    made.map_features.add(id=91).road_line.type = 8  # without points
    records.write_tfrecord(path, [made.SerializeToString()])
    code, summary = convert(capsys, path, "--out", out)
    assert (code, summary["left_out"]) == (0, 2)
    assert open_bank(out).header.left_out == (2,)


def test_a_place_is_read_where_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    offsets = shard(path, "one", "two", "three")
    places = list(places_in([path]))
    assert all(isinstance(place, AbstractPlace) for place in places)
    read = [p.read() for p in reversed(places) if isinstance(p, AbstractPlace)]
    assert [scene.scenario_id for scene in read] == ["three", "two", "one"]
    assert read[0].source == f"{path}: record 2 at byte {offsets[2]}"
    assert len({p.key for p in places if isinstance(p, AbstractPlace)}) == 3
    drawn = next(procedural_places(3, 1))
    assert isinstance(drawn, AbstractPlace)
    assert np.isfinite(drawn.read().position).all()


def test_workers_do_without_jax() -> None:
    """It would cost each a second and 200 MB."""
    code = "import sys, sim.conversion; sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_two_do_not_convert_into_one_bank(tmp_path: Path) -> None:
    folder = work_folder(tmp_path / "a.bank")
    with working_in(folder):
        with pytest.raises(SceneError, match="another process converts"):
            with working_in(folder):
                pass
        assert folder.exists()
    assert not folder.exists()


def test_what_is_no_bank_is_not_overwritten(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "a.rec", tmp_path / "thesis.tex"
    shard(path, "one")
    out.write_text("precious")
    assert main(["scenes", "convert", str(path), "--out", str(out)]) == 2
    assert "exists and is no bank" in capsys.readouterr().err
    assert out.read_text() == "precious"


def test_a_full_disk_is_one_line_and_goes_on(tmp_path: Path, capsys) -> None:
    """No file may be larger than the work files, which the bank is."""
    path, out = tmp_path / "a.rec", tmp_path / "a.bank"
    shard(path, "one", "two", "three")
    limit = (60_000, 60_000)
    ended = subprocess.run(
        [*COMMAND, str(path), "--out", str(out)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
    )
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1 and "3 of 3 records" in ended.stderr
    assert not out.exists()
    code, summary = convert(capsys, path, "--out", out)
    assert (code, summary["scenes"], summary["resumed"]) == (0, 3, 3)
    verify(open_bank(out))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bank", "a.rec"]


def children(process: int) -> list[int]:
    """The processes that it has started."""
    listed = Path(f"/proc/{process}/task/{process}/children").read_text()
    return [int(child) for child in listed.split()]


def begun(path: Path, out: Path) -> subprocess.Popen[str]:
    """A conversion in two processes that has made a work file."""
    process = subprocess.Popen(
        [*COMMAND, str(path), "--out", str(out), "--workers", "2"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell's background job has Ctrl-C ignored, and its children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while not out.exists() and not any(work_folder(out).glob(".*")):
        assert process.poll() is None, process.communicate()
        os.sched_yield()
    return process


def test_a_killed_conversion_goes_on(tmp_path: Path, capsys) -> None:
    """Killed, its workers end too; the next one makes the bank that it would have."""
    path, out = tmp_path / "a.rec", tmp_path / "a.bank"
    shard(path, *(f"scene {number}" for number in range(60)))
    process = begun(path, out)
    workers = children(process.pid)
    process.kill()
    process.communicate()
    assert not out.exists()
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        os.sched_yield()
    made = sum(len(p.name) == 41 for p in work_folder(out).iterdir())
    code, summary = convert(capsys, path, "--out", out)
    assert (code, summary["scenes"]) == (0, 60)
    assert 0 < made == summary["resumed"] < 60
    assert not work_folder(out).exists()
    direct = tmp_path / "direct.bank"
    write_bank(read_scenes([path]), direct)
    assert open_bank(direct).content_hash == open_bank(out).content_hash


@pytest.mark.slow
def test_ctrl_c_ends_all_and_says_how_to_go_on(tmp_path: Path, capsys) -> None:
    """The terminal sends it to the whole group; nobody prints a traceback."""
    path, out = tmp_path / "a.rec", tmp_path / "a.bank"
    shard(path, *(f"scene {number}" for number in range(60)))
    process = begun(path, out)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate()
    assert process.returncode == 130
    assert errors.endswith("interrupted\n") and errors.count("\n") <= 2
    code, summary = convert(capsys, path, "--out", out)
    assert (code, summary["scenes"]) == (0, 60)
    assert summary["resumed"] > 0


@final
class Poison(AbstractPlace):
    """Kills who reads it, as the kernel does where memory runs out."""

    key = name = "poison"

    def read(self) -> Scene:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError


@pytest.mark.slow
def test_a_scene_that_kills_its_process_is_told(tmp_path: Path) -> None:
    """The others are converted, in order."""
    path, work = tmp_path / "a.rec", tmp_path / "work"
    shard(path, *(f"scene {number}" for number in range(20)))
    work.mkdir()
    places = list(places_in([path]))
    places.insert(6, Poison())
    conversion = Conversion(folder=work, workers=2)
    made = list(converted(places, conversion))
    assert ids(made) == [f"scene {number}" for number in range(20)]
    assert "the process that converted it was killed" in str(made[6].result)
    many = [*places, *(Poison() for _ in range(3))]
    with pytest.raises(SceneError, match="poison: the process"):
        list(converted(many, conversion))
