"""Sampled rows by a TCP connection of their own, beside Zenoh.

Zenoh's TCP cuts an answer into fragments, copies each several times and hands it from
thread to thread: 8 to 9 us of CPU time for 8 KB, both ends together. A plain socket
takes 3. So a sampler that cannot share memory with its service (`replay.arena`)
connects to it once more, and large answers are divided: the header comes by Zenoh as
ever, the body (ids, probabilities, rows) by the stream. Where there is no stream, the
whole answer comes by Zenoh; nothing has to be configured, and losing a stream costs
only the answers that were in it, as losing a Zenoh link would.

    sampler    asks by Zenoh for an offer: addresses, a secret token, the capacity
               connects, sends MAGIC, the token, a name for the connection, and a
               byte: whether it keeps rows
    service    one byte: welcome
    sampler    names the connection and a number in each sample request
    service    number u64, length u64, body; and the header by Zenoh

To a sampler that keeps rows (`replay.mirror`) a body brings only those that it lacks:
with eight samples per insert an eighth of the bytes.

`replay.streams` is the service's side, `replay.body_stream` the sampler's; this module
has what both speak.
"""

import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from typing import Final

from replay.places import NAME_BYTES

LEAST_BYTES: Final = 256 << 10  # of a body: smaller ones cost less in the answer
MAGIC: Final = b"SLSTREAM"
WELCOME: Final = b"\x01"
KEEPS, KEEPS_NOT = b"\x01", b"\x00"
GREETING_BYTES: Final = len(MAGIC) + 2 * NAME_BYTES + len(KEEPS)
FRAME: Final = struct.Struct("<QQ")
_DEAD_S: Final = 20  # of silence on a link that should not be silent


def tuned(connection: socket.socket) -> socket.socket:
    """Notices a peer that is gone without a word; does not wait to fill packets."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        ("TCP_KEEPIDLE", _DEAD_S // 4),
        ("TCP_KEEPINTVL", _DEAD_S // 4),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", _DEAD_S * 1000),
    ):
        number = getattr(socket, option, None)  # not everywhere but on Linux
        if number is not None:
            connection.setsockopt(socket.IPPROTO_TCP, number, value)
    return connection


def hosts(locators: Iterable[str]) -> set[str]:
    """The numeric hosts of plain TCP links, `tcp/HOST:PORT`."""
    addresses = [text.removeprefix("tcp/") for text in locators if text[:4] == "tcp/"]
    return {address.rpartition(":")[0].strip("[]") for address in addresses}


def receive(connection: socket.socket, into: memoryview) -> None:
    """Fills the memory; raises `OSError` if the connection ends before."""
    while into:
        got = connection.recv_into(into, len(into), socket.MSG_WAITALL)
        if not got:
            raise ConnectionResetError("the stream has ended")
        into = into[got:]


def end(connection: socket.socket) -> None:
    """Ends a connection that a thread may be waiting on."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()
