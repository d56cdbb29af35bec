"""Finds out what a scene file is, by its content, and reads it.

    WOMD Scenario     TFRecord of `Scenario` messages      sim.womd
    WOMD tf.Example   TFRecord of flat examples            sim.womd_example
    GPUDrive          JSON with `objects` and `roads`      sim.gpudrive
    Argoverse 2       Parquet, and its map (JSON) beside   sim.argoverse2

A file that is named must be one of them. Of a folder, files that are not are left out
and can be had from `on_skip` (but for the maps of Argoverse 2, which are read with
their scenarios); files are read in sorted order, each once. Every error
is one line that names file, record, place and what to do.
"""

import enum
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from sim import argoverse2, tfrecord
from sim.gpudrive import parse_gpudrive
from sim.scene import Scene, SceneError
from sim.womd import parse_scenario
from sim.womd_example import is_example, parse_example

SUPPORTED = (
    "WOMD Scenario and tf.Example TFRecords, GPUDrive JSON and Argoverse 2 Parquet"
)

_HEAD_BYTES = 4096
_BANK_MAGIC = b"SLIPBANK"  # `sim.bank` has it too; importing that imports jax
_GZIP_MAGIC = b"\x1f\x8b"
_MARK = b"\xef\xbb\xbf"  # of UTF-8; some editors put it before JSON


class UnsupportedFormat(SceneError):
    """A file is no scene at all; a damaged one is another `SceneError`."""


class Format(enum.Enum):
    """The kinds of file that can be told apart."""

    WOMD_SCENARIO = "WOMD Scenario TFRecord"
    WOMD_EXAMPLE = "WOMD tf.Example TFRecord"
    GPUDRIVE = "GPUDrive JSON"
    ARGOVERSE2 = "Argoverse 2 Parquet"
    ARGOVERSE2_MAP = "map of an Argoverse 2 scenario"
    BANK = "Slipstream bank"


def detect(path: Path) -> Format:
    """Looks into a file; raises `SceneError` if it is nothing that is known."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    if head.startswith(_BANK_MAGIC):
        return Format.BANK
    # Before JSON: a record's length may well begin with the byte of a brace.
    if tfrecord.is_header(head):
        return _detect_record(path)
    if head.removeprefix(_MARK).lstrip().startswith(b"{"):
        return _detect_json(path)
    if head.startswith(argoverse2.MAGIC):
        if argoverse2.is_scenario(path):
            return Format.ARGOVERSE2
        raise UnsupportedFormat(
            f"{path}: Parquet without an Argoverse 2 scenario's columns; supported are "
            f"{SUPPORTED}"
        )
    raise _refusal(path, head)


def _detect_json(path: Path) -> Format:
    """What a JSON file holds."""
    text = _read_bytes(path)
    if argoverse2.is_map(text):
        return Format.ARGOVERSE2_MAP
    if b'"objects"' in text:
        return Format.GPUDRIVE
    raise UnsupportedFormat(f"{path}: JSON without objects; supported are {SUPPORTED}")


def _detect_record(path: Path) -> Format:
    """Which message the first readable record of a TFRecord holds.

    Where none is readable the answer makes no difference: reading reports each.
    """
    for record in tfrecord.read_records(path):
        if isinstance(record, tfrecord.Record) and is_example(record.payload):
            return Format.WOMD_EXAMPLE
        if isinstance(record, tfrecord.Record):
            break
    return Format.WOMD_SCENARIO


def _refusal(path: Path, head: bytes) -> SceneError:
    """Why a file whose content is not recognised is refused."""
    if not head:
        return UnsupportedFormat(f"{path}: is empty; fetch it again")
    if head.startswith(_GZIP_MAGIC):
        return UnsupportedFormat(f"{path}: is compressed by gzip; unpack it first")
    # The name decides only about the message: what damage has made of a recording's
    # first bytes cannot be recognised.
    if "tfrecord" not in path.name.lower():
        return UnsupportedFormat(
            f"{path}: is of no supported format; supported are {SUPPORTED}"
        )
    if len(head) < tfrecord.HEADER_BYTES:
        return SceneError(
            f"{path}: truncated at byte {len(head)}: the record at byte 0 needs "
            "more; fetch the file again"
        )
    return SceneError(
        f"{path}: CRC mismatch of the record length at byte 0; fetch the file again, "
        f"or give one of the supported formats: {SUPPORTED}"
    )


def list_files(
    paths: Sequence[Path], *, on_skip: Callable[[str], None] | None = None
) -> list[Path]:
    """The scene files among `paths` and in the folders among them, each once."""
    files: dict[Path, Path] = {}
    for path in paths:
        if not path.exists():
            raise SceneError(f"{path}: no such file or folder; check the path")
        for file in _scene_files(path, on_skip) if path.is_dir() else [path]:
            files.setdefault(file.resolve(), file)
    return list(files.values())


def _scene_files(folder: Path, on_skip: Callable[[str], None] | None) -> Iterable[Path]:
    """The scene files at any depth of a folder, of which there must be one."""
    found = []
    for file in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
        if hidden or not file.is_file():
            continue
        if _is_scene_file(file, on_skip):
            found.append(file)
    if not found:
        raise SceneError(
            f"{folder}: no scene in this folder; supported are {SUPPORTED}"
        )
    return found


def _is_scene_file(file: Path, on_skip: Callable[[str], None] | None) -> bool:
    """Whether to read a file that lies in a folder; tells `on_skip` if not."""
    try:
        kind = detect(file)
        if kind is Format.ARGOVERSE2_MAP:
            return False
        if kind is not Format.BANK:
            return True
        reason = f"{file}: is a bank"
    except UnsupportedFormat as error:
        reason = str(error)
    except SceneError:
        # Damage is not passed over in silence: reading the file reports its place.
        return True
    if on_skip is not None:
        on_skip(reason)
    return False


def read_outcomes(
    paths: Sequence[Path], *, on_skip: Callable[[str], None] | None = None
) -> Iterator[Scene | SceneError]:
    """Yields every record's scene or, in its place, what is wrong with it."""
    for file in list_files(paths, on_skip=on_skip):
        yield from read_file(file)


def read_scenes(
    paths: Sequence[Path], *, on_skip: Callable[[str], None] | None = None
) -> Iterator[Scene]:
    """Yields every scene in order; raises `SceneError` at the first bad record."""
    for outcome in read_outcomes(paths, on_skip=on_skip):
        if isinstance(outcome, SceneError):
            raise outcome
        yield outcome


def bad_records(paths: Sequence[Path]) -> list[str]:
    """One line for each record that cannot be read, in order."""
    return [str(o) for o in read_outcomes(paths) if isinstance(o, SceneError)]


def read_file(path: Path) -> Iterator[Scene | SceneError]:
    """Yields the outcomes of one file's records."""
    try:
        yield from _read_as(path, detect(path))
    except SceneError as error:
        yield error


def _read_as(path: Path, format_: Format) -> Iterator[Scene | SceneError]:
    """Yields the outcomes of the records of a file of this format."""
    if format_ is Format.BANK:
        raise SceneError(f"{path}: is a bank, converted already; use it as it is")
    if format_ is Format.ARGOVERSE2_MAP:
        raise SceneError(
            f"{path}: is a map of Argoverse 2; give the scenario's Parquet file, which "
            "is read with the map beside it"
        )
    if format_ is Format.ARGOVERSE2:
        yield argoverse2.read_argoverse2(path)
        return
    if format_ is Format.GPUDRIVE:
        yield parse_gpudrive(_read_bytes(path).removeprefix(_MARK), source=str(path))
        return
    parse = parse_scenario if format_ is Format.WOMD_SCENARIO else parse_example
    for index, record in enumerate(tfrecord.read_records(path)):
        if isinstance(record, SceneError):
            yield record
            continue
        try:
            source = f"{path}: record {index} at byte {record.offset}"
            yield parse(record.payload, source=source)
        except SceneError as error:
            yield error


def _read_bytes(path: Path) -> bytes:
    """A whole file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
