"""`slipstream bench sim`: how fast and how exact the simulator is, on this machine.

Sections, each of which can be had alone: `table6` (Gulino et al., 2023, appendix A.3,
with its figures 4 and 5), `oracle` (the same work by brute force in the same run),
`steps` (whole environment steps on one core), `scale` (their cost against the number of
environments and objects), `banks` (the cost of the number of scenes), `bicycle` (the
one-step error on logs). Figures are ratios within one run where they
are to hold on another machine; every run says what machine it was.

Each section runs in a process of its own (`launch.bench_child`).
"""

import dataclasses
import datetime
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from launch import bench_child, bench_print, bench_targets
from launch.bench_output import check_outputs, write_report
from launch.bench_scenes import description, source_of
from launch.bench_sections import ONE_CORE, Sizes
from launch.bench_steps import STEPS
from launch.tables import printer

FORMAT: Final = 1
Section = Literal["table6", "oracle", "steps", "scale", "banks", "bicycle"]
ALL: Final[tuple[Section, ...]] = get_args(Section)


@dataclass(frozen=True, kw_only=True)
class SimConfig:
    """Measures the simulator."""

    scenes: tuple[str, ...] = ()
    """Files or folders of recorded scenes, or `procedural`; the one with the most road
    points is measured. By default, of the folder named by SLIPSTREAM_DATA, the scene in
    WOMD's tf.Example form; without that, a procedural one."""
    sections: tuple[Section, ...] = ALL
    """What is measured."""
    quick: bool = False
    """The smallest sizes, briefly: tries everything, measures nothing well."""
    objects: tuple[int, ...] = (8, 16, 32, 64, 128)
    """Object slots of table 6 and the oracle."""
    batches: tuple[int, ...] = (1, 16)
    """Batch sizes of table 6."""
    environments: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096)
    """Environments of the cost against scale."""
    scale_objects: tuple[int, ...] = (8, 16, 32, 64, 128, 256)
    """Objects of it; where the scene has fewer, copies of its own fill up."""
    bank_scenes: tuple[int, ...] = (1, 1000)
    """Procedural scenes of the banks; generating 10,000 takes many minutes."""
    seconds: float = 0.3
    """How long each program is timed."""
    json: str = ""
    """Writes everything to this file, or to standard output by -."""
    plot: str = ""
    """Writes the figures to this folder, as PNG and SVG."""

    def __post_init__(self) -> None:
        """Refuses sizes of nothing."""
        counts = {
            "objects": self.objects,
            "batches": self.batches,
            "environments": self.environments,
            "scale-objects": self.scale_objects,
            "bank-scenes": self.bank_scenes,
        }
        for name, values in counts.items():
            if min(values, default=0) < 1:
                raise ValueError(f"--{name} needs numbers of at least 1")
        if self.seconds <= 0:
            raise ValueError(f"seconds={self.seconds} must be above 0")

    @property
    def sizes(self) -> Sizes:
        """How much is measured."""
        if self.quick:
            return Sizes(
                objects=self.objects[:1],
                batches=(1,),
                steps=((2, 4), (1, 8)),
                environments=(1, 4),
                scale_objects=self.scale_objects[:2],
                bank_scenes=(1, 2),
                seconds=0.02,
            )
        return Sizes(
            objects=self.objects,
            batches=self.batches,
            steps=STEPS,
            environments=self.environments,
            scale_objects=self.scale_objects,
            bank_scenes=self.bank_scenes,
            seconds=self.seconds,
        )


def sim_command(options: SimConfig) -> int:
    """`slipstream bench sim`."""
    check_outputs(options.json, options.plot)
    source = source_of(options.scenes)
    report: dict[str, Any] = {
        "format": FORMAT,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "load_average": list(os.getloadavg()),
        "scene": description(source, source.scene()),
        "sizes": dataclasses.asdict(options.sizes),
    }
    request = {
        "source": dataclasses.asdict(source),
        "sizes": dataclasses.asdict(options.sizes),
    }
    quiet = options.json == "-"
    console = printer()
    (report["yardsticks"],) = _measured("yardsticks", request)
    if not quiet:
        console.print(_words(report["scene"]))
        console.print(bench_print.yardsticks_table(report))
    report["sections"] = {}
    for name in ALL:
        if name not in options.sections:
            continue
        rows = report["sections"][name] = _measured(name, request)
        for table in bench_print.section_tables(name, rows):
            if not quiet:
                console.print(table)
    report["targets"] = bench_targets.targets(report["sections"])
    if report["targets"] and not quiet:
        console.print(bench_print.targets_table(report["targets"]))
    write_report(report, json_path=options.json, plot=options.plot, figures=_figures)
    return 0


def _measured(section: str, request: dict[str, Any]) -> list[Any]:
    return list(bench_child.run(section, request, one_core=section in ONE_CORE))


def _words(scene: dict[str, Any]) -> str:
    return (
        f"{scene['kind']} scene {scene['id']}: {scene['objects']} objects, "
        f"{scene['steps']} steps, {scene['road_points']:,} road points, "
        f"{scene['road_edge_points']:,} of them on road edges"
    )


def _figures(report: Mapping[str, Any]) -> dict[str, bytes]:
    from launch.bench_figures import figures  # matplotlib, only where it is wanted

    return figures(report)
