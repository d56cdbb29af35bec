"""The acting scan and the loop around it."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors import acting, policy
from actors.acting import ActingConfig, Running, Transitions
from actors.actor import ActorConfig, exploration, run_actor
from actors.network import NetworkConfig
from sim.bank import BankFile
from sim.environment import EnvironmentConfig
from sim.observation import ObservationConfig
from sim.procedural import generate_many
from tests import scenes

ENVIRONMENTS = 6
CONFIG = ActingConfig(
    environment=EnvironmentConfig(
        observation=ObservationConfig(neighbours=4, road_rows=8, lights=1),
        progress=0.1,
        terminate=True,
    ),
    network=NetworkConfig(width=16, heads=2, latents=2, mlp_width=16, mlp_layers=1),
    scan_steps=10,
    watched=2,
)
SCANS = 8


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> BankFile:
    short = scenes.scene_of(
        [scenes.driver(), scenes.driver(y=20.0)], roads=scenes.corridor(half=30.0)
    )
    return scenes.bank_of(
        [*generate_many(17, 2), short], tmp_path_factory.mktemp("acting")
    )


_random_vector = jax.jit(policy.random_vector, static_argnums=(1, 2))
_start = jax.jit(acting.start, static_argnums=2)


def weights(seed: int = 0) -> jax.Array:
    """Of an untrained network."""
    return _random_vector(jax.random.key(seed), CONFIG.network, CONFIG.environment)


class Scan(NamedTuple):
    """One call of `act`."""

    before: Running
    batch: Transitions


_act, _traces = scenes.counted(functools.partial(acting.act, config=CONFIG))


def scans(file: BankFile, epsilon: np.ndarray, seed: int = 0) -> list[Scan]:
    """Several calls, one after the other."""
    start_key, *keys = jax.random.split(jax.random.key(seed), SCANS + 1)
    begin = acting.begin_of(file.bank, CONFIG)
    running = _start(start_key, begin, ENVIRONMENTS)
    results = []
    for key in keys:
        after, batch = _act(
            key, file.bank, begin, weights(), running, jnp.asarray(epsilon)
        )
        results.append(Scan(running, jax.device_get(batch)))
        running = after
    return results


def joined(results: list[Scan]) -> Transitions:
    """The scans' transitions behind one another, without the axis of the one object."""
    every = jax.tree.map(
        lambda *parts: np.concatenate(parts), *(scan.batch for scan in results)
    )
    assert every.present.all()
    shared = ("scene", "step", "q_values")
    return Transitions(
        **{
            name: values if name in shared else values[:, :, 0]
            for name, values in every._asdict().items()
        }
    )


@pytest.fixture(scope="module")
def acted(file: BankFile) -> Transitions:
    """With some exploration."""
    return joined(scans(file, np.full(ENVIRONMENTS, 0.3, np.float32)))


def test_epsilons_are_log_spaced_over_all_actors() -> None:
    shares = [
        acting.epsilons(actor=actor, actors=3, environments=4, lowest=0.01, highest=0.4)
        for actor in range(3)
    ]
    every = np.stack(shares, 1).ravel()  # interleaved: the first of each, and so on
    np.testing.assert_allclose(every[[0, -1]], [0.4, 0.01], rtol=1e-6)
    np.testing.assert_allclose(
        np.diff(np.log(every)), np.log(0.01 / 0.4) / 11, rtol=1e-5
    )
    assert all(share.dtype == np.float32 for share in shares)


def test_one_environment_explores_most() -> None:
    alone = acting.epsilons(actor=0, actors=1, environments=1, lowest=0.01, highest=0.4)
    np.testing.assert_allclose(alone, [0.4])


def test_exploration_is_as_configured() -> None:
    config = ActorConfig(environments=4, epsilon_lowest=0.02, epsilon_highest=0.5)
    found = np.concatenate(
        [exploration(config, actor=actor, actors=2) for actor in range(2)]
    )
    assert found.max() == pytest.approx(0.5)
    assert found.min() == pytest.approx(0.02)


def test_s_t_is_the_next_s_tm1_within_an_episode(acted: Transitions) -> None:
    goes_on = ~acted.over[:-1]
    assert goes_on.mean() > 0.5
    for name, shifted in (
        ("states", (acted.states[:-1, :, 1:], acted.states[1:, :, :-1])),
        ("valid", (acted.valid[:-1, :, 1:], acted.valid[1:, :, :-1])),
        ("scene", (acted.scene[:-1], acted.scene[1:])),
        ("controlled", (acted.controlled[:-1], acted.controlled[1:])),
        ("step", (acted.step[:-1] + 1, acted.step[1:])),
    ):
        before, after = shifted
        np.testing.assert_array_equal(before[goes_on], after[goes_on], err_msg=name)


def test_an_episode_starts_where_the_recording_lets_act(
    file: BankFile, acted: Transitions
) -> None:
    steps, rows = np.nonzero(acted.over[:-1])
    assert len(steps) > 5
    log, current = file.arrays["log"], file.arrays["current_step"]
    for step, row in zip(steps + 1, rows, strict=True):
        scene = acted.scene[step, row]
        assert acted.step[step, row] == current[scene] + 1
        assert acted.controlled[step, row] == file.arrays["sdc"][scene]
        logged = log[scene, current[scene], acted.controlled[step, row]]
        np.testing.assert_array_equal(
            acted.states[step, row, -2], logged[[0, 1, 3, 4, 5]]
        )


def test_the_state_before_a_restart_is_kept(file: BankFile, acted: Transitions) -> None:
    """The last transition of an episode ends where it ended, not where it resumes."""
    moved = np.hypot(*(acted.states[:, :, -1] - acted.states[:, :, -2])[..., :2].T)
    assert moved.max() < 4.0  # m in a step: nobody is moved to another start


def test_episodes_end_by_failure_or_with_the_recording(
    file: BankFile, acted: Transitions
) -> None:
    failure = acted.overlap | acted.offroad
    last = acted.step == file.arrays["steps"][acted.scene] - 1
    np.testing.assert_array_equal(acted.over, failure | last)
    np.testing.assert_array_equal(acted.discount == 0, failure)
    assert (acted.over & ~failure).any()
    assert (acted.over & failure).any()
    assert set(np.unique(acted.discount)) == {0.0, 1.0}


def test_scores_are_returns_of_episodes(acted: Transitions) -> None:
    score = np.zeros(ENVIRONMENTS)
    failed = np.zeros(ENVIRONMENTS, bool)
    for step in range(len(acted.over)):
        score += acted.reward[step]
        failed |= acted.overlap[step] | acted.offroad[step]
        np.testing.assert_allclose(acted.score[step], score, atol=1e-4)
        np.testing.assert_array_equal(acted.failed[step], failed)
        score[acted.over[step]] = 0.0
        failed[acted.over[step]] = False


def test_the_watched_q_values_explain_the_greedy_actions(file: BankFile) -> None:
    greedy = joined(scans(file, np.zeros(ENVIRONMENTS, np.float32)))
    assert greedy.q_values.shape[1:] == (2, CONFIG.environment.action.count)
    np.testing.assert_array_equal(greedy.q_values.argmax(-1), greedy.action[:, :2])


def test_epsilon_is_the_share_of_random_actions(file: BankFile) -> None:
    """The first environment never explores, the second always does."""
    epsilon = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0], np.float32)
    batch = joined(scans(file, epsilon, seed=5))
    greedy = batch.q_values.argmax(-1) == batch.action[:, :2]
    assert greedy[:, 0].all()
    assert greedy[:, 1].mean() < 0.2
    assert len(np.unique(batch.action[:, 1:])) > CONFIG.environment.action.count * 0.9


def test_scans_depend_on_the_key_alone(file: BankFile) -> None:
    epsilon = np.full(ENVIRONMENTS, 0.5, np.float32)
    one, same, other = (joined(scans(file, epsilon, seed)) for seed in (3, 3, 4))
    for name in Transitions._fields:
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert (one.action != other.action).any()


def test_acting_compiles_once(file: BankFile) -> None:
    begin = acting.begin_of(file.bank, CONFIG)
    running = _start(jax.random.key(0), begin, ENVIRONMENTS)
    for seed in range(3):
        epsilon = np.full(ENVIRONMENTS, 0.1 * seed, np.float32)
        running, _ = _act(
            jax.random.key(seed),
            file.bank,
            begin,
            weights(seed),
            running,
            jnp.asarray(epsilon),
        )
    assert len(_traces) == 1


class Sent(NamedTuple):
    """Stands in for the weights channel's message."""

    version: int
    vector: np.ndarray


def aligned(vector: np.ndarray) -> np.ndarray:
    """A copy at an address at which JAX may use the memory as it is."""
    space = np.empty(len(vector) + 16, np.float32)
    skip = -space.ctypes.data % 64 // 4
    space[skip : skip + len(vector)] = vector
    return space[skip : skip + len(vector)]


def loop(
    file: BankFile, versions: list[int], *, spoil: bool = False, show=None
) -> tuple[list, np.ndarray]:
    """`run_actor` for a few scans: its ticks and all rows that it wrote.

    With `spoil` the weights' buffer is overwritten after each scan, as by a channel
    that receives the next message into it.
    """
    buffer = aligned(np.asarray(weights(0)))
    sent = iter(versions)
    known = [0]
    written: list[np.ndarray] = []

    def latest() -> Sent:
        version = next(sent)
        if version != known[-1]:  # the same weights are not sent twice
            buffer[:] = weights(version)
        known.append(version)
        return Sent(version, buffer)

    ticks = []
    loop = run_actor(
        key=jax.random.key(1),
        bank=file.bank,
        config=CONFIG,
        epsilon=np.full(ENVIRONMENTS, 0.2, np.float32),
        actor=4,
        latest=latest,
        write=written.append,
        show=show,
    )
    for tick in itertools.islice(loop, len(versions)):
        ticks.append(tick)
        if spoil:
            buffer[:] = np.nan
    return ticks, np.concatenate(written)


@pytest.mark.slow
def test_the_loop_is_determined_by_its_key(file: BankFile) -> None:
    """And by the weights at the time, whatever becomes of their buffer."""
    shown: list = []
    ticks, written = loop(file, [0, 0, 7], show=shown.append)
    _, same = loop(file, [0, 0, 7], spoil=True)
    assert written.tobytes() == same.tobytes()
    per_scan = ENVIRONMENTS * CONFIG.scan_steps
    assert [tick.steps for tick in ticks] == [per_scan, 2 * per_scan, 3 * per_scan]
    assert [tick.version for tick in ticks] == [0, 0, 7]
    assert (written["serial"] == np.arange(3 * per_scan)).all()
    assert (written["actor"] == 4).all()
    assert (written["weights_version"] == np.repeat([0, 0, 7], per_scan)).all()
    for tick in ticks:
        assert tick.scores.shape == tick.failed.shape == tick.progress.shape
        assert tick.acted_s > 0
    # Frames of the two watched environments after every scan.
    assert [frame.environment for frame in shown] == [0, 1] * 3
    first = written[:per_scan:ENVIRONMENTS]
    np.testing.assert_array_equal(shown[0].frames["step"], first["step"])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"environments": 0}, "environments=0 must be at least 1"),
        ({"scan_steps": 0}, "scan_steps=0 must be at least 1"),
        ({"window": 0}, "window=0 must be at least 1"),
        ({"watched": 33}, "watched=33 must be 0 to 32 environments"),
        ({"epsilon_lowest": 0.0}, "must satisfy 0 < lowest <= highest <= 1"),
        ({"epsilon_lowest": 0.5}, "must satisfy 0 < lowest <= highest <= 1"),
        ({"epsilon_highest": 1.5}, "must satisfy 0 < lowest <= highest <= 1"),
    ],
)
def test_settings_that_cannot_work_are_refused(wrong: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ActorConfig(**wrong)
