"""A directory gets to know its shards whatever the order of events, and without any."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import zenoh

from replay.client import ReplayTimeout
from replay.control import encode
from replay.keys import RunKeys
from replay.session import open_session, undeclare
from replay.shards import Announcement, ShardLink, live_shards
from replay.shards_directory import ShardDirectory
from replay.shards_sampler import ShardedSampler
from tests.replay_parts import KEYS, SPEC, eventually, free_endpoint, session_to
from tests.replay_shard_parts import ENDLESS, directory_of, fill, shards_of


def test_a_link_that_hears_of_its_shard_at_once_is_drawn_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its token comes, and the sampler looks, before the directory has the link."""
    heard, looked = threading.Event(), threading.Event()

    def slow(*, on_change: Callable[[], object], **rest: Any) -> ShardLink:
        def changed() -> None:
            on_change()
            heard.set()

        link = ShardLink(on_change=changed, **rest)
        assert looked.wait(10.0)
        return link

    with shards_of(ENDLESS, 1) as (hub,):
        with directory_of(hub, count=1) as directory:
            fill(directory, {0: 200})
        monkeypatch.setattr("replay.shards_directory.ShardLink", slow)
        with directory_of(hub) as directory:
            sampler = ShardedSampler(directory=directory, spec=SPEC, batch_size=8)
            assert heard.wait(10.0)
            with pytest.raises(ReplayTimeout):
                sampler.sample(0.1)
            looked.set()
            assert sampler.sample(5.0).size == 200


def test_a_shard_that_does_not_answer_at_first_is_asked_again() -> None:
    """The token is there before who answers, and the first question is lost."""
    endpoint, asked = free_endpoint(), []
    told = encode(
        Announcement(
            shard=0, incarnation=5, schema_hash=SPEC.schema_hash.hex(), endpoints=()
        )
    )

    def on_query(query: zenoh.Query) -> None:
        asked.append(query)
        with query:
            if len(asked) > 1:
                query.reply(query.key_expr, told)

    with open_session(listen=[endpoint], router=True) as router:
        key = KEYS.life(5)
        token = router.liveliness().declare_token(key)
        with session_to(endpoint) as session:
            directory = ShardDirectory(session=session, keys=KEYS, spec=SPEC)
            assert not directory.announced
            queryable = router.declare_queryable(key, on_query)
            assert eventually(lambda: len(directory.links) == 1)
            directory.close()
        undeclare(queryable, token)
    assert len(asked) > 1


def _deaf(session: zenoh.Session) -> zenoh.Session:
    """A session that is told of no token, and may ask."""
    real = session.liveliness()
    deaf = Mock(spec=zenoh.Session, wraps=session)
    deaf.liveliness.return_value = SimpleNamespace(
        get=real.get,
        declare_subscriber=lambda key, on_token, history: real.declare_subscriber(
            key, lambda token: None, history=history
        ),
    )
    return deaf


def test_shards_are_found_without_an_event(monkeypatch: pytest.MonkeyPatch) -> None:
    """And so is their end."""
    monkeypatch.setattr("replay.shards_directory._LOOK_S", 0.1)
    with shards_of(ENDLESS, 2) as shards, session_to(shards[0].endpoint) as session:
        directory = ShardDirectory(session=_deaf(session), keys=KEYS, spec=SPEC)
        try:
            assert eventually(lambda: len(directory.links) == 2)
            assert directory.announced == (0, 1)
            shards[1].close()
            assert eventually(lambda: directory.announced == (0,))
        finally:
            directory.close()


def test_a_get_that_misses_tokens_hides_no_shard() -> None:
    def told(*shards: int) -> list[SimpleNamespace]:
        keys = [RunKeys(KEYS.run_id, shard).life(7) for shard in shards]
        return [SimpleNamespace(ok=SimpleNamespace(key_expr=key)) for key in keys]

    session = Mock(spec_set=zenoh.Session)
    session.liveliness().get.side_effect = [told(), told(2), told(0, 1, 2)]
    assert live_shards(session, KEYS) == [0, 1, 2]
    session.liveliness().get.side_effect = [
        told(1),
        told(0, 1),
        [SimpleNamespace(ok=None)],
    ]
    assert live_shards(session, KEYS) == [0, 1]
