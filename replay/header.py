"""What every message begins with, and the checks that all of them share.

    magic "SLST" | version u16 | kind u16 | hash of the row's schema, 8 bytes

and 48 bytes of the message's own. `replay.wire` has the messages.
"""

import enum
import struct

from replay.spec import ReplayError

WIRE_VERSION = 5
MAGIC = b"SLST"
HEADER_BYTES = 64
MAX_ROWS = 1 << 20  # per message
MAX_UPDATES = 1 << 20
MAX_REPLY_BYTES = 256 << 20
MAX_NUMBER = 1 << 62  # of epochs and sequences: the next one must fit as well
MAX_HOLD_MS = 60_000  # longer ones are cut: nobody may keep the service's memory
COMMON = struct.Struct("<4sHH8s")
NO_SCHEMA = bytes(8)


class WireError(ReplayError):
    """A payload is not the message that it should be."""


class Kind(enum.IntEnum):
    """Which message a payload is."""

    INSERT = 1
    INSERT_REPLY = 2
    SAMPLE_REQUEST = 3
    SAMPLE_REPLY = 4
    FETCH_REQUEST = 5
    WEIGHTS = 6


class Status(enum.IntEnum):
    """What became of a request."""

    OK = 0
    BUSY = 1  # the rate limiter did not admit it in time; ask again
    GAP = 2  # not the next sequence; go back to the one in the reply
    STALE = 3  # a newer process writes under this number
    REFUSED = 4  # it can never be accepted; the reason says why
    ABSENT = 5  # the rows are not where the message says; send them along


def header(kind: Kind, schema_hash: bytes, rest: bytes) -> bytes:
    """The 64 bytes that begin a message."""
    head = COMMON.pack(MAGIC, WIRE_VERSION, kind, schema_hash) + rest
    return head.ljust(HEADER_BYTES, b"\0")


def open_header(payload: bytes, kind: Kind, schema_hash: bytes) -> None:
    """Checks the common header; raises `WireError` naming what differs."""
    name = kind.name
    if len(payload) < HEADER_BYTES:
        raise WireError(f"{name}: {len(payload)} bytes, a header has {HEADER_BYTES}")
    magic, version, got_kind, got_hash = COMMON.unpack_from(payload)
    if magic != MAGIC:
        raise WireError(f"{name}: begins with {magic!r}, not {MAGIC!r}")
    if version != WIRE_VERSION:
        raise WireError(
            f"{name}: wire version {version}, this process speaks {WIRE_VERSION}; "
            "run the same release everywhere"
        )
    if got_kind != kind:
        raise WireError(f"{name}: got a message of kind {got_kind}")
    if got_hash != schema_hash:
        raise WireError(
            f"{name}: row schema {got_hash.hex()}, expected {schema_hash.hex()}; "
            "actors, replay and learner must run with the same row layout"
        )


def check_length(payload: bytes, kind: Kind, body: int) -> None:
    """A body of exactly `body` bytes must follow the header."""
    if len(payload) != HEADER_BYTES + body:
        raise WireError(
            f"{kind.name}: {len(payload) - HEADER_BYTES} bytes after the header, "
            f"expected {body}"
        )


def check_count(kind: Kind, what: str, count: int, most: int) -> None:
    """At most `most` of them are allowed."""
    if not count <= most:
        raise WireError(f"{kind.name}: {count} {what}, at most {most} are allowed")


def reason_of(payload: bytes, kind: Kind) -> str:
    """The text that follows a reply's header."""
    try:
        return payload[HEADER_BYTES:].decode()
    except UnicodeDecodeError as error:
        raise WireError(f"{kind.name}: the reason is not UTF-8") from error


def status_of(value: int, kind: Kind) -> Status:
    """The status of this number."""
    try:
        return Status(value)
    except ValueError as error:
        raise WireError(f"{kind.name}: unknown status {value}") from error
