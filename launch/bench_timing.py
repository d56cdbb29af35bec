"""Times small and large calls alike, and measures what the machine can do.

A figure is the median and the least of several samples; a sample is the mean of a loop
that lasts at least `SAMPLE_S`, so that the clock's own cost vanishes. The caller has
compiled what it calls and waits for the result within it. The least is what the
machine can do when nobody disturbs; the median is what it did.
"""

import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

SAMPLE_S: Final = 2e-3
TURN: Final = 5  # samples of the shorter call before and after one of the longer
MATRIX: Final = 1024  # rows and columns of the matrix product
COPIED: Final = 1 << 26  # bytes of the memory copy: beyond most caches


@dataclass(frozen=True)
class Timing:
    """How long one call took."""

    median_ms: float
    least_ms: float
    calls: int  # all that were made while measuring

    def json(self) -> dict[str, Any]:
        """For the report."""
        return asdict(self)


def timed(call: Callable[[], Any], *, seconds: float) -> Timing:
    """Times a call for about `seconds`; at least once, however long it takes.

    The first call warms caches up and does not count, unless it alone takes longer
    than that.
    """
    first = _lasted(call, 1)
    if first > seconds:
        return Timing(first * 1e3, first * 1e3, 1)
    loop = max(1, round(SAMPLE_S / max(_lasted(call, 1), 1e-9)))
    samples = [_lasted(call, loop)]
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(samples) < 3:
        samples.append(_lasted(call, loop))
    return _timing(samples, loop)


def _timing(samples: list[float], loop: int) -> Timing:
    return Timing(
        statistics.median(samples) * 1e3, min(samples) * 1e3, loop * len(samples)
    )


def side_by_side(
    one: Callable[[], Any], other: Callable[[], Any], *, seconds: float
) -> tuple[Timing, Timing]:
    """Times two calls in turns, so that what else the machine does hits both alike.

    Each turn gives the first call, thought of as the shorter one, several samples
    before and after one of the other. At least one turn, however long it takes.
    """
    _lasted(one, 1)
    loop = max(1, round(SAMPLE_S / max(_lasted(one, 1), 1e-9)))
    ours: list[float] = []
    theirs: list[float] = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or not theirs:
        ours += [_lasted(one, loop) for _ in range(TURN)]
        theirs.append(_lasted(other, 1))
        ours += [_lasted(one, loop) for _ in range(TURN)]
    return _timing(ours, loop), _timing(theirs, 1)


def _lasted(call: Callable[[], Any], times: int) -> float:
    """Seconds per call of a loop."""
    begin = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begin) / times


def matrix_product_gflops(*, seconds: float, size: int = MATRIX) -> float:
    """Best rate of float32 matrix products on the cores that this process may use."""
    rng = np.random.default_rng(0)
    one, other = rng.random((2, size, size), np.float32)
    out = np.empty_like(one)
    best = timed(lambda: np.matmul(one, other, out=out), seconds=seconds)
    return 2 * size**3 / (best.least_ms * 1e6)


def memory_copy_gb_s(*, seconds: float, size: int = COPIED) -> float:
    """Best rate at which one thread copies bytes (read and written count once)."""
    source, target = np.ones((2, size), np.uint8)
    best = timed(lambda: np.copyto(target, source), seconds=seconds)
    return size / (best.least_ms * 1e6)


def processor_name(path: Path = Path("/proc/cpuinfo")) -> str:
    """The model's name as the kernel has it; the architecture elsewhere."""
    try:
        lines = path.read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or platform.machine()


def yardsticks(*, seconds: float) -> dict[str, Any]:
    """The machine that a run's figures are ratios against."""
    import jax

    return {
        "matrix_product_gflops": matrix_product_gflops(seconds=seconds),
        "memory_copy_gb_s": memory_copy_gb_s(seconds=seconds),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "devices": [f"{device.platform} {device.id}" for device in jax.devices()],
    }
