"""The learner learns, copies its target on time, and repeats itself exactly."""

import itertools
import resource
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from actors.network import NetworkConfig
from learner.groups import in_groups
from learner.learner import Batch, Learner, LearnerConfig, UpdateResult, learn
from learner.network import shared_tensor, to_vector
from learner.training import compute_device, keep_memory
from sim.observation import Observation, ObservationSizes

SIZES = ObservationSizes(
    ego=4, neighbours=3, agent=5, rows=4, road=3, lights=1, light=2
)
ACTIONS = 4
NETWORK = NetworkConfig(width=16, heads=2, latents=2, mlp_width=32, mlp_layers=2)


def make_learner(**fields):
    config = LearnerConfig(**{"loss": "plain", "learning_rate": 1e-3, **fields})
    return Learner(config=config, network=NETWORK, sizes=SIZES, actions=ACTIONS)


def make_observations(batch, rng):
    def features(*shape):
        return rng.standard_normal((batch, *shape)).astype(np.float32)

    def mask(count):
        return rng.random((batch, count)) < 0.7

    return Observation(
        ego=features(SIZES.ego),
        agents=features(SIZES.neighbours, SIZES.agent),
        agents_valid=mask(SIZES.neighbours),
        road=features(SIZES.rows, SIZES.road),
        road_valid=mask(SIZES.rows),
        lights=features(SIZES.lights, SIZES.light),
        lights_valid=mask(SIZES.lights),
    )


def make_batches(seed=0, batch=32):
    """Random transitions for ever."""
    rng = np.random.default_rng(seed)
    while True:
        yield Batch(
            observation_tm1=make_observations(batch, rng),
            a_tm1=rng.integers(0, ACTIONS, batch).astype(np.int32),
            r_t=rng.standard_normal(batch).astype(np.float32),
            discount_t=(rng.random(batch) < 0.9).astype(np.float32),
            observation_t=make_observations(batch, rng),
            probabilities=rng.random(batch) + 0.01,
        )


def test_solves_a_bandit_with_context():
    """One step, then the end: Q is the reward, 1 for the action the ego names."""
    rng = np.random.default_rng(0)
    learner = make_learner()
    for _ in range(300):
        batch = next(make_batches(int(rng.integers(1 << 30)), 64))
        right = batch.observation_tm1.ego.argmax(axis=1)
        learner.update(
            batch._replace(
                r_t=(batch.a_tm1 == right).astype(np.float32),
                discount_t=np.zeros(64, np.float32),
            )
        )
    unseen = next(make_batches(99, 256))
    right = unseen.observation_tm1.ego.argmax(axis=1)
    reward = (unseen.a_tm1 == right).astype(np.float32)
    result = learner.update(
        unseen._replace(r_t=reward, discount_t=np.zeros(256, np.float32))
    )
    assert np.mean(result.priorities) < 0.2  # guessing the mean gives 0.375
    assert result.max_q == pytest.approx(1.0, abs=0.15)


def test_bootstraps_to_the_geometric_sum():
    """Reward 1 for ever at discount 0.5: every value is 2."""
    learner = make_learner(discount=0.5, target_period=10)
    batch = next(make_batches())
    batch = batch._replace(
        r_t=np.ones(32, np.float32),
        discount_t=np.ones(32, np.float32),
        observation_t=batch.observation_tm1,
    )
    for _ in range(400):
        result = learner.update(batch)
    assert result.mean_q == pytest.approx(2.0, abs=0.1)


def test_target_is_copied_every_period_exactly():
    learner, previous = make_learner(target_period=3), None
    for count, batch in zip(range(1, 10), make_batches(), strict=False):
        previous = to_vector(learner.target)
        learner.update(batch)
        target = to_vector(learner.target)
        if count % 3 == 0:
            np.testing.assert_array_equal(target, learner.vector())
            assert (target != previous).any()
        else:
            np.testing.assert_array_equal(target, previous)
            assert (target != learner.vector()).any()


def losses_of(learner, updates=5):
    batches = itertools.islice(make_batches(), updates)
    return [learner.update(batch).loss for batch in batches]


@pytest.mark.parametrize("loss", ["plain", "torchrl"])
def test_same_seed_same_losses(loss):
    first = losses_of(make_learner(loss=loss))
    assert first == losses_of(make_learner(loss=loss))
    assert first != losses_of(make_learner(loss=loss, seed=1))


def test_torchrl_and_plain_train_alike():
    plain, theirs = make_learner(loss="plain"), make_learner(loss="torchrl")
    np.testing.assert_allclose(losses_of(plain), losses_of(theirs), rtol=1e-4)
    np.testing.assert_allclose(plain.vector(), theirs.vector(), atol=1e-4)


def test_rewards_are_clipped():
    batch = next(make_batches())
    sign = np.where(np.arange(32) % 2, 1, -1).astype(np.float32)
    results = [
        make_learner().update(batch._replace(r_t=sign * size)).loss
        for size in (np.float32(1), np.float32(50))
    ]
    assert results[0] == results[1]


def test_configured_discount_multiplies_the_rows():
    """A discount of 0 makes every state terminal."""
    batch = next(make_batches())
    ended = batch._replace(discount_t=np.zeros(32, np.float32))
    # The first head is small; a reward-sized difference needs values of that size.
    learners = [make_learner(discount=0.0), make_learner(discount=0.9)]
    assert learners[0].update(batch).loss == learners[1].update(ended).loss


def test_rare_rows_weigh_most():
    """A row drawn 1,000 times as often hardly moves the network."""
    batch = next(make_batches())
    probabilities = np.full(32, 1.0)
    probabilities[0] = 1e-3
    heavy = make_learner(importance_exponent=1.0)
    result = heavy.update(batch._replace(probabilities=probabilities))
    losses = np.where(
        result.priorities < 1, result.priorities**2 / 2, result.priorities - 0.5
    )
    weights = np.where(np.arange(32) == 0, 1.0, 1e-3)
    assert result.loss == pytest.approx(np.mean(weights * losses), rel=1e-4)


def test_gradients_are_clipped_only_on_request():
    batch = next(make_batches())
    assert np.isnan(make_learner().update(batch).gradient_norm)
    clipped = make_learner(max_gradient_norm=1e-3)
    assert clipped.update(batch).gradient_norm > 1e-3
    total = sum(float(p.grad.square().sum()) for p in clipped.network.parameters())
    assert total**0.5 == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"learning_rate": 0.0}, "learning_rate=0.0 must be above 0"),
        ({"discount": 1.5}, "discount=1.5 must be within 0 and 1"),
        ({"importance_exponent": -1.0}, "must not be negative"),
    ],
)
def test_settings_that_learn_nothing_are_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        LearnerConfig(**fields)


class Draw(NamedTuple):
    """A stand-in for what the replay's client returns."""

    ids: np.ndarray
    probabilities: np.ndarray
    rows: np.ndarray


ROW = np.dtype([("action", "<i4"), ("reward", "<f4"), ("discount", "<f4")])


def test_the_loop_publishes_and_returns_priorities():
    rng = np.random.default_rng(0)
    published, updated = [], []
    draws = []
    for index in range(6):
        rows = np.zeros(8, ROW)
        rows["action"] = rng.integers(0, ACTIONS, 8)
        rows["reward"] = 0.1 * index
        ids = np.arange(8, dtype=np.uint64) + 8 * index
        draws.append(Draw(ids, np.full(8, 0.1), rows))
    source = iter([draws[0], None, *draws[1:]])
    learner = make_learner(publish_period=2)
    steps = learn(
        learner=learner,
        sample=lambda: next(source),
        update_priorities=lambda ids, values: updated.append((ids, values)),
        render=lambda rows: (
            make_observations(len(rows), rng),
            make_observations(len(rows), rng),
        ),
        publish=lambda version, vector: published.append((version, vector)),
    )
    turns = list(itertools.islice(steps, 7))
    assert turns[1] is None
    results = [turn.result for turn in turns if turn is not None]
    assert len(results) == 6
    assert all(isinstance(result, UpdateResult) for result in results)
    # The caller has not asked for more, so the version of update 6 is out already.
    assert [version for version, _ in published] == [0, 2, 4, 6]
    np.testing.assert_array_equal(published[-1][1], learner.vector())
    assert (published[0][1] != published[1][1]).any()
    for (ids, values), draw, result in zip(updated, draws, results, strict=True):
        np.testing.assert_array_equal(ids, draw.ids)
        np.testing.assert_array_equal(values, result.priorities)
    assert all(turn.updated_s > 0 for turn in turns if turn is not None)


@pytest.mark.parametrize("average_updates", [0, 4])
def test_the_policy_is_the_mean_of_the_weights_where_that_is_asked_for(
    average_updates: int,
) -> None:
    learner, batches = make_learner(average_updates=average_updates), make_batches()
    expected = learner.vector()
    for update in range(1, 8):
        learner.update(next(batches))
        # The definition: each update moves the mean by 1/n, n at most the window.
        share = 1.0 / min(update, average_updates) if average_updates else 1.0
        expected = expected + share * (learner.vector() - expected)
    np.testing.assert_allclose(learner.policy_vector(), expected, atol=1e-6)
    assert (learner.policy_vector() != learner.vector()).any() == (average_updates > 0)


@pytest.mark.parametrize("precision", ["bfloat16-targets", "bfloat16"])
def test_bfloat16_learns_nearly_the_same_and_keeps_float32_weights(precision):
    exact, fast = make_learner(), make_learner(precision=precision)
    ours, theirs = losses_of(exact, 20), losses_of(fast, 20)
    assert ours != theirs
    np.testing.assert_allclose(ours, theirs, rtol=0.05)
    assert {p.dtype for p in fast.network.parameters()} == {torch.float32}
    assert {m["exp_avg"].dtype for m in fast.optimiser.state.values()} == {
        torch.float32
    }


def test_values_that_are_learnt_stay_float32_when_targets_are_not():
    exact, mixed, fast = (
        make_learner(precision=precision)
        for precision in ("float32", "bfloat16-targets", "bfloat16")
    )
    batch = next(make_batches())
    taken = [learner.update(batch).mean_q for learner in (exact, mixed, fast)]
    assert taken[0] == taken[1] != taken[2]


def test_auto_is_the_device_at_hand_and_a_missing_one_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert compute_device("auto") == torch.device("cpu")
    with pytest.raises(ValueError, match="give cpu or auto"):
        compute_device("cuda")


def joined_batches(batches):
    """One behind the other."""
    return jax.tree.map(lambda *parts: np.concatenate(parts), *batches)


def results_of(learner, updates):
    """By whichever way the learner makes them: losses and priorities."""
    batches = list(itertools.islice(make_batches(), updates))
    if learner.group == 1:
        return [learner.update(batch) for batch in batches]
    count = learner.group
    groups = [batches[at : at + count] for at in range(0, updates, count)]
    return [
        result
        for group in groups
        for result in learner.update_group(joined_batches(group))
    ]


def test_several_updates_in_one_call_are_the_same_updates():
    """The target is due within a call, and the average's share changes in it."""
    fields = {"average_updates": 5, "target_period": 5, "max_gradient_norm": 0.5}
    single = make_learner(**fields)
    grouped = make_learner(**fields, grouped="always", batches_per_reply=3)
    assert (single.group, grouped.group) == (1, 3)
    ours, theirs = results_of(grouped, 12), results_of(single, 12)
    assert grouped.updates == 12
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine.priorities, other.priorities, rtol=1e-5)
        np.testing.assert_allclose(mine[:1] + mine[2:], other[:1] + other[2:], 1e-5)
    np.testing.assert_allclose(grouped.vector(), single.vector(), atol=1e-6)
    target = to_vector(grouped.target)
    np.testing.assert_allclose(target, to_vector(single.target), atol=1e-6)
    assert np.abs(target - grouped.vector()).max() > 1e-5
    average = grouped.policy_vector()
    np.testing.assert_allclose(average, single.policy_vector(), atol=1e-6)
    with pytest.raises(ValueError, match="64 rows for 3 batches"):
        grouped.update_group(joined_batches(itertools.islice(make_batches(), 2)))


def test_groups_are_for_cuda_unless_asked_for():
    cpu, cuda = torch.device("cpu"), torch.device("cuda")
    assert not in_groups(LearnerConfig(), cpu)
    assert in_groups(LearnerConfig(), cuda)
    assert in_groups(LearnerConfig(grouped="always"), cpu)
    assert not in_groups(LearnerConfig(grouped="never"), cuda)
    assert not in_groups(LearnerConfig(batches_per_reply=1), cuda)


def test_the_loop_makes_the_updates_of_a_call_together():
    rows = np.zeros(8, ROW)
    draws = [Draw(np.full(8, i, np.uint64), np.full(8, 0.1), rows) for i in range(6)]
    source = iter([draws[0], None, *draws[1:]])
    rng = np.random.default_rng(0)
    updated, published, rendered = [], [], []

    def render(rows):
        rendered.append(len(rows))
        return make_observations(len(rows), rng), make_observations(len(rows), rng)

    steps = learn(
        learner=make_learner(grouped="always", batches_per_reply=3, publish_period=2),
        sample=lambda: next(source),
        update_priorities=lambda ids, values: updated.append(int(ids[0])),
        render=render,
        publish=lambda version, vector: published.append(version),
    )
    assert next(steps) is None
    turns = list(itertools.islice(steps, 3))
    assert updated == [0, 1, 2]
    assert len({turn.result.loss for turn in turns}) == 3
    assert turns[0].updated_s > 0
    assert turns[1].updated_s == turns[2].updated_s == 0
    list(itertools.islice(steps, 3))
    assert updated == [0, 1, 2, 3, 4, 5]
    assert published == [0, 3, 6]
    assert rendered == [24, 24]


def test_a_call_of_the_loop_learns_from_each_draw_what_single_updates_do():
    rng = np.random.default_rng(0)
    rows = np.zeros(48, ROW)
    rows["action"] = rng.integers(0, ACTIONS, 48)
    rows["reward"] = np.arange(48) / 100  # names the row
    seen = make_observations(48, rng), make_observations(48, rng)
    draws = [
        Draw(np.arange(8, dtype=np.uint64), rng.random(8) + 0.01, rows[at : at + 8])
        for at in range(0, 48, 8)
    ]

    def render(drawn):
        named = (drawn["reward"] * 100).round().astype(int)
        return jax.tree.map(lambda field: field[named], seen)

    def results(**fields):
        source = iter(draws)
        steps = learn(
            learner=make_learner(**fields),
            sample=lambda: next(source),
            update_priorities=lambda ids, values: None,
            render=render,
            publish=lambda version, vector: None,
        )
        return [turn.result for turn in itertools.islice(steps, len(draws))]

    grouped = results(grouped="always", batches_per_reply=3)
    for ours, single in zip(grouped, results(), strict=True):
        assert ours.loss == pytest.approx(single.loss, rel=1e-5)
        np.testing.assert_allclose(ours.priorities, single.priorities, rtol=1e-5)


def test_what_is_saved_is_by_layer():
    """So that an optimiser's state does not depend on how parameters are laid out."""
    learner = make_learner()
    learner.update(next(make_batches()))
    state = learner.state()
    layers = dict(learner.network.named_parameters())
    moments = state["optimiser"]["state"]
    assert [m["exp_avg"].shape for m in moments.values()] == [
        layer.shape for layer in layers.values()
    ]
    other = make_learner(seed=1)
    other.restore(state)
    batches = list(itertools.islice(make_batches(1), 3))
    expected = [learner.update(batch).loss for batch in batches]
    assert [other.update(batch).loss for batch in batches] == expected


def test_a_rendered_array_becomes_a_tensor_without_a_copy():
    for field in (jnp.ones((4, 3)), jnp.ones((4, 3), bool)):
        for host in (True, False):
            tensor = shared_tensor(field, host=host)
            assert tensor.data_ptr() == field.unsafe_buffer_pointer()
            assert tensor.shape == (4, 3)
            assert bool((tensor == 1).all())


def test_freed_memory_is_kept():
    """A large tensor that is made anew lies in pages that are there already."""
    if not keep_memory():
        pytest.skip("no glibc here")
    values, times = 1 << 21, 8
    for _ in range(2):
        torch.ones(values)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(times):
        torch.ones(values)
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    assert faults < times * values * 4 / resource.getpagesize() / 2
