"""Our loss, torchrl's behind our types, and torchrl's as its manual uses it."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from learner.losses import QBatch, TorchrlLosses, plain_losses

ACTIONS = 5


def functions(threshold=1.0):
    def plain(batch):
        return plain_losses(batch, threshold=threshold)

    return {
        "plain": plain,
        "torchrl": TorchrlLosses(actions=ACTIONS, threshold=threshold),
    }


def random_batch(seed=0, rows=64):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return 2.0 * torch.randn(*shape, generator=generator)

    return QBatch(
        q_tm1=normal(rows, ACTIONS).requires_grad_(),
        a_tm1=torch.randint(ACTIONS, (rows,), generator=generator),
        r_t=normal(rows),
        discount_t=torch.rand(rows, generator=generator).round() * 0.99,
        q_online_t=normal(rows, ACTIONS),
        q_target_t=normal(rows, ACTIONS),
    )


@pytest.mark.parametrize("name", ["plain", "torchrl"])
def test_losses_by_hand(name):
    q_online_t = torch.zeros(3, ACTIONS)
    q_online_t[:, 3] = 1.0
    q_target_t = torch.tensor([[9.0, 9.0, 9.0, 2.0, 9.0]]).repeat(3, 1)
    losses = functions()[name](
        QBatch(
            q_tm1=torch.tensor([[0.0, 1.0, 0.0, 0.0, 0.0]]).repeat(3, 1),
            a_tm1=torch.tensor([1, 1, 0]),
            r_t=torch.tensor([-1.0, -0.4, 1.0]),
            discount_t=torch.tensor([0.5, 0.5, 0.0]),
            q_online_t=q_online_t,
            q_target_t=q_target_t,
        )
    )
    # Targets: -1 + 0.5 * 2 = 0;  -0.4 + 1 = 0.6;  1 (terminal). Errors: -1, -0.4, 1.
    torch.testing.assert_close(losses.priority, torch.tensor([1.0, 0.4, 1.0]))
    torch.testing.assert_close(losses.loss, torch.tensor([0.5, 0.08, 0.5]))


@pytest.mark.parametrize("threshold", [1.0, 0.3, 2.5])
def test_plain_equals_torchrl(threshold):
    results, gradients = [], []
    for function in functions(threshold).values():
        batch = random_batch()
        losses = function(batch)
        results.append(losses)
        gradients.append(torch.autograd.grad(losses.loss.sum(), batch.q_tm1)[0])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(*gradients)
    assert gradients[0].abs().max() == pytest.approx(threshold)


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_equals_dqn_loss_with_the_networks_inside():
    """Oracle: torchrl as its manual uses it, running both networks itself."""
    torch.manual_seed(0)
    network = torch.nn.Linear(3, ACTIONS)
    actor = QValueActor(
        TensorDictModule(network, in_keys=["x"], out_keys=["action_value"]),
        spec=Categorical(ACTIONS),
    )
    oracle = DQNLoss(
        actor,
        loss_function="smooth_l1",
        double_dqn=True,
        delay_value=True,
        reduction="none",
    )
    oracle.make_value_estimator(gamma=0.9)
    target = torch.nn.Linear(3, ACTIONS)
    for key, value in oracle.target_value_network_params.flatten_keys(".").items():
        value.data.copy_(target.get_parameter(key.split(".")[-1]))
    x_tm1, x_t, r_t = torch.randn(32, 3), torch.randn(32, 3), torch.randn(32)
    a_tm1, ends = torch.randint(ACTIONS, (32,)), torch.rand(32) < 0.3
    following = {
        "x": x_t,
        "reward": r_t[:, None],
        "done": ends[:, None],
        "terminated": ends[:, None],
    }
    data = TensorDict({"x": x_tm1, "action": a_tm1, "next": following}, batch_size=[32])
    expected = oracle(data)["loss"]
    batch = QBatch(
        q_tm1=network(x_tm1),
        a_tm1=a_tm1,
        r_t=r_t,
        discount_t=0.9 * (~ends).float(),
        q_online_t=network(x_t).detach(),
        q_target_t=target(x_t).detach(),
    )
    for function in functions().values():
        losses = function(batch)
        torch.testing.assert_close(losses.loss, expected)
        np.testing.assert_allclose(
            losses.priority.numpy() ** 2,
            data["td_error"].squeeze(-1).numpy(),
            rtol=1e-4,
            atol=1e-6,
        )


@pytest.mark.parametrize("name", ["plain", "torchrl"])
def test_only_the_value_at_tm1_has_a_gradient(name):
    batch = random_batch()
    q_online_t = batch.q_online_t.requires_grad_()
    losses = functions()[name](batch)
    assert not losses.priority.requires_grad
    assert torch.autograd.grad(losses.loss.sum(), q_online_t, allow_unused=True) == (
        None,
    )
