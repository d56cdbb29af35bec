"""Draws from all shards as if they were one table.

A batch of B rows takes n_s rows from shard s. Row i of shard s, whose table draws it
with probability P_s(i) = p_i / mass_s, comes with

    P(i) = share_s P_s(i),    E[n_s] = B share_s,    sum over s of share_s = 1

so that a mean weighted by 1 / (N P) is unbiased whatever the shares are (each shard is
a stratum), N being the rows of all shards. With share_s = mass_s / (sum of masses) it
is P(i) = p_i / (sum of p): one big table's, and so are the draws. That is the share
taken while every shard gives rows as fast as they are used.

It cannot be kept where a shard's rate limiter admits less than its share, for instance
because its writers stand still. A shard that has not given its share within 20 ms is
late until it has as many rows at hand as are asked for at once: it is not waited for,
its share is what it was seen to give, an average over some 32 batches, and the others
take the rest in proportion to their masses.

Equal shares were rejected: rows of a shard of small priorities would be drawn
more often than in one table, and be weighted down, at the price of variance. Whole
batches from one shard at a time were, too: the largest weight of a batch, by which a
learner divides, would then be a shard's and not the run's.

n_s is rounded by one random offset for all (systematic sampling): never further than 1
from B share_s, and equal to it on average. The rows of a reply are dealt out in random
order, as they come sorted by where they lie in the table.
What a shard that left has given and was not used yet is dropped with it.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, final

import numpy as np
from jaxtyping import Float, Int64, Integer

from replay.client import ReplayTimeout, Sampler
from replay.shards import ShardLink, global_ids, split_ids
from replay.shards_directory import ShardDirectory
from replay.spec import RowSpec, Sample

_PATIENCE_S: Final = 0.02
_MEMORY: Final = 1 / 32  # weight of the newest batch in the average of what was given


@final
@dataclass(eq=False)
class Supply:
    """One shard's rows that were received and not used yet."""

    shard: int
    incarnation: int
    sampler: Sampler
    given: float  # rows per batch, on average
    pieces: deque[tuple[Sample, np.ndarray]] = field(default_factory=deque)
    rows: int = 0  # in the pieces
    fresh: int = 0  # received since the last batch
    late: bool = False  # not waited for
    mass: float = 0.0  # of its table, as far as is known
    size: int = 0
    inserts: int = 0

    def receive(self, enough: int, random: np.random.Generator) -> None:
        """Takes what has come, until there are `enough` rows."""
        while self.rows < enough:
            try:
                sample = self.sampler.sample(0.0)
            except ReplayTimeout:
                return
            self.pieces.append((sample, random.permutation(len(sample.ids))))
            self.rows += len(sample.ids)
            self.fresh += len(sample.ids)
            self.mass, self.size = sample.mass, sample.size
            self.inserts = sample.inserts

    def whole(self) -> Sample | None:
        """The next batch as it came, without a copy; None if none has come."""
        try:
            sample = self.sampler.sample(0.0)
        except ReplayTimeout:
            return None
        if self.shard == 0:
            return sample
        return replace(sample, ids=global_ids(sample.ids, self.shard))

    def deal(self, count: int, share: float, into: Sample, start: int) -> None:
        """Moves `count` rows into a batch, from its row `start` on."""
        width = into.rows.dtype.itemsize
        target = into.rows.view(np.uint8).reshape(-1, width)
        self.rows -= count
        while count:
            sample, order = self.pieces.popleft()
            places, rest = order[:count], order[count:]
            if len(rest):
                self.pieces.appendleft((sample, rest))
            here = slice(start, start + len(places))
            into.ids[here] = global_ids(sample.ids[places], self.shard)
            into.probabilities[here] = share * sample.probabilities[places]
            source = sample.rows.view(np.uint8).reshape(-1, width)
            # Places are a permutation's: "clip" only spares take a copy of its own.
            np.take(source, places, axis=0, out=target[here], mode="clip")
            start += len(places)
            count -= len(places)


def shares_of(
    masses: Float[np.ndarray, " shards"], limits: Float[np.ndarray, " shards"]
) -> Float[np.ndarray, " shards"]:
    """Shares in proportion to the masses, none above its limit; their sum is 1.

    The limits' sum has to be 1 at least. Shards without mass share what others leave.
    """
    shares = np.zeros(len(masses))
    free = np.ones(len(masses), bool)
    while (left := 1.0 - shares.sum()) > 1e-12 and free.any():
        weights = np.where(free, masses, 0.0)
        # Divided by the largest first: the smallest floats do not survive a product.
        largest = weights.max()
        weights = weights / largest if largest > 0.0 else free.astype(float)
        wanted = shares + left * weights / weights.sum()
        over = free & (wanted >= limits)
        if not over.any():
            return wanted
        shares = np.where(over, limits, shares)
        free &= ~over
    return shares


def rounded(
    shares: Float[np.ndarray, " shards"],
    batch_size: int,
    rows: Int64[np.ndarray, " shards"],
    offset: float,
) -> Int64[np.ndarray, " shards"]:
    """Whole numbers that sum to the batch's size, within 1 of its shares.

    Their mean over offsets in [0, 1) is `batch_size * shares`. `rows`: that there are;
    no share is of more.
    """
    places = np.floor(np.cumsum(shares) * batch_size + offset).astype(np.int64)
    places = np.minimum(places, batch_size)  # an offset just below 1 is rounded up
    places[-1] = batch_size
    counts = np.diff(places, prepend=0)
    while (lacking := counts > rows).any():  # the last bit of a sum
        counts[np.argmax(rows - counts)] += 1
        counts[np.argmax(lacking)] -= 1
    return counts


@final
class ShardedSampler:
    """The learner's end, like `replay.client.Sampler`. For one thread only."""

    def __init__(
        self,
        *,
        directory: ShardDirectory,
        spec: RowSpec,
        batch_size: int,
        batches_per_reply: int = 1,
        in_flight: int = 2,
        seed: int = 0,
        say: Callable[[str], object] = lambda line: print(line, flush=True),
    ) -> None:
        """Of each shard, `in_flight` replies of so many batches are asked for."""
        self._directory = directory
        self._spec = spec
        self._batch_size = batch_size
        self._batches = batches_per_reply
        self._in_flight = in_flight
        self._random = np.random.default_rng(seed)
        self._say = say
        self._supplies: dict[int, Supply] = {}
        self._wake = threading.Event()
        self._changed = threading.Event()
        self._changed.set()
        self._waited_s = 0.0
        directory.on_change(self._on_change)

    def _on_change(self) -> None:
        self._changed.set()
        self._wake.set()

    @property
    def waited_s(self) -> float:
        """Total time that `sample` has spent waiting for an answer."""
        return self._waited_s

    @property
    def shards(self) -> tuple[int, ...]:
        """Those drawn from."""
        return tuple(sorted(self._supplies))

    def sample(self, timeout: float) -> Sample:
        """The next batch; raises `ReplayTimeout` after `timeout` seconds."""
        began = time.monotonic()
        while True:
            self._wake.clear()
            self._follow()
            waited = time.monotonic() - began
            batch = self._next(waited)
            if batch is not None:
                self._waited_s += waited
                return batch
            if waited >= timeout:
                self._waited_s += waited
                raise ReplayTimeout(
                    f"no batch from the replay's shards {list(self.shards)} within "
                    f"{timeout:g} s; are they up, and do actors insert?"
                )
            longest = _PATIENCE_S if waited < _PATIENCE_S else 0.1
            self._wake.wait(min(longest, timeout - waited))

    def update_priorities(
        self,
        ids: Integer[np.ndarray, " updates"],
        priorities: Float[np.ndarray, " priorities"],
    ) -> None:
        """New priorities, |TD error|; those of shards that left are dropped."""
        for shard, places, own in split_ids(ids):
            if shard in self._supplies:
                supply = self._supplies[shard]
                supply.sampler.update_priorities(own, priorities[places])

    def _follow(self) -> None:
        """Begins with shards that joined, drops those that left; says so."""
        if not self._changed.is_set():
            return
        self._changed.clear()
        links = {link.shard: link for link in self._directory.links}
        for shard, supply in list(self._supplies.items()):
            link = links.get(shard)
            if link is None or link.incarnation != supply.incarnation:
                del self._supplies[shard]
                self._say(f"replay shard {shard} left: drawn from no longer")
        for shard, link in links.items():
            incarnation = link.incarnation
            if shard not in self._supplies and incarnation is not None:
                self._supplies[shard] = self._supply(link, incarnation)
                self._say(f"replay shard {shard} joined: drawn from once it has rows")

    def _supply(self, link: ShardLink, incarnation: int) -> Supply:
        return Supply(
            shard=link.shard,
            incarnation=incarnation,
            sampler=Sampler(
                session=link.session,
                keys=link.keys,
                spec=self._spec,
                batch_size=self._batch_size,
                batches_per_reply=self._batches,
                in_flight=self._in_flight,
                on_answer=self._wake.set,
            ),
            given=float(self._batch_size),
            late=True,  # it may take long until it has rows
        )

    def _limits(self, supplies: Sequence[Supply]) -> Float[np.ndarray, " shards"]:
        """The largest shares that the shards can keep up."""
        given = [s.given / self._batch_size if s.late else 1.0 for s in supplies]
        return np.minimum(1.0, np.array(given))

    def _next(self, waited: float) -> Sample | None:
        """A batch if there is one to be had by now."""
        supplies = [self._supplies[shard] for shard in self.shards]
        if len(supplies) == 1 and not supplies[0].rows:
            return supplies[0].whole()
        for supply in supplies:
            supply.receive(self._batch_size * self._batches, self._random)
        if supplies and self._is_enough(supplies, waited):
            return self._batch(supplies)
        return None

    def _is_enough(self, supplies: Sequence[Supply], waited: float) -> bool:
        """Whether a batch can be made, and there is nobody to wait for."""
        size = self._batch_size
        if sum(supply.rows for supply in supplies) < size:
            return False
        for supply in supplies:
            supply.late &= supply.rows < size * self._batches
        masses = np.array([supply.mass for supply in supplies])
        limits = self._limits(supplies)
        if limits.sum() < 1.0:  # all are late
            return True
        wanted = np.ceil(size * shares_of(masses, limits))
        missing = False
        for supply, rows in zip(supplies, wanted, strict=True):
            if supply.rows < rows:
                supply.late |= waited >= _PATIENCE_S
                missing |= not supply.late
        return not missing

    def _batch(self, supplies: Sequence[Supply]) -> Sample:
        """One batch of what has come."""
        size = self._batch_size
        masses = np.array([supply.mass for supply in supplies])
        rows = np.array([supply.rows for supply in supplies])
        limits = np.minimum(self._limits(supplies), rows / size)
        if limits.sum() < 1.0:
            limits = np.minimum(1.0, rows / size)
        shares = shares_of(masses, limits)
        counts = rounded(shares, size, rows, self._random.random())
        batch = Sample(
            ids=np.empty(size, np.uint64),
            probabilities=np.empty(size),
            rows=np.empty(size, self._spec.dtype),
            size=sum(supply.size for supply in supplies),
            inserts=sum(supply.inserts for supply in supplies),
            mass=float(masses.sum()),
        )
        start = 0
        for supply, share, count in zip(supplies, shares, counts, strict=True):
            supply.deal(int(count), float(share), batch, start)
            supply.given += _MEMORY * (supply.fresh - supply.given)
            supply.fresh = 0
            start += int(count)
        return batch
