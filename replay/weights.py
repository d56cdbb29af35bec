"""The policy's parameters from the learner to the actors: latest wins.

The publisher announces a new version with a few bytes and answers whoever then asks
for the vector. A published vector was rejected: with congestion control DROP its
fragments are dropped when a link is busy, with BLOCK one actor that stalls holds up
the learner's own link. An actor has one request in flight at most, so a slow one
skips versions instead of queueing them; and joining late is the same request.
"""

import threading
from typing import final

import numpy as np
import zenoh
from jaxtyping import Float

from replay.keys import RunKeys
from replay.session import undeclare
from replay.wire import Weights, WireError

_FETCH_TIMEOUT_S = 10.0
_ASK_AGAIN_S = 1.0


@final
class WeightsPublisher:
    """The learner's end."""

    def __init__(self, *, session: zenoh.Session, keys: RunKeys) -> None:
        """Starts to answer; there is nothing to answer with before `publish`."""
        self._payload: bytes | None = None
        self._notice = session.declare_publisher(
            keys.weights,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )
        self._queryable = session.declare_queryable(keys.weights, self._answer)

    def publish(
        self,
        version: int,
        layout_hash: str,
        vector: Float[np.ndarray, " parameters"],
    ) -> None:
        """Makes these the latest weights; returns without waiting for anyone."""
        weights = Weights(version=version, layout_hash=layout_hash, vector=vector)
        self._payload = weights.encode()
        self._notice.put(b"")

    def close(self) -> None:
        """Stops answering."""
        undeclare(self._queryable, self._notice)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            payload = self._payload
            if payload is not None:
                query.reply(query.key_expr, payload)


@final
class WeightsSubscriber:
    """An actor's end; all methods may be called from any thread."""

    def __init__(self, *, session: zenoh.Session, keys: RunKeys) -> None:
        """Starts to listen, and asks for what was published before."""
        self._session = session
        self._key = keys.weights
        self._changed = threading.Condition()
        self._latest: Weights | None = None
        self._asking = False
        self._ask_again = False
        self._error: WireError | None = None
        self._subscriber = session.declare_subscriber(keys.weights, self._on_notice)
        self._ask()

    def latest(self) -> Weights | None:
        """The newest weights that have arrived; None before the first."""
        with self._changed:
            if self._error is not None:
                raise self._error
            return self._latest

    def wait(self, timeout: float) -> Weights | None:
        """The newest weights, waiting up to `timeout` seconds for the first."""
        left = timeout
        while self.latest() is None and left > 0:
            with self._changed:
                step = min(left, _ASK_AGAIN_S)
                self._changed.wait_for(
                    lambda: self._latest is not None or self._error is not None, step
                )
            left -= step
            if self.latest() is None:
                self._ask()
        return self.latest()

    def close(self) -> None:
        """Stops listening."""
        undeclare(self._subscriber)

    def _on_notice(self, _: zenoh.Sample) -> None:
        self._ask()

    def _ask(self) -> None:
        """Asks for the vector, or once more when the request in flight ends."""
        with self._changed:
            if self._asking:
                self._ask_again = True
                return
            self._asking, self._ask_again = True, False
        self._session.get(
            self._key,
            zenoh.handlers.Callback(self._on_reply, self._on_end),
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=_FETCH_TIMEOUT_S,
        )

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            return
        with self._changed:
            try:
                self._latest = Weights.decode(reply.ok.payload.to_bytes())
            except WireError as error:
                self._error = error
            self._changed.notify_all()

    def _on_end(self) -> None:
        with self._changed:
            self._asking = False
            again = self._ask_again
        if again and not self._session.is_closed():
            self._ask()
