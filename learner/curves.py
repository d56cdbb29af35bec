"""Training curves: a CSV file, TensorBoard events, and a picture of them.

One writer feeds both, so they agree. Columns are fixed when the file is made; a value
that is not known at a step leaves its cell empty. A run that resumes from update u
drops what was written beyond u (those updates are about to be made again), so no step
stands twice. TensorBoard is written by `torch.utils.tensorboard`: torchrl's logger
wraps the same class, but importing it takes seconds and it cannot purge.
"""

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float
from torch.utils.tensorboard import SummaryWriter

STEP = "updates"


class CurvesError(Exception):
    """Curves cannot be written or read; the message says what, where, what to do."""


@final
class CurvesWriter:
    """Appends rows to `curves.csv` and scalars to the TensorBoard folder."""

    def __init__(
        self,
        *,
        csv_path: Path,
        tensorboard: Path | None,
        columns: Sequence[str],
        resume_from: int | None = None,
    ) -> None:
        """Opens both for appending.

        Args:
            csv_path: the file, made if it is missing.
            tensorboard: the folder of event files; None writes none.
            columns: names of all values that will ever be written.
            resume_from: number of updates of the checkpoint resumed from: rows
                beyond it are dropped. None starts afresh and refuses an old file.
        """
        self._columns = (STEP, *columns)
        self._path = csv_path
        kept = self._kept_lines(resume_from)
        csv_path.parent.mkdir(parents=True, exist_ok=True)
        partial = csv_path.with_name(f".{csv_path.name}.partial")
        partial.write_text("".join(kept))
        os.replace(partial, csv_path)
        self._file = csv_path.open("a", newline="")
        self._csv = csv.writer(self._file, lineterminator="\n")
        self._events: SummaryWriter | None = None
        if tensorboard is not None:
            purge = None if resume_from is None else resume_from + 1
            self._events = SummaryWriter(str(tensorboard), purge_step=purge)

    def write(self, updates: int, values: Mapping[str, float]) -> None:
        """Adds one row; it is on its way to the disk when this returns."""
        unknown = values.keys() - set(self._columns[1:])
        if unknown:
            raise ValueError(f"no column {', '.join(sorted(unknown))} in {self._path}")
        cells = [_cell(values.get(name)) for name in self._columns[1:]]
        self._csv.writerow([updates, *cells])
        self._file.flush()
        if self._events is not None:
            for name, value in values.items():
                if math.isfinite(value):
                    self._events.add_scalar(name, value, updates)

    def close(self) -> None:
        """Flushes and closes both."""
        self._file.close()
        if self._events is not None:
            self._events.close()

    def _kept_lines(self, resume_from: int | None) -> list[str]:
        """The header and the rows up to the resumed step."""
        header = ",".join(self._columns) + "\n"
        if not self._path.exists():
            return [header]
        if resume_from is None:
            raise CurvesError(
                f"{self._path}: exists already; resume its run or choose another folder"
            )
        lines = self._path.read_text().splitlines(keepends=True)
        if lines and lines[0] != header:
            raise CurvesError(
                f"{self._path}: has other columns than this version writes; "
                "move it away and resume again"
            )
        # A last line without its end is a write that a kill cut short.
        rows = [line for line in lines[1:] if line.endswith("\n")]
        return [header, *(row for row in rows if _step_of(row) <= resume_from)]


def read_curves(path: Path) -> dict[str, Float[np.ndarray, " rows"]]:
    """Columns of a curves file; empty cells are nan."""
    try:
        with path.open(newline="") as file:
            rows = list(csv.reader(file))
        header, body = rows[0], [row for row in rows[1:] if len(row) == len(rows[0])]
        table = np.array(
            [[float(cell) if cell else math.nan for cell in row] for row in body]
        ).reshape(len(body), len(header))
    except OSError as error:
        raise CurvesError(f"{path}: {error.strerror}") from error
    except (ValueError, IndexError) as error:
        raise CurvesError(f"{path}: not a file of training curves") from error
    return {name: table[:, index] for index, name in enumerate(header)}


def plot_curves(
    csv_paths: Path | Sequence[Path], png_path: Path, *, title: str = ""
) -> None:
    """Draws every column that has values over the number of updates.

    A first file's columns go by their names, those of further ones by the file's, too.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first, *others = [csv_paths] if isinstance(csv_paths, Path) else csv_paths
    drawn = _drawn(first, "")
    for other in others:
        drawn |= _drawn(other, f"{other.stem}: ")
    across = 3
    down = max(1, -(-len(drawn) // across))
    # Figure and canvas by hand: pyplot keeps global state and looks for a display.
    figure = Figure(figsize=(4.0 * across, 2.6 * down), layout="constrained")
    FigureCanvasAgg(figure)
    for index, (name, (steps, values)) in enumerate(drawn.items()):
        axes = figure.add_subplot(down, across, index + 1)
        known = np.isfinite(values)
        marker = "." if known.sum() < 20 else ""
        axes.plot(steps[known], values[known], linewidth=1.0, marker=marker)
        axes.set_title(name, fontsize=9)
        axes.set_xlabel(STEP, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(visible=True, alpha=0.3)
    if title:
        figure.suptitle(title, fontsize=10)
    png_path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(png_path, dpi=120)


def _drawn(
    path: Path, prefix: str
) -> dict[str, tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]]:
    """Steps and values of a file's columns that have any."""
    curves = read_curves(path)
    steps = curves.pop(STEP, None)
    if steps is None:
        raise CurvesError(f"{path}: has no column {STEP}")
    return {
        f"{prefix}{name}": (steps, values)
        for name, values in curves.items()
        if np.isfinite(values).any()
    }


def _cell(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"{value:.9g}"


def _step_of(row: str) -> float:
    first = row.split(",", 1)[0]
    return int(first) if first.isdigit() else math.inf
