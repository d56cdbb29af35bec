"""Columns for Rerun's bar charts, which its own `columns` cannot make (0.41)."""

from dataclasses import dataclass
from typing import final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr
from jaxtyping import Float

from launch.scene_view import Colour


def bar_colour(colour: Colour) -> list[rr.DescribedComponentBatch]:
    """The colour of a bar chart alone: the archetype's constructor wants values."""
    batches = rr.BarChart([0.0], color=colour).as_component_batches()
    return [
        batch
        for batch in batches
        if batch.component_descriptor().component == "BarChart:color"
    ]


def vectors(
    component: str, rows: Float[np.ndarray, "rows values"]
) -> rr.ComponentColumn:
    """A column of one vector a row, for a bar chart.

    `BarChart.columns` takes a single tensor (rerun 0.41), so Arrow joins them.
    """
    descriptor = rr.ComponentDescriptor(
        f"BarChart:{component}",
        archetype="rerun.archetypes.BarChart",
        component_type="rerun.components.TensorData",
    )
    arrays = [
        rr.components.TensorDataBatch(row).as_arrow_array()
        for row in rows.astype(np.float32)
    ]
    return rr.ComponentColumn(descriptor, _Arrow(pa.concat_arrays(arrays)))


@final
@dataclass(frozen=True)
class _Arrow:
    """An Arrow array as Rerun's `ComponentBatchLike`."""

    array: pa.Array

    def as_arrow_array(self) -> pa.Array:
        """The array."""
        return self.array
