"""Scenes on the command line: convert, describe, generate; banks for the commands.

A bank is used as it is; files and folders of scenes are converted; `procedural` is
generated. What a folder holds besides scenes is passed over with a word.
"""

import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tyro
from rich.console import Console
from rich.table import Table

from launch.budget import ScenesConfig
from launch.converting import Places, Tally, gathering, processors, say
from launch.errors import LaunchError
from sim.bank import BankFile, is_bank, open_bank, verify
from sim.conversion import Conversion, work_folder
from sim.formats import list_files, read_scenes
from sim.parts import Part
from sim.places import places_in, procedural_places
from sim.scene import Scene

PROCEDURAL: Final = "procedural"
HELD_OUT_SEED: Final = 1_000_003  # added to the seed of the training scenes
INCOMPLETE: Final = 1  # exit code: there is a bank, but not of all that was named
SHOWN: Final = 50  # scenes in a table


def write_procedural(
    path: Path, *, count: int, seed: int, keep: bool = False
) -> BankFile:
    """Generates scenes into a bank; `keep` as in `gathering`."""
    if count < 1 or seed < 0:
        raise LaunchError(
            f"count {count} must be at least 1 and seed {seed} at least 0"
        )
    _write(path, lambda: procedural_places(seed, count), _Options(), keep=keep)
    return open_bank(path)


@dataclass(frozen=True, kw_only=True)
class _Options:
    """How to convert."""

    slots: int = 0
    workers: int = 0  # 0: one for each processor
    dt: float | None = None


def _write(path: Path, places: Places, options: _Options, *, keep: bool) -> Tally:
    """Converts scenes into a bank; work files are beside it meanwhile."""
    if path.exists() and not is_bank(path):
        raise LaunchError(f"{path}: exists and is no bank; choose another --out")
    folder = work_folder(path)
    with gathering(folder, keep=keep) as gathered:
        gathered.gather(places, _conversion(folder, options), options.dt)
        gathered.write(path, gathered.parts)
    return gathered.tally


def _conversion(folder: Path, options: _Options) -> Conversion:
    return Conversion(
        folder=folder,
        slots=options.slots,
        workers=options.workers or processors(),
    )


def _recorded(sources: Sequence[Path]) -> Places:
    """The records of files and folders."""
    files = list_files(sources, on_skip=lambda why: say(f"passed over: {why}"))
    return lambda: places_in(files)


def split(parts: Sequence[Part], share: float) -> tuple[list[Part], list[Part]]:
    """To train on and to hold out: the last ones; of a single scene, both are it."""
    if len(parts) == 1:
        say("one scene only: it is trained on and evaluated on")
        return list(parts), list(parts)
    kept = min(max(1, round(len(parts) * share)), len(parts) - 1)
    return list(parts[:-kept]), list(parts[-kept:])


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
    places, folder = _recorded(paths), work_folder(train)
    with gathering(folder, keep=False) as gathered:
        gathered.gather(places, _conversion(folder, _Options()))
        ours, theirs = split(gathered.parts, config.held_out_share)
        gathered.write(train, ours)
        gathered.write(held_out, theirs)
    _tell_left_out(gathered.tally)
    return open_bank(train), open_bank(held_out)


def prepare_rotation(
    every: Path, turn: Callable[[int], tuple[Path, Path]], *, sources: Sequence[str]
) -> int:
    """A bank of all recorded scenes, and two for each; how many scenes there are.

    `turn` names the two: all others to train on, and the one that is held out.
    """
    if every.exists():  # written last
        return open_bank(every).scenes
    paths = [Path(source) for source in sources]
    made = [str(path) for path in paths if path.is_file() and is_bank(path)]
    if made or PROCEDURAL in sources:
        raise LaunchError(
            f"--rotate: {[*made, PROCEDURAL][0]} is not taken; name files or folders "
            "of recorded scenes"
        )
    every.parent.mkdir(exist_ok=True)
    with gathering(work_folder(every), keep=False) as gathered:
        gathered.gather(_recorded(paths), _conversion(work_folder(every), _Options()))
        parts = gathered.parts
        if len(parts) < 2:
            raise LaunchError("--rotate: of one scene none is left to train on")
        for number, part in enumerate(parts):
            train, held_out = turn(number)
            train.parent.mkdir(exist_ok=True)
            gathered.write(train, [*parts[:number], *parts[number + 1 :]])
            gathered.write(held_out, [part])
        gathered.write(every, parts)
    _tell_left_out(gathered.tally)
    return len(parts)


def _tell_left_out(tally: Tally) -> None:
    if tally.settled > tally.scenes:
        say(f"{tally.scenes} scenes{tally.words()}")


def _given(
    banks: Sequence[Path], paths: Sequence[Path], train: Path, held_out: Path
) -> tuple[BankFile, BankFile]:
    """Banks of the user's, in the run folder too, so that it is whole."""
    if len(banks) != len(paths) or len(banks) > 2:
        raise LaunchError(
            f"{banks[0]}: is a bank; give --scenes one bank, or two: the second one is "
            "held out"
        )
    for path in banks:
        open_bank(path)
    train.parent.mkdir(parents=True, exist_ok=True)
    _place(banks[0], train)
    _place(banks[-1], held_out)
    return open_bank(train), open_bank(held_out)


def _place(bank: Path, to: Path) -> None:
    """Links a bank, or copies it: banks are written beside and renamed, never changed.

    The runs of a sweep share a bank of gigabytes.
    """
    try:
        os.link(bank, to)
    except OSError:
        shutil.copyfile(bank, to)


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
    _tell_left_out(_write(folder / "a.bank", _recorded(paths), _Options(), keep=False))
    return open_bank(folder / "a.bank")


@dataclass(frozen=True, kw_only=True)
class ConvertConfig:
    """Converts recorded scenes into a bank."""

    sources: tyro.conf.Positional[tuple[Path, ...]]
    """Files or folders; formats are told by content."""
    out: Path
    """The bank to write. Work files lie beside it in OUT.parts meanwhile."""
    slots: int = 0
    """Objects a scene keeps at most: the recording vehicle, tracks to predict, then
    those that come nearest to it; 0 keeps all."""
    dt: float | None = None
    """Step length [s] of the scenes to take; left out: the first scene's."""
    workers: int = 0
    """Processes that convert; 0: one for each processor."""
    json: bool = False
    """Prints the summary as JSON."""


def convert_command(options: ConvertConfig) -> int:
    """`slipstream scenes convert`: 0, or 1 if the bank lacks scenes that were named."""
    if not options.sources:
        raise LaunchError("slipstream scenes convert: name files or folders of scenes")
    if options.slots < 0 or options.workers < 0:
        raise LaunchError(
            f"--slots {options.slots} and --workers {options.workers} must be 0 or more"
        )
    how = _Options(slots=options.slots, workers=options.workers, dt=options.dt)
    tally = _write(options.out, _recorded(options.sources), how, keep=True)
    bank = open_bank(options.out)
    size = bank.path.stat().st_size
    if options.json:
        known = {"bank": str(bank.path), "bytes": size, "dt": bank.dt}
        print(json.dumps(known | dataclasses.asdict(tally), indent=1))
    else:
        _tell_bank(bank, tally.words())
    return 0 if tally.complete else INCOMPLETE


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
    bank = write_procedural(
        options.out, count=options.count, seed=options.seed, keep=True
    )
    _tell_bank(bank)
    return 0


def _tell_bank(bank: BankFile, words: str = "") -> None:
    size = bank.path.stat().st_size / 1e6
    print(f"{bank.path}: {bank.scenes} scenes, {size:.1f} MB{words}")


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
        "dropped": 0,
        "left_out": scene.left_out,
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
            "dropped": bank.header.dropped[row],
            "left_out": bank.header.left_out[row],
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
    verify: bool = False
    """Reads all of a bank and compares its hash."""


def info_command(options: InfoConfig) -> int:
    """`slipstream scenes info`."""
    source = options.source
    content: dict[str, Any] = {"source": str(source)}
    if source.is_file() and is_bank(source):
        bank = open_bank(source)
        if options.verify:
            verify(bank)
        content |= {"hash": bank.content_hash, "bytes": source.stat().st_size}
        content |= {"verified": options.verify, "dropped": sum(bank.header.dropped)}
        content["scenes"] = _bank_info(bank)
    else:
        content["files"] = [str(path) for path in list_files([source])]
        content["scenes"] = [_scene_info(scene) for scene in read_scenes([source])]
    if options.json:
        print(json.dumps(content, indent=1))
    else:
        _show(content)
    return 0


def _show(content: dict[str, Any]) -> None:
    """The first scenes as a table, and what is said of all of them."""
    scenes = content["scenes"]
    table = Table(title=f"{content['source']}: {len(scenes)} scenes")
    columns = ["id", "objects", "steps", "valid", "current_step", "dt", "lights"]
    columns.append("dropped")
    for name in columns:
        table.add_column(name)
    for scene in scenes[:SHOWN]:
        table.add_row(*(str(scene[name]) for name in columns))
    console = Console()
    console.print(table)
    if len(scenes) > SHOWN:
        console.print(f"and {len(scenes) - SHOWN} more; --json has them all")
    if "hash" in content:
        checked = "verified" if content["verified"] else "not verified: --verify"
        console.print(
            f"{content['bytes'] / 1e6:.1f} MB, {content['dropped']} objects dropped, "
            f"hash {content['hash'][:16]} ({checked})",
            highlight=False,
        )
