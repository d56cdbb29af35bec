"""What a file is, decided by content; folders, order, and refusals."""

import re
from pathlib import Path

import pytest

from sim.formats import (
    SUPPORTED,
    Format,
    bad_records,
    detect,
    list_files,
    read_outcomes,
    read_scenes,
)
from sim.scene import Scene, SceneError
from sim.tfrecord import frame
from tests import records


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Scenes of every format under misleading names, among other files."""
    (tmp_path / "b").mkdir()
    scenarios = [records.scenario(name=n).SerializeToString() for n in ("s1", "s2")]
    records.write_tfrecord(tmp_path / "b" / "scenarios.json", scenarios)
    features = records.example() | {"scenario/id": b"e1"}
    records.write_tfrecord(tmp_path / "c.bin", [records.encode_example(features)])
    content = records.gpudrive() | {"scenario_id": "g1"}
    records.write_json(tmp_path / "a.tfrecord", content)
    (tmp_path / "README.md").write_text("# Scenes")
    (tmp_path / "config.json").write_text('{"learning_rate": 1}')
    (tmp_path / "old.bank").write_bytes(b"SLIPBANK" + bytes(64))
    (tmp_path / ".hidden").write_text("{")
    return tmp_path


def test_content_decides(folder: Path) -> None:
    assert detect(folder / "b" / "scenarios.json") is Format.WOMD_SCENARIO
    assert detect(folder / "c.bin") is Format.WOMD_EXAMPLE
    assert detect(folder / "a.tfrecord") is Format.GPUDRIVE
    assert detect(folder / "old.bank") is Format.BANK


def test_a_folder_is_read_in_sorted_order(folder: Path) -> None:
    skipped: list[str] = []
    scenes = list(read_scenes([folder], on_skip=skipped.append))
    assert [scene.scenario_id for scene in scenes] == ["g1", "s1", "s2", "e1"]
    assert [Path(line.split(": ")[0]).name for line in skipped] == [
        "README.md",
        "config.json",
        "old.bank",
    ]


def test_each_file_is_read_once(folder: Path) -> None:
    files = list_files([folder / "c.bin", folder, folder / "b"])
    names = [file.name for file in files]
    assert names == ["c.bin", "a.tfrecord", "scenarios.json"]


def test_json_may_start_with_a_mark_or_blanks(tmp_path: Path) -> None:
    path = tmp_path / "scene"
    records.write_json(path, records.gpudrive())
    path.write_bytes(b"\xef\xbb\xbf\n " + path.read_bytes())
    assert [scene.scenario_id for scene in read_scenes([path])] == ["abc"]


def test_a_record_as_long_as_a_brace_is_no_json(tmp_path: Path) -> None:
    path = tmp_path / "scene"
    path.write_bytes(frame(b"x" * ord("{")))
    assert path.read_bytes()[:1] == b"{"
    assert detect(path) is Format.WOMD_SCENARIO


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a", b"", "is empty"),
        ("a.tfrecord", b"", "is empty"),
        ("a.tfrecord", b"12345", "truncated at byte 5"),
        ("a.tfrecord", bytes(40), "CRC mismatch of the record length at byte 0"),
        ("a.json", b"{}", "JSON without objects"),
        ("a.json", b'{"objects": 3}', "not a GPUDrive scene"),
        ("a.json", b'{"objects": [', "broken JSON at line 1 column 14 (byte 13)"),
        ("a.json", b"[1, 2]", f"no supported format; supported are {SUPPORTED}"),
        ("a.png", b"\x89PNG", f"no supported format; supported are {SUPPORTED}"),
        ("a.gz", b"\x1f\x8b\x08", "compressed by gzip; unpack it first"),
        ("a.bank", b"SLIPBANK", "is a bank, converted already"),
        ("a", frame(b"x")[:-1], "truncated at byte 16"),
        ("a", frame(b"x"), "record 0 at byte 0: not a WOMD Scenario"),
    ],
)
def test_a_named_file_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes, problem: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SceneError, match=re.escape(problem)) as caught:
        list(read_scenes([path]))
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert bad_records([path]) == [str(caught.value)]


def test_a_missing_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no such file or folder; check the path"):
        list(read_scenes([tmp_path / "none"]))
    with pytest.raises(SceneError, match="no such file"):
        detect(tmp_path / "none")


def test_a_folder_without_scenes_is_refused(tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("# Nothing")
    with pytest.raises(SceneError, match="no scene in this folder"):
        list(read_scenes([tmp_path]))


def test_damage_in_a_folder_is_reported_and_the_rest_read(folder: Path) -> None:
    path = folder / "b" / "scenarios.json"
    whole = bytearray(path.read_bytes())
    whole[40] ^= 1
    path.write_bytes(whole[:-3])
    (folder / "d.tfrecord").write_bytes(bytes(20))
    outcomes = list(read_outcomes([folder]))
    assert [isinstance(o, Scene) for o in outcomes] == [True, False, False, True, False]
    first, second, third = bad_records([folder])
    assert "CRC mismatch in the record at byte 0" in first
    assert f"truncated at byte {len(whole) - 3}" in second
    assert "CRC mismatch of the record length at byte 0" in third


def test_all_real_scenes_are_found(scenes_data: Path) -> None:
    found = {scene.scenario_id for scene in read_scenes([scenes_data])}
    assert found >= {
        "637f20cafde22ff8",
        "a3bb37c25ce56418",
        "ef3a8f65142f41ac",
        "db4edc9bd0c9d18c",
        "bada21415c031740",
    }
