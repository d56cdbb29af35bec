"""Every key of a run, spelled once.

A key expression is a path of chunks; `*` stands for one chunk, `**` for any number.
All keys of a run lie below `slipstream/<run_id>/`, so that one access rule covers it.
A shard's number is part of its replay keys. What a shard says of itself (claim, life)
ends in the number of its process, so that two lives of one shard are two keys.
"""

import re
from dataclasses import dataclass
from typing import final

from replay.spec import ReplayError

_CHUNK = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def plain_chunk(text: str, *, what: str) -> str:
    """Returns `text` if it can be one chunk of a key, or raises."""
    if not _CHUNK.fullmatch(text):
        raise ReplayError(
            f"{what} {text!r} cannot be part of a key: use 1 to 64 letters, digits, "
            "'.', '_' or '-', and begin with a letter or digit"
        )
    return text


@final
@dataclass(frozen=True)
class RunKeys:
    """Key space below `slipstream/<run_id>/`; run_id is one plain chunk."""

    run_id: str
    shard: int = 0

    def __post_init__(self) -> None:
        """Refuses a run_id that would be a wildcard or several chunks."""
        plain_chunk(self.run_id, what="run id")

    @property
    def everything(self) -> str:
        """All keys of the run."""
        return f"slipstream/{self.run_id}/**"

    @property
    def insert(self) -> str:
        """Queries that carry rows; the reply is the acknowledgement."""
        return f"slipstream/{self.run_id}/replay/{self.shard}/insert"

    @property
    def sample(self) -> str:
        """Queries for sampled rows; they carry priority updates."""
        return f"slipstream/{self.run_id}/replay/{self.shard}/sample"

    @property
    def fetch(self) -> str:
        """Queries for rows by range of ids."""
        return f"slipstream/{self.run_id}/replay/{self.shard}/fetch"

    @property
    def stats(self) -> str:
        """Queries for the service's counters."""
        return f"slipstream/{self.run_id}/replay/{self.shard}/stats"

    @property
    def sync(self) -> str:
        """Queries that are answered once all rows of now are on the disk."""
        return f"slipstream/{self.run_id}/replay/{self.shard}/sync"

    @property
    def stream(self) -> str:
        """Queries for where sampled rows may be had by a stream."""
        return f"slipstream/{self.run_id}/replay/{self.shard}/stream"

    @property
    def claims(self) -> str:
        """Liveliness of whoever serves this shard, or is about to."""
        return f"slipstream/{self.run_id}/claims/{self.shard}/*"

    def claim(self, incarnation: int) -> str:
        """The process `incarnation` claims this shard."""
        return f"slipstream/{self.run_id}/claims/{self.shard}/{incarnation:x}"

    @property
    def lives(self) -> str:
        """Liveliness of this shard's service."""
        return f"slipstream/{self.run_id}/shards/{self.shard}/*"

    @property
    def all_lives(self) -> str:
        """Liveliness of all shards' services."""
        return f"slipstream/{self.run_id}/shards/*/*"

    def life(self, incarnation: int) -> str:
        """The process `incarnation` serves this shard; it says how to be reached."""
        return f"slipstream/{self.run_id}/shards/{self.shard}/{incarnation:x}"

    @property
    def weights(self) -> str:
        """The policy's parameters: published, and kept for those who join late."""
        return f"slipstream/{self.run_id}/weights"

    @property
    def control(self) -> str:
        """The call to stop."""
        return f"slipstream/{self.run_id}/control"

    def status(self, role: str) -> str:
        """Role `role` (e.g. `actor-3`) publishes its counters here."""
        return f"slipstream/{self.run_id}/status/{plain_chunk(role, what='role')}"

    @property
    def all_status(self) -> str:
        """The console subscribes here."""
        return f"slipstream/{self.run_id}/status/*"

    def frames(self, actor: int) -> str:
        """Actor `actor` publishes rollout frames here while anyone watches."""
        return f"slipstream/{self.run_id}/frames/{actor}"

    @property
    def all_frames(self) -> str:
        """The viewer subscribes here."""
        return f"slipstream/{self.run_id}/frames/*"

    def file(self, name: str) -> str:
        """Queries for the file served under `name`."""
        return f"slipstream/{self.run_id}/files/{plain_chunk(name, what='file name')}"

    @property
    def all_files(self) -> str:
        """Whoever serves files answers here."""
        return f"slipstream/{self.run_id}/files/*"
