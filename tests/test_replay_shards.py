"""Shards in one process, over real sessions: who is there, who draws and writes."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from replay.client import Writer, fetch_rows, fetch_stats
from replay.control import encode
from replay.keys import RunKeys
from replay.local import ReplayConfig
from replay.shards import (
    Announcement,
    ShardClaim,
    check_announcement,
    global_ids,
    home_of,
    live_shards,
    reachable,
    split_ids,
)
from replay.shards_sampler import ShardedSampler, rounded, shares_of
from replay.shards_tools import fetch_all_stats, total
from replay.shards_writer import ShardedWriter
from replay.spec import ReplayError
from replay.wire import WireError
from tests.replay_parts import KEYS, SPEC, eventually, make_rows
from tests.replay_shard_parts import (
    ENDLESS,
    Shard,
    directory_of,
    fill,
    shard_of,
    shards_of,
)

INSERTS = ReplayConfig(
    capacity=1 << 14,
    min_size=1 << 14,
    samples_per_insert=1.0,
    tolerance=1.0,
    sampler="uniform",
)


@given(
    st.lists(st.tuples(st.floats(0, 1e6), st.floats(0, 1)), min_size=1, max_size=5),
    st.integers(1, 300),
    st.floats(0, 1, exclude_max=True),
)
def test_shares_follow_masses_up_to_the_limits(
    shards: list[tuple[float, float]], batch: int, offset: float
) -> None:
    masses = np.array([mass if mass > 1e-6 else 0.0 for mass, _ in shards])
    limits = np.array([limit for _, limit in shards])
    limits[0] = max(limits[0], 1 - limits[1:].sum())
    shares = shares_of(masses, limits)
    assert abs(shares.sum() - 1) < 1e-9
    assert (shares >= 0).all() and (shares <= limits + 1e-9).all()
    free = (shares < limits - 1e-9) & (masses > 0)
    if free.sum() > 1:  # those below their limits stand to each other as their masses
        ratios = shares[free] / masses[free]
        np.testing.assert_allclose(ratios, ratios[0], rtol=1e-6)
    rows = np.ceil(shares * batch + 1e-6).astype(np.int64)
    counts = rounded(shares, batch, rows, offset)
    assert counts.sum() == batch and (counts >= 0).all() and (counts <= rows).all()
    assert (np.abs(counts - shares * batch) <= 1 + 1e-6).all()


def test_rounding_is_right_on_average() -> None:
    shares, rows = np.array([0.013, 0.5, 0.487]), np.full(3, 64)
    offsets = (np.arange(10_000) + 0.5) / 10_000
    counts = [rounded(shares, 64, rows, float(offset)) for offset in offsets]
    np.testing.assert_allclose(np.mean(counts, 0), 64 * shares, atol=1e-3)


def test_ids_of_the_run_name_a_shard_and_its_own_id() -> None:
    own = np.array([0, 5, (1 << 48) - 1], np.uint64)
    mixed = np.concatenate([global_ids(own, 3), global_ids(own, 0)])
    parts = {shard: (places, ids) for shard, places, ids in split_ids(mixed)}
    assert set(parts) == {0, 3}
    np.testing.assert_array_equal(parts[3][0], [0, 1, 2])
    np.testing.assert_array_equal(parts[0][1], own)
    ((shard, places, ids),) = split_ids(global_ids(own, 7))
    assert shard == 7 and len(places) == 3
    np.testing.assert_array_equal(ids, own)


def test_writers_are_dealt_out_evenly_and_few_move() -> None:
    known = range(4)
    homes = [home_of(w, known=known, live=known, waits=False) for w in range(16)]
    assert np.bincount(homes).tolist() == [4, 4, 4, 4]
    without = [home_of(w, known=known, live=[0, 1, 3], waits=False) for w in range(16)]
    moved = [w for w in range(16) if homes[w] != without[w]]
    assert moved == [w for w in range(16) if homes[w] == 2]
    assert len({without[w] for w in moved}) == 3  # spread, not all to one
    assert home_of(2, known=known, live=[0, 1, 3], waits=True) == 2
    assert home_of(2, known=known, live=[], waits=False) == 2


def test_endpoints_are_used_as_this_machine_reaches_them() -> None:
    told = ("tcp/127.0.0.1:8000", "tcp/0.0.0.0:7448")
    assert reachable(told, ["tcp/127.0.0.1:7447"])[0] == "tcp/127.0.0.1:8000"
    assert reachable(told, ["tcp/10.0.0.5:7447"]) == ("tcp/10.0.0.5:7448",)
    assert reachable(told[:1], ["tcp/10.0.0.5:7447"]) == ()
    assert reachable((), ["tcp/127.0.0.1:7447"]) == ()


def test_announcements_that_do_not_fit_are_refused() -> None:
    good = {
        "shard": 2,
        "incarnation": 5,
        "schema_hash": SPEC.schema_hash.hex(),
        "endpoints": ("tcp/127.0.0.1:1",),
    }
    check_announcement(Announcement(**good), life=(2, 5), spec=SPEC)  # type: ignore[arg-type]
    for bad, match in (
        ({"shard": 3}, "says that it is shard 3"),
        ({"incarnation": 6}, "says that it is"),
        ({"schema_hash": "ff"}, "row schema"),
        ({"endpoints": ()}, "reached without endpoints"),
    ):
        told = Announcement(**(good | bad))  # type: ignore[arg-type]
        with pytest.raises(WireError, match=match):
            check_announcement(told, life=(2, 5), spec=SPEC)


def test_draws_from_shards_of_different_sizes_are_one_tables() -> None:
    with (
        shards_of(ENDLESS, 3) as shards,
        directory_of(shards[0], count=3) as directory,
    ):
        fill(directory, {0: 100, 1: 200, 2: 500})
        said: list[str] = []
        sampler = ShardedSampler(
            directory=directory, spec=SPEC, batch_size=64, say=said.append
        )
        assert eventually(lambda: sampler.sample(20.0).size == 800)
        drawn = [sampler.sample(20.0) for _ in range(250)]
        # Where a shard did not answer in time, the others stood in for it.
        drawn = [b for b in drawn if np.allclose(b.probabilities, 1 / 800, 1e-12, 0)]
        assert len(drawn) > 200
        for batch in drawn:
            counts = np.bincount(shard_of(batch.ids), minlength=3)
            assert (np.abs(counts - [8, 16, 40]) <= 1).all()  # 64 in 1 : 2 : 5
            assert (batch.rows["number"] // 10_000 == shard_of(batch.ids)).all()
        numbers = np.concatenate([batch.rows["number"] for batch in drawn])
        seen = np.unique(numbers, return_counts=True)[1]
        assert len(seen) == 800
        expected = len(numbers) / 800
        # Strata only make it smaller than chi-square's 799 + 4 sqrt(2 x 799).
        assert ((seen - expected) ** 2 / expected).sum() < 799 + 4 * np.sqrt(1598)
        sampler.update_priorities(drawn[0].ids, np.ones(64))
        shards[1].close()
        assert eventually(lambda: sampler.sample(20.0).size == 600)
        assert sampler.shards == (0, 2)
        assert said[-1] == "replay shard 1 left: drawn from no longer"
        again = Shard(1, ENDLESS, hub=shards[0], endpoint=shards[1].endpoint)
        shards.append(again)
        assert eventually(lambda: sampler.shards == (0, 1, 2) or not sampler.sample(20))
        assert "replay shard 1 joined" in said[-1]
        stats = fetch_all_stats(shards[0].hub, KEYS)
        assert total(stats)["size"] == sum(told["size"] for told in stats.values())
        for shard in shards[2:]:
            shard.close()
        assert eventually(lambda: sampler.sample(20.0).size == 100)


@pytest.mark.slow
def test_a_shard_whose_writers_stand_still_holds_nobody_up() -> None:
    """Shard 1 gives 800 rows and then none until 50 more are written to it."""
    limited = ReplayConfig(
        capacity=1 << 14,
        min_size=100,
        samples_per_insert=4.0,
        tolerance=2.0,
        sampler="uniform",
    )
    with (
        shards_of(ENDLESS, 1) as shards,
        directory_of(shards[0]) as directory,
    ):
        shards.append(Shard(1, limited, hub=shards[0]))
        assert eventually(lambda: len(directory.links) == 2)
        fill(directory, {0: 100, 1: 100})
        sampler = ShardedSampler(directory=directory, spec=SPEC, batch_size=20)
        assert eventually(lambda: sampler.sample(20.0).size == 200)
        started = time.monotonic()
        drawn = [sampler.sample(20.0) for _ in range(300)]
        assert time.monotonic() - started < 10.0
        given = np.array([(shard_of(batch.ids) == 1).sum() for batch in drawn])
        assert 700 <= given.sum() <= 800
        assert (given[-20:] == 0).all()
        for batch in drawn:
            # Each shard's rows tell its share; where both are drawn, they make up 1.
            shares = [
                batch.probabilities[shard_of(batch.ids) == shard] * 100
                for shard in range(2)
            ]
            if all(map(len, shares)):
                np.testing.assert_allclose(shares[0] + shares[1][0], 1.0, rtol=1e-9)
        link = directory.links[1]
        writer = Writer(
            session=link.session,
            keys=link.keys,
            spec=SPEC,
            writer=9,
            epoch=1,
            batch_rows=50,
        )
        writer.append(make_rows(20_000, 50))
        assert writer.close(20.0)
        assert eventually(lambda: (shard_of(sampler.sample(20.0).ids) == 1).any())


@pytest.mark.slow
def test_writers_move_from_a_shard_that_left_and_back() -> None:
    with (
        shards_of(INSERTS, 3) as shards,
        directory_of(shards[0], wanted=()) as directory,
    ):
        sink = ShardedWriter(
            directory=directory,
            spec=SPEC,
            writer=1,
            epoch=1000,
            shards=3,
            durable=False,
            batch_rows=10,
        )
        sent = 0

        def write(count: int) -> bool:
            nonlocal sent
            for _ in range(count):
                assert sink.append(make_rows(sent, 10, writer=1), 20.0)
                sent += 10
            return True

        assert write(30) and sink.flush(20.0) and sink.shard == 1
        lost = sent
        write(3)
        shards[1].close()
        assert eventually(lambda: write(1) and sink.shard in (0, 2))
        assert sink.flush(20.0)
        shards.append(Shard(1, INSERTS, hub=shards[0], endpoint=shards[1].endpoint))
        assert eventually(lambda: write(1) and sink.shard == 1)
        shards.append(Shard(3, INSERTS, hub=shards[0]))  # 1 of 4: stays where it is
        assert write(5) and sink.close(20.0)
        kept = [
            page.rows["number"]
            for shard in live_shards(shards[0].hub, KEYS)
            for page in fetch_rows(
                session=shards[0].hub, keys=RunKeys(KEYS.run_id, shard), spec=SPEC
            )
        ]
        numbers = np.sort(np.concatenate(kept))
        # Of what the shard acknowledged before it left, nothing is there; of the rest
        # everything is, once.
        assert len(np.unique(numbers)) == len(numbers)
        assert numbers[-1] == sent - 1 and numbers[0] >= lost
        np.testing.assert_array_equal(np.diff(numbers), 1)
        stats = fetch_stats(shards[0].hub, RunKeys(KEYS.run_id, 1))
        assert stats["size"] > 0


def test_a_second_process_of_a_shards_number_is_refused() -> None:
    with shards_of(INSERTS, 2) as shards:
        with pytest.raises(ReplayError, match="has a shard 1 already"):
            ShardClaim(shards[1].hub, RunKeys(KEYS.run_id, 1))
        shards[1].close()
        ShardClaim(shards[0].hub, RunKeys(KEYS.run_id, 1)).close()


def test_a_false_announcement_is_said_once_and_not_used() -> None:
    with (
        shards_of(INSERTS, 1) as shards,
        directory_of(shards[0], count=1) as directory,
    ):
        said: list[str] = []
        directory._say = said.append
        keys = RunKeys(KEYS.run_id, 4)
        told = encode(
            Announcement(
                shard=4,
                incarnation=7,
                schema_hash=SPEC.schema_hash.hex(),
                endpoints=("tcp/198.51.100.1:7447",),
            )
        )

        def answer(query: object) -> None:
            with query:  # type: ignore[attr-defined]
                query.reply(query.key_expr, told)  # type: ignore[attr-defined]

        hub = shards[0].hub
        declared = [
            hub.declare_queryable(keys.life(7), answer),
            hub.liveliness().declare_token(keys.life(7)),
            hub.liveliness().declare_token(RunKeys(KEYS.run_id, 9999).life(1)),
        ]
        assert eventually(lambda: said)
        assert said == [
            "replay shard 4 is not used: tcp/198.51.100.1:7447 is not a loopback "
            "address and the link is not encrypted; on a network that you trust, pass "
            "--insecure"
        ]
        assert [link.shard for link in directory.links] == [0]
        for one in declared:
            one.undeclare()
