"""The peer Reverb in `slipstream bench replay`: its service, a writer, a reader.

Run by another Python, which has dm-reverb; of Slipstream it imports nothing but
`bench_replay_lines`, of the standard library. One reasonable setting, not a search for
Reverb's best:

    writing   TrajectoryWriter, chunks of one item, at most three batches unconfirmed
    reading   TrajectoryDataset, batched and prefetched by tf.data, as NumPy arrays
    updating  Client.mutate_priorities once per batch
"""

import importlib
from typing import Any

import numpy as np

from launch.bench_replay_lines import Counts, Line, request

TABLE = "replay"


def main() -> None:
    """One of the three processes."""
    wanted = request()
    {"service": service, "writers": writers, "reader": reader}[wanted["role"]](wanted)


def service(wanted: dict[str, Any]) -> None:
    """A table with the workload's limiter, in Reverb's C++ server."""
    reverb: Any = importlib.import_module("reverb")
    load = wanted["workload"]
    error = load["tolerance"] * load["samples_per_insert"] * load["min_size"]
    table = reverb.Table(
        name=TABLE,
        sampler=reverb.selectors.Prioritized(load["exponent"]),
        remover=reverb.selectors.Fifo(),
        max_size=load["capacity"],
        rate_limiter=reverb.rate_limiters.SampleToInsertRatio(
            samples_per_insert=load["samples_per_insert"],
            min_size_to_sample=load["min_size"],
            error_buffer=error,
        ),
    )
    server = reverb.Server(tables=[table], port=wanted["ports"][0])
    line = Line(lambda: {"rows": table.info.current_size})
    line.ready()
    line.ended.wait()
    server.stop()


def writers(wanted: dict[str, Any]) -> None:
    """Appends items as fast as it is let."""
    reverb: Any = importlib.import_module("reverb")
    load = wanted["workload"]
    client = reverb.Client(f"localhost:{wanted['ports'][0]}")
    items = np.random.default_rng(0).integers(
        0, 255, (load["insert_rows"], load["row_bytes"]), np.uint8
    )
    counts = Counts()
    line = Line(counts.all)
    line.ready()
    with client.trajectory_writer(num_keep_alive_refs=1) as out:
        while not line.ended.is_set():
            for item in items:
                out.append({"x": item})
                out.create_item(
                    TABLE, priority=1.0, trajectory={"x": out.history["x"][-1]}
                )
            # At most so many unconfirmed, as many as our writer's window has.
            out.flush(block_until_num_items=3 * load["insert_rows"])
            counts.add(len(items))


def reader(wanted: dict[str, Any]) -> None:
    """Samples batches, reads every byte and sets every priority."""
    reverb: Any = importlib.import_module("reverb")
    tensorflow: Any = importlib.import_module("tensorflow")
    load = wanted["workload"]
    address = f"localhost:{wanted['ports'][0]}"
    client = reverb.Client(address)
    batch = load["batch_size"]
    ahead = load["in_flight"] * load["batches_per_reply"] * batch
    dataset = reverb.TrajectoryDataset(
        server_address=address,
        table=TABLE,
        dtypes={"x": tensorflow.uint8},
        shapes={"x": tensorflow.TensorShape([load["row_bytes"]])},
        max_in_flight_samples_per_worker=ahead,
        num_workers_per_iterator=1,
    )
    samples = dataset.batch(batch, drop_remainder=True).prefetch(2)
    random = np.random.default_rng(0)
    counts = Counts()
    line = Line(counts.all)
    started = False
    for sample in samples.as_numpy_iterator():
        sample.data["x"].view(np.uint64).sum()
        new = random.random(batch)
        keys = sample.info.key
        client.mutate_priorities(TABLE, updates=dict(zip(keys, new, strict=True)))
        counts.add(batch)
        if not started:
            line.ready()
            started = True
        if line.ended.is_set():
            return


if __name__ == "__main__":
    main()
