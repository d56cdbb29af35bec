"""The processes of `slipstream bench replay`: service, writers, reader.

`python -m launch.bench_replay_roles REQUEST`: ours, and torchrl's buffer behind the
same wire (`launch.bench_replay_torchrl`). Every reader reads every byte that it is
given, and sets the priority of every row. Rows are noise, which nothing compresses, or
transitions of a bank, which can be rendered.

Several writers share a process, each with a thread and a number of its own: a hundred
processes would measure the scheduler of a small machine. Several shards are dealt out
as in a run: writer i writes to shard i modulo their number, a reader draws from all in
turn, and there is a session for each.
"""

import itertools
import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from launch.bench_replay_lines import Counts, Line, request
from replay.client import Sampler, Writer
from replay.keys import RunKeys
from replay.local import ReplayConfig
from replay.session import open_session
from replay.spec import Field, RowSpec

Request = dict[str, Any]
RUN: Final = "bench"
WAIT_S: Final = 0.5  # between two looks at the end
PATIENCE_S: Final = 60.0  # for a sample: the table has to fill first
ROUNDS: Final = 16  # different batches of a writer


def spec_of(load: Request) -> RowSpec:
    """Rows of noise, or the project's own with so many steps of history."""
    if load["history"]:
        from actors.rows import row_spec

        return row_spec(load["history"])
    return RowSpec((Field("noise", "u8", (load["row_bytes"] // 8,)),))


def config_of(load: Request) -> ReplayConfig:
    """The service's settings."""
    return ReplayConfig(
        capacity=load["capacity"],
        min_size=load["min_size"],
        samples_per_insert=load["samples_per_insert"],
        tolerance=load["tolerance"],
        priority_exponent=load["exponent"],
        durable=load["durable"],
    )


def service(wanted: Request) -> None:
    """Our table, or torchrl's, behind our wire."""
    from replay.server import ReplayServer

    load = wanted["workload"]
    spec = spec_of(load)
    with open_session(
        listen=[f"tcp/127.0.0.1:{wanted['ports'][0]}"],
        router=True,
        shared_memory=wanted["shared_memory"],
    ) as session:
        server = ReplayServer(
            session=session,
            keys=RunKeys(RUN),
            spec=spec,
            config=config_of(load),
            folder=Path(wanted["folder"]),
        )
        if wanted["peer"] == "torchrl":
            _put_peer(server, load, spec)
        counts = Counts()
        line = Line(counts.all)

        def tell() -> None:
            if server.wait_ready(PATIENCE_S):
                line.ready()

        threading.Thread(target=tell, daemon=True).start()
        server.run(line.ended)


def _put_peer(server: Any, load: Request, spec: RowSpec) -> None:  # noqa: ANN401
    """Puts torchrl's buffer into the place of the service's table."""
    from launch.bench_replay_torchrl import TorchrlTable
    from replay.table import Table

    # The service has no seam here and needs none but for this comparison.
    server._replay.table = cast(
        Table,
        TorchrlTable(
            capacity=load["capacity"],
            row_bytes=spec.row_bytes,
            exponent=load["exponent"],
        ),
    )


def writers(wanted: Request) -> None:
    """As many writers as asked for, each with a thread that appends."""
    load = wanted["workload"]
    spec = spec_of(load)
    rows = _rows(load, spec)
    counts = [Counts() for _ in range(wanted["writers"])]
    sinks: list[Writer] = []
    line = Line(lambda: {**_sum(counts), "stored": sum(s.acknowledged for s in sinks)})
    with ExitStack() as stack:
        sessions = _sessions(wanted, stack)
        sinks += [
            _writer(sessions[number % len(sessions)], spec, load, number)
            for number in range(wanted["writers"])
        ]
        threads = [
            threading.Thread(target=_write, args=(sink, rows, count, line.ended))
            for sink, count in zip(sinks, counts, strict=True)
        ]
        for thread in threads:
            thread.start()
        line.ready()
        for thread in threads:
            thread.join()


def _sum(counts: list[Counts]) -> dict[str, float]:
    return {
        "rows": sum(count.rows for count in counts),
        "queries": sum(count.queries for count in counts),
    }


def _sessions(wanted: Request, stack: ExitStack) -> list[Any]:
    """One for each shard."""
    return [
        stack.enter_context(
            open_session(
                connect=[f"tcp/127.0.0.1:{port}"],
                shared_memory=wanted["shared_memory"],
            )
        )
        for port in wanted["ports"]
    ]


def _rows(load: Request, spec: RowSpec) -> np.ndarray:
    """What a writer sends, over and over: `ROUNDS` batches."""
    count = ROUNDS * load["insert_rows"]
    if load["bank"]:
        from launch.bench_replay_rows import bank_rows

        return bank_rows(Path(load["bank"]), spec, count)
    random = np.random.default_rng(0)
    noise = random.integers(0, 255, count * spec.row_bytes, np.uint8)
    return noise.view(spec.dtype)


def _writer(session: Any, spec: RowSpec, load: Request, number: int) -> Writer:  # noqa: ANN401
    return Writer(
        session=session,
        keys=RunKeys(RUN),
        spec=spec,
        writer=number,
        epoch=1,
        batch_rows=load["insert_rows"],
    )


def _write(
    writer: Writer, rows: np.ndarray, counts: Counts, ended: threading.Event
) -> None:
    size = len(rows) // ROUNDS
    for start in itertools.cycle(range(0, len(rows), size)):
        # What did not fit is whole and offered again: a batch is one append.
        taken = writer.append(rows[start : start + size], WAIT_S)
        while not taken and not ended.is_set():
            taken = writer.append(rows[:0], WAIT_S)
        if ended.is_set():
            return
        counts.add(size)


def reader(wanted: Request) -> None:
    """Samples, reads every byte (or renders) and sets every priority."""
    load = wanted["workload"]
    spec = spec_of(load)
    counts = Counts()
    line = Line(counts.all)
    use = _use(wanted)
    random = np.random.default_rng(0)
    share = 1.0 / load["batches_per_reply"]
    with ExitStack() as stack:
        samplers = [
            Sampler(
                session=session,
                keys=RunKeys(RUN),
                spec=spec,
                batch_size=load["batch_size"],
                batches_per_reply=load["batches_per_reply"],
                in_flight=load["in_flight"],
            )
            for session in _sessions(wanted, stack)
        ]
        while not line.ended.is_set():
            for sampler in samplers:
                sample = sampler.sample(PATIENCE_S)
                use(sample.rows)
                new = random.random(len(sample.ids))
                sampler.update_priorities(sample.ids, new)
                first = counts.rows == 0
                counts.add(len(sample.ids), share)
                if first:
                    line.ready()


def _use(wanted: Request) -> Callable[[np.ndarray], object]:
    """What is done with a batch."""
    if not wanted["render"]:
        return lambda rows: int(rows.view(np.uint64).sum())
    from launch.bench_replay_rows import renderer

    load = wanted["workload"]
    return renderer(Path(load["bank"]), wanted["render"], rows=load["batch_size"])


def main() -> None:
    """One process."""
    wanted = request()
    os.sched_setaffinity(0, wanted["cores"])
    {"service": service, "writers": writers, "reader": reader}[wanted["role"]](wanted)


if __name__ == "__main__":
    main()
