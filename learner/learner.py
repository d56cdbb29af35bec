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

Several updates can go in one call (`learner.groups`), on CUDA as one graph.
"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt
from torch import Tensor, nn

from actors.network import Layout, NetworkConfig, parameter_layout
from learner.config import LearnerConfig
from learner.groups import Inputs, Outcome, UpdateGroup, in_groups
from learner.losses import LossFunction, QBatch, TorchrlLosses, plain_losses
from learner.network import QNetwork, to_torch, to_vector
from learner.targets import importance_weights, weighted_mean
from learner.training import (
    compute_device,
    flatten,
    in_precision,
    make_adam,
    restore_training,
    step_down,
    training_state,
    vector_of,
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
        self._target_vector = flatten(self.target)
        self._average_vector = flatten(self.average)
        self.optimiser = make_adam(
            self.network,
            learning_rate=config.learning_rate,
            epsilon=config.adam_epsilon,
        )
        self._follow_target(1.0)
        self._group = self._make_group() if in_groups(config, self._device) else None
        # What torchrl's loss does cannot all be captured.
        plain = config.loss == "plain" or self._group is not None
        self._losses = _loss_function(config, actions, plain=plain)

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

    @property
    def group(self) -> int:
        """Updates that are made in one call: `update`'s 1, or `update_group`'s."""
        return 1 if self._group is None else self.config.batches_per_reply

    def update(self, batch: Batch) -> UpdateResult:
        """One step of Adam on the batch; the target follows when it is due."""
        outcome = self._descend(self._inputs(batch))
        self.updates += 1
        self._follow_average(self._share(self.updates))
        if self.updates % self.config.target_period == 0:
            self._follow_target(1.0)
        return _results([outcome])[0]

    def update_group(self, batches: Batch) -> list[UpdateResult]:
        """The same for `group` batches, one behind the other, in one call."""
        if self._group is None or len(batches.a_tm1) % self.group:
            raise ValueError(f"{len(batches.a_tm1)} rows for {self.group} batches")
        every = range(self.updates + 1, self.updates + 1 + self.group)
        period = self.config.target_period
        outcomes = self._group.run(
            self._inputs(batches),
            shares=[self._share(update) for update in every],
            due=[float(update % period == 0) for update in every],
        )
        self.updates += self.group
        return _results(outcomes)

    def _share(self, update: int) -> float:
        """By how much the average moves towards the network: at first a plain mean."""
        return 1.0 / max(1, min(update, self.config.average_updates))

    @torch.no_grad()
    def _follow_average(self, share: float | Tensor) -> None:
        if self.config.average_updates:
            self._average_vector.lerp_(vector_of(self.optimiser), share)

    @torch.no_grad()
    def _follow_target(self, share: float | Tensor) -> None:
        """1: the target becomes the network, to the bit; 0: nothing."""
        self._target_vector.lerp_(vector_of(self.optimiser), share)

    def state(self) -> dict[str, object]:
        """The whole state, of types that `torch.load(weights_only=True)` reads."""
        return training_state(self._modules(), self.optimiser, self.updates)

    def restore(self, state: Mapping[str, object]) -> None:
        """Goes on from where `state` was taken; the layout has to be the same.

        Hyperparameters stay this learner's, so that a resumed run may change them.
        """
        self.updates = restore_training(state, self._modules(), self.optimiser)

    def _make_group(self) -> UpdateGroup:
        return UpdateGroup(
            descend=self._descend,
            follow_average=self._follow_average,
            follow_target=self._follow_target,
            graph=self._device.type == "cuda",
        )

    def _modules(self) -> dict[str, nn.Module]:
        return {
            "network": self.network,
            "target": self.target,
            "average": self.average,
        }

    def _inputs(self, batch: Batch) -> Inputs:
        return Inputs(
            tm1=to_torch(batch.observation_tm1, self._device),
            a_tm1=self._tensor(batch.a_tm1).long(),
            r_t=self._tensor(batch.r_t),
            discount_t=self._tensor(batch.discount_t),
            t=to_torch(batch.observation_t, self._device),
            probabilities=self._tensor(batch.probabilities),
        )

    def _descend(self, inputs: Inputs) -> Outcome:
        """The update but for target and average; nothing waits for the device."""
        q_batch = self._q_batch(inputs)
        losses = self._losses(q_batch)
        weights = importance_weights(
            inputs.probabilities, self.config.importance_exponent
        )
        loss = weighted_mean(losses.loss, weights)
        norm = step_down(
            loss,
            network=self.network,
            optimiser=self.optimiser,
            limit=self.config.max_gradient_norm,
        )
        q_tm1 = q_batch.q_tm1.detach()
        taken = q_tm1.gather(-1, inputs.a_tm1[:, None])
        told = [loss.detach(), taken.mean(), q_tm1.amax(dim=-1).mean(), norm]
        return Outcome(torch.stack(told), losses.priority)

    def _q_batch(self, inputs: Inputs) -> QBatch:
        # Two passes, though one of twice the batch would start fewer kernels: its
        # backward runs over both halves and made an update 35% slower.
        with in_precision(self.config.precision, self._device):
            q_tm1 = self.network(*inputs.tm1)
        with (
            torch.no_grad(),
            in_precision(self.config.precision, self._device, learns=False),
        ):
            q_online_t = self.network(*inputs.t)
            q_target_t = self.target(*inputs.t)
        clip = self.config.reward_clip
        return QBatch(
            q_tm1=q_tm1.float(),
            a_tm1=inputs.a_tm1,
            r_t=inputs.r_t.clamp(-clip, clip),
            discount_t=inputs.discount_t * self.config.discount,
            q_online_t=q_online_t.float(),
            q_target_t=q_target_t.float(),
        )

    def _tensor(self, values: np.ndarray) -> Tensor:
        """On the device; float64 (the replay's probabilities) becomes float32."""
        tensor = torch.from_numpy(np.ascontiguousarray(values)).to(self._device)
        return tensor.float() if tensor.is_floating_point() else tensor


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
    """One update, and where its time went: the first of a call has all."""

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
    draws: list[Drawn] = []
    waited_s = 0.0
    while True:
        start = time.perf_counter()
        drawn = sample()
        sampled = time.perf_counter()
        if drawn is None:
            yield None
            continue
        draws.append(drawn)
        waited_s += sampled - start
        if len(draws) < learner.group:
            continue
        # All draws of a call together: 256 rows take 1.8 times as long as 64 (`quick`,
        # one core), and on a GPU every call has its kernels to start.
        batch = _render(draws, render)
        rendered = time.perf_counter()
        results = _update(learner, batch)
        for drawn, result in zip(draws, results, strict=True):
            update_priorities(drawn.ids, result.priorities)
        updated = time.perf_counter()
        if learner.updates % learner.config.publish_period < len(draws):
            publish(learner.updates, learner.vector())
        spent = (waited_s, rendered - sampled, updated - rendered)
        for result in results:
            yield LearnStep(result, *spent)
            spent = (0.0, 0.0, 0.0)
        draws, waited_s = [], 0.0


def _update(learner: Learner, batch: Batch) -> list[UpdateResult]:
    if learner.group > 1:
        return learner.update_group(batch)
    return [learner.update(batch)]


def _render(
    draws: Sequence[Drawn],
    render: Callable[[np.ndarray], tuple[Observation, Observation]],
) -> Batch:
    """The transitions of all draws, one behind the other."""
    rows, probabilities = draws[0].rows, draws[0].probabilities
    if len(draws) > 1:
        rows = np.concatenate([drawn.rows for drawn in draws])
        probabilities = np.concatenate([drawn.probabilities for drawn in draws])
    observation_tm1, observation_t = render(rows)
    return Batch(
        observation_tm1=observation_tm1,
        a_tm1=rows["action"],
        r_t=rows["reward"],
        discount_t=rows["discount"],
        observation_t=observation_t,
        probabilities=probabilities,
    )


def _loss_function(config: LearnerConfig, actions: int, *, plain: bool) -> LossFunction:
    if plain:
        return functools.partial(plain_losses, threshold=config.huber_threshold)
    return TorchrlLosses(actions=actions, threshold=config.huber_threshold)


def _results(outcomes: Sequence[Outcome]) -> list[UpdateResult]:
    """What the device computed, in two transfers for all of them."""
    told = torch.stack([outcome.told for outcome in outcomes]).tolist()
    priorities = torch.stack([outcome.priorities for outcome in outcomes])
    return [
        UpdateResult(
            loss=loss,
            priorities=values,
            mean_q=mean_q,
            max_q=max_q,
            gradient_norm=norm,
        )
        for (loss, mean_q, max_q, norm), values in zip(
            told, priorities.cpu().numpy(), strict=True
        )
    ]
