"""Where the body of a sample reply may lie instead of behind its header.

pid u32 | fd u32 | offset u64 | token [16]       in the sampler's memory
0       | 1      | number u64 | connection [16]  on a stream of the sampler's
0       | 0                                      nowhere: behind the header
"""

import struct
from dataclasses import dataclass
from typing import Final, final

NAME_BYTES: Final = 16
_PLACE: Final = struct.Struct("<IIQ16s")
_STREAM: Final = 1
NO_PLACE: Final = bytes(_PLACE.size)


@final
@dataclass(frozen=True, kw_only=True)
class MemoryPlace:
    """Where in which process's memory something lies or may lie: `replay.arena`."""

    pid: int
    fd: int
    offset: int  # bytes from the start of the file
    token: bytes


@final
@dataclass(frozen=True, kw_only=True)
class StreamPlace:
    """By which connection a body is to come, and as which: `replay.stream_frames`."""

    name: bytes  # the connection's
    number: int


Place = MemoryPlace | StreamPlace


def encode_place(place: Place | None) -> bytes:
    """32 bytes."""
    match place:
        case MemoryPlace():
            return _PLACE.pack(place.pid, place.fd, place.offset, place.token)
        case StreamPlace():
            return _PLACE.pack(0, _STREAM, place.number, place.name)
        case None:
            return NO_PLACE


def decode_place(data: bytes, offset: int) -> Place | None:
    """The place at `offset` of a message."""
    pid, fd, number, token = _PLACE.unpack_from(data, offset)
    if pid:
        return MemoryPlace(pid=pid, fd=fd, offset=number, token=token)
    return StreamPlace(name=token, number=number) if fd == _STREAM else None
