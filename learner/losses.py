"""torchrl's double-DQN loss behind our types: the one module that uses torchrl.

`DQNLoss` wants to run the networks itself, through functional copies of their
parameters. Here it gets Q-values that are computed already: its "value network" picks
one of two entries of its input by its single parameter, 0 in the online set and 1 in
the target set. So both networks stay plain modules (their parameters are what is
saved and published), and an update costs 9% less than with the networks inside
(batch 64, preset `quick`, one core).

What torchrl does otherwise than we, and what is done about it:
- it writes the squared TD error as the priority: we take the root;
- it reduces importance-weighted losses by sum(w l) / sum(w): we ask for the losses
  one by one (`reduction="none"`) and reduce them ourselves;
- its smooth L1 has the threshold 1: values are divided by the threshold h before and
  losses multiplied by h^2 after, which is exact;
- it knows one gamma and a terminal flag: the discount of each row multiplies the
  target values instead, which commutes with picking one of them.

`plain_losses` is the same arithmetic from `learner.targets`, without torchrl's import
(4 s) and bookkeeping; a test holds the two equal.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple, final

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from learner.targets import double_q_target, huber, td_error


class QBatch(NamedTuple):
    """What the loss is a function of; only `q_tm1` carries gradients."""

    q_tm1: Float[Tensor, "batch actions"]  # online network at s_tm1
    a_tm1: Int[Tensor, " batch"]  # the action taken there
    r_t: Float[Tensor, " batch"]  # clipped already
    discount_t: Float[Tensor, " batch"]  # gamma, or 0 if and only if s_t is terminal
    q_online_t: Float[Tensor, "batch actions"]  # online network at s_t
    q_target_t: Float[Tensor, "batch actions"]  # target network at s_t


class Losses(NamedTuple):
    """One number per row of the batch."""

    loss: Float[Tensor, " batch"]  # Huber loss of the TD error, with gradients
    priority: Float[Tensor, " batch"]  # |TD error|, without


LossFunction = Callable[[QBatch], Losses]


def plain_losses(batch: QBatch, *, threshold: float) -> Losses:
    """Double-Q Huber losses from `learner.targets` alone."""
    target_tm1 = double_q_target(
        batch.r_t, batch.discount_t, batch.q_online_t, batch.q_target_t
    )
    delta = td_error(batch.q_tm1, batch.a_tm1, target_tm1)
    return Losses(loss=huber(delta, threshold), priority=delta.detach().abs())


@final
class TorchrlLosses:
    """Double-Q Huber losses by torchrl's `DQNLoss`."""

    def __init__(self, *, actions: int, threshold: float) -> None:
        """Builds torchrl's loss once; imports torchrl, which takes seconds."""
        from tensordict import TensorDict
        from tensordict.nn import TensorDictModule
        from torchrl.data import Categorical
        from torchrl.modules import QValueActor
        from torchrl.objectives import DQNLoss

        self._tensordict = TensorDict
        self._threshold = threshold
        pick = TensorDictModule(
            _Pick(), in_keys=["online", "target"], out_keys=["action_value"]
        )
        # Nobody updates the parameters of the target set, and that is right here.
        warnings.filterwarnings("ignore", message="No target network updater")
        self._loss = DQNLoss(
            QValueActor(pick, spec=Categorical(actions)),
            loss_function="smooth_l1",
            double_dqn=True,
            delay_value=True,
            reduction="none",
        )
        self._loss.make_value_estimator(gamma=1.0)
        self._loss.target_value_network_params.data.apply_(lambda x: x.fill_(1.0))

    def __call__(self, batch: QBatch) -> Losses:
        """Losses and priorities of a batch."""
        h = self._threshold
        ends = torch.zeros(len(batch.r_t), 1, dtype=torch.bool, device=batch.r_t.device)
        q_tm1 = batch.q_tm1 / h
        data = self._tensordict(
            {
                "online": q_tm1,
                "target": q_tm1.detach(),
                "action": batch.a_tm1,
                "next": {
                    "online": batch.q_online_t,
                    "target": batch.q_target_t * (batch.discount_t / h)[:, None],
                    "reward": (batch.r_t / h)[:, None],
                    "done": ends,
                    "terminated": ends,
                },
            },
            batch_size=[len(batch.r_t)],
        )
        loss = self._loss(data)["loss"]
        priority = data["td_error"].squeeze(-1).sqrt()
        return Losses(loss=h * h * loss, priority=h * priority)


@final
class _Pick(nn.Module):
    """A value network with one parameter: which of its two inputs it returns."""

    def __init__(self) -> None:
        nn.Module.__init__(self)
        self.which = nn.Parameter(torch.zeros(()))

    def forward(
        self,
        online: Float[Tensor, "batch actions"],
        target: Float[Tensor, "batch actions"],
    ) -> Float[Tensor, "batch actions"]:
        """The first where the parameter is 0, else the second."""
        return online if float(self.which.detach()) == 0.0 else target
