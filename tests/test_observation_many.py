"""Observations of procedural and real scenes: against brute force, and in batches."""

import numpy as np
import pytest

from sim.bank import BankFile
from sim.features import POSITION_SCALE, SIZE_SCALE
from sim.observation import (
    ObservationConfig,
    observation_sizes,
    observe_batch,
)
from sim.procedural import generate_many
from sim.world import View
from tests import scenes
from tests.seeing import CONFIG, SMALL, batch_of, seen


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    return scenes.bank_of(list(generate_many(21, 3)), tmp_path_factory.mktemp("made"))


@pytest.mark.parametrize("config", [CONFIG, SMALL], ids=["default", "small"])
def test_shapes_are_the_announced_sizes(made: BankFile, config) -> None:
    found, sizes = seen(made, 0, 20, 1, config), observation_sizes(config)
    assert found.ego.shape == (sizes.ego,)
    assert found.agents.shape == (sizes.neighbours, sizes.agent)
    assert found.agents_valid.shape == (sizes.neighbours,)
    assert found.road.shape == (sizes.rows, sizes.road)
    assert found.road_valid.shape == (sizes.rows,)
    assert found.lights.shape == (sizes.lights, sizes.light)
    assert found.lights_valid.shape == (sizes.lights,)
    assert all(
        value.dtype == (bool if name.endswith("valid") else np.float32)
        for name, value in found._asdict().items()
    )


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"history": 1}, "history=1 must be >= 2"),
        ({"road_rows": 0}, "road_rows=0 must be 1 to 64"),
        ({"road_rows": 65}, "road_rows=65 must be 1 to 64"),
    ],
)
def test_sizes_that_show_nothing_are_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ObservationConfig(**wrong)


def test_values_that_are_not_valid_are_zero(made: BankFile) -> None:
    for step, controlled in ((10, 0), (40, 2), (90, 5)):
        found = seen(made, 1, step, controlled)
        for name in ("agents", "road", "lights"):
            values, valid = getattr(found, name), getattr(found, f"{name}_valid")
            assert not values[~valid].any(), name
            assert (np.abs(values[valid]).sum(-1) > 0).all(), name


def test_neighbours_are_the_nearest_valid_ones(made: BankFile) -> None:
    for scene in range(made.scenes):
        for step in (10, 45, 80):
            log = made.arrays["log"][scene, step]
            valid = made.arrays["log_valid"][scene, step]
            for controlled in np.flatnonzero(valid)[:4]:
                own = log[controlled]
                distance = np.hypot(*(log[:, :2] - own[:2]).T)
                others = [
                    row
                    for row in np.argsort(distance, kind="stable")
                    if valid[row] and row != controlled and distance[row] < 60.0
                ][: CONFIG.neighbours]
                found = seen(made, scene, step, int(controlled))
                assert found.agents_valid.sum() == len(others)
                assert found.agents_valid[: len(others)].all()
                cos, sin = np.cos(own[3]), np.sin(own[3])
                place = log[others, :2] - own[:2]
                ahead = (cos * place[:, 0] + sin * place[:, 1]) / POSITION_SCALE
                aside = (cos * place[:, 1] - sin * place[:, 0]) / POSITION_SCALE
                now = found.agents[: len(others), 7 * (CONFIG.history - 1) :]
                np.testing.assert_allclose(now[:, 0], ahead, atol=1e-5)
                np.testing.assert_allclose(now[:, 1], aside, atol=1e-5)


def test_road_rows_are_the_nearest_to_the_cell(made: BankFile) -> None:
    """Cells are 5 m wide: a row that is left out is nearly as far as the last seen."""
    config = ObservationConfig(road_rows=12)
    few, all_rows = seen(made, 0, 30, 1, config), seen(made, 0, 30, 1)
    np.testing.assert_array_equal(few.road, all_rows.road[:12])

    def distance(rows: np.ndarray) -> np.ndarray:
        middle = rows[:, :2] * POSITION_SCALE
        half = rows[:, 2:4] * rows[:, 4:5] * SIZE_SCALE
        along = np.clip(
            -(middle * half).sum(1) / np.maximum((half**2).sum(1), 1e-9), -1, 1
        )
        return np.hypot(*(middle + along[:, None] * half).T)

    rows = all_rows.road[all_rows.road_valid]
    slack = 5 * np.sqrt(2) + 0.2
    assert distance(rows[:12]).max() <= distance(rows[12:]).min() + slack


def test_far_from_the_map_nothing_breaks(made: BankFile) -> None:
    found = seen(made, 0, 30, 1, offset=np.array([5e4, -5e4, 0, 0, 0]))
    assert all(np.isfinite(value).all() for value in found)
    assert not found.agents_valid.any()


@pytest.mark.slow
def test_the_real_scenes_bit_for_bit_in_batches_of_any_size(real) -> None:
    """All finite and of about unit range, too."""
    recorded, file = real
    rng = np.random.default_rng(3)
    scene = rng.integers(0, len(recorded), 512)
    step = rng.integers(0, 91, 512)
    controlled = np.array([rng.integers(file.arrays["objects"][row]) for row in scene])
    whole = batch_of(file, scene, step, controlled)
    for name, value in whole._asdict().items():
        assert np.isfinite(value).all(), name
        assert np.abs(value).max() < 50, name
    places = [slice(row, row + 1) for row in range(100)] + [slice(0, 33)]
    for place in places:
        part = batch_of(file, scene[place], step[place], controlled[place])
        for name, value in part._asdict().items():
            np.testing.assert_array_equal(
                value, getattr(whole, name)[place], err_msg=f"{name} of {place}"
            )


def test_observing_compiles_once(made: BankFile) -> None:
    jitted, traces = scenes.counted(lambda *args: observe_batch(*args, SMALL))
    for start in (0, 1):
        rows = np.full(4, start, np.int32)
        view = View(
            scene=rows,
            step=rows + 10,
            controlled=rows[:, None],
            history=np.zeros((4, 1, 2, 5), np.float32) + start,
            history_valid=np.ones((4, 1, 2), bool),
        )
        jitted(made.bank, view)
    assert len(traces) == 1
