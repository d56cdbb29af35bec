"""What the C library's allocator is told, where it is glibc's."""

import ctypes
from typing import Final

# glibc's <malloc.h>.
TRIM_THRESHOLD: Final = -1
MMAP_THRESHOLD: Final = -3
ARENA_MAX: Final = -8


def tell_malloc(option: int, value: int) -> bool:
    """Sets an option of this process's allocator; False where it has no such thing."""
    try:
        return bool(ctypes.CDLL(None).mallopt(option, value))
    except (AttributeError, OSError):  # another C library
        return False
