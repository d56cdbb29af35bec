"""Figures measured elsewhere, for orientation: they are not of the run they stand in.

Table 6 is that of Gulino et al., Waymax, NeurIPS 2023, appendix A.3, milliseconds and
MB; its CPU was an AMD EPYC 7B12 (64 GB), its GPU a V100. RolloutExpert was not run at
batch size 16, memory was not given for the GPU. Figures 4 and 5 draw the same numbers.

`WAYMAX` are timings of Waymax that were reported from a 2-core test machine, batch 1.
"""

from typing import Final, NamedTuple

SOURCE: Final = "Gulino et al., 2023, table 6"


class Row(NamedTuple):
    """One line of table 6; None where the paper has no figure."""

    device: str
    batch: int
    objects: int
    reset: float  # ms
    transition: float
    metrics: float
    rollout: float | None
    memory: float | None  # MB


TABLE_6: Final = (
    Row("cpu", 1, 8, 0.194, 0.191, 0.773, 121.492, 5.409),
    Row("cpu", 1, 16, 0.184, 0.176, 1.431, 190.357, 5.590),
    Row("cpu", 1, 32, 0.197, 0.223, 2.428, 378.926, 5.956),
    Row("cpu", 1, 64, 0.225, 0.221, 4.468, 637.125, 6.652),
    Row("cpu", 1, 128, 0.286, 0.274, 9.831, 1159.158, 8.036),
    Row("cpu", 16, 8, 1.741, 2.004, 10.689, None, 84.066),
    Row("cpu", 16, 16, 1.744, 1.894, 20.069, None, 86.805),
    Row("cpu", 16, 32, 2.084, 2.414, 33.002, None, 92.283),
    Row("cpu", 16, 64, 2.575, 2.648, 66.486, None, 103.239),
    Row("cpu", 16, 128, 2.837, 3.080, 124.530, None, 125.151),
    Row("gpu", 1, 8, 0.250, 0.265, 0.159, 27.010, None),
    Row("gpu", 1, 16, 0.253, 0.267, 0.158, 28.041, None),
    Row("gpu", 1, 32, 0.258, 0.268, 0.208, 30.488, None),
    Row("gpu", 1, 64, 0.260, 0.276, 0.157, 33.206, None),
    Row("gpu", 1, 128, 0.246, 0.257, 0.152, 36.856, None),
    Row("gpu", 16, 8, 0.264, 0.266, 0.154, None, None),
    Row("gpu", 16, 16, 0.258, 0.264, 0.175, None, None),
    Row("gpu", 16, 32, 0.251, 0.268, 0.221, None, None),
    Row("gpu", 16, 64, 0.280, 0.289, 0.301, None, None),
    Row("gpu", 16, 128, 0.262, 0.272, 0.469, None, None),
)

WAYMAX: Final = {  # objects: (Metrics ms, RolloutExpert ms)
    8: (8.3, 1600.0),
    32: (34.0, 5500.0),
    128: (119.0, 21000.0),
}


def paper_row(device: str, batch: int, objects: int) -> Row | None:
    """The paper's line for a measured one."""
    key = (device, batch, objects)
    rows = {(row.device, row.batch, row.objects): row for row in TABLE_6}
    return rows.get(key)
