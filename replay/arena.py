"""Memory that a client shares with a service on the same machine, part by part.

Zenoh's shared memory costs three copies of a reply in Python: gather, into the shared
buffer, out of it. Here the client makes the memory and says where in it an answer may
lie; the service gathers rows straight into that place, and only a header travels.

The memory is an anonymous file (`memfd_create`): it has no name in any folder and is
gone with the last process that has it mapped, however that ends. It begins with
a random token; a place names process, descriptor, offset and token. The service opens
`/proc/PID/fd/FD`. Another machine, another container or another user's process has no
such file, or one without that token: then the answer travels as a whole. So nothing has
to be configured, and a wrong guess is impossible.

What the service trusts: nobody but its own user, whose processes could also attach
a debugger to it. It checks the owner, that the size can never change (seals: a file
that shrinks kills whoever writes to its end), that the memory is there, the token, and
offset, length and alignment of every place. It writes to the place and does not read
back what it wrote.

A part's lifetime: `take` lends it to one request. `view` gives the rows that lie in
it, read-only; the part is free again once neither that array nor any view of it is
left. A request that ended without an answer may still be answered, late: whoever has
one throws the whole arena away.
"""

import mmap
import os
import secrets
import sys
import time
import weakref
from collections import OrderedDict
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import UInt8

from replay.places import MemoryPlace

TOKEN_BYTES = 16
HEAD_BYTES = 4096  # before the first part: the token
ALIGNMENT = 64
MAX_ARENA_BYTES = 1 << 30
MAX_MAPPED = 256  # arenas of others
IDLE_S = 10.0  # after which they are let go of; opening one again takes 0.1 ms
_NAME = "slipstream"


@final
class Arena:
    """The client's side: equal parts, each lent until nobody looks at it any more."""

    def __init__(self, *, parts: int, part_bytes: int) -> None:
        """Takes the memory at once, so that writing to it cannot fail."""
        stride = -(-part_bytes // ALIGNMENT) * ALIGNMENT
        size = HEAD_BYTES + parts * stride
        self._fd = _sealed_file(size)
        self._close = weakref.finalize(self, os.close, self._fd)
        self._memory = np.frombuffer(mmap.mmap(self._fd, size), np.uint8)
        self._token = secrets.token_bytes(TOKEN_BYTES)
        self._memory[:TOKEN_BYTES] = np.frombuffer(self._token, np.uint8)
        # The last one that came free is the next: it is in the cache.
        self._free = [HEAD_BYTES + part * stride for part in reversed(range(parts))]
        self._lent: dict[int, weakref.ref[np.ndarray]] = {}

    def take(self) -> MemoryPlace | None:
        """A part that nobody uses, or None."""
        if not self._free:
            return None
        return MemoryPlace(
            pid=os.getpid(), fd=self._fd, offset=self._free.pop(), token=self._token
        )

    def room(self, place: MemoryPlace, length: int) -> memoryview:
        """The first bytes of the part, to be written by this process."""
        return self._memory.data[place.offset : place.offset + length]

    def give_back(self, place: MemoryPlace) -> None:
        """The part was not used."""
        self._free.append(place.offset)

    def view(self, place: MemoryPlace, length: int) -> UInt8[np.ndarray, " length"]:
        """The first bytes of the part; it is free when no view of them is left."""
        # An array of its own: views of it keep it alive, and not each other's parts.
        whole = np.frombuffer(self._memory.data, np.uint8, length, place.offset)
        whole.flags.writeable = False
        free, lent, offset = self._free, self._lent, place.offset

        def on_unused(_: "weakref.ref[np.ndarray]") -> None:
            del lent[offset]
            free.append(offset)

        lent[offset] = weakref.ref(whole, on_unused)
        return whole

    def close(self) -> None:
        """No service can open it any more; views stay valid."""
        self._close()


def make_arena(*, parts: int, part_bytes: int) -> Arena | None:
    """An arena, or None where there can be none: then everything travels."""
    if HEAD_BYTES + parts * (part_bytes + ALIGNMENT) > MAX_ARENA_BYTES:
        return None
    try:
        return Arena(parts=parts, part_bytes=part_bytes)
    except OSError:  # not Linux, no memory, or forbidden in this container
        return None


def _sealed_file(size: int) -> int:
    """An anonymous file whose size can never change, all of its pages there."""
    if sys.platform != "linux":
        raise OSError("anonymous files are Linux's")
    import fcntl

    fd = os.memfd_create(_NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.posix_fallocate(fd, 0, size)
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _seals())
    except OSError:
        os.close(fd)
        raise
    return fd


def _seals() -> int:
    """What makes a mapping of the file safe for good."""
    if sys.platform != "linux":
        return 0
    import fcntl

    return fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL


@final
@dataclass(kw_only=True)
class _Mapped:
    memory: mmap.mmap
    used_at: float  # time.monotonic


@final
class Arenas:
    """The service's side: the arenas of clients, mapped while they are used."""

    def __init__(self) -> None:
        """Knows none yet."""
        self._mapped: OrderedDict[tuple[int, int, bytes], _Mapped] = OrderedDict()

    def __len__(self) -> int:
        """How many are mapped now."""
        return len(self._mapped)

    def part(self, place: MemoryPlace, length: int) -> memoryview | None:
        """The `length` bytes at the place, or None if this process cannot see them."""
        memory = self._memory_of(place)
        inside = HEAD_BYTES <= place.offset <= place.offset + length
        if memory is None or not inside or place.offset + length > len(memory):
            return None
        if place.offset % ALIGNMENT:
            return None
        return memoryview(memory)[place.offset : place.offset + length]

    def let_go(self, now: float) -> None:
        """Unmaps what has not been used for long: its owner may be gone."""
        while self._mapped:
            key, oldest = next(iter(self._mapped.items()))
            if now - oldest.used_at < IDLE_S and len(self._mapped) <= MAX_MAPPED:
                return
            del self._mapped[key]  # unmapped with the last view of it

    def _memory_of(self, place: MemoryPlace) -> mmap.mmap | None:
        key = (place.pid, place.fd, place.token)
        known = self._mapped.get(key)
        if known is None:
            memory = _open_sealed(place)
            if memory is None:
                return None
            known = self._mapped[key] = _Mapped(memory=memory, used_at=0.0)
        known.used_at = time.monotonic()
        self._mapped.move_to_end(key)
        self.let_go(known.used_at)
        return known.memory


def _open_sealed(place: MemoryPlace) -> mmap.mmap | None:
    """Maps the file if it is what the place says; the module says what is checked."""
    path = f"/proc/{place.pid}/fd/{place.fd}"
    try:
        # Before it is opened: opening a pipe or a device may have an effect.
        if not os.readlink(path).startswith(f"/memfd:{_NAME}"):
            return None
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except (OSError, ValueError):
        return None
    try:
        return _map_checked(fd, place.token)
    except (OSError, ValueError):
        return None
    finally:
        os.close(fd)


def _map_checked(fd: int, token: bytes) -> mmap.mmap | None:
    if sys.platform != "linux":
        return None
    import fcntl

    status = os.fstat(fd)
    sealed = fcntl.fcntl(fd, fcntl.F_GET_SEALS) & _seals() == _seals()
    if not sealed or status.st_uid != os.geteuid():
        return None
    if not HEAD_BYTES < status.st_size <= MAX_ARENA_BYTES:
        return None
    if status.st_blocks * 512 < status.st_size:  # pages that may not come
        return None
    memory = mmap.mmap(fd, status.st_size)
    return memory if secrets.compare_digest(memory[:TOKEN_BYTES], token) else None
