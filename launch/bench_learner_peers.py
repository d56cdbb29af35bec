"""The loops that `slipstream bench learner` compares with: plain, eager, float32.

Double DQN as torchrl's manual writes it: `DQNLoss` runs the networks, `HardUpdate`
copies the target, and Adam is as it comes. It neither weighs by importance nor clips,
which is less work than ours does. Cloning with `torch.distributions`, as one would
write it first. Both have the same network as ours and get the same arrays.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import distributions as D

from actors.mixture import LARGEST, SMALLEST, action_limits
from learner.cloning import CloningBatch, CloningLearner
from learner.learner import Batch, Learner
from learner.network import QNetwork, to_torch
from sim.dynamics import ActionConfig
from sim.observation import Observation

Turn = Callable[[], object]
_CPU = torch.device("cpu")


def torchrl_dqn(ours: Learner, network: QNetwork, batch: Batch) -> Turn:
    """One update of torchrl's double DQN, priorities out."""
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from torchrl.data import Categorical
    from torchrl.modules import QValueActor
    from torchrl.objectives import DQNLoss, HardUpdate

    names = list(Observation._fields)
    module = TensorDictModule(network, in_keys=names, out_keys=["action_value"])
    actor = QValueActor(module, in_keys=names, spec=Categorical(ours.actions))
    loss = DQNLoss(actor, loss_function="smooth_l1", double_dqn=True, delay_value=True)
    loss.make_value_estimator(gamma=ours.config.discount)
    target = HardUpdate(loss, value_network_update_interval=ours.config.target_period)
    adam = torch.optim.Adam(loss.parameters(), lr=ours.config.learning_rate)
    rows = len(batch.a_tm1)

    def fields(observation: Observation) -> dict[str, Any]:
        return dict(zip(names, to_torch(observation, _CPU), strict=True))

    def turn() -> object:
        ends = torch.from_numpy(batch.discount_t == 0)[:, None]
        data = TensorDict(
            {
                **fields(batch.observation_tm1),
                "action": torch.from_numpy(batch.a_tm1).long(),
                "next": {
                    **fields(batch.observation_t),
                    "reward": torch.from_numpy(batch.r_t)[:, None],
                    "done": ends,
                    "terminated": ends,
                },
            },
            batch_size=[rows],
        )
        value = loss(data)["loss"]
        adam.zero_grad()
        value.backward()
        adam.step()
        target.step()
        return data["td_error"].numpy(), float(value.detach())

    return turn


def plain_cloning(
    ours: CloningLearner, action: ActionConfig, network: QNetwork, batch: CloningBatch
) -> Turn:
    """One update of behaviour cloning."""
    adam = torch.optim.Adam(network.parameters(), lr=ours.config.learning_rate)
    limits = torch.from_numpy(action_limits(action))

    def turn() -> object:
        outputs = network(*to_torch(batch.observation_tm1, _CPU))
        if ours.mixture:
            scaled = torch.from_numpy(batch.continuous_tm1) / limits
            density = mixture_density(outputs, ours.mixture, len(limits))
            loss = -density.log_prob(scaled.clamp(-LARGEST, LARGEST)).mean()
        else:
            index = torch.from_numpy(batch.a_tm1).long()
            loss = torch.nn.functional.cross_entropy(outputs, index)
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
        return float(loss.detach())

    return turn


def mixture_density(
    outputs: torch.Tensor, mixture: int, components: int
) -> D.Distribution:
    """A network's outputs as a tanh-squashed Gaussian mixture."""
    rest = outputs[:, mixture:].reshape(-1, 2, mixture, components)
    scales = SMALLEST + torch.nn.functional.softplus(rest[:, 1])
    squashed = D.TransformedDistribution(
        D.Normal(rest[:, 0], scales), [D.TanhTransform()]
    )
    return D.MixtureSameFamily(
        D.Categorical(logits=outputs[:, :mixture]),
        D.Independent(squashed, 1),
    )
