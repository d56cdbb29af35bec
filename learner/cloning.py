"""Behaviour cloning (Gulino et al., 2023, appendix A.2): the loss, an update, its loop.

    loss = - mean over the batch of log p(a_tm1 | s_tm1)

with p a softmax over the grid's actions, or a tanh-squashed Gaussian mixture over
continuous actions scaled to [-1, 1] by their limits (`learner.mixture`); the density's
unit is that of the scaled action, so the likelihoods of two spaces do not compare.
Delta's means are relative to going on at the same speed (`actors.mixture.inertia`).
Adam, batches drawn uniformly. The paper leaves a mixture's first weights open: here its
means start apart, at standard normals before squashing, for components that start
equal stay equal.
"""

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from actors.mixture import FIRST_SCALE, action_limits, policy_outputs
from actors.network import Layout, NetworkConfig, parameter_layout
from learner.config import CloningConfig
from learner.mixture import (
    mixture_log_prob,
    shifted,
    softmax_log_prob,
    split_mixture,
)
from learner.network import QNetwork, follow_average, to_torch, to_vector
from learner.training import (
    compute_device,
    in_precision,
    make_adam,
    restore_training,
    step_down,
    training_state,
)
from sim.dynamics import ActionConfig
from sim.features import SPEED_SCALE
from sim.observation import Observation, ObservationSizes


class CloningBatch(NamedTuple):
    """What an expert saw and did, all of the same first axis; arrays are numpy's."""

    observation_tm1: Observation
    a_tm1: Int[np.ndarray, " batch"]  # index into the action table
    continuous_tm1: Float[np.ndarray, "batch components"]  # own frame and units


class CloningResult(NamedTuple):
    """What one update says about itself."""

    loss: float  # minus the mean log-likelihood [nats]
    gradient_norm: float  # over all parameters, before clipping; nan if never clipped


@final
class CloningLearner:
    """Network and optimiser; nothing in an update is random."""

    def __init__(
        self,
        *,
        config: CloningConfig,
        network: NetworkConfig,
        sizes: ObservationSizes,
        action: ActionConfig,
        dt: float = 0.1,
    ) -> None:
        """Draws the first weights from the seed. Sets torch's thread count.

        Args:
            config: the updates.
            network: the policy's sizes.
            sizes: of the observation.
            action: the space.
            dt: a step's length [s].
        """
        if config.mixture and network.dueling:
            raise ValueError("dueling is for values, not for a mixture: switch it off")
        torch.set_num_threads(config.torch_threads)
        self.config = config
        self.network_config = network
        self.sizes = sizes
        self.actions = policy_outputs(action, config.mixture)
        self.updates = 0
        self._action, self._dt = action, dt
        self._device = compute_device(config.device)
        self._limits = torch.from_numpy(action_limits(action)).to(self._device)
        generator = torch.Generator().manual_seed(config.seed)
        build = functools.partial(
            QNetwork,
            config=network,
            sizes=sizes,
            actions=self.actions,
            generator=generator,
        )
        self.network = build()
        if config.mixture:
            _spread(self.network, config.mixture, len(self._limits), generator)
        self.network.to(self._device)
        self.average = build().to(self._device).requires_grad_(False)
        self.average.load_state_dict(self.network.state_dict())
        self.optimiser = make_adam(
            self.network,
            learning_rate=config.learning_rate,
            epsilon=config.adam_epsilon,
        )

    @property
    def mixture(self) -> int:
        """Components of the mixture that the outputs are; 0: one for each action."""
        return self.config.mixture

    @property
    def layout(self) -> Layout:
        """Names and shapes of the weight vector."""
        return parameter_layout(self.network_config, self.sizes, self.actions)

    def vector(self) -> Float[np.ndarray, " parameters"]:
        """A copy of the network's weights as one vector."""
        return to_vector(self.network)

    def policy_vector(self) -> Float[np.ndarray, " parameters"]:
        """A copy of the weights to drive with: averaged, where that is configured."""
        return to_vector(self._policy())

    def update(self, batch: CloningBatch) -> CloningResult:
        """One step of Adam on the batch."""
        loss = -self._log_prob(self.network, batch).mean()
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
        return CloningResult(
            loss=float(loss.detach()), gradient_norm=float(gradient_norm)
        )

    @torch.no_grad()
    def log_likelihood(self, batch: CloningBatch) -> Float[np.ndarray, " batch"]:
        """The log-likelihoods of a batch under the policy to drive with [nats]."""
        values: np.ndarray = self._log_prob(self._policy(), batch).cpu().numpy()
        return values

    def state(self) -> dict[str, object]:
        """The whole state, of types that `torch.load(weights_only=True)` reads."""
        return training_state(self._modules(), self.optimiser, self.updates)

    def restore(self, state: Mapping[str, object]) -> None:
        """Goes on from where `state` was taken; the layout has to be the same.

        Hyperparameters stay this learner's, so that a resumed run may change them.
        """
        self.updates = restore_training(state, self._modules(), self.optimiser)

    def _modules(self) -> dict[str, nn.Module]:
        return {"network": self.network, "average": self.average}

    def _policy(self) -> QNetwork:
        return self.average if self.config.average_updates else self.network

    def _log_prob(
        self, network: QNetwork, batch: CloningBatch
    ) -> Float[Tensor, " batch"]:
        with in_precision(self.config.precision, self._device):
            seen = to_torch(batch.observation_tm1, self._device)
            outputs = network(*seen).float()
        if not self.config.mixture:
            index = torch.from_numpy(np.ascontiguousarray(batch.a_tm1))
            return softmax_log_prob(outputs, index.to(self._device).long())
        action = torch.from_numpy(np.ascontiguousarray(batch.continuous_tm1))
        scaled = action.to(self._device) / self._limits
        distribution = shifted(
            split_mixture(outputs, len(self._limits)),
            seen[0][:, 0] * SPEED_SCALE,  # `sim.features.own_features`
            self._action,
            self._dt,
        )
        return mixture_log_prob(distribution, scaled)


def cloning_batch(rows: np.ndarray, observation_tm1: Observation) -> CloningBatch:
    """Rows of `actors.cloning.expert_rows` with what was seen there."""
    return CloningBatch(observation_tm1, rows["action"], rows["continuous"])


class CloneStep(NamedTuple):
    """One turn of the loop: the update, and where its time went."""

    result: CloningResult
    waited_s: float  # for the rows
    rendered_s: float  # rows to observations
    updated_s: float


def clone(
    *,
    learner: CloningLearner,
    sample: Callable[[], np.ndarray | None],
    render: Callable[[np.ndarray], Observation],
) -> Iterator[CloneStep | None]:
    """Updates for ever; the caller decides when to stop, log, evaluate or save.

    Args:
        learner: what is updated.
        sample: the next rows, uniformly drawn, or None when none came in its time:
            then None is yielded.
        render: rows to the observations at t-1.
    """
    while True:
        start = time.perf_counter()
        rows = sample()
        sampled = time.perf_counter()
        if rows is None:
            yield None
            continue
        batch = cloning_batch(rows, render(rows))
        rendered = time.perf_counter()
        result = learner.update(batch)
        yield CloneStep(
            result=result,
            waited_s=sampled - start,
            rendered_s=rendered - sampled,
            updated_s=time.perf_counter() - rendered,
        )


@torch.no_grad()
def _spread(
    network: QNetwork, mixture: int, components: int, generator: torch.Generator
) -> None:
    """First biases of a mixture: equal weights, means apart, scales `FIRST_SCALE`."""
    means = mixture * (1 + components)
    network.head.bias[mixture:means].normal_(generator=generator)
    network.head.bias[means:].fill_(float(np.log(np.expm1(FIRST_SCALE))))
