"""The durable storage: stopped at any store, it recovers what was acknowledged."""

import json
import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from replay import mapped
from replay.folder import SYNC
from replay.local import LocalReplay, ReplayConfig
from replay.mapped import MappedStorage
from replay.spec import ReplayError
from replay.storage import WriterMark
from replay.table import Table
from tests.replay_durable_parts import Killed, fast_folder, kill, open_here
from tests.replay_parts import SPEC, make_rows

CAPACITY = 24


def table_on(storage: MappedStorage, *, capacity: int = CAPACITY) -> Table:
    return Table(
        capacity=capacity,
        spec=SPEC,
        priority_exponent=0.6,
        seed=0,
        max_times_sampled=3,
        storage=storage,
    )


class Sender:
    """A writer and what the world knows of its rows."""

    def __init__(self, writer: int) -> None:
        """Has sent nothing."""
        self.writer, self.epoch, self.sequence, self.rows = writer, 1, 0, 0

    def batch(self, count: int, number: int) -> tuple[np.ndarray, WriterMark]:
        rows = SPEC.as_bytes(make_rows(number, count, writer=self.writer))
        mark = WriterMark(
            writer=self.writer,
            epoch=self.epoch,
            next_sequence=self.sequence + 1,
            rows=self.rows + count,
            life=7,
        )
        return rows, mark


def draw(table: Table, count: int) -> None:
    table.draw(
        batch_size=count,
        ids=np.zeros(count, np.uint64),
        probabilities=np.zeros(count),
    )


class World:
    """Oracle: the batches in the order of their acknowledgement, through all lives."""

    def __init__(self, seed: int, folder: Path) -> None:
        """Nothing sent yet."""
        self.chance = random.Random(seed)
        self.folder = folder
        self.stored: list[np.ndarray] = []
        self.senders = [Sender(writer) for writer in (0, 5, 9)]
        self.pending: tuple[Sender, np.ndarray] | None = None
        self.samples = [0]
        self.pushed_out = 0

    def rows(self) -> np.ndarray:
        """All that was stored."""
        return np.concatenate([np.zeros((0, SPEC.row_bytes), np.uint8), *self.stored])

    def live(self, budget: int) -> None:
        """One life of the process, to its end after `budget` bytes of stores."""
        try:
            storage = open_here(
                self.folder, spec=SPEC, capacity=CAPACITY, budget=budget
            )
        except Killed:
            return
        self.check(storage)
        table = table_on(storage)
        try:
            for _ in range(40):
                self.act(table, storage)
                table.check_invariants()
        except Killed:
            pass
        kill(storage)

    def check(self, storage: MappedStorage) -> None:
        """What is recovered is what was acknowledged, and perhaps what was pending."""
        state = storage.state
        if self.pending is not None:
            sender, batch = self.pending
            self.pushed_out = max(
                self.pushed_out, len(self.rows()) + len(batch) - CAPACITY
            )
            if state.inserts > len(self.rows()):
                self.stored.append(batch)
                sender.sequence += 1
                sender.rows += len(batch)
        self.pending = None
        rows = self.rows()
        self.pushed_out = max(self.pushed_out, len(rows) - CAPACITY)
        assert (state.inserts, state.oldest) == (len(rows), self.pushed_out) or (
            state.oldest < self.pushed_out and state.inserts == len(rows)
        )
        slots = np.arange(state.oldest, state.inserts) % CAPACITY
        np.testing.assert_array_equal(storage.rows[slots], rows[state.oldest :])
        marks = {mark.writer: mark for mark in state.writers}
        for sender in self.senders:
            mark = marks.get(sender.writer)
            assert (mark.next_sequence if mark else 0) == sender.sequence
            assert (mark.rows if mark else 0) == sender.rows
        assert state.samples in self.samples
        self.samples = [state.samples]
        table_on(storage).check_invariants()

    def act(self, table: Table, storage: MappedStorage) -> None:
        """An insert, a draw or an update of priorities."""
        kind = self.chance.random()
        if kind < 0.6:
            sender = self.chance.choice(self.senders)
            batch, mark = sender.batch(self.chance.randint(1, 7), len(self.rows()))
            if not storage.admits(len(batch), inserts=table.inserts):
                storage.wait()
            self.pending = (sender, batch)
            table.insert(batch, mark)
            self.stored.append(batch)
            sender.sequence, sender.rows = mark.next_sequence, mark.rows
            self.pending = None
        elif kind < 0.8 and table.size > 4:
            self.samples.append(self.samples[0] + 4)
            draw(table, 4)
            storage.count_samples(self.samples[1])
            self.samples = self.samples[1:]
        elif table.size:
            ids = np.arange(table.inserts - table.size, table.inserts)
            table.update_priorities(ids, 2.0 + ids)


# Without shrinking: a world that fails takes minutes to be made smaller.
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


@settings(deadline=None, max_examples=30, phases=PHASES)
@given(seed=st.integers(0, 2**32), budgets=st.lists(st.integers(0, 4000), max_size=6))
def test_stopped_at_any_store_every_acknowledged_batch_is_there_once(
    seed: int, budgets: list[int]
) -> None:
    with fast_folder() as folder:
        world = World(seed, folder)
        for budget in [*budgets, 20_000]:
            world.live(budget)


@settings(deadline=None, max_examples=30, phases=PHASES)
@given(seed=st.integers(0, 2**32), before=st.integers(1, 60), after=st.integers(0, 60))
def test_a_power_loss_costs_what_came_after_the_last_snapshot(
    seed: int, before: int, after: int
) -> None:
    """Of what is stored after it, any pages may be on the disk and others not."""
    with fast_folder() as folder:
        lose_power(folder, random.Random(seed), before, after)


def lose_power(folder: Path, chance: random.Random, before: int, after: int) -> None:
    """So many batches before the snapshot, so many after it, then the power goes."""
    capacity = 256
    storage = open_here(folder, spec=SPEC, capacity=capacity)
    table, sender = table_on(storage, capacity=capacity), Sender(3)

    def insert(times: int) -> None:
        for _ in range(times):
            batch, mark = sender.batch(7, table.inserts)
            if not storage.admits(7, inserts=table.inserts):
                return
            table.insert(batch, mark)
            sender.sequence, sender.rows = mark.next_sequence, mark.rows

    for _ in range(before):
        insert(1)
        storage.wait()
    storage.ask_sync()
    storage.wait()
    durable = storage._syncer.durable
    disk = {name: bytes(file.map) for name, file in storage._files.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MappedStorage, "tend", lambda _: None)  # no other snapshot
        insert(after)
    now = {name: bytes(file.map) for name, file in storage._files.items()}
    kill(storage)
    for name, old in disk.items():
        if name != SYNC:
            pages = range(0, len(old), 4096)
            old = b"".join(
                chance.choice((old, now[name]))[page : page + 4096] for page in pages
            )
        (folder / name).write_bytes(old)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mapped, "boot_id", lambda: b"another".ljust(40, b"\0"))
        storage = open_here(folder, spec=SPEC, capacity=capacity)
    assert storage.power_lost
    state = storage.state
    assert state.inserts == durable.inserts
    assert [mark.rows for mark in state.writers] == [durable.inserts]
    assert state.oldest <= max(0, durable.inserts - capacity + capacity // 4 + 7)
    expected = SPEC.as_bytes(make_rows(0, durable.inserts, writer=3))
    slots = np.arange(state.oldest, state.inserts) % capacity
    np.testing.assert_array_equal(storage.rows[slots], expected[state.oldest :])
    table_on(storage, capacity=capacity).check_invariants()
    kill(storage)


CONFIG = ReplayConfig(
    capacity=100, min_size=10, samples_per_insert=2.0, tolerance=2.0, durable=True
)


def local(folder: Path, config: ReplayConfig = CONFIG) -> LocalReplay:
    return LocalReplay(spec=SPEC, config=config, seed=0, folder=folder)


def test_a_closed_replay_goes_on_where_it_was(tmp_path: Path) -> None:
    first = local(tmp_path)
    drawn: set[int] = set()
    for start in range(0, 180, 4):
        first.insert(make_rows(start, 4))
        while first.may_sample(8):
            sample = first.sample(8)
            first.update_priorities(sample.ids, sample.ids % 5 + 0.5)
            drawn |= set(sample.ids.tolist())
    kept = first.table.read(0, 1000)
    first.close()
    second = local(tmp_path)
    for before, after in zip(kept, second.table.read(0, 1000), strict=True):
        np.testing.assert_allclose(after, before, rtol=1e-12)
    assert (second.inserts, second.samples, second.size) == (180, first.samples, 100)
    assert second.table.deletes == first.table.deletes == 80
    second.insert(make_rows(180, 4))
    second.table.check_invariants()
    second.close()


def test_one_service_per_folder(tmp_path: Path) -> None:
    first = local(tmp_path)
    with pytest.raises(ReplayError, match="another replay service uses this folder"):
        local(tmp_path)
    first.close()
    local(tmp_path).close()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"capacity": 99}, "holds a replay of capacity 100, this run has 99"),
        ({"format": 1}, "replay format 1, this version reads 2"),
        ({"schema_hash": "00"}, "holds a replay of schema_hash 00"),
    ],
)
def test_another_replay_is_refused(
    tmp_path: Path, change: dict[str, int | str], why: str
) -> None:
    local(tmp_path).close()
    config = CONFIG
    if "capacity" in change:
        config = ReplayConfig(capacity=99, min_size=10, durable=True)
    else:
        meta = json.loads((tmp_path / "meta.json").read_text())
        (tmp_path / "meta.json").write_text(json.dumps(meta | change))
    with pytest.raises(ReplayError, match=why):
        local(tmp_path, config)


def test_damage_is_refused_in_one_line(tmp_path: Path) -> None:
    local(tmp_path).close()
    (tmp_path / "meta.json").write_text("[")
    with pytest.raises(ReplayError, match="replay format None"):
        local(tmp_path)
    (tmp_path / "meta.json").unlink()
    local(tmp_path).close()  # a folder that was not completed is begun anew
    with (tmp_path / "rows.bin").open("ab") as file:
        file.write(b"?")
    with pytest.raises(ReplayError, match="the file is damaged"):
        local(tmp_path)
    with (tmp_path / "rows.bin").open("r+b") as file:
        file.truncate(100 * SPEC.row_bytes)
    with (tmp_path / "state.bin").open("r+b") as file:
        file.seek(512)
        file.write(b"?" * 1024)
    with pytest.raises(ReplayError, match="no whole commit"):
        local(tmp_path)


def test_no_place_for_a_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ReplayError, match="cannot keep the replay here"):
        local(tmp_path / "file")
    with pytest.raises(ReplayError, match="needs a folder"):
        LocalReplay(spec=SPEC, config=CONFIG, seed=0)


def test_a_disk_that_fails_stops_inserts_until_it_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay = local(tmp_path)
    storage = replay.durable
    assert storage is not None
    replay.insert(make_rows(0, 4))

    def refuse(*_: object) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr("replay.syncing.write_snapshot", refuse)
        storage.ask_sync()
        storage.wait()
    assert "cannot write to the disk (Input/output error)" in replay.fault
    with pytest.raises(ReplayError, match="inserts go on when it works"):
        replay.insert(make_rows(4, 4))
    storage._due = 0.0
    storage.tend()
    storage.wait()
    assert replay.fault == ""
    replay.insert(make_rows(4, 4))
    assert replay.table.read(0, 10)[0].tolist() == list(range(8))
    replay.close()
