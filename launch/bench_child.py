"""Measures sections of `slipstream bench sim` in a process of its own.

XLA reads its thread settings once and a process's memory only ever grows, so what has
to be measured on one core, or from a cold start, needs a fresh process. The request is
JSON on the command line; every result is one line of JSON on standard output, which
nothing else may write to; words for a person go to standard error.

`one_core` binds the process to one core before anything starts threads.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from launch.errors import INTERRUPTED

ONE_THREAD: Final = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
PATIENCE_S: Final = 10.0  # for a child that was interrupted
# Whatever else JAX finds.
CPU_ONLY: Final = frozenset({"steps", "scale", "bank", "rendering"})


def run(
    section: str, request: Mapping[str, Any], *, one_core: bool = False
) -> Iterator[Any]:
    """Yields a section's results as they come from a process of its own.

    Ctrl-C reaches both processes; the child is ended however this is left.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    if one_core:
        environment |= ONE_THREAD
    if section in CPU_ONLY:
        environment["JAX_PLATFORMS"] = "cpu"
    text = json.dumps({**request, "section": section, "one_core": one_core})
    command = [sys.executable, "-m", "launch.bench_child", text]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment
    ) as child:
        try:
            assert child.stdout is not None
            for line in child.stdout:
                yield json.loads(line)
            code = child.wait()
        finally:
            _end(child)
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise RuntimeError(f"bench sim: section {section} ended with code {code}")


def _end(child: "subprocess.Popen[str]") -> None:
    """Interrupts a child that still runs: it removes its files, or is killed."""
    if child.poll() is not None:
        return
    child.send_signal(signal.SIGINT)
    try:
        child.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        child.kill()


def main() -> int:
    """Runs the one section that was asked for."""
    request = json.loads(sys.argv[1])
    results = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever prints must not end up among the results
    if request["one_core"]:
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    # An end that leaves no files behind, however it is asked for.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from launch.bench_sections import SECTIONS

        with tempfile.TemporaryDirectory(prefix="slipstream-bench-") as folder:
            for result in SECTIONS[request["section"]](request, Path(folder)):
                print(json.dumps(result), file=results, flush=True)
    except (KeyboardInterrupt, BrokenPipeError):
        return INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
