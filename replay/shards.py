"""Which shards a run has, and how each is reached.

A shard is a replay service of its own: table, limiter, folder, process. Shard 0 is the
run's hub, the router that every role connects to. Any other shard listens on endpoints
of its own and has a client's session to the hub besides, on which it

    claims its number           a liveliness token; a second process that finds one
                                there ends
    announces itself            a second token once it serves, and an answer to who asks
                                under the same key: its endpoints and its rows' schema
    answers questions           counters, sync, export; rows never take that way

A client in Zenoh is connected to one router, so a process opens a session per shard
that it uses, directly to the announced endpoint (peers that mesh were rejected: every
process would hold a link to every other). Each link watches the shard's token on its
own session: a shard is known to be gone 2 to 10 ms after its process was killed, also
while the hub is down, which only keeps new shards from being found.

An announced address without a host (0.0.0.0) is the machine of the hub, as this process
reaches it. What is announced is checked like everything that comes from outside.

The id of a row in the run is its id in its shard below the shard's number.
"""

import contextlib
import re
import secrets
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Final, final

import msgspec
import numpy as np
import zenoh
from jaxtyping import Integer, UInt64

from replay.control import Count, Message, encode
from replay.keys import RunKeys
from replay.session import is_loopback, undeclare
from replay.spec import ReplayError, RowSpec
from replay.wire import WireError

MAX_SHARDS: Final = 1 << 10
SHARD_SHIFT: Final = 48  # bits of an id below its shard's number
_ANSWER_S = 2.0  # for the hub to say which tokens there are
_ASKS = 3  # gets for one look at the tokens
_LIFE = re.compile(r"([0-9]{1,4})/([0-9a-f]{1,16})")


@final
class Announcement(Message, frozen=True, kw_only=True, tag=True):
    """A shard's answer to who asks how it is reached."""

    shard: Annotated[int, msgspec.Meta(ge=0, lt=MAX_SHARDS)]
    incarnation: Count  # of its process
    schema_hash: str  # of its rows, hexadecimal
    # None at all: it is the hub, and reached already.
    endpoints: Annotated[tuple[str, ...], msgspec.Meta(max_length=16)]


def global_ids(
    ids: UInt64[np.ndarray, " rows"], shard: int
) -> UInt64[np.ndarray, " rows"]:
    """Ids of a shard as ids of the run."""
    return ids | np.uint64(shard << SHARD_SHIFT)


def split_ids(
    ids: Integer[np.ndarray, " rows"],
) -> Iterator[tuple[int, np.ndarray, UInt64[np.ndarray, " part"]]]:
    """Ids of the run per shard: its number, where they stand, its own ids."""
    own = np.asarray(ids, np.uint64)
    shards = own >> np.uint64(SHARD_SHIFT)
    if len(own) and (shards == shards[0]).all():
        every = np.arange(len(own))
        yield int(shards[0]), every, own & np.uint64((1 << SHARD_SHIFT) - 1)
        return
    for shard in np.unique(shards):
        places = np.flatnonzero(shards == shard)
        yield int(shard), places, own[places] & np.uint64((1 << SHARD_SHIFT) - 1)


def home_of(
    writer: int, *, known: Sequence[int], live: Sequence[int], waits: bool
) -> int:
    """The shard that a writer writes to.

    Writers are dealt out to the known shards in turn, so that few writers are spread
    evenly too (a hash would put two writers into one of two shards half the time).
    When its shard is not live, a writer waits for it, or moves to a live one: only the
    writers of shards that left move.
    """
    everyone = sorted(known)
    home = everyone[writer % len(everyone)]
    if waits or home in live or not live:
        return home
    return sorted(live)[writer // len(everyone) % len(live)]


@final
class ShardClaim:
    """A shard's number, taken by this process until `close`."""

    def __init__(self, hub: zenoh.Session, keys: RunKeys) -> None:
        """Refuses a number that is in use."""
        self.incarnation = secrets.randbits(62)
        self._hub = hub
        self._keys = keys
        self._refuse_if(keys.claims)
        # Looked at before and after: of two that come together neither sees the other
        # before, and at least one after.
        token = hub.liveliness().declare_token(keys.claim(self.incarnation))
        self._declared: list[Any] = [token]
        try:
            self._refuse_if(keys.claims)
        except ReplayError:
            self.close()
            raise

    def _refuse_if(self, key: str) -> None:
        mine = self._keys.claim(self.incarnation)
        found = [k for k in alive(self._hub, key) if k != mine]
        if found:
            raise ReplayError(
                f"run {self._keys.run_id} has a shard {self._keys.shard} already; "
                "choose another number by --shard"
            )

    def announce(
        self, local: zenoh.Session, spec: RowSpec, endpoints: Sequence[str]
    ) -> None:
        """Says that the shard serves, on its own session and on the hub's."""
        key = self._keys.life(self.incarnation)
        told = encode(
            Announcement(
                shard=self._keys.shard,
                incarnation=self.incarnation,
                schema_hash=spec.schema_hash.hex(),
                endpoints=tuple(endpoints),
            )
        )

        def on_query(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, told)

        self._declared.append(self._hub.declare_queryable(key, on_query))
        for session in {id(s): s for s in (local, self._hub)}.values():
            self._declared.append(session.liveliness().declare_token(key))

    def close(self) -> None:
        """Gives the number back."""
        undeclare(*reversed(self._declared))
        self._declared = []


def alive(session: zenoh.Session, key: str) -> list[str]:
    """Keys of the tokens there are.

    Asked several times: a busy session that has a liveliness subscriber too is told of
    none, or not of all, by one get in a thousand (Zenoh 1.10: 66 of 82,000 under load;
    of three in a row by 1 of 123,000). Without a subscriber that was never seen. No get
    tells of a token that is not there.
    """
    found: dict[str, None] = {}
    for _ in range(_ASKS):
        for reply in session.liveliness().get(key, timeout=_ANSWER_S):
            if reply.ok is not None:
                found[str(reply.ok.key_expr)] = None
    return list(found)


def life_of(key: str) -> tuple[int, int] | None:
    """(shard, incarnation) of a life's key; None of anything else."""
    found = _LIFE.fullmatch("/".join(key.rsplit("/", 2)[1:]))
    if found is None or int(found[1]) >= MAX_SHARDS:
        return None
    return int(found[1]), int(found[2], 16)


def live_shards(session: zenoh.Session, keys: RunKeys) -> list[int]:
    """Numbers of the shards that the hub knows to be up."""
    lives = [life_of(key) for key in alive(session, keys.all_lives)]
    return sorted({life[0] for life in lives if life is not None})


def check_announcement(
    told: Announcement, *, life: tuple[int, int], spec: RowSpec
) -> None:
    """Refuses what does not fit the run, or the key that it came under."""
    if (told.shard, told.incarnation) != life:
        raise WireError(f"it says that it is shard {told.shard}")
    if told.schema_hash != spec.schema_hash.hex():
        raise WireError(
            f"row schema {told.schema_hash[:16]!r}, expected {spec.schema_hash.hex()}; "
            "run the same release everywhere"
        )
    if bool(told.endpoints) == (told.shard == 0):
        raise WireError("the hub, and no other shard, is reached without endpoints")


def reachable(endpoints: Sequence[str], hub: Sequence[str]) -> tuple[str, ...]:
    """The announced endpoints as this process can use them.

    `hub`: those by which it reaches the hub.
    """
    found = list(endpoints)
    for host in ("/0.0.0.0:", "/[::]:") if hub else ():
        ours = f"/{hub[0].split('/', 1)[1].rpartition(':')[0]}:"
        found = [endpoint.replace(host, ours) for endpoint in found]
    near = tuple(endpoint for endpoint in found if is_loopback(endpoint))
    if near and (not hub or is_loopback(hub[0])):
        return near
    return tuple(endpoint for endpoint in found if endpoint not in near)


@final
class ShardLink:
    """A session to a shard, and whether a process serves it now."""

    def __init__(
        self,
        *,
        keys: RunKeys,
        session: zenoh.Session,
        owned: bool,
        endpoints: tuple[str, ...],
        on_change: Callable[[], object],
    ) -> None:
        """Watches the shard's token; `owned`: the session is closed with the link."""
        self.keys = keys
        self.session = session
        self.endpoints = endpoints
        self._owned = owned
        self._lock = threading.Lock()
        self._lives: tuple[int, ...] = ()
        self._heard = 0  # events
        self._on_change = on_change
        self._subscriber = session.liveliness().declare_subscriber(
            keys.lives, self._on_token, history=True
        )

    @property
    def shard(self) -> int:
        """The shard's number."""
        return self.keys.shard

    @property
    def incarnation(self) -> int | None:
        """Of the process that serves; None while none does."""
        return self._lives[0] if self._lives else None

    def _on_token(self, sample: zenoh.Sample) -> None:
        with self._lock:
            self._heard += 1
            self._take(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)
        self._on_change()

    def _take(self, key: str, born: bool) -> None:
        life = life_of(key)
        if life is not None and life[0] == self.shard:
            others = tuple(one for one in self._lives if one != life[1])
            self._lives = (*others, life[1])[:4] if born else others

    def look(self) -> None:
        """Takes up a process that serves though no event has told so."""
        heard = self._heard
        for key in alive(self.session, self.keys.lives) if not self._lives else ():
            with self._lock:
                if self._heard == heard:  # or what was found may be over already
                    self._take(key, True)
            self._on_change()

    def close(self) -> None:
        """Ends the session if it is the link's own."""
        undeclare(self._subscriber)
        if self._owned:
            # In a thread: a session to a machine that is gone takes its time to end,
            # 10 s at most. Waited for at the program's end: one that came back from
            # Zenoh after Python is gone aborts the process.
            threading.Thread(target=_close, args=(self.session,)).start()


def _close(session: zenoh.Session) -> None:
    with contextlib.suppress(zenoh.ZError):  # it gave up: whoever was there is not
        session.close()  # type: ignore[no-untyped-call]
