"""`slipstream replay export`: a replay as an HDF5 file in D4RL's layout.

The layout that offline-RL libraries load (`d4rl.qlearning_dataset`, CORL, d3rlpy):

    observations       float32 [N, D]   s_tm1, rendered and flattened
    next_observations  float32 [N, D]   s_t
    actions            int32   [N]      a_tm1, index into the action grid
    rewards            float32 [N]      r_t
    terminals          bool    [N]      s_t is terminal (discount 0)
    timeouts           bool    [N]      s_t is the last recorded step of its scene
    infos/NAME         [N, ...]         the row's own fields: scene, step, ...
    infos/id           uint64  [N]      order of insertion; shard x 2^48 + its own order

Rows of several actors and environments lie mixed, in the order in which they were
inserted, one shard of the replay after the other, so s_t is given and not to be taken
from the next row.

Rows hold states. Observations are rendered from them and the run's scenes by the
function that the actor acted on (`actors.rows.render`), so D and the meaning of each
number are those of the run's configuration. The file's attributes say all that is
needed to do it again:

    config            JSON, the run's configuration
    observation       JSON, [name, first column, shape] of each part, in the order of
                      `sim.observation.Observation`; units are described there
    bank_sha256       the scenes' hash
    format, rows

Minari's layout was rejected: it needs whole episodes, which a replay that has pushed
rows out does not have. Parquet was too: none of those libraries reads it.
"""

import dataclasses
import functools
import json
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import jax
import msgspec
import numpy as np

from actors.rows import Columns, columns_of, render
from launch.config import row_spec_of
from launch.errors import LaunchError
from launch.join import JoinConfig, Joined, joined, train_bank
from launch.replay_stats import place_of
from replay.client import fetch_rows
from replay.keys import RunKeys
from replay.shards import global_ids
from replay.shards_tools import shards_to_ask
from replay.spec import RowSpec, Sample
from sim.bank import Bank
from sim.observation import Observation, ObservationConfig

FORMAT: Final = "D4RL"
_PAGE: Final = 1024  # rows rendered at once, always as many: compiled once

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Writes the rows of a run's replay to an HDF5 file that offline-RL users read."""

    out: Path
    """The file, e.g. replay.hdf5."""
    run: Path | None = None
    """The folder of a run in progress on this machine; it knows the rest."""
    run_id: str = ""
    """The run's name in its Zenoh keys, where its folder is elsewhere."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, e.g. tcp/127.0.0.1:7447."""
    insecure: bool = False
    """Allows addresses other than loopback; nothing is encrypted."""
    observations: bool = True
    """Render the observations; without, only the rows as they are stored."""


def flat(observation: Observation) -> np.ndarray:
    """Parts one after the other, [batch, D] float32; masks as 0 and 1."""
    parts = [np.asarray(part, np.float32) for part in observation]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def layout_of(observation: Observation) -> list[tuple[str, int, list[int]]]:
    """(name, first column, shape) of each part."""
    found, column = [], 0
    for name, part in observation._asdict().items():
        shape = list(part.shape[1:])
        found.append((name, column, shape))
        column += int(np.prod(shape))
    return found


def rendering(bank: Bank, config: ObservationConfig) -> Callable[[np.ndarray], Any]:
    """Rows of any number to (s_tm1, s_t), by a program for `_PAGE` rows."""
    compiled = jax.jit(functools.partial(render, config=config))

    def run(rows: np.ndarray) -> tuple[Observation, Observation]:
        full = np.resize(rows, _PAGE)  # repeats what is there
        columns: Columns = columns_of(full)
        before, after = jax.device_get(compiled(bank, columns))
        cut = len(rows)
        return (
            Observation(*(part[:cut] for part in before)),
            Observation(*(part[:cut] for part in after)),
        )

    return run


def stored(sample: Sample, last_steps: np.ndarray) -> Arrays:
    """The datasets that need no rendering."""
    rows = sample.rows
    terminals = rows["discount"] == 0.0
    names = [name for name in (rows.dtype.names or ()) if name]
    return {
        "actions": rows["action"],
        "rewards": rows["reward"],
        "terminals": terminals,
        "timeouts": (rows["step"] >= last_steps[rows["scene"]]) & ~terminals,
        "infos/id": sample.ids,
        **{f"infos/{name}": rows[name] for name in names},
    }


def append(file: Any, arrays: Arrays) -> None:  # noqa: ANN401 (h5py has no types)
    """Adds rows to every dataset; makes those that are not there."""
    for name, values in arrays.items():
        if name not in file:
            file.create_dataset(
                name,
                shape=(0, *values.shape[1:]),
                maxshape=(None, *values.shape[1:]),
                dtype=values.dtype,
                chunks=(_PAGE, *values.shape[1:]),
                compression="gzip",
                compression_opts=1,
            )
        dataset = file[name]
        start = len(dataset)
        dataset.resize(start + len(values), axis=0)
        dataset[start:] = values


def write(file: Any, pages: Iterator[Sample], place: Joined, observe: bool) -> int:  # noqa: ANN401
    """Writes all pages; the number of rows."""
    opened, config = train_bank(place), place.run.config
    bank, count = opened.bank, 0
    last_steps = np.asarray(bank.steps) - 1
    run = rendering(bank, config.environment.observation) if observe else None
    for page in pages:
        arrays = stored(page, last_steps)
        if run is not None:
            before, after = run(page.rows)
            arrays |= {"observations": flat(before), "next_observations": flat(after)}
            file.attrs["observation"] = json.dumps(layout_of(before))
        append(file, arrays)
        count += len(page.ids)
    file.attrs["format"] = FORMAT
    file.attrs["rows"] = count
    file.attrs["config"] = msgspec.json.encode(config).decode()
    file.attrs["bank_sha256"] = opened.content_hash
    return count


def all_pages(place: Joined, spec: RowSpec) -> Iterator[Sample]:
    """Every row of every shard that is up, under its id in the run."""
    for shard in shards_to_ask(place.session, place.keys):
        for page in fetch_rows(
            session=place.session,
            keys=RunKeys(place.keys.run_id, shard),
            spec=spec,
            page_rows=_PAGE,
        ):
            yield dataclasses.replace(page, ids=global_ids(page.ids, shard))


def export_command(options: ExportConfig) -> int:
    """`slipstream replay export`; the exit code."""
    try:
        import h5py
    except ImportError:
        raise LaunchError(
            "replay export needs h5py: pip install 'slipstream[export]'"
        ) from None
    run_id, connect = place_of(options.run, options.run_id, options.connect)
    join = JoinConfig(
        run_id=run_id, connect=connect, insecure=options.insecure, run=options.run
    )
    partial = options.out.with_name(f".{options.out.name}.partial")
    with joined(join, threading.Event()) as place:
        spec = row_spec_of(place.run)
        pages = all_pages(place, spec)
        try:
            with h5py.File(partial, "w") as file:
                count = write(file, pages, place, options.observations)
            if count == 0:
                raise LaunchError(f"run {run_id}: its replay holds no rows yet")
            os.replace(partial, options.out)
        finally:
            partial.unlink(missing_ok=True)
    print(f"{options.out}: {count} transitions")
    return 0
