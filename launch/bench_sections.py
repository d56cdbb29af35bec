"""The sections of `slipstream bench sim`, as the measuring processes run them."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from launch import bench_banks, bench_bicycle, bench_steps, bench_table6
from launch.bench_scenes import Source
from launch.bench_table6 import Work
from launch.bench_timing import yardsticks
from launch.converting import say

Request = Mapping[str, Any]


@dataclass(frozen=True)
class Sizes:
    """How much is measured; travels to the measuring processes."""

    objects: tuple[int, ...]  # slots of table 6 and the oracle
    batches: tuple[int, ...]
    steps: tuple[tuple[int, int], ...]  # controlled a scene, environments
    environments: tuple[int, ...]  # of the cost against scale
    scale_objects: tuple[int, ...]
    bank_scenes: tuple[int, ...]
    seconds: float  # per timed program


def source_from(request: Request) -> Source:
    """The scenes that were asked for."""
    source = request["source"]
    return Source(source["kind"], tuple(source["main"]), tuple(source["logs"]))


def work_from(request: Request, folder: Path) -> Work:
    """What the sections on the one scene work with."""
    sizes = request["sizes"]
    return Work(
        scene=source_from(request).scene(),
        folder=folder,
        objects=tuple(sizes["objects"]),
        batches=tuple(sizes["batches"]),
        steps=tuple((controlled, count) for controlled, count in sizes["steps"]),
        environments=tuple(sizes["environments"]),
        scale_objects=tuple(sizes["scale_objects"]),
        seconds=sizes["seconds"],
        say=say,
    )


def _yardsticks(request: Request, folder: Path) -> Iterator[Any]:
    yield yardsticks(seconds=max(request["sizes"]["seconds"], 0.1))


def _table6(request: Request, folder: Path) -> Iterator[Any]:
    return bench_table6.table6(work_from(request, folder))


def _oracle(request: Request, folder: Path) -> Iterator[Any]:
    return bench_table6.oracle(work_from(request, folder))


def _steps(request: Request, folder: Path) -> Iterator[Any]:
    return bench_steps.steps(work_from(request, folder))


def _scale(request: Request, folder: Path) -> Iterator[Any]:
    return bench_steps.scale(work_from(request, folder))


def _banks(request: Request, folder: Path) -> Iterator[Any]:
    sizes = request["sizes"]
    counts = tuple(sizes["bank_scenes"])
    return bench_banks.banks(counts, sizes["seconds"], folder, say)


def _bank(request: Request, folder: Path) -> Iterator[Any]:
    return bench_banks.bank(request)


def _bicycle(request: Request, folder: Path) -> Iterator[Any]:
    return bench_bicycle.bicycle(source_from(request).scenes())


def _rendering(request: Request, folder: Path) -> Iterator[Any]:
    # Of `bench replay`; imported here, for nothing else of it is needed.
    from launch.bench_replay_rows import rendering

    return rendering(request)


SECTIONS: Final[dict[str, Callable[[Request, Path], Iterator[Any]]]] = {
    "yardsticks": _yardsticks,
    "table6": _table6,
    "oracle": _oracle,
    "steps": _steps,
    "scale": _scale,
    "banks": _banks,
    "bank": _bank,
    "bicycle": _bicycle,
    "rendering": _rendering,
}
# Small programs only wait for one another on a second core.
ONE_CORE: Final = frozenset({"yardsticks", "table6", "oracle", "steps", "scale"})
