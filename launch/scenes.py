"""Scenes on the command line: convert, describe, generate; banks for the commands.

A bank is used as it is; files and folders of scenes are converted; `procedural` is
generated. What a folder holds besides scenes is passed over with a word.
"""

import json
import sys
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tyro
from rich.console import Console
from rich.table import Table

from launch.config import ScenesConfig
from launch.errors import LaunchError
from sim.bank import BankFile, is_bank, open_bank
from sim.bank_writer import write_bank
from sim.formats import list_files, read_scenes
from sim.procedural import generate_many
from sim.scene import Scene

PROCEDURAL: Final = "procedural"
HELD_OUT_SEED: Final = 1_000_003  # added to the seed of the training scenes


def say(line: str) -> None:
    """For a person; standard output is kept for results."""
    print(line, file=sys.stderr, flush=True)


def _counted(scenes: Iterable[Scene], path: Path) -> None:
    """Writes a bank and says how far it is."""
    console = Console(stderr=True)
    with ExitStack() as stack:
        status = None
        if console.is_terminal:
            status = stack.enter_context(console.status(f"{path.name}: ..."))

        def progress(count: int) -> None:
            if status is not None:
                status.update(f"{path.name}: {count} scenes")

        path.parent.mkdir(parents=True, exist_ok=True)
        write_bank(scenes, path, progress=progress)


def write_procedural(path: Path, *, count: int, seed: int) -> BankFile:
    """Generates scenes into a bank."""
    if count < 1 or seed < 0:
        raise LaunchError(
            f"count {count} must be at least 1 and seed {seed} at least 0"
        )
    _counted(generate_many(seed, count), path)
    return open_bank(path)


def write_recorded(path: Path, sources: Sequence[Path]) -> BankFile:
    """Converts recorded scenes into a bank."""
    _counted(_recorded(sources), path)
    return open_bank(path)


def _recorded(sources: Sequence[Path]) -> list[Scene]:
    """All scenes of files and folders; no two of one id."""
    scenes = list(read_scenes(sources, on_skip=lambda why: say(f"passed over: {why}")))
    if not scenes:
        raise LaunchError(
            f"{sources[0]}: holds no scene; name a file or folder of them"
        )
    unique = {scene.scenario_id: scene for scene in reversed(scenes)}
    return [scene for scene in scenes if unique.get(scene.scenario_id) is scene]


def split(scenes: Sequence[Scene], share: float) -> tuple[list[Scene], list[Scene]]:
    """To train on and to hold out: the last ones; of a single scene, both are it."""
    if len(scenes) == 1:
        say("one scene only: it is trained on and evaluated on")
        return list(scenes), list(scenes)
    kept = min(max(1, round(len(scenes) * share)), len(scenes) - 1)
    return list(scenes[:-kept]), list(scenes[-kept:])


def prepare_banks(
    train: Path, held_out: Path, *, sources: Sequence[str], config: ScenesConfig
) -> tuple[BankFile, BankFile]:
    """The two banks of a run."""
    if tuple(sources) == (PROCEDURAL,):
        held_seed = config.seed + HELD_OUT_SEED
        return (
            write_procedural(train, count=config.train, seed=config.seed),
            write_procedural(held_out, count=config.held_out, seed=held_seed),
        )
    paths = [Path(source) for source in sources]
    banks = [path for path in paths if path.is_file() and is_bank(path)]
    if banks:
        return _given(banks, paths, train, held_out)
    ours, theirs = split(_recorded(paths), config.held_out_share)
    _counted(ours, train)
    _counted(theirs, held_out)
    return open_bank(train), open_bank(held_out)


def _given(
    banks: Sequence[Path], paths: Sequence[Path], train: Path, held_out: Path
) -> tuple[BankFile, BankFile]:
    """Banks of the user's: copied, so that the run folder is whole."""
    if len(banks) != len(paths) or len(banks) > 2:
        raise LaunchError(
            f"{banks[0]}: is a bank; give --scenes one bank, or two: the second one is "
            "held out"
        )
    for path in banks:
        open_bank(path)
    train.parent.mkdir(parents=True, exist_ok=True)
    train.write_bytes(banks[0].read_bytes())
    held_out.write_bytes(banks[-1].read_bytes())
    return open_bank(train), open_bank(held_out)


def bank_of(
    sources: Sequence[str], *, config: ScenesConfig, keep: ExitStack
) -> BankFile:
    """One bank of whatever was named; a converted one lives as long as `keep`."""
    paths = [Path(source) for source in sources]
    if len(paths) == 1 and paths[0].is_file() and is_bank(paths[0]):
        return open_bank(paths[0])
    folder = Path(keep.enter_context(tempfile.TemporaryDirectory(prefix="slipstream-")))
    if tuple(sources) == (PROCEDURAL,):
        seed = config.seed + HELD_OUT_SEED
        return write_procedural(folder / "a.bank", count=config.held_out, seed=seed)
    return write_recorded(folder / "a.bank", paths)


@dataclass(frozen=True, kw_only=True)
class ConvertConfig:
    """Converts recorded scenes into a bank."""

    sources: tyro.conf.Positional[tuple[Path, ...]]
    """Files or folders; formats are told by content."""
    out: Path
    """The bank to write."""


def convert_command(options: ConvertConfig) -> int:
    """`slipstream scenes convert`."""
    if not options.sources:
        raise LaunchError("slipstream scenes convert: name files or folders of scenes")
    _tell_bank(write_recorded(options.out, options.sources))
    return 0


@dataclass(frozen=True, kw_only=True)
class ProceduralConfig:
    """Generates scenes into a bank."""

    count: int
    """Number of scenes."""
    out: Path
    """The bank to write."""
    seed: int = 0
    """The same seed gives the same scenes."""


def procedural_command(options: ProceduralConfig) -> int:
    """`slipstream scenes procedural`."""
    bank = write_procedural(options.out, count=options.count, seed=options.seed)
    _tell_bank(bank)
    return 0


def _tell_bank(bank: BankFile) -> None:
    size = bank.path.stat().st_size / 1e6
    print(f"{bank.path}: {bank.scenes} scenes, {size:.1f} MB")


def _scene_info(scene: Scene) -> dict[str, Any]:
    kinds: dict[str, int] = {}
    for road in scene.roads:
        kinds[road.kind.name.lower()] = kinds.get(road.kind.name.lower(), 0) + 1
    return {
        "id": scene.scenario_id,
        "objects": scene.objects,
        "steps": scene.steps,
        "valid": int(scene.valid.sum()),
        "current_step": scene.current_step,
        "dt": scene.dt,
        "lights": len(scene.lights.lane_ids),
        "roads": kinds,
    }


def _bank_info(bank: BankFile) -> list[dict[str, Any]]:
    arrays = bank.arrays
    return [
        {
            "id": name,
            "objects": int(arrays["objects"][row]),
            "steps": int(arrays["steps"][row]),
            "valid": int(arrays["log_valid"][row].sum()),
            "current_step": int(arrays["current_step"][row]),
            "dt": bank.dt,
            "lights": int(arrays["lights"][row]),
        }
        for row, name in enumerate(bank.scenario_ids)
    ]


@dataclass(frozen=True, kw_only=True)
class InfoConfig:
    """Says what a bank or scene files hold."""

    source: tyro.conf.Positional[Path]
    """A bank, a file or a folder of scenes."""
    json: bool = False
    """Prints JSON and no table."""


def info_command(options: InfoConfig) -> int:
    """`slipstream scenes info`."""
    source = options.source
    content: dict[str, Any] = {"source": str(source)}
    if source.is_file() and is_bank(source):
        bank = open_bank(source)
        content |= {"hash": bank.content_hash, "bytes": source.stat().st_size}
        content["scenes"] = _bank_info(bank)
    else:
        content["files"] = [str(path) for path in list_files([source])]
        content["scenes"] = [_scene_info(scene) for scene in read_scenes([source])]
    if options.json:
        print(json.dumps(content, indent=1))
        return 0
    table = Table(title=str(source))
    columns = ("id", "objects", "steps", "valid", "current_step", "dt", "lights")
    for name in columns:
        table.add_column(name)
    for scene in content["scenes"]:
        table.add_row(*(str(scene[name]) for name in columns))
    Console().print(table)
    return 0
