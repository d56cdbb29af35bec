"""One measurement of `slipstream bench replay`: real processes, looked at twice.

A service per shard, writers in one process, a reader in another. They start, the
tables fill up (a ring that is not full yet pushes nothing out), and then a window of
time is measured between two looks at their counters and at the kernel's account of
their CPU time. Nothing of the start is in a figure.

The processes end when their standard input does, so none outlives the bench.
"""

import dataclasses
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, final

import psutil

from launch.bench_child import ONE_THREAD
from launch.errors import LaunchError
from launch.join import free_port

Name = Literal["slipstream", "torchrl", "reverb"]
START_S: Final = 90.0  # for a process to say that it works
FILL_S: Final = 120.0  # for a table to be full
LOOK_S: Final = 0.1  # between two looks while it fills
END_S: Final = 3.0  # for a process to end when asked
OURS: Final = "launch.bench_replay_roles"


@dataclass(frozen=True, kw_only=True)
class Workload:
    """What is inserted and sampled, and how."""

    row_bytes: int = 8192
    batch_size: int = 64
    insert_rows: int = 64  # per message
    samples_per_insert: float = 8.0
    min_size: int = 2_000
    tolerance: float = 0.1  # of samples_per_insert * min_size
    capacity: int = 20_000
    exponent: float = 0.6
    durable: bool = False
    batches_per_reply: int = 16
    in_flight: int = 2  # replies
    history: int = 0  # above 0: the project's own rows, of the bank named here
    bank: str = ""


@dataclass(frozen=True, kw_only=True)
class Contestant:
    """A replay, and how its processes reach it."""

    name: Name
    shared_memory: bool = False
    python: str = sys.executable

    @property
    def label(self) -> str:
        """For tables."""
        return f"{self.name}, {'shared memory' if self.shared_memory else 'TCP'}"


@dataclass(frozen=True, kw_only=True)
class Crew:
    """Which processes there are."""

    shards: int = 1
    writers: int = 1
    reader: bool = True
    render: str = ""  # the preset whose observations the reader renders
    one_core: bool = False  # the reader alone on the last core, all else on the others


@final
class Child:
    """A process that answers by lines; see `launch.bench_replay_lines`."""

    def __init__(
        self, *, kind: str, command: Sequence[str], folder: Path, quiet: bool
    ) -> None:
        """Starts it; its words go to a log in `folder`. `quiet`: one thread each."""
        self.kind = kind
        self._log = folder / f"{kind}.log"
        environment = {
            **os.environ,
            "PYTHONPATH": _root(),
            "JAX_PLATFORMS": "cpu",
            "TF_CPP_MIN_LOG_LEVEL": "3",
        }
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env={**environment, **(ONE_THREAD if quiet else {})},
                start_new_session=True,  # Ctrl-C is the bench's to handle
            )
        self._account = psutil.Process(self._process.pid)

    def wait_ready(self) -> None:
        """Until it works."""
        self._answer(START_S)

    def look(self) -> dict[str, float]:
        """Its counters, the time, its CPU time and memory."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self._fail("ended early")
        told = self._answer(START_S)
        spent = self._account.cpu_times()
        told["cpu_s"] = spent.user + spent.system
        told["resident_bytes"] = self._account.memory_info().rss
        return told

    def own_bytes(self) -> int:
        """Pages that no other process has, anonymous or of its files."""
        return int(self._account.memory_full_info().uss)

    def _answer(self, patience_s: float) -> dict[str, float]:
        out = self._process.stdout
        assert out is not None
        if not select.select([out], [], [], patience_s)[0]:
            self._fail(f"said nothing for {patience_s:g} s")
        line = out.readline()
        if not line:
            self._fail("ended early")
        told: dict[str, float] = json.loads(line)
        return told

    def _fail(self, what: str) -> None:
        words = self._log.read_text(errors="replace").strip().splitlines()
        last = words[-1] if words else "it left no word"
        raise LaunchError(f"bench replay: the process {self.kind} {what}: {last}")

    def ask_to_end(self) -> None:
        """Its standard input ends."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            pass

    def end(self) -> None:
        """Waits a little for it to end by itself, which frees its shared memory."""
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


def _root() -> str:
    """Where the project's packages lie."""
    return str(Path(__file__).resolve().parent.parent)


@final
class Crewed:
    """All processes of a measurement; use as a context."""

    def __init__(self, contestant: Contestant, workload: Workload, crew: Crew) -> None:
        """Nothing is started yet."""
        self._contestant = contestant
        self._workload = workload
        self._crew = crew
        self._stack = ExitStack()
        self._children: list[Child] = []

    def __enter__(self) -> "Crewed":
        """Starts everything and waits until all of it works."""
        name = self._stack.enter_context(
            tempfile.TemporaryDirectory(prefix="slipstream-bench-")
        )
        self._stack.callback(self._end)
        try:
            self._start(Path(name))
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Ends all processes and removes their files."""
        self._stack.close()

    def _start(self, folder: Path) -> None:
        crew = self._crew
        ports = [free_port() for _ in range(crew.shards)]
        for shard, port in enumerate(ports):
            self._add("service", folder, shard=shard, ports=[port])
        for child in self._children:
            child.wait_ready()
        others = [self._add("writers", folder, ports=ports)]
        if crew.reader:
            others.append(self._add("reader", folder, ports=ports))
        for child in others:
            child.wait_ready()

    def _add(self, kind: str, folder: Path, **more: Any) -> Child:  # noqa: ANN401
        crew, contestant = self._crew, self._contestant
        label = f"{kind}-{more['shard']}" if "shard" in more else kind
        request = {
            "role": kind,
            "workload": dataclasses.asdict(self._workload),
            "peer": contestant.name,
            "shared_memory": contestant.shared_memory,
            "writers": crew.writers,
            "render": crew.render if kind == "reader" else "",
            "cores": self._cores(kind),
            "folder": str(folder / label),
            **more,
        }
        module = OURS
        if contestant.name == "reverb":
            module = "launch.bench_replay_reverb"
        command = [contestant.python, "-m", module, json.dumps(request)]
        child = Child(
            kind=label,
            command=command,
            folder=folder,
            quiet=crew.one_core and kind == "reader",
        )
        self._children.append(child)
        return child

    def _cores(self, kind: str) -> list[int]:
        """The cores that a process may use; all where nobody is to be alone."""
        cores = sorted(os.sched_getaffinity(0))
        if not self._crew.one_core or len(cores) == 1:
            return cores
        return cores[-1:] if kind == "reader" else cores[:-1]

    def _end(self) -> None:
        for child in self._children:
            child.ask_to_end()
        for child in self._children:
            child.end()

    def look(self) -> dict[str, dict[str, float]]:
        """Every process's counters."""
        return {child.kind: child.look() for child in self._children}

    def own_bytes(self, kind: str) -> int:
        """Memory that one process has to itself."""
        (only,) = (child for child in self._children if child.kind == kind)
        return only.own_bytes()

    def fill(self, rows: int) -> None:
        """Until so many rows were inserted."""
        (writers,) = (child for child in self._children if child.kind == "writers")
        deadline = time.monotonic() + FILL_S
        while writers.look()["rows"] < rows:
            if time.monotonic() > deadline:
                raise LaunchError(
                    f"bench replay: {self._contestant.label} took no {rows} rows "
                    f"within {FILL_S:g} s; is this machine busy with something else?"
                )
            time.sleep(LOOK_S)


def measure(
    contestant: Contestant,
    workload: Workload,
    crew: Crew = Crew(),
    *,
    seconds: float,
) -> dict[str, Any]:
    """Rates and CPU time over `seconds`, from a full table on."""
    with Crewed(contestant, workload, crew) as crewed:
        crewed.fill(workload.capacity * crew.shards)
        first = crewed.look()
        time.sleep(seconds)
        last = crewed.look()
    return {
        "contestant": contestant.name,
        "shared_memory": contestant.shared_memory,
        "shards": crew.shards,
        "writers": crew.writers,
        "batches_per_reply": workload.batches_per_reply,
        "load_average": os.getloadavg()[0],
        **figures(first, last),
    }


def figures(
    first: Mapping[str, Mapping[str, float]], last: Mapping[str, Mapping[str, float]]
) -> dict[str, Any]:
    """What happened between two looks."""

    def rate(kind: str, name: str) -> float:
        one, other = first[kind], last[kind]
        return (other[name] - one[name]) / (other["at"] - one["at"])

    samples, inserts = rate("reader", "rows"), rate("writers", "rows")
    if samples <= 0 or inserts <= 0:
        raise LaunchError("bench replay: nothing happened while it was measured")
    cores: dict[str, float] = {}
    for process in first:
        kind = process.split("-")[0]
        cores[kind] = cores.get(kind, 0.0) + rate(process, "cpu_s")
    return {
        "seconds": last["reader"]["at"] - first["reader"]["at"],
        "samples_per_s": samples,
        "inserts_per_s": inserts,
        "samples_per_insert": samples / inserts,
        "sample_queries_per_s": rate("reader", "queries"),
        "insert_queries_per_s": rate("writers", "queries"),
        "cores": cores,
        "cpu_us_per_sample": sum(cores.values()) / samples * 1e6,
        "cpu_us_per_sample_by": {
            kind: spent / samples * 1e6 for kind, spent in cores.items()
        },
        "resident_bytes": {
            process: told["resident_bytes"] for process, told in last.items()
        },
    }
