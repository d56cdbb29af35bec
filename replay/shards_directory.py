"""The shards of a run as one process knows them: who is announced, who is linked.

One thread does what can block (asking a shard how it is reached, opening sessions);
Zenoh's callbacks only enqueue. What was heard of a shard stays when the hub forgets it:
its link tells whether it is there. A shard that does not answer yet is asked again, and
every 10 s the thread looks at what there is: what is known does not hang on any event.
"""

import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, final

import zenoh

from replay.control import decode
from replay.keys import RunKeys
from replay.session import ConnectError, ask, check_endpoints, open_session, undeclare
from replay.shards import (
    Announcement,
    ShardLink,
    alive,
    check_announcement,
    life_of,
    reachable,
)
from replay.spec import ReplayError, RowSpec

_ANSWER_S: Final = 2.0  # for a shard to say how it is reached
_OPEN_S: Final = 3.0
_RETRY_S: Final = 0.5  # between two attempts to reach what is announced
_LOOK_S: Final = 10.0  # between two looks at what there is
_MOST: Final = 256  # shards, and a life each, that are taken up


@final
class ShardDirectory:
    """Follows the announcements on the hub; links to the shards that are wanted."""

    def __init__(
        self,
        *,
        session: zenoh.Session,
        keys: RunKeys,
        spec: RowSpec,
        hub: Sequence[str] = (),
        insecure: bool = False,
        wanted: Sequence[int] | None = None,
        say: Callable[[str], object] = lambda line: print(line, flush=True),
    ) -> None:
        """`session` is the one to the hub, which is reached by the endpoints `hub`.

        `wanted`: the shards to link to; unless given, all. `want` changes that.
        """
        self._session = session
        self._run = keys.run_id
        self._spec = spec
        self._hub = tuple(hub)
        self._insecure = insecure
        self._wanted = None if wanted is None else frozenset(wanted)
        self._say = say
        self._events: queue.SimpleQueue[tuple[str, bool] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._told: dict[int, Announcement] = {}  # the last one of each shard
        self._announced: dict[int, int] = {}  # shard to life, while the hub knows it
        self._open: dict[tuple[int, int], str] = {}  # lives whose answer is awaited
        self._links: dict[int, ShardLink] = {}
        self._refused: set[tuple[int, int]] = set()
        self._listeners: list[Callable[[], object]] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run_thread, daemon=True)
        self._subscriber = session.liveliness().declare_subscriber(
            keys.all_lives,
            lambda token: self._events.put(
                (str(token.key_expr), token.kind == zenoh.SampleKind.PUT)
            ),
            history=True,
        )
        self._thread.start()

    def on_change(self, listener: Callable[[], object]) -> None:
        """Calls `listener`, on another thread, whenever something has changed."""
        self._listeners.append(listener)

    def want(self, shards: frozenset[int]) -> None:
        """Links to these shards from now on, and to no other."""
        if self._wanted != shards:
            self._wanted = shards
            self._events.put(None)

    @property
    def announced(self) -> tuple[int, ...]:
        """Shards that the hub knows to be up, or that a link knows to be."""
        with self._lock:
            linked = {n for n, link in self._links.items() if link.incarnation}
            return tuple(sorted(linked | self._announced.keys()))

    @property
    def links(self) -> tuple[ShardLink, ...]:
        """Links to the wanted shards that are up, in order."""
        with self._lock:
            live = [link for link in self._links.values() if link.incarnation]
        return tuple(sorted(live, key=lambda link: link.shard))

    def close(self) -> None:
        """Ends all links."""
        self._closing.set()
        self._events.put(None)
        self._thread.join()
        undeclare(self._subscriber)
        for link in self._links.values():
            link.close()

    def _changed(self) -> None:
        for listener in self._listeners:
            listener()

    def _run_thread(self) -> None:
        look_at = time.monotonic() + _LOOK_S
        while not self._closing.is_set():
            wait = max(0.0, look_at - time.monotonic())
            if self._open or self._missing():
                wait = min(wait, _RETRY_S)
            try:
                self._round(self._events.get(timeout=wait))
            except queue.Empty:
                self._round(None)
            if time.monotonic() >= look_at:
                self._look()
                look_at = time.monotonic() + _LOOK_S

    def _round(self, event: tuple[str, bool] | None) -> None:
        """Takes one event, or asks again who did not answer; links what is to be."""
        if event is not None:
            self._take(*event)
        else:
            for key in list(self._open.values()):
                if not self._closing.is_set():
                    self._ask(key)
        self._reach()

    def _look(self) -> None:
        """Takes up what the hub and the shards know and no event has told."""
        keys = alive(self._session, RunKeys(self._run).all_lives)
        found = {life: key for key in keys if (life := life_of(key)) is not None}
        known = set(self._announced.items())
        # Nothing at all is a hub that is silent, not one that has no shard.
        for shard, incarnation in known - found.keys() if found else ():
            self._take(RunKeys(self._run, shard).life(incarnation), False)
        for life in found.keys() - known - self._open.keys():
            self._take(found[life], True)
        self._reach()
        for link in list(self._links.values()):
            if not self._closing.is_set():
                link.look()

    def _take(self, key: str, up: bool) -> None:
        """A life began or ended, as the hub sees it."""
        life = life_of(key)
        if life is None:
            return
        shard, incarnation = life
        if up and len(self._announced) + len(self._open) < _MOST:
            self._open[life] = key
            self._ask(key)
        elif not up:
            self._open.pop(life, None)
            self._refused.discard(life)
            with self._lock:
                gone = self._announced.get(shard) == incarnation
                if gone:
                    del self._announced[shard]
            if gone:
                self._changed()

    def _ask(self, key: str) -> None:
        """Takes up a shard once it says how it is reached."""
        life = life_of(key)
        assert life is not None
        payload = ask(self._session, key, timeout_s=_ANSWER_S)
        if payload is None or self._announced.get(life[0], life[1]) != life[1]:
            return  # not yet, or the life before it has not ended: asked again
        self._open.pop(life, None)
        try:
            told = decode(payload, Announcement)
            check_announcement(told, life=life, spec=self._spec)
            check_endpoints(told.endpoints, insecure=True)  # that they are some
        except ReplayError as error:
            self._refuse(life, str(error))
            return
        with self._lock:
            self._told[life[0]], self._announced[life[0]] = told, life[1]
        self._changed()

    def _refuse(self, life: tuple[int, int], reason: str) -> None:
        """Says once why a shard is not used."""
        if life not in self._refused and len(self._refused) < _MOST:
            self._refused.add(life)
            self._say(f"replay shard {life[0]} is not used: {reason}")

    def _missing(self) -> bool:
        """Whether a wanted shard that is up has no link."""
        return any(self._is_wanted(n) and n not in self._links for n in self._announced)

    def _is_wanted(self, shard: int) -> bool:
        return self._wanted is None or shard in self._wanted

    def _reach(self) -> None:
        """Opens what is wanted and missing; ends what is not wanted or has moved."""
        for shard, told in list(self._told.items()):
            endpoints = reachable(told.endpoints, self._hub)
            link = self._links.get(shard)
            if link is not None and (
                not self._is_wanted(shard) or link.endpoints != endpoints
            ):
                with self._lock:
                    del self._links[shard]
                link.close()
                link = None
                self._changed()
            wanted = self._is_wanted(shard) and shard in self._announced
            if link is None and wanted and not self._closing.is_set():
                self._link(shard, endpoints)

    def _link(self, shard: int, endpoints: tuple[str, ...]) -> None:
        try:
            if shard and not endpoints:
                raise ConnectError("its endpoints are another machine's loopback")
            session = self._session if shard == 0 else _open(endpoints, self._insecure)
        except ConnectError as error:
            self._refuse((shard, self._announced[shard]), str(error))
            return
        link = ShardLink(
            keys=RunKeys(self._run, shard),
            session=session,
            owned=shard != 0,
            endpoints=endpoints,
            on_change=self._changed,
        )
        with self._lock:
            self._links[shard] = link
        # What the link heard until here it said while nobody could find it.
        self._changed()


def _open(endpoints: tuple[str, ...], insecure: bool) -> zenoh.Session:
    check_endpoints(endpoints, insecure)
    return open_session(connect=endpoints, timeout_s=_OPEN_S)
