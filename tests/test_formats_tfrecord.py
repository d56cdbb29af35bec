"""TFRecord frames: checksums, and where each kind of damage is reported."""

import tempfile
import time
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from sim.formats import bad_records, read_outcomes
from sim.scene import Scene, SceneError
from sim.tfrecord import Record, frame, is_header, masked_crc, read_records
from tests import records


def test_crc_is_that_of_the_standard() -> None:
    """RFC 3720, appendix B.4: 32 bytes of zeros give 0x8a9136aa."""
    crc = 0x8A9136AA
    rotated = ((crc >> 15) | (crc << 17)) & 0xFFFFFFFF
    assert masked_crc(bytes(32)) == (rotated + 0xA282EAD8) % 2**32


def test_a_megabyte_is_checked_in_milliseconds() -> None:
    payload = bytes(1_000_000)
    begin = time.perf_counter()
    masked_crc(payload)
    assert time.perf_counter() - begin < 0.1  # a loop over bytes takes seconds


@given(st.lists(st.binary(max_size=40), max_size=4))
def test_round_trip(payloads: list[bytes]) -> None:
    with _file(b"".join(frame(payload) for payload in payloads)) as path:
        found = list(read_records(path))
    assert [r.payload for r in found if isinstance(r, Record)] == payloads


def test_truncation_at_every_byte(tmp_path: Path) -> None:
    path = tmp_path / "scenes.tfrecord"
    payloads = [b"first payload", b"", b"third"]
    offsets = records.write_tfrecord(path, payloads)
    whole = path.read_bytes()
    for cut in range(len(whole)):
        path.write_bytes(whole[:cut])
        found = list(read_records(path))
        complete = sum(end <= cut for end in offsets[1:])
        assert [r.payload for r in found[:complete]] == payloads[:complete]
        if cut in offsets:
            assert len(found) == complete
        else:
            (error,) = found[complete:]
            start = offsets[complete]
            assert isinstance(error, SceneError)
            assert f"truncated at byte {cut}: the record at byte {start}" in str(error)


@given(st.data())
def test_no_flipped_bit_goes_unnoticed(data: st.DataObject) -> None:
    payloads = [b"first payload", b"second", b"third"]
    whole = bytearray(b"".join(frame(payload) for payload in payloads))
    bit = data.draw(st.integers(0, 8 * len(whole) - 1))
    whole[bit // 8] ^= 1 << (bit % 8)
    with _file(bytes(whole)) as path:
        found = list(read_records(path))
    errors = [str(r) for r in found if isinstance(r, SceneError)]
    assert len(errors) == 1
    assert "CRC mismatch" in errors[0]
    good = [r.payload for r in found if isinstance(r, Record)]
    assert all(payload in payloads for payload in good)


def test_a_bad_payload_costs_one_record(tmp_path: Path) -> None:
    path = tmp_path / "scenes"
    names = ("a", "b", "c")
    offsets = records.write_tfrecord(
        path, [records.scenario(name=n).SerializeToString() for n in names]
    )
    whole = bytearray(path.read_bytes())
    whole[offsets[1] + 50] ^= 4
    path.write_bytes(whole)
    outcomes = list(read_outcomes([path]))
    good = [o.scenario_id for o in outcomes if isinstance(o, Scene)]
    assert good == ["a", "c"]
    (line,) = bad_records([path])
    assert f"CRC mismatch in the record at byte {offsets[1]}" in line
    assert str(path) in line and "\n" not in line


def test_a_length_of_terabytes_is_not_allocated(tmp_path: Path) -> None:
    path = tmp_path / "scenes"
    length = (1 << 45).to_bytes(8, "little")
    path.write_bytes(length + masked_crc(length).to_bytes(4, "little") + b"x")
    assert is_header(path.read_bytes())
    (error,) = read_records(path)
    assert "truncated at byte 13" in str(error)


def test_a_missing_file_is_an_error_not_a_crash(tmp_path: Path) -> None:
    (error,) = read_records(tmp_path / "none")
    assert "No such file" in str(error)


class _file:
    """A temporary file of this content (fixtures are not reset between examples)."""

    def __init__(self, content: bytes) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name) / "scenes.tfrecord"
        self._path.write_bytes(content)

    def __enter__(self) -> Path:
        return self._path

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()
