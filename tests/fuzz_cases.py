"""Broken scene files of every format, drawn from a random generator.

A case starts from a small sound file made by hand (or one of a folder of real ones) and
breaks it in one of two ways: the bytes (cut, flipped, moved, doubled, overwritten), or
the content before it is written (values that are odd, of the wrong type, missing,
doubled or in another order), behind right checksums. Some cases break nothing.
"""

import functools
import json
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from sim.bank_writer import write_bank
from sim.formats import read_scenes
from sim.tfrecord import frame
from tests import records, records_argoverse2
from tests.fuzz_damage import (
    ODD,
    ODD_NUMBERS,
    ODD_TEXTS,
    Rng,
    broken_bytes,
    broken_message,
    broken_tree,
    pick,
    reordered_fields,
)

Maker = Callable[[Rng, Path], Path]


def _tfrecord(rng: Rng, folder: Path, payloads: list[bytes]) -> Path:
    """Frames the payloads, sometimes damaged, in or behind the frames."""
    payloads = list(payloads)
    kind = int(rng.integers(4))
    if kind == 0:
        payloads[0] = broken_bytes(rng, payloads[0])
    elif kind == 1:
        payloads[0] = reordered_fields(rng, payloads[0])
    data = b"".join(frame(payload) for payload in payloads)
    path = folder / "case.tfrecord"
    path.write_bytes(broken_bytes(rng, data) if kind == 2 else data)
    return path


def scenario(rng: Rng, folder: Path) -> Path:
    """WOMD `Scenario` records."""
    message = records.scenario(objects=int(rng.integers(1, 5)))
    for _ in range(int(rng.integers(0, 4))):
        broken_message(rng, message)
    whole = records.scenario(name="whole").SerializeToString()
    return _tfrecord(rng, folder, [message.SerializeToString(), whole])


def _example(rng: Rng, folder: Path, features: dict[str, Any]) -> Path:
    """A flat example with some features broken, in any order."""
    for _ in range(int(rng.integers(0, 4))):
        name = pick(rng, list(features))
        broken = _broken_feature(rng, features.pop(name))
        if broken is not None:
            features[name] = broken
    names = list(features)
    rng.shuffle(names)
    return _tfrecord(
        rng, folder, [records.encode_example({name: features[name] for name in names})]
    )


def _broken_feature(rng: Rng, values: Any) -> Any:
    """A feature's values broken, or None for none."""
    if isinstance(values, bytes) or not values:
        return pick(rng, (None, [1], [0.5], b"", b"\xff"))
    kind, values = int(rng.integers(8)), list(values)
    at = int(rng.integers(len(values)))
    if kind == 0:
        return None
    if kind == 1:
        return values[:at]
    if kind == 2:
        return [*values, *values[:at]]
    if kind == 3:
        return pick(rng, ([float(v) for v in values], b"text"))
    return _odd_values(rng, values, at)


def _odd_values(rng: Rng, values: list, at: int) -> list:
    """All or one of the values odd, or in another order."""
    kind = int(rng.integers(4))
    if kind == 0:
        rng.shuffle(values)
    elif kind == 1:
        scale = pick(rng, (0, -1, 1e4, 1e9, math.nan))
        values = [float(v) * scale for v in values]
    elif isinstance(values[0], float):
        values[at] = float(pick(rng, ODD_NUMBERS))
    else:
        values[at] = pick(rng, (0, 1, -1, 2, 5, 17, 2**31, 2**63 - 1, -(2**63)))
    return values


def example(rng: Rng, folder: Path) -> Path:
    """WOMD's flat form as of the first releases."""
    return _example(rng, folder, records.example(slots=int(rng.integers(2, 6))))


def example_paths(rng: Rng, folder: Path) -> Path:
    """WOMD's flat form with path samples."""
    return _example(rng, folder, records.with_paths(records.example()))


def gpudrive(rng: Rng, folder: Path) -> Path:
    """GPUDrive's JSON."""
    content = records.gpudrive(objects=int(rng.integers(1, 5)))
    return _json(rng, folder / "case.json", content)


def _json(rng: Rng, path: Path, content: Any) -> Path:
    """JSON that is broken in content, in bytes or not at all."""
    kind = rng.random()
    if kind < 0.7:
        content = broken_tree(rng, content)
    data = json.dumps(content).encode()
    path.write_bytes(broken_bytes(rng, data) if kind > 0.9 else data)
    return path


def argoverse2(rng: Rng, folder: Path) -> Path:
    """Argoverse 2's Parquet and map."""
    table, kind = records_argoverse2.columns(), rng.random()
    path = records_argoverse2.write(folder)
    beside = next(folder.glob("log_map_archive*"))
    if kind < 0.4:
        _json(rng, beside, records_argoverse2.map_content())
    elif kind < 0.7:
        _broken_columns(rng, table)
    compression = pick(rng, ("none", "snappy", "gzip", "zstd"))
    parquet.write_table(_arrow(table), path, compression=compression)
    if kind > 0.75:
        path.write_bytes(broken_bytes(rng, path.read_bytes()))
    if rng.random() < 0.02:
        beside.unlink()
    return path


def _broken_columns(rng: Rng, table: dict[str, list]) -> None:
    """Breaks a table of columns: a cell, a column or the rows."""
    name, kind = pick(rng, list(table)), int(rng.integers(7))
    rows = np.arange(len(table[name]))
    if kind == 0:
        del table[name]
    elif kind == 1:
        table[name] = [str(value) for value in table[name]]
    elif kind == 2:
        table[name] = [pick(rng, ODD)] * len(rows)
    elif kind <= 4:
        table[name][pick(rng, rows)] = pick(rng, (*ODD_NUMBERS, *ODD_TEXTS, None))
    else:
        order = rng.permutation(rows) if kind == 5 else rng.choice(rows, len(rows))
        for column, values in table.items():
            table[column] = [values[row] for row in order]


def _arrow(table: dict[str, list]) -> pa.Table:
    """An Arrow table; a column of mixed types is one of text."""
    columns = {}
    for name, values in table.items():
        try:
            columns[name] = pa.array(values)
            if pa.types.is_nested(columns[name].type):
                raise pa.ArrowInvalid("Parquet has no struct without a field")
        except (pa.ArrowException, OverflowError):
            columns[name] = pa.array([str(value) for value in values])
    return pa.table(columns)


@functools.cache
def _bank_bytes() -> bytes:
    """A sound bank of two scenes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        payloads = [records.scenario(name=n).SerializeToString() for n in "ab"]
        records.write_tfrecord(folder / "a", payloads)
        write_bank(read_scenes([folder / "a"]), folder / "b.bank")
        return (folder / "b.bank").read_bytes()


def bank(rng: Rng, folder: Path) -> Path:
    """A bank with a broken header or broken bytes."""
    data, path = _bank_bytes(), folder / "case.bank"
    if rng.random() < 0.5:
        path.write_bytes(broken_bytes(rng, data))
        return path
    length = int.from_bytes(data[8:16], "little")
    header = json.dumps(broken_tree(rng, json.loads(data[16 : 16 + length]))).encode()
    # Padded to the same length, or every case would end at the file's size.
    header = header.ljust(length)
    path.write_bytes(
        data[:8] + len(header).to_bytes(8, "little") + header + data[16 + length :]
    )
    return path


MAKERS: dict[str, Maker] = {
    "scenario": scenario,
    "example": example,
    "example+paths": example_paths,
    "gpudrive": gpudrive,
    "argoverse2": argoverse2,
    "bank": bank,
}


def real(rng: Rng, folder: Path, data: Path) -> Path:
    """A real file with broken bytes."""
    files = sorted(path for path in data.rglob("*") if path.suffix != ".md")
    files = [path for path in files if path.is_file()]
    source = pick(rng, files)
    path = folder / source.name
    path.write_bytes(broken_bytes(rng, source.read_bytes()))
    if source.suffix == ".parquet":
        for beside in source.parent.glob("*.json"):
            (folder / beside.name).write_bytes(beside.read_bytes())
    return path
