"""Scenes with more objects than there are slots: who stays.

The recording vehicle (SDC), then the objects that the caller names (tracks to predict,
what will be controlled), then those that come nearest to the SDC: by the smallest
distance between the centres, in the plane, over the steps at which both are recorded.
Objects never recorded together with the SDC come last, in the order of their rows.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sim.scene import Scene


def keep_nearest(scene: Scene, *, slots: int, keep: Sequence[int] = ()) -> Scene:
    """The scene with at most `slots` objects, in the order that they had.

    All that points at rows is renumbered; rows to predict or of interest that are
    dropped are no longer listed. How many objects were dropped is the difference of
    `.objects`, which the caller has to report.

    Args:
        scene: any scene; it is returned as it is if it has no more than `slots`.
        slots: at least 1, as the SDC always stays.
        keep: rows that go before all others but the SDC, the first ones first.
    """
    if slots < 1:
        raise ValueError(f"slots={slots} must be at least 1: the SDC needs one")
    if scene.objects <= slots:
        return scene
    nearest = np.argsort(_distances(scene), kind="stable")
    ranked = dict.fromkeys((scene.sdc_index, *keep, *map(int, nearest)))
    rows = np.sort(np.array(list(ranked)[:slots]))
    number = {int(row): at for at, row in enumerate(rows)}
    return dataclasses.replace(
        scene,
        sdc_index=number[scene.sdc_index],
        object_ids=scene.object_ids[rows],
        object_types=scene.object_types[rows],
        position=scene.position[rows],
        yaw=scene.yaw[rows],
        velocity=scene.velocity[rows],
        size=scene.size[rows],
        valid=scene.valid[rows],
        tracks_to_predict=_renumbered(scene.tracks_to_predict, number),
        objects_of_interest=_renumbered(scene.objects_of_interest, number),
    )


def _distances(scene: Scene) -> Float[np.ndarray, " objects"]:
    """Each object's smallest distance from the SDC [m], infinite if never together."""
    offset = scene.position[..., :2] - scene.position[scene.sdc_index, :, :2]
    together = scene.valid & scene.valid[scene.sdc_index]
    # Values that are not valid may be anything, NaN too.
    squared = np.where(together, np.square(offset).sum(-1), np.inf)
    return np.sqrt(squared.min(1, initial=np.inf))


def _renumbered(rows: tuple[int, ...], number: dict[int, int]) -> tuple[int, ...]:
    return tuple(number[row] for row in rows if row in number)
