"""Prioritised double DQN as Acme trains it: one update, and the loop around it.

Settings and their sources stand in `learner.config`. One update, for a batch drawn
with probabilities P:

    q_tm1, q_online_t = online(s_tm1), online(s_t)      q_target_t = target(s_t)
    loss = mean(w l) as in `learner.targets`, with the reward clipped
    Adam step; the priorities handed back are |TD error|
    target := online after every `target_period`-th update

A policy read off the last weights alone changes from update to update: with
`average_updates` the trained policy is read off their exponential mean (Polyak and
Juditsky, 1992). Actors take the last weights: what they do wrong is what is to learn.

`discount_t` of a row is the environment's: 1, or 0 if and only if s_t is terminal;
it is multiplied by the configured discount here. Rows of n steps are made by the
actors (`actors.windows`), with the return of the n steps and the discount of all but
the last: nothing here depends on n but that the reward is clipped after the sum, as
Acme does. Nothing in an update is random, so
network, target, optimiser and the counter are the whole state.
"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt
from torch import Tensor, nn

from actors.network import Layout, NetworkConfig, parameter_layout
from learner.config import LearnerConfig
from learner.losses import LossFunction, QBatch, TorchrlLosses, plain_losses
from learner.network import QNetwork, follow_average, to_torch, to_vector
from learner.targets import importance_weights, weighted_mean
from learner.training import (
    compute_device,
    in_precision,
    make_adam,
    restore_training,
    step_down,
    training_state,
)
from sim.observation import Observation, ObservationSizes


class Batch(NamedTuple):
    """Rendered transitions, all of the same first axis; arrays are numpy's."""

    observation_tm1: Observation  # s_tm1, where the action was chosen
    a_tm1: Int[np.ndarray, " batch"]  # index into the action table
    r_t: Float[np.ndarray, " batch"]  # not clipped yet; n steps: their return
    discount_t: Float[np.ndarray, " batch"]  # of the row, 0 iff s_t is terminal
    observation_t: Observation  # s_t, or the state n steps after s_tm1
    probabilities: Float[np.ndarray, " batch"]  # with which the replay drew the rows


class UpdateResult(NamedTuple):
    """What one update says about itself."""

    loss: float  # the weighted mean that was minimised
    priorities: Float[np.ndarray, " batch"]  # |TD error|, for the replay
    mean_q: float  # of the actions taken, before the update
    max_q: float  # mean over the batch of the greedy value at s_tm1
    gradient_norm: float  # over all parameters, before clipping; nan if never clipped


@final
class Learner:
    """Network, target network and optimiser; `update` is the only thing it does."""

    def __init__(
        self,
        *,
        config: LearnerConfig,
        network: NetworkConfig,
        sizes: ObservationSizes,
        actions: int,
    ) -> None:
        """Draws the first weights from the seed. Sets torch's thread count."""
        torch.set_num_threads(config.torch_threads)
        self.config = config
        self.network_config = network
        self.sizes = sizes
        self.actions = actions
        self.updates = 0
        self._device = compute_device(config.device)
        generator = torch.Generator().manual_seed(config.seed)
        build = functools.partial(
            QNetwork, config=network, sizes=sizes, actions=actions, generator=generator
        )
        self.network = build().to(self._device)
        self.target = build().to(self._device).requires_grad_(False)
        self.average = build().to(self._device).requires_grad_(False)
        self._copy_target()
        self.optimiser = make_adam(
            self.network,
            learning_rate=config.learning_rate,
            epsilon=config.adam_epsilon,
        )
        self._losses = _loss_function(config, actions)

    @property
    def mixture(self) -> int:
        """0: the outputs are the actions' values."""
        return 0

    @property
    def layout(self) -> Layout:
        """Names and shapes of the weight vector."""
        return parameter_layout(self.network_config, self.sizes, self.actions)

    def vector(self) -> Float[np.ndarray, " parameters"]:
        """A copy of the network's weights as one vector, for the actors."""
        return to_vector(self.network)

    def policy_vector(self) -> Float[np.ndarray, " parameters"]:
        """A copy of the weights to drive with: averaged, where that is configured."""
        averaged = self.config.average_updates > 0
        return to_vector(self.average if averaged else self.network)

    def update(self, batch: Batch) -> UpdateResult:
        """One step of Adam on the batch; the target follows when it is due."""
        q_batch = self._q_batch(batch)
        losses = self._losses(q_batch)
        probabilities = self._tensor(batch.probabilities)
        weights = importance_weights(probabilities, self.config.importance_exponent)
        loss = weighted_mean(losses.loss, weights)
        gradient_norm = step_down(
            loss,
            network=self.network,
            optimiser=self.optimiser,
            limit=self.config.max_gradient_norm,
        )
        self.updates += 1
        follow_average(
            self.average,
            self.network,
            updates=self.updates,
            window=self.config.average_updates,
        )
        if self.updates % self.config.target_period == 0:
            self._copy_target()
        q_tm1 = q_batch.q_tm1.detach()
        return UpdateResult(
            loss=float(loss.detach()),
            priorities=losses.priority.cpu().numpy(),
            mean_q=float(q_tm1.gather(-1, q_batch.a_tm1[:, None]).mean()),
            max_q=float(q_tm1.amax(dim=-1).mean()),
            gradient_norm=gradient_norm,
        )

    def state(self) -> dict[str, object]:
        """The whole state, of types that `torch.load(weights_only=True)` reads."""
        return training_state(self._modules(), self.optimiser, self.updates)

    def restore(self, state: Mapping[str, object]) -> None:
        """Goes on from where `state` was taken; the layout has to be the same.

        Hyperparameters stay this learner's, so that a resumed run may change them.
        """
        self.updates = restore_training(state, self._modules(), self.optimiser)

    def _modules(self) -> dict[str, nn.Module]:
        return {
            "network": self.network,
            "target": self.target,
            "average": self.average,
        }

    def _q_batch(self, batch: Batch) -> QBatch:
        tm1 = to_torch(batch.observation_tm1, self._device)
        t = to_torch(batch.observation_t, self._device)
        # Two passes, though one of twice the batch would start fewer kernels: its
        # backward runs over both halves and made an update 35% slower.
        with in_precision(self.config.precision, self._device):
            q_tm1 = self.network(*tm1)
            with torch.no_grad():
                q_online_t = self.network(*t)
                q_target_t = self.target(*t)
        clip = self.config.reward_clip
        return QBatch(
            q_tm1=q_tm1.float(),
            a_tm1=self._tensor(batch.a_tm1).long(),
            r_t=self._tensor(batch.r_t).clamp(-clip, clip),
            discount_t=self._tensor(batch.discount_t) * self.config.discount,
            q_online_t=q_online_t.float(),
            q_target_t=q_target_t.float(),
        )

    def _tensor(self, values: np.ndarray) -> Tensor:
        """On the device; float64 (the replay's probabilities) becomes float32."""
        tensor = torch.from_numpy(np.ascontiguousarray(values)).to(self._device)
        return tensor.float() if tensor.is_floating_point() else tensor

    @torch.no_grad()
    def _copy_target(self) -> None:
        torch._foreach_copy_(
            list(self.target.parameters()), list(self.network.parameters())
        )


@runtime_checkable
class Drawn(Protocol):
    """What the replay hands over: rows, with what is needed to weigh and name them."""

    @property
    def ids(self) -> UInt[np.ndarray, " batch"]:
        """The replay's names of the rows."""

    @property
    def probabilities(self) -> Float[np.ndarray, " batch"]:
        """With which each row was drawn."""

    @property
    def rows(self) -> np.ndarray:
        """Structured rows with fields `action`, `reward` and `discount` at least."""


class LearnStep(NamedTuple):
    """One turn of the loop: the update, and where its time went."""

    result: UpdateResult
    waited_s: float  # for the replay
    rendered_s: float  # rows to observations
    updated_s: float  # the update itself and the new priorities


def learn(
    *,
    learner: Learner,
    sample: Callable[[], Drawn | None],
    update_priorities: Callable[..., object],
    render: Callable[[np.ndarray], tuple[Observation, Observation]],
    publish: Callable[[int, Float[np.ndarray, " parameters"]], object],
) -> Iterator[LearnStep | None]:
    """Updates for ever; the caller decides when to stop, log or save.

    Args:
        learner: what is updated.
        sample: the next draw, or None when none came in its time: then None is
            yielded, so that the caller gets to look at its reasons to stop.
        update_priorities: takes the ids and the new priorities.
        render: rows to the observations at t-1 and at t.
        publish: takes the number of updates, as version, and the weight vector;
            called once before the first update, then every `publish_period`.
    """
    publish(learner.updates, learner.vector())
    while True:
        start = time.perf_counter()
        drawn = sample()
        sampled = time.perf_counter()
        if drawn is None:
            yield None
            continue
        batch = _render(drawn, render)
        rendered = time.perf_counter()
        result = learner.update(batch)
        update_priorities(drawn.ids, result.priorities)
        updated = time.perf_counter()
        if learner.updates % learner.config.publish_period == 0:
            publish(learner.updates, learner.vector())
        yield LearnStep(
            result=result,
            waited_s=sampled - start,
            rendered_s=rendered - sampled,
            updated_s=updated - rendered,
        )


def _render(
    drawn: Drawn, render: Callable[[np.ndarray], tuple[Observation, Observation]]
) -> Batch:
    observation_tm1, observation_t = render(drawn.rows)
    return Batch(
        observation_tm1=observation_tm1,
        a_tm1=drawn.rows["action"],
        r_t=drawn.rows["reward"],
        discount_t=drawn.rows["discount"],
        observation_t=observation_t,
        probabilities=drawn.probabilities,
    )


def _loss_function(config: LearnerConfig, actions: int) -> LossFunction:
    if config.loss == "plain":
        return functools.partial(plain_losses, threshold=config.huber_threshold)
    return TorchrlLosses(actions=actions, threshold=config.huber_threshold)
