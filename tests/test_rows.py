"""A row's states render the very observations that its actor acted on."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors import acting, actor, policy, rows
from actors.acting import ActingConfig, Transitions
from actors.network import NetworkConfig
from sim.bank import BankFile
from sim.environment import EnvironmentConfig
from sim.observation import Observation
from sim.procedural import generate_many
from tests import scenes

ENVIRONMENTS = 5
SCANS = 8
CONFIG = ActingConfig(
    environment=EnvironmentConfig(progress=0.1, terminate=True),
    network=NetworkConfig(width=16, heads=2, latents=2, mlp_width=16, mlp_layers=1),
    scan_steps=14,
    watched=1,
)

Acted = tuple[BankFile, np.ndarray, Transitions, Observation]


@pytest.fixture(scope="module")
def acted(tmp_path_factory: pytest.TempPathFactory) -> Acted:
    """Rows of several scans, and the observations that were acted on, in order.

    The acting program is the real one: a callback hands out what it observed.
    """
    short = scenes.scene_of(
        [scenes.driver(), scenes.driver(y=20.0)], roads=scenes.corridor(half=30.0)
    )
    made = [*generate_many(13, 2), short]
    file = scenes.bank_of(made, tmp_path_factory.mktemp("rows"))
    seen: list[Observation] = []
    observe_batch = acting.observe_batch

    def spied(*args):
        observation = observe_batch(*args)
        jax.debug.callback(
            lambda *values: seen.append(
                Observation(*(np.array(value) for value in values))
            ),
            *observation,
            ordered=True,
        )
        return observation

    environment = CONFIG.environment
    vector = jax.jit(policy.random_vector, static_argnums=(1, 2))(
        jax.random.key(0), CONFIG.network, environment
    )
    running = jax.jit(acting.start, static_argnums=(2, 3))(
        jax.random.key(1), file.bank, ENVIRONMENTS, environment
    )
    epsilon = jnp.full(ENVIRONMENTS, 0.3)
    batches = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(acting, "observe_batch", spied)
        act = jax.jit(functools.partial(acting.act, config=CONFIG))
        for scan in range(SCANS):
            running, batch = act(
                jax.random.key(2 + scan), file.bank, vector, running, epsilon
            )
            batches.append(jax.device_get(batch))
        jax.effects_barrier()
    written = np.concatenate(
        [actor.rows_of(batch, version=3, actor=0, first=0) for batch in batches]
    )
    transitions = jax.tree.map(lambda *parts: np.concatenate(parts), *batches)
    return (
        file,
        written,
        transitions,
        jax.tree.map(lambda *parts: np.concatenate(parts), *seen),
    )


_render, _traces = scenes.counted(
    lambda bank, columns: rows.render(bank, columns, CONFIG.environment.observation)
)


def rendered(file: BankFile, written: np.ndarray) -> tuple[Observation, Observation]:
    """`rows.render` in a program of its own."""
    return jax.device_get(_render(file.bank, rows.columns_of(written)))


def assert_bits(one: Observation, other: Observation) -> None:
    """Equal bit for bit, the sign of zero and all."""
    for name in Observation._fields:
        left, right = np.asarray(getattr(one, name)), np.asarray(getattr(other, name))
        assert left.dtype == right.dtype
        assert left.tobytes() == right.tobytes(), name


def part(observation: Observation, index: slice | np.ndarray) -> Observation:
    """Some rows of a batch."""
    return Observation(*(np.asarray(value)[index] for value in observation))


def test_there_was_something_to_see(acted: Acted) -> None:
    _, written, transitions, seen = acted
    assert len(written) == len(seen.ego) == SCANS * CONFIG.scan_steps * ENVIRONMENTS
    ended = transitions.over.ravel()
    discount = transitions.discount.ravel()
    assert (ended & (discount == 1)).any()  # truncated
    assert (ended & (discount == 0)).any()  # terminated
    assert (np.asarray(seen.agents_valid).sum(1) > 0).any()


@pytest.mark.parametrize("batch", [1, 64, SCANS * CONFIG.scan_steps * ENVIRONMENTS])
def test_a_row_renders_what_its_actor_saw_bit_for_bit(acted: Acted, batch) -> None:
    file, written, _, seen = acted
    starts = range(0, len(written) - batch + 1, max(batch, len(written) // 10))
    for start in starts:
        here = slice(start, start + batch)
        before, _ = rendered(file, written[here])
        assert_bits(before, part(seen, here))


def test_the_next_observation_is_the_one_acted_on_next(acted: Acted) -> None:
    """Bit for bit, except where a new episode has begun in between."""
    file, written, transitions, seen = acted
    _, after = rendered(file, written)
    goes_on = np.flatnonzero(~transitions.over.ravel()[:-ENVIRONMENTS])
    assert len(goes_on) > len(written) // 2
    assert_bits(part(after, goes_on), part(seen, goes_on + ENVIRONMENTS))


def test_a_row_holds_what_the_replay_stores(acted: Acted) -> None:
    file, written, transitions, _ = acted
    spec = rows.row_spec(CONFIG.environment.observation.history)
    assert written.dtype == spec.dtype
    assert spec.row_bytes == written.dtype.itemsize
    assert spec.row_bytes <= 300
    for name in ("scene", "step", "controlled", "action", "reward", "discount"):
        np.testing.assert_array_equal(written[name], getattr(transitions, name).ravel())
    assert set(np.unique(written["discount"])) == {0.0, 1.0}
    assert (written["weights_version"] == 3).all()
    assert (written["controlled"] == file.arrays["sdc"][written["scene"]]).all()


def test_columns_are_the_rows(acted: Acted) -> None:
    _, written, _, _ = acted
    columns = rows.columns_of(written)
    np.testing.assert_array_equal(columns.states, written["states"])
    np.testing.assert_array_equal(columns.valid, written["valid"] == 1)
    assert all(column.flags.c_contiguous for column in columns)


def test_layouts_differ_with_the_history() -> None:
    assert rows.row_spec(3).schema_hash == rows.row_spec(3).schema_hash
    assert rows.row_spec(3).schema_hash != rows.row_spec(4).schema_hash
    assert rows.row_spec(4).dtype["states"].shape == (5, 5)


def test_rendering_compiles_once_for_a_batch_size(acted: Acted) -> None:
    file, written, _, _ = acted
    rendered(file, written[:64])
    before = len(_traces)
    rendered(file, written[64:128])
    assert len(_traces) == before


def test_a_row_of_n_steps_shows_both_its_ends() -> None:
    spec = rows.row_spec(3, n_step=2)
    assert spec.dtype["states"].shape == (5, 5)
    assert spec.dtype["reward"].shape == spec.dtype["discount"].shape == (2,)
    assert rows.row_spec(3, n_step=1).schema_hash == rows.row_spec(3).schema_hash
    some = np.zeros(4, spec.dtype)
    some["step"], some["valid"] = 12, [0, 1, 1, 1, 1]
    some["states"] = np.arange(5)[:, None]
    before, after = rows.views_of(rows.columns_of(some), 3)
    assert (before.step == 10).all()
    assert (after.step == 12).all()
    np.testing.assert_array_equal(before.history[0, 0, :, 0], [0, 1, 2])
    np.testing.assert_array_equal(after.history[0, 0, :, 0], [2, 3, 4])
    np.testing.assert_array_equal(before.history_valid[0, 0], [False, True, True])
