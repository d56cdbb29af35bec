"""A row's states render the very observations that its actor acted on."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors import acting, policy, rows, windows
from actors.acting import ActingConfig, Transitions
from actors.network import NetworkConfig
from sim.bank import BankFile
from sim.environment import EnvironmentConfig
from sim.episodes import NearestToSdc
from sim.observation import Observation, observe_batch
from sim.procedural import generate_many
from tests import scenes

ENVIRONMENTS = 5
SCANS = 8
N_STEP = 3
CONFIG = ActingConfig(
    environment=EnvironmentConfig(progress=0.1, terminate=True),
    network=NetworkConfig(width=16, heads=2, latents=2, mlp_width=16, mlp_layers=1),
    scan_steps=14,
    watched=1,
)


class Acted(NamedTuple):
    """What an actor did and saw."""

    file: BankFile
    transitions: Transitions  # `action` numbers them, as `seen` is ordered
    seen: Observation  # what each slot acted on, by step, environment and slot

    def rows(self, n_step: int) -> np.ndarray:
        """What is written of it, scan by scan."""
        made = windows.Windows(n_step=n_step, discount=0.9, actor=0)
        scans = range(0, len(self.transitions.scene), CONFIG.scan_steps)
        parts = [
            Transitions(
                *(part[at : at + CONFIG.scan_steps] for part in self.transitions)
            )
            for at in scans
        ]
        return np.concatenate([made.add(part, version=3) for part in parts])


def act(file: BankFile, config: ActingConfig) -> Acted:
    """Several scans of the real acting program: a callback hands out what it saw."""
    seen: list[Observation] = []
    observe_first_batch = acting.observe_first_batch

    def spied(*args):
        observation = observe_first_batch(*args)
        jax.debug.callback(
            lambda *values: seen.append(
                Observation(*(np.array(value) for value in values))
            ),
            *observation,
            ordered=True,
        )
        return observation

    vector = jax.jit(policy.random_vector, static_argnums=(1, 2))(
        jax.random.key(0), config.network, config.environment
    )
    begin = acting.begin_of(file.bank, config)
    running = jax.jit(acting.start, static_argnums=2)(
        jax.random.key(1), begin, ENVIRONMENTS
    )
    epsilon = jnp.full(ENVIRONMENTS, 0.3)
    batches = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(acting, "observe_first_batch", spied)
        scan, traces = scenes.counted(functools.partial(acting.act, config=config))
        for number in range(SCANS):
            running, batch = scan(
                jax.random.key(2 + number), file.bank, begin, vector, running, epsilon
            )
            batches.append(jax.device_get(batch))
        jax.effects_barrier()
    assert len(traces) == 1
    transitions = jax.tree.map(lambda *parts: np.concatenate(parts), *batches)
    count = np.arange(transitions.action.size, dtype=np.int32)
    return Acted(
        file,
        transitions._replace(action=count.reshape(transitions.action.shape)),
        jax.tree.map(lambda *parts: np.concatenate(parts), *seen),
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    short = scenes.scene_of(
        [scenes.driver(), scenes.driver(y=20.0)], roads=scenes.corridor(half=30.0)
    )
    made = [*generate_many(13, 2), short]
    return scenes.bank_of(made, tmp_path_factory.mktemp("rows"))


@pytest.fixture(scope="module")
def acted(file: BankFile) -> Acted:
    return act(file, CONFIG)


@pytest.fixture(scope="module")
def several(file: BankFile) -> Acted:
    """Three objects at most in each environment; the short scene has two."""
    choose = NearestToSdc(3, moving=True, vehicles=True)
    return act(file, dataclasses.replace(CONFIG, choose=choose))


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
    transitions = acted.transitions
    assert len(acted.seen.ego) == SCANS * CONFIG.scan_steps * ENVIRONMENTS
    ended, discount = transitions.over, transitions.discount
    assert transitions.present.all()
    assert (ended & (discount == 1)).any()  # truncated
    assert (ended & (discount == 0)).any()  # terminated
    assert (np.asarray(acted.seen.agents_valid).sum(1) > 0).any()


@pytest.mark.parametrize("batch", [1, 64, SCANS * CONFIG.scan_steps * ENVIRONMENTS])
def test_a_row_renders_what_its_actor_saw_bit_for_bit(acted: Acted, batch) -> None:
    written = acted.rows(1)
    starts = range(0, len(written) - batch + 1, max(batch, len(written) // 10))
    for start in starts:
        here = slice(start, start + batch)
        before, _ = rendered(acted.file, written[here])
        assert_bits(before, part(acted.seen, here))


def check_both_ends(acted: Acted, n_step: int) -> None:
    """Bit for bit, the second one where no new episode has begun in between."""
    written = acted.rows(n_step)
    before, after = rendered(acted.file, written)
    count = written["action"]
    assert_bits(before, part(acted.seen, count))
    slots = acted.transitions.over.shape[2]
    span = written["span"] if n_step > 1 else np.ones(len(written), int)
    last = count + (span - 1) * ENVIRONMENTS * slots
    following = last + ENVIRONMENTS * slots
    goes_on = ~acted.transitions.over.ravel()[last]
    goes_on &= following < len(acted.seen.ego)
    assert goes_on.sum() > len(written) // 2
    assert_bits(part(after, goes_on), part(acted.seen, following[goes_on]))
    assert set(np.unique(span)) == set(range(1, n_step + 1))


@pytest.mark.parametrize("n_step", [1, pytest.param(N_STEP, marks=pytest.mark.slow)])
def test_the_observation_n_steps_later_is_the_one_acted_on_then(
    acted: Acted, n_step: int
) -> None:
    check_both_ends(acted, n_step)


@pytest.mark.slow
@pytest.mark.parametrize("n_step", [1, N_STEP])
def test_rows_of_several_objects_render_what_each_of_them_saw(
    several: Acted, n_step: int
) -> None:
    check_both_ends(several, n_step)


@pytest.mark.slow
def test_what_one_of_several_sees_is_what_it_sees_among_them(several: Acted) -> None:
    """`observe_first` reads the seen ones only; `observe` makes the whole world."""
    written = several.rows(1)[:64]
    before, _ = rows.views_of(rows.columns_of(written), 3)
    config = CONFIG.environment.observation
    of_all = jax.jit(observe_batch, static_argnums=2)(several.file.bank, before, config)
    for name, values in of_all._asdict().items():
        seen = getattr(several.seen, name)[written["action"]]
        np.testing.assert_allclose(values[:, 0], seen, atol=1e-5, err_msg=name)
    logged = before._replace(controlled=before.controlled[:, :1])
    logged = logged._replace(
        history=before.history[:, :1], history_valid=before.history_valid[:, :1]
    )
    alone = jax.jit(observe_batch, static_argnums=2)(several.file.bank, logged, config)
    assert (np.abs(np.asarray(alone.agents) - of_all.agents[:, :1]) > 0.01).any()


@pytest.mark.slow
def test_each_of_several_objects_has_episodes_of_its_own(several: Acted) -> None:
    """Once failed, nothing of it is written until its environment starts anew."""
    got, bank = several.transitions, several.file
    rows_of_log = bank.arrays["log"].shape[2]
    there = got.controlled < rows_of_log
    assert not (got.present & ~there).any()
    assert (got.present.sum(2) == 3).any()
    failure = got.overlap | got.offroad
    terminal = got.discount == 0
    alone_ended = 0
    for environment, slot in np.ndindex(ENVIRONMENTS, 3):
        ended = False
        for step in range(len(got.scene)):
            at = (step, environment, slot)
            here = got.step[step, environment]
            first = bank.arrays["current_step"][got.scene[step, environment]] + 1
            fresh = here == first
            ended &= not fresh
            valid = got.valid[at]
            recorded = valid[-2] and valid[-1]
            assert got.present[at] == (recorded and not ended)
            if got.present[at]:
                assert terminal[at] == failure[at]
                ended |= bool(terminal[at])
            alone_ended += ended and got.present[step, environment].any()
    assert alone_ended > 5


def test_a_row_holds_what_the_replay_stores(acted: Acted) -> None:
    transitions, written = acted.transitions, acted.rows(1)
    spec = rows.row_spec(CONFIG.environment.observation.history)
    assert written.dtype == spec.dtype
    assert spec.row_bytes == written.dtype.itemsize
    assert spec.row_bytes <= 300
    for name in ("scene", "step", "controlled", "action", "reward", "discount"):
        np.testing.assert_array_equal(written[name], getattr(transitions, name).ravel())
    assert set(np.unique(written["discount"])) == {0.0, 1.0}
    assert (written["weights_version"] == 3).all()
    sdc = acted.file.arrays["sdc"]
    assert (written["controlled"] == sdc[written["scene"]]).all()


def test_columns_are_the_rows(acted: Acted) -> None:
    written = acted.rows(1)
    columns = rows.columns_of(written)
    np.testing.assert_array_equal(columns.states[:, 0], written["states"])
    np.testing.assert_array_equal(columns.valid[:, 0], written["valid"] == 1)
    assert all(column.flags.c_contiguous for column in columns if column is not None)


def test_layouts_differ_with_the_history() -> None:
    assert rows.row_spec(3).schema_hash == rows.row_spec(3).schema_hash
    assert rows.row_spec(3).schema_hash != rows.row_spec(4).schema_hash
    assert rows.row_spec(4).dtype["states"].shape == (5, 5)


def test_rendering_compiles_once_for_a_batch_size(acted: Acted) -> None:
    written = acted.rows(1)
    rendered(acted.file, written[:64])
    before = len(_traces)
    rendered(acted.file, written[64:128])
    assert len(_traces) == before


def test_a_row_shows_both_its_ends() -> None:
    """Of three steps at most: the second one spans two."""
    spec = rows.row_spec(3, n_step=3, others=1)
    assert spec.dtype["states"].shape == (6, 5)
    assert rows.row_spec(3, n_step=1).schema_hash == rows.row_spec(3).schema_hash
    some = np.zeros(2, spec.dtype)
    some["step"], some["valid"], some["span"] = 12, [0, 1, 1, 1, 1, 1], [3, 2]
    some["states"] = np.arange(6)[:, None]
    some["others_states"] = 10 + np.arange(6)[:, None]
    some["controlled"], some["others"] = 1, 4
    before, after = rows.views_of(rows.columns_of(some), 3)
    assert before.step.tolist() == [9, 10]
    assert after.step.tolist() == [12, 12]
    assert before.controlled.tolist() == [[1, 4], [1, 4]]
    np.testing.assert_array_equal(before.history[0, :, :, 0], [[0, 1, 2], [10, 11, 12]])
    np.testing.assert_array_equal(after.history[0, :, :, 0], [[3, 4, 5], [13, 14, 15]])
    np.testing.assert_array_equal(after.history[1, 0, :, 0], [2, 3, 4])
    np.testing.assert_array_equal(before.history_valid[0, 0], [False, True, True])


def test_bytes_of_a_transition() -> None:
    """With three states of history; six objects that drive fit in 600 bytes."""
    sizes = {
        (1, 1): rows.row_spec(3).row_bytes,
        (1, 3): rows.row_spec(3, n_step=3).row_bytes,
        (6, 1): rows.row_spec(3, others=5).row_bytes,
        (8, 1): rows.row_spec(3, others=7).row_bytes,
        (8, 3): rows.row_spec(3, n_step=3, others=7).row_bytes,
    }
    assert sizes == {(1, 1): 128, (1, 3): 192, (6, 1): 576, (8, 1): 768, (8, 3): 1088}
