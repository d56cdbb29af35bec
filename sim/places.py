"""Where scenes come from: places that any process can read one scene from.

    a record of a TFRecord     file, byte offset
    a file of one scene        file
    a procedural scene         seed, index

Finding the places of a file costs as good as nothing: of a TFRecord only the frames'
lengths are read. So one process hands out places and others parse them. A place's
`key` changes whenever what is read there could: with a file's name, size or time of
change (and those of the map beside a scenario of Argoverse 2), or the seed.
"""

import abc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from sim import formats, tfrecord
from sim.formats import Format
from sim.procedural import generate
from sim.scene import Scene, SceneError
from sim.womd import parse_scenario
from sim.womd_example import parse_example


class AbstractPlace(abc.ABC):
    """Something that one scene can be read from."""

    @property
    @abc.abstractmethod
    def key(self) -> str:
        """Names the place and the state that it was found in."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """What messages call it."""

    @abc.abstractmethod
    def read(self) -> Scene:
        """The scene; raises `SceneError`."""


@final
@dataclass(frozen=True)
class FilePlace(AbstractPlace):
    """A file that holds one scene."""

    path: Path
    state: str  # `_state_of` the file

    @property
    def key(self) -> str:
        """The file's name and state."""
        return self.state

    @property
    def name(self) -> str:
        """The file."""
        return str(self.path)

    def read(self) -> Scene:
        """The file's scene."""
        outcomes = list(formats.read_file(self.path))
        for outcome in outcomes:
            if isinstance(outcome, SceneError):
                raise outcome
            return outcome
        raise SceneError(f"{self.path}: holds no scene; fetch it again")


@final
@dataclass(frozen=True)
class RecordPlace(AbstractPlace):
    """A record of a TFRecord."""

    path: Path
    state: str  # `_state_of` the file
    example: bool  # whether it is a flat `tf.Example`
    index: int
    offset: int  # bytes

    @property
    def key(self) -> str:
        """The file's name and state, and the offset."""
        return f"{self.state} {self.offset}"

    @property
    def name(self) -> str:
        """The file, the record's number and its offset."""
        return f"{self.path}: record {self.index} at byte {self.offset}"

    def read(self) -> Scene:
        """The record's scene."""
        record = tfrecord.read_record(self.path, self.offset)
        parse = parse_example if self.example else parse_scenario
        return parse(record.payload, source=self.name)


@final
@dataclass(frozen=True)
class ProceduralPlace(AbstractPlace):
    """A scene of the generator."""

    seed: int
    index: int

    @property
    def key(self) -> str:
        """Seed and index."""
        return f"procedural {self.seed} {self.index}"

    @property
    def name(self) -> str:
        """Seed and index."""
        return f"procedural scene {self.index} of seed {self.seed}"

    def read(self) -> Scene:
        """Generates it."""
        return generate(self.seed, self.index)


Found = AbstractPlace | SceneError


def places_in(files: Sequence[Path]) -> Iterator[Found]:
    """The places of files, in order, or in their stead what is wrong with a file."""
    for path in files:
        try:
            yield from _places_of(path)
        except SceneError as error:
            yield error
        except OSError as error:
            yield SceneError(f"{path}: cannot be read ({error.strerror})")


def procedural_places(seed: int, count: int) -> Iterator[Found]:
    """The first scenes of a seed."""
    return (ProceduralPlace(seed, index) for index in range(count))


def _places_of(path: Path) -> Iterator[Found]:
    with path.open("rb") as file:
        records = tfrecord.is_header(file.read(tfrecord.HEADER_BYTES))
    state = _state_of(path)
    if not records:
        yield FilePlace(path, state)
        return
    example = formats.detect(path) is Format.WOMD_EXAMPLE
    for index, offset in enumerate(tfrecord.record_offsets(path)):
        if isinstance(offset, SceneError):
            yield offset
        else:
            yield RecordPlace(path, state, example, index, offset)


def _state_of(path: Path) -> str:
    """A file's full name, size and time of change, and those of a map beside it."""
    beside = path.with_name(
        f"log_map_archive_{path.stem.removeprefix('scenario_')}.json"
    )
    files = [path, beside] if beside.exists() else [path]
    stats = [(file, file.stat()) for file in files]
    return " ".join(f"{f.resolve()} {s.st_size} {s.st_mtime_ns}" for f, s in stats)
