"""The scenes of a sweep: two banks for all of its runs, or two for each turn."""

import functools
from collections.abc import Sequence
from pathlib import Path

from launch.budget import ScenesConfig


def banks_of(folder: Path, turn: int = -1) -> tuple[Path, Path]:
    """Where the scenes of all runs are, or those of a turn: to train on, held out."""
    scenes = folder / "scenes" / (f"without-{turn}" if turn >= 0 else "")
    return scenes / "train.bank", scenes / "heldout.bank"


def make_scenes(folder: Path, sources: Sequence[str], config: ScenesConfig) -> None:
    """Both banks, once for all runs."""
    from launch.scenes import prepare_banks

    train, held_out = banks_of(folder)
    if train.exists() and held_out.exists():
        return  # a bank has its name only when it is whole
    train.parent.mkdir(exist_ok=True)
    prepare_banks(train, held_out, sources=sources, config=config)


def make_rotation(folder: Path, sources: Sequence[str]) -> int:
    """The banks of every turn; how many there are, one for each scene."""
    from launch.scenes import prepare_rotation

    turn = functools.partial(banks_of, folder)
    return prepare_rotation(banks_of(folder)[1], turn, sources=sources)
