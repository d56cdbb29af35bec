"""Which objects of each scene an evaluation controls, and which of them it judges."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from sim.bank import BankFile


class ControlledError(Exception):
    """Objects cannot be controlled; the message says which, where and what to do."""


@dataclass(frozen=True)
class ControlledSet:
    """A row of slots per scene: first the judged ones, then those that only react."""

    slots: Int[np.ndarray, "scenes slots"]  # rows of the log; its length: empty
    judged: int  # of the slots


def sdc_of(file: BankFile) -> ControlledSet:
    """The recording vehicle of each scene."""
    return ControlledSet(file.arrays["sdc"][:, None].astype(np.int32), 1)


def all_of(file: BankFile) -> ControlledSet:
    """Every object."""
    rows = file.arrays["log"].shape[2]
    return ControlledSet(
        np.tile(np.arange(rows, dtype=np.int32), (file.scenes, 1)), rows
    )


def tracks_of(file: BankFile) -> ControlledSet:
    """Each scene's tracks to predict; scenes without any have empty slots."""
    tracks = file.arrays["tracks"].astype(np.int32)
    if (tracks >= file.arrays["log"].shape[2]).all():
        raise ControlledError(
            f"{file.path}: no scene names tracks to predict; control sdc, all, or "
            "objects by index"
        )
    return ControlledSet(tracks, tracks.shape[1])


def rows_of(file: BankFile, rows: Sequence[int]) -> ControlledSet:
    """The same rows in every scene."""
    if len(set(rows)) < len(rows) or not rows:
        raise ControlledError(f"objects {list(rows)}: name each object once")
    objects = file.arrays["objects"]
    for row in rows:
        short = np.flatnonzero((row >= objects) | (row < 0))
        if len(short):
            scene = int(short[0])
            raise ControlledError(
                f"{file.path}: scene {file.scenario_ids[scene]} has objects 0 to "
                f"{objects[scene] - 1}, {row} is none; name others or fewer scenes"
            )
    slots = np.tile(np.array(rows, np.int32), (file.scenes, 1))
    return ControlledSet(slots, len(rows))


def with_others(file: BankFile, chosen: ControlledSet) -> ControlledSet:
    """The same judged slots, and behind them every other object of the scene."""
    rows = file.arrays["log"].shape[2]
    every = np.arange(rows, dtype=np.int32)
    slots = np.full((file.scenes, chosen.judged + rows), rows, np.int32)
    slots[:, : chosen.judged] = chosen.slots
    longest = 0
    for scene in range(file.scenes):
        here = every[: int(file.arrays["objects"][scene])]
        rest = np.setdiff1d(here, chosen.slots[scene])
        slots[scene, chosen.judged : chosen.judged + len(rest)] = rest
        longest = max(longest, len(rest))
    return ControlledSet(slots[:, : chosen.judged + longest], chosen.judged)
