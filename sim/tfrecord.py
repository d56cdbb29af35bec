"""TFRecord files: frames of bytes, each with its length and two checksums.

    length   uint64, little-endian
    crc      uint32, masked CRC32C of the 8 bytes of the length
    payload  `length` bytes
    crc      uint32, masked CRC32C of the payload

    masked(c) = rotate_right(c, 15) + 0xa282ead8   (mod 2^32)

TensorFlow, "TFRecords format details". A payload whose checksum is wrong costs
itself only, since the length is known; after a wrong length or a cut file there is
no way to find the next frame, so reading ends there. Offsets count from the start
of the file.
"""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import google_crc32c

from sim.scene import SceneError

HEADER_BYTES = 12
_FOOTER_BYTES = 4
_MASK_DELTA = 0xA282EAD8


class Record(NamedTuple):
    """One frame's payload."""

    offset: int  # byte of the file at which the frame (its length) starts
    payload: bytes


def masked_crc(data: bytes) -> int:
    """The checksum that a frame stores for `data`."""
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + _MASK_DELTA) & 0xFFFFFFFF


def frame(payload: bytes) -> bytes:
    """The frame that holds `payload`."""
    length = struct.pack("<Q", len(payload))
    return b"".join(
        (
            length,
            struct.pack("<I", masked_crc(length)),
            payload,
            struct.pack("<I", masked_crc(payload)),
        )
    )


def is_header(head: bytes) -> bool:
    """Whether a file's first bytes are a frame's length with its right checksum."""
    if len(head) < HEADER_BYTES:
        return False
    crc: int = struct.unpack_from("<I", head, 8)[0]
    return crc == masked_crc(head[:8])


def read_records(path: Path) -> Iterator[Record | SceneError]:
    """Yields each frame or, in its place, what is wrong with it; raises nothing.

    Errors are yielded so that a conversion can report a bad record and go on.
    """
    try:
        with path.open("rb") as file:
            yield from _frames(path, file)
    except OSError as error:
        yield SceneError(f"{path}: cannot be read ({error.strerror})")


def record_offsets(path: Path) -> Iterator[int | SceneError]:
    """Yields where each frame starts, of which only the lengths are read.

    An error ends it, as in `read_records`; payloads' checksums are not looked at.
    """
    try:
        with path.open("rb") as file:
            for head in _heads(path, file):
                yield head if isinstance(head, SceneError) else head[0]
    except OSError as error:
        yield SceneError(f"{path}: cannot be read ({error.strerror})")


def read_record(path: Path, offset: int) -> Record:
    """The frame that starts at `offset`; raises `SceneError` if it is damaged."""
    try:
        with path.open("rb") as file:
            record = next(_frames(path, file, offset), None)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    if record is None:
        raise SceneError(f"{path}: no record at byte {offset}; did the file change?")
    if isinstance(record, SceneError):
        raise record
    return record


def _frames(
    path: Path, file: BinaryIO, offset: int = 0
) -> Iterator[Record | SceneError]:
    """Reads the frames of an open file from `offset` on."""
    for head in _heads(path, file, offset):
        if isinstance(head, SceneError):
            yield head
            return
        start, length = head
        body = file.read(length + _FOOTER_BYTES)
        if len(body) < length + _FOOTER_BYTES:
            needed = HEADER_BYTES + length + _FOOTER_BYTES
            yield _truncated(path, start, needed, start + HEADER_BYTES + len(body))
            return
        yield _checked(path, start, body)


def _heads(
    path: Path, file: BinaryIO, offset: int = 0
) -> Iterator[tuple[int, int] | SceneError]:
    """Walks the frames: where each starts and how long its payload is.

    While one is looked at the file stands at its payload.
    """
    size = os.fstat(file.fileno()).st_size
    while offset < size:
        file.seek(offset)
        head = file.read(HEADER_BYTES)
        if len(head) < HEADER_BYTES:
            yield _truncated(path, offset, HEADER_BYTES, size)
            return
        if not is_header(head):
            yield SceneError(
                f"{path}: CRC mismatch of the record length at byte {offset}; the "
                "rest of the file cannot be read, fetch it again"
            )
            return
        length: int = struct.unpack_from("<Q", head)[0]
        end = offset + HEADER_BYTES + length + _FOOTER_BYTES
        # Compared with the size before reading: a length of terabytes must not be
        # allocated to find out that the file is shorter.
        if end > size:
            yield _truncated(path, offset, end - offset, size)
            return
        yield offset, length
        offset = end


def _checked(path: Path, offset: int, body: bytes) -> Record | SceneError:
    """The record in `body` (payload and checksum), or that its checksum is wrong."""
    payload = body[:-_FOOTER_BYTES]
    (crc,) = struct.unpack("<I", body[-_FOOTER_BYTES:])
    if crc != masked_crc(payload):
        return SceneError(
            f"{path}: CRC mismatch in the record at byte {offset} "
            f"({len(payload)} bytes from byte {offset + HEADER_BYTES}); fetch the "
            "file again"
        )
    return Record(offset, payload)


def _truncated(path: Path, offset: int, needed: int, size: int) -> SceneError:
    """The file ends inside the frame at `offset`."""
    return SceneError(
        f"{path}: truncated at byte {size}: the record at byte {offset} needs "
        f"{needed} bytes, {max(size - offset, 0)} are there; fetch the file again"
    )
