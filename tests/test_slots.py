"""Which objects stay when there are more than slots."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.scene import Scene
from sim.slots import keep_nearest
from sim.validate import check_scene
from tests import scenes


def crowd(count: int, *, sdc: int = 0) -> Scene:
    """Cars side by side, row i at y = 3 i, all of one speed."""
    drivers = [scenes.driver(y=3.0 * row) for row in range(count)]
    made = scenes.scene_of(drivers)
    return dataclasses.replace(
        made, sdc_index=sdc, object_ids=np.arange(count) + 100, tracks_to_predict=(1,)
    )


def test_a_scene_that_fits_is_left_alone() -> None:
    scene = crowd(4)
    assert keep_nearest(scene, slots=4) is scene


def test_the_nearest_stay_in_their_order() -> None:
    kept = check_scene(keep_nearest(crowd(7, sdc=3), slots=3))
    assert kept.object_ids.tolist() == [102, 103, 104]
    assert kept.sdc_index == 1
    assert kept.tracks_to_predict == ()


def test_named_rows_go_before_nearer_ones_and_all_indices_follow() -> None:
    scene = dataclasses.replace(
        crowd(9, sdc=4), tracks_to_predict=(8, 0, 5), objects_of_interest=(4, 7)
    )
    kept = check_scene(keep_nearest(scene, slots=4, keep=(8, 0)))
    assert set(kept.object_ids) == {100, 104, 108, 103}  # 3 before 5: equally near
    assert kept.object_ids[kept.sdc_index] == 104
    assert [kept.object_ids[row] for row in kept.tracks_to_predict] == [108, 100]
    assert [kept.object_ids[row] for row in kept.objects_of_interest] == [104]


def test_more_named_than_slots_keeps_the_first_and_the_sdc() -> None:
    kept = keep_nearest(crowd(6, sdc=5), slots=2, keep=(4, 0, 1))
    assert kept.object_ids.tolist() == [104, 105]


def test_only_steps_that_both_were_recorded_at_count() -> None:
    """Row 1 passes close by while the SDC is not recorded; NaN stands there."""
    scene = crowd(3)
    position, valid = scene.position.copy(), scene.valid.copy()
    position[1, :, 1] = 50.0
    position[1, 0, :2] = position[0, 0, :2]
    valid[0, 0] = False
    position[2, 3] = np.nan
    valid[2, 3] = False
    scene = dataclasses.replace(scene, position=position, valid=valid)
    assert keep_nearest(scene, slots=2).object_ids.tolist() == [100, 102]


def test_no_slot_is_refused() -> None:
    with pytest.raises(ValueError, match="slots=0 must be at least 1"):
        keep_nearest(crowd(2), slots=0)


def nearest_by_definition(scene: Scene, row: int) -> float:
    """Oracle: step by step."""
    sdc = scene.sdc_index
    together = [t for t in range(scene.steps) if scene.valid[[row, sdc], t].all()]
    ways = [scene.position[row, t, :2] - scene.position[sdc, t, :2] for t in together]
    return min((float(np.hypot(*way)) for way in ways), default=np.inf)


@given(st.integers(0, 10**6), st.integers(1, 6))
def test_none_that_is_dropped_was_nearer(seed: int, slots: int) -> None:
    rng = np.random.default_rng(seed)
    scene = crowd(6, sdc=int(rng.integers(6)))
    scene = dataclasses.replace(
        scene,
        position=rng.normal(0, 30, scene.position.shape),
        valid=rng.random(scene.valid.shape) < 0.1,
    )
    kept = keep_nearest(scene, slots=slots)
    assert kept.objects == min(slots, scene.objects)
    assert kept.object_ids[kept.sdc_index] == scene.object_ids[scene.sdc_index]
    stay = set((kept.object_ids - 100).tolist())
    away = [nearest_by_definition(scene, row) for row in range(6)]
    others = stay - {scene.sdc_index}
    assert max((away[row] for row in others), default=0) <= min(
        (away[row] for row in set(range(6)) - stay), default=np.inf
    )
