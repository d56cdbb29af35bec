"""The bank's file: whole or refused, mapped and not read."""

import dataclasses
import json
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest

from sim import bank as bank_module
from sim import convert, layout
from sim.bank import (
    ALIGNMENT,
    MAGIC,
    Bank,
    BankError,
    BankFile,
    is_bank,
    open_bank,
    verify,
)
from sim.bank_writer import write_bank
from sim.procedural import generate_many
from sim.scene import Scene
from tests import scenes

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def made() -> tuple[Scene, ...]:
    return (
        *generate_many(7, 2),
        scenes.scene_of([scenes.driver(), scenes.driver(y=3)], name="short"),
    )


@pytest.fixture(scope="module")
def file(made, tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    return scenes.bank_of(made, tmp_path_factory.mktemp("bank"))


def data_start(path: Path) -> int:
    """The byte at which the arrays begin."""
    length = int.from_bytes(path.read_bytes()[8:16], "little")
    return -(-(16 + length) // ALIGNMENT) * ALIGNMENT


def copy_with(folder: Path, content: bytes) -> Path:
    """A file with this content."""
    path = folder / "copy.bank"
    path.write_bytes(content)
    return path


def with_header(file: BankFile, folder: Path, **changes: object) -> Path:
    """A copy with another header; None removes a field."""
    content = file.path.read_bytes()
    length = int.from_bytes(content[8:16], "little")
    header = json.loads(content[16 : 16 + length]) | changes
    header = {name: value for name, value in header.items() if value is not None}
    text = json.dumps(header, separators=(",", ":")).encode()
    text = text.ljust(length)  # the data stay where they were
    assert len(text) == length
    head = MAGIC + length.to_bytes(8, "little")
    return copy_with(folder, head + text + content[16 + length :])


def joined(parts: list[convert.Converted], name: str) -> np.ndarray:
    """Oracle: an array of the bank from those of its scenes, by `sim.layout`."""
    arrays = [part[name] for part in parts]
    if name in layout.SHIFTED:
        first = np.cumsum([0] + [len(part[layout.SHIFTED[name]]) for part in parts])
        arrays = [a + n * (a >= 0) for a, n in zip(arrays, first, strict=False)]
    if name in layout.TABLES:
        return np.concatenate(arrays)
    widest = np.maximum(np.max([a.shape for a in arrays], 0), 1)
    objects = max(len(part["object_type"]) for part in parts)
    fill = objects if name == "tracks" else layout.PADDED.get(name, 0)
    whole = np.full((len(arrays), *widest), fill)
    whole = whole.astype(arrays[0].dtype)
    for row, array in enumerate(arrays):
        whole[(row, *map(slice, array.shape))] = array
    return whole


def test_what_was_written_is_read(made, file: BankFile) -> None:
    assert set(file.arrays) == set(Bank._fields)
    parts = [convert.convert(scene) for scene in made]
    for name in parts[0]:
        np.testing.assert_array_equal(file.arrays[name], joined(parts, name), name)
    for name, table in layout.STARTS.items():
        ends = np.cumsum([len(part[table]) for part in parts])
        np.testing.assert_array_equal(file.arrays[name], [0, *ends[:-1]], name)
    assert len(file.arrays["candidates"]) == file.arrays["list_count"].max()
    for name, array in file.bank._asdict().items():
        np.testing.assert_array_equal(np.asarray(array), file.arrays[name])
    assert file.scenario_ids == tuple(scene.scenario_id for scene in made)
    assert file.scenes == 3
    assert file.dt == 0.1
    verify(file)
    assert is_bank(file.path)


def test_the_log_is_the_scenes_less_its_origin(made, file: BankFile) -> None:
    for index, scene in enumerate(made):
        log = file.arrays["log"][index].transpose(1, 0, 2)
        log = log[: scene.objects, : scene.steps].astype(np.float64)
        np.testing.assert_allclose(
            (log[..., :3] + np.array(file.origins[index]))[scene.valid],
            scene.position[scene.valid],
            atol=1e-4,
        )
        np.testing.assert_allclose(
            log[..., 3][scene.valid], scene.yaw[scene.valid], atol=1e-6
        )
        recorded = file.arrays["log_valid"][index].T
        np.testing.assert_array_equal(
            recorded[: scene.objects, : scene.steps], scene.valid
        )
        assert not recorded[scene.objects :].any()
        assert not recorded[:, scene.steps :].any()
        assert file.arrays["objects"][index] == scene.objects
        assert file.arrays["steps"][index] == scene.steps


def test_a_scene_is_the_same_alone_and_among_others(made, tmp_path: Path) -> None:
    """Tables of different lengths stand one behind the other."""
    alone = scenes.bank_of(made[:1], tmp_path, "alone")
    second = scenes.bank_of([made[2], made[0]], tmp_path, "second")
    steps, objects = made[0].steps, made[0].objects
    np.testing.assert_array_equal(
        second.arrays["log"][1, :steps, :objects], alone.arrays["log"][0]
    )
    np.testing.assert_array_equal(
        second.arrays["route"][1, :objects], alone.arrays["route"][0]
    )


def test_the_hash_is_of_the_content(made, file: BankFile, tmp_path: Path) -> None:
    again = scenes.bank_of(made, tmp_path, "again")
    assert again.content_hash == file.content_hash
    other = scenes.bank_of(made[::-1], tmp_path, "other")
    assert other.content_hash != file.content_hash
    position = made[2].position.copy()
    position[1, 3, 0] += 0.01
    nearly = dataclasses.replace(made[2], position=position)
    changed = scenes.bank_of([*made[:2], nearly], tmp_path, "changed")
    assert changed.content_hash != file.content_hash


@pytest.mark.parametrize("where", ["empty", "magic", "length", "header", "data", "end"])
def test_a_truncated_bank_is_refused(file: BankFile, tmp_path: Path, where) -> None:
    content = file.path.read_bytes()
    start = data_start(file.path)
    length, message = {
        "empty": (0, "the file is empty"),
        "magic": (5, "is not a bank"),
        "length": (12, "truncated at byte 12"),
        "header": (100, "truncated at byte 100"),
        "data": (start + 10, "is truncated"),
        "end": (len(content) - 1, "is truncated"),
    }[where]
    path = copy_with(tmp_path, content[:length])
    with pytest.raises(BankError, match=message) as refusal:
        open_bank(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_bytes_behind_the_end_are_refused(file, tmp_path: Path) -> None:
    path = copy_with(tmp_path, file.path.read_bytes() + b"\0")
    with pytest.raises(BankError, match="convert its scenes again"):
        open_bank(path)


def test_another_version_is_refused(file: BankFile, tmp_path: Path) -> None:
    path = with_header(file, tmp_path, version=9, origins=None)
    message = rf"has version 9, this program reads {bank_module.VERSION}"
    with pytest.raises(BankError, match=message):
        open_bank(path)


@pytest.mark.parametrize("missing", ["version", "sha256", "bytes", "arrays", "dt"])
def test_a_header_without_a_field_is_refused(
    file: BankFile, tmp_path: Path, missing: str
) -> None:
    with pytest.raises(BankError, match="broken header"):
        open_bank(with_header(file, tmp_path, **{missing: None}))


def test_a_header_that_lacks_an_array_is_refused(file, tmp_path: Path) -> None:
    with pytest.raises(BankError, match="lacks arrays"):
        open_bank(with_header(file, tmp_path, arrays=[]))


@pytest.mark.parametrize(
    "entry",
    [
        {"dtype": "<f4", "shape": [10**9], "offset": 0},
        {"dtype": "<f4", "shape": [1], "offset": -(10**6)},
        {"dtype": "|O", "shape": [1], "offset": 0},
        {"dtype": "nonsense", "shape": [1], "offset": 0},
        {"shape": [1], "offset": 0},
    ],
)
def test_an_array_beyond_the_file_is_refused(file, tmp_path: Path, entry) -> None:
    path = with_header(file, tmp_path, arrays=[{"name": "log", **entry}])
    with pytest.raises(BankError, match="broken header"):
        open_bank(path)


def test_damage_to_any_part_is_refused_or_found(file, tmp_path: Path) -> None:
    """Every 40th byte of the header, and a bit in every array."""
    content = bytearray(file.path.read_bytes())
    start = data_start(file.path)
    length = int.from_bytes(content[8:16], "little")
    header = json.loads(content[16 : 16 + length])
    places = [*range(0, 16 + length, 40)]
    places += [
        start + entry["offset"] + (np.prod(entry["shape"]) * 5) % 4096 // 8
        for entry in header["arrays"]
        if np.prod(entry["shape"])
    ]
    found = 0
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 0x10
        path = copy_with(tmp_path, bytes(damaged))
        try:
            verify(open_bank(path))
        except BankError:
            found += 1
        else:  # the header is JSON: 1e5 is 1E5
            assert place < start
    assert found >= len(places) - 2


def test_a_damaged_byte_is_found_by_verify(file: BankFile, tmp_path: Path) -> None:
    content = bytearray(file.path.read_bytes())
    content[data_start(file.path) + file.arrays["current_step"].nbytes - 1] ^= 1
    damaged = open_bank(copy_with(tmp_path, bytes(content)))
    with pytest.raises(BankError, match="is damaged"):
        verify(damaged)


def test_opening_maps_the_file_and_does_not_read_it(file: BankFile) -> None:
    opened = open_bank(file.path)
    for name, array in opened.arrays.items():
        assert not array.flags.owndata, name
        assert not array.flags.writeable, name
        assert array.ctypes.data % 64 == 0, name
    before = peak_kilobytes()
    sparse = file.path.with_name("sparse.bank")
    grow(file.path, sparse, 2**30)
    opened = open_bank(sparse)
    assert opened.arrays["edges"].nbytes > 2**30 - 2**20
    assert peak_kilobytes() - before < 100_000
    sparse.unlink()


def peak_kilobytes() -> int:
    """The most memory that this process has ever had resident."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1])


def grow(source: Path, path: Path, size: int) -> None:
    """The bank with a huge (sparse) last array."""
    content = source.read_bytes()
    length = int.from_bytes(content[8:16], "little")
    header = json.loads(content[16 : 16 + length])
    last = next(e for e in header["arrays"] if e["name"] == "edges")
    last |= {"shape": [size // 40, 10], "offset": header["bytes"]}
    header["bytes"] += size
    text = json.dumps(header).encode()
    start = -(-(16 + len(text)) // ALIGNMENT) * ALIGNMENT
    with open(path, "wb") as file:
        file.write(MAGIC + len(text).to_bytes(8, "little") + text)
        file.truncate(start + header["bytes"])


def test_on_a_cpu_the_pages_are_used_as_they_are(file: BankFile) -> None:
    """Aligned for JAX: the log of 10,000 scenes is not copied."""
    if jax.default_backend() != "cpu":
        pytest.skip("only a CPU shares memory with the file")
    array = file.bank.log
    assert array.unsafe_buffer_pointer() == file.arrays["log"].ctypes.data


def leftovers(folder: Path) -> list[str]:
    """Names in a folder, hidden ones too."""
    return sorted(path.name for path in folder.iterdir())


def test_nothing_is_left_when_the_scenes_break_off(made, tmp_path: Path) -> None:
    def broken() -> Iterator[Scene]:
        yield made[2]
        raise RuntimeError("killed")

    with pytest.raises(RuntimeError, match="killed"):
        write_bank(broken(), tmp_path / "a.bank")
    assert leftovers(tmp_path) == []


def test_the_old_bank_stays_until_the_new_one_is_whole(
    made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = scenes.bank_of(made[2:], tmp_path, "a")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BankError, match=r"cannot write bank .*a\.bank: No space left"):
        write_bank(made[:1], tmp_path / "a.bank")
    assert leftovers(tmp_path) == ["a.bank"]
    verify(open_bank(old.path))
    assert open_bank(old.path).content_hash == old.content_hash


LIMITED = textwrap.dedent(
    """
    import resource, sys
    from pathlib import Path
    from sim.bank import BankError
    from sim.bank_writer import write_bank
    from sim.procedural import generate_many

    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
    try:
        write_bank(generate_many(1, 1), Path(sys.argv[1]))
    except BankError as error:
        print(error)
        sys.exit(2)
    """
)


def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    """A limit on the size of files, for want of a full disk."""
    path = tmp_path / "a.bank"
    ended = subprocess.run(
        [sys.executable, "-c", LIMITED, str(path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2, ended.stderr
    assert ended.stdout.startswith(f"cannot write bank {path}: ")
    assert "None" not in ended.stdout
    assert ended.stdout.count("\n") == 1
    assert leftovers(tmp_path) == []


def test_a_folder_that_may_not_be_written_is_one_line(made, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BankError, match="cannot write bank"):
        write_bank(made[2:], tmp_path / "file" / "a.bank")


def test_no_scene_makes_no_bank(tmp_path: Path) -> None:
    with pytest.raises(BankError, match="no scene to write"):
        write_bank([], tmp_path / "a.bank")
    assert leftovers(tmp_path) == []


def test_scenes_of_different_steps_are_refused(made, tmp_path: Path) -> None:
    other = dataclasses.replace(made[2], dt=0.2)
    with pytest.raises(BankError, match=r"different step lengths \[0\.1, 0\.2\] s"):
        write_bank([made[2], other], tmp_path / "a.bank")


def test_progress_counts_the_scenes(made, tmp_path: Path) -> None:
    counts: list[int] = []
    write_bank(made, tmp_path / "a.bank", progress=counts.append)
    assert counts == [1, 2, 3]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "none.bank"
    with pytest.raises(BankError, match=r"cannot open bank .*none\.bank: No such file"):
        open_bank(path)
    assert not is_bank(path)


def test_another_file_is_not_a_bank(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_text('{"name": "a scene, not a bank"}')
    assert not is_bank(path)
    with pytest.raises(BankError, match="is not a bank"):
        open_bank(path)
