"""Reading a policy: found where a user points, refused in one line where damaged."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors import policy
from actors.network import (
    NetworkConfig,
    batched,
    layout_hash,
    parameter_count,
    parameter_layout,
)
from actors.policy import Policy, PolicyError, find_policy, read_policy
from sim import environment
from sim.agents import discrete
from sim.dynamics import ActionConfig
from sim.environment import EnvironmentConfig, State
from sim.observation import ObservationConfig, observation_sizes, observe
from sim.procedural import generate_many
from tests import scenes

NETWORK = NetworkConfig(width=16, heads=2, latents=2, mlp_width=16, mlp_layers=1)
CONFIG = EnvironmentConfig(
    observation=ObservationConfig(neighbours=4, road_rows=8, lights=1)
)
SIZES = observation_sizes(CONFIG.observation)
ACTIONS = CONFIG.action.count
LAYOUT = parameter_layout(NETWORK, SIZES, ACTIONS)
ZEROS = np.zeros(parameter_count(LAYOUT), np.float32)


def vector() -> np.ndarray:
    """Some weights."""
    return np.random.default_rng(0).normal(0, 0.1, len(ZEROS)).astype(np.float32)


def save(folder: Path, **changes: object) -> Path:
    """A policy's file; None leaves an array out."""
    arrays = {
        "vector": vector(),
        "network": json.dumps(dataclasses.asdict(NETWORK)),
        "sizes": json.dumps(SIZES._asdict()),
        "actions": ACTIONS,
        "extra": json.dumps({"updates": 7}),
        "layout_hash": layout_hash(LAYOUT),
    } | changes
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / policy.POLICY
    np.savez(
        path, **{name: value for name, value in arrays.items() if value is not None}
    )
    return path


def refusal(path: Path) -> str:
    """The message with which a policy is refused: one line."""
    with pytest.raises(PolicyError) as caught:
        read_policy(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_what_was_saved_is_read(tmp_path: Path) -> None:
    read = read_policy(save(tmp_path))
    np.testing.assert_array_equal(read.vector, vector())
    assert (read.network, read.sizes, read.actions) == (NETWORK, SIZES, ACTIONS)
    assert read.extra == {"updates": 7}
    read.check(CONFIG, tmp_path)


def test_a_run_its_checkpoints_or_one_of_them_may_be_named(tmp_path: Path) -> None:
    run = tmp_path / "run"
    old = save(run / "checkpoints" / "000000100")
    new = save(run / "checkpoints" / "000000200")
    (run / "checkpoints" / policy.LATEST).write_text("000000200\n")
    assert find_policy(run) == find_policy(run / "checkpoints") == new
    assert find_policy(new.parent) == find_policy(new) == new
    assert find_policy(old.parent) == old


def test_a_missing_policy_is_named(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none", tmp_path / "none" / policy.POLICY):
        message = refusal(path)
        assert message.startswith(f"{path}: no checkpoint there")
        assert "name a run folder" in message
    (tmp_path / policy.LATEST).write_text("000000300")
    assert "no checkpoint there" in refusal(tmp_path)


def test_a_truncated_policy_is_refused(tmp_path: Path) -> None:
    content = save(tmp_path).read_bytes()
    path = tmp_path / policy.POLICY
    for length in (0, 1, 10, len(content) // 2, len(content) - 10):
        path.write_bytes(content[:length])
        message = refusal(path)
        assert message.startswith(f"{path}: cannot be read as a policy")
        assert "use another checkpoint" in message


def test_a_damaged_policy_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path)
    content = bytearray(path.read_bytes())
    content[500] ^= 0xFF  # within the vector, which its zip member's sum covers
    path.write_bytes(bytes(content))
    assert "cannot be read as a policy" in refusal(path)


def test_another_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / policy.POLICY
    path.write_text("not a policy")
    assert "cannot be read as a policy" in refusal(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    path.write_bytes((tmp_path / "array.npy").read_bytes())
    assert "cannot be read as a policy" in refusal(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"vector": None},
        {"layout_hash": None},
        {"network": "{"},
        {"network": json.dumps({"nonsense": 1})},
        {"network": json.dumps({"width": 0})},
        {"network": json.dumps([1])},
        {"sizes": json.dumps({"ego": 1})},
        {"sizes": json.dumps(dict.fromkeys(SIZES._fields, "many"))},
        {"actions": "many"},
        {"extra": "{"},
        {"vector": np.array([{}], object)},
        {"vector": ZEROS[None]},
        {"vector": ZEROS.astype(np.float64)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_policy_of_another_version_is_refused(tmp_path: Path, changes) -> None:
    assert "cannot be read as a policy" in refusal(save(tmp_path, **changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"vector": ZEROS[:-1]},
        {"layout_hash": "0" * 16},
        {"actions": ACTIONS + 1},
        {"network": json.dumps(dataclasses.asdict(NETWORK) | {"latents": 3})},
    ],
    ids=["short", "hash", "actions", "latents"],
)
def test_weights_of_another_network_are_refused(tmp_path: Path, changes) -> None:
    message = refusal(save(tmp_path, **changes))
    assert "laid out for another network" in message
    assert "use another checkpoint" in message


@pytest.mark.parametrize(
    "other",
    [
        dataclasses.replace(CONFIG, observation=ObservationConfig(neighbours=5)),
        dataclasses.replace(CONFIG, action=ActionConfig(curvature_bins=3)),
    ],
    ids=["observation", "action"],
)
def test_a_policy_refuses_an_environment_it_does_not_fit(other) -> None:
    read = Policy(vector(), NETWORK, SIZES, ACTIONS, {})
    with pytest.raises(
        PolicyError, match=r"runs/x is of another network.*config\.json"
    ):
        read.check(other, Path("runs/x"))


def test_untrained_weights_fill_the_layout() -> None:
    drawn = jax.jit(policy.random_vector, static_argnums=(1, 2))
    weights, same, other = (
        np.asarray(drawn(jax.random.key(seed), NETWORK, CONFIG)) for seed in (0, 0, 1)
    )
    assert weights.shape == ZEROS.shape
    assert weights.dtype == np.float32
    assert np.isfinite(weights).all()
    assert (weights != other).any()
    np.testing.assert_array_equal(weights, same)


@pytest.mark.slow
def test_greedy_takes_the_highest_q_value_of_every_object(tmp_path: Path) -> None:
    file = scenes.bank_of(list(generate_many(3, 1)), tmp_path)
    bank = file.bank
    controlled = jnp.arange(5, dtype=jnp.int32)
    state = jax.jit(environment.reset, static_argnums=3)(
        bank, jnp.int32(0), controlled, CONFIG
    )
    weights = jnp.asarray(vector())
    agent = policy.greedy(weights, NETWORK, CONFIG)
    decision = jax.jit(agent)(jax.random.key(0), bank, state)

    def q_values(state: State) -> jax.Array:
        observation = observe(bank, state.view, CONFIG.observation)
        return batched(
            weights, observation, config=NETWORK, sizes=SIZES, actions=ACTIONS
        )

    np.testing.assert_allclose(decision.q_values, jax.jit(q_values)(state), atol=1e-5)
    np.testing.assert_array_equal(decision.action, decision.q_values.argmax(1))
    moved = jax.jit(discrete, static_argnums=3)(
        state.history[:, -1], decision.action, decision.q_values, CONFIG
    ).moved
    np.testing.assert_allclose(decision.moved, moved, atol=1e-5)
