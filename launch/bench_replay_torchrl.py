"""The peer torchrl in `slipstream bench replay`: its buffer in the place of our table.

`TensorDictPrioritizedReplayBuffer` over `LazyTensorStorage`, in batches throughout
(one `extend` an insert, one `sample` and one `update_priority` a batch), behind our
service: the same messages, limiter and client, so that only the tables differ. Its
priorities are kept as given ((p + eps)^alpha, eps 1e-8), it draws independently, and
its indices are slots, which it writes in turn: so the ids of the rows follow from them.
An update of a row that was overwritten meets the new one.
"""

from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Integer, UInt8, UInt64
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer


@final
class TorchrlTable:
    """What `ReplayServer` asks of a `replay.table.Table`, by torchrl's buffer."""

    def __init__(self, *, capacity: int, row_bytes: int, exponent: float) -> None:
        """An empty buffer."""
        torch.set_num_threads(1)  # as the service's other threads need the other core
        self._buffer: Any = TensorDictPrioritizedReplayBuffer(
            alpha=exponent,
            beta=0.4,
            storage=LazyTensorStorage(capacity),
            priority_key="td_error",
        )
        self._row_bytes = row_bytes
        self._capacity = capacity
        self._drawn: list[np.ndarray] = []
        self.inserts = 0
        """Rows ever inserted."""

    @property
    def size(self) -> int:
        """Rows in the buffer."""
        return len(self._buffer)

    @property
    def deletes(self) -> int:
        """Rows pushed out."""
        return self.inserts - self.size

    @property
    def memory_bytes(self) -> int:
        """Not known: the benchmark looks at the process."""
        return 0

    def mass(self) -> float:
        """Not asked for by one reader."""
        return 0.0

    def insert(self, rows: UInt8[np.ndarray, "rows row_bytes"], mark: object) -> None:
        """One `extend`, which copies the rows into the storage."""
        # A copy of its own would be one too many: the payload is read-only memory,
        # which torch warns of and only reads here.
        source = torch.frombuffer(bytearray(rows), dtype=torch.uint8)
        batch = source.view(len(rows), self._row_bytes)
        self._buffer.extend(TensorDict({"row": batch}, batch_size=[len(rows)]))
        self.inserts += len(rows)

    def draw(
        self,
        *,
        batch_size: int,
        ids: UInt64[np.ndarray, " rows"],
        probabilities: Float[np.ndarray, " rows"],
    ) -> None:
        """One `sample` a batch, which brings the rows as well."""
        self._drawn = []
        for start in range(0, len(ids), batch_size):
            part = slice(start, start + batch_size)
            sample = self._buffer.sample(batch_size)
            self._drawn.append(sample["row"].numpy())
            slots = sample["index"].numpy()
            ids[part] = self.inserts - 1 - (self.inserts - 1 - slots) % self._capacity
            probabilities[part] = sample["priority_weight"].numpy()

    def gather(
        self,
        ids: UInt64[np.ndarray, " rows"],
        rows: UInt8[np.ndarray, "rows row_bytes"],
    ) -> None:
        """What was drawn, copied into the reply; of a part of it, from the storage."""
        if len(ids) == sum(map(len, self._drawn)):
            np.concatenate(self._drawn, out=rows)
            return
        slots = torch.from_numpy((ids % np.uint64(self._capacity)).astype(np.int64))
        rows[:] = self._buffer[slots]["row"].numpy()

    def update_priorities(
        self,
        ids: Integer[np.ndarray, " updates"],
        priorities: Float[np.ndarray, " priorities"],
    ) -> int:
        """One `update_priority`; none is known to be stale."""
        if len(ids):
            slots = (ids.astype(np.uint64) % np.uint64(self._capacity)).astype(np.int64)
            self._buffer.update_priority(
                torch.from_numpy(slots),
                torch.from_numpy(priorities.astype(np.float32)),
            )
        return 0
