"""What the learner does with a batch; free of torch.

Whoever reads a run's configuration needs this class, and an actor's machine has no
torch. The defaults are the Waymax paper's (appendix A.2) and, where it is silent,
Acme's.
"""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class LearnerConfig:
    """What the learner does with a batch. Defaults: the paper's, else Acme's."""

    learning_rate: float = 5e-5
    """Adam's step size."""

    adam_epsilon: float = 1e-8
    """Added to Adam's denominator."""

    batch_size: int = 64
    """Transitions per update."""

    discount: float = 0.99
    """Gamma; multiplies each row's discount, which is 0 at a terminal state."""

    n_step: int = 1
    """Steps whose rewards are summed before the target network's value: the actors make
    rows of as many. The paper's is 1."""

    target_period: int = 100
    """Updates between two copies of the network to the target network."""

    importance_exponent: float = 0.2
    """Beta of the weights (1 / P)^beta; 0 switches them off."""

    huber_threshold: float = 1.0
    """|TD error| at which the loss turns from quadratic to linear."""

    reward_clip: float = 1.0
    """Rewards are clipped to plus or minus this; of n steps, their sum is."""

    max_gradient_norm: float = 0.0
    """Gradients are scaled down to this norm over all parameters; 0 means never."""

    average_updates: int = 0
    """The trained policy has the mean of the weights over about this many updates
    (exponential); 0, the paper's, is the network itself. Actors take the network."""

    loss: Literal["torchrl", "plain"] = "torchrl"
    """Whose arithmetic: torchrl's `DQNLoss`, or the same in plain torch, which is
    faster and equal to it by test."""

    batches_per_reply: int = 4
    """Batches that one reply of the replay brings: a query's cost is shared by them,
    and their priorities are older by as many updates."""

    grouped: Literal["auto", "always", "never"] = "auto"
    """Whether the batches of one reply are learnt from in one call, on CUDA as one
    graph: auto does so on CUDA alone. The loss is then the plain one."""

    publish_period: int = 50
    """Updates between two publications of the weights to the actors."""

    torch_threads: int = 1
    """Threads of torch in the learner's process."""

    precision: Literal["float32", "bfloat16-targets", "bfloat16"] = "float32"
    """Of the network's matrix products; weights and losses are float32 either way.
    bfloat16-targets: only of the values of the next state, of which no gradient is
    taken; what is learnt from them is computed in float32."""

    device: str = "cpu"
    """Where torch computes: cpu, cuda, cuda:1, ..., or auto: CUDA where there is."""

    seed: int = 0
    """Seed of the network's first weights."""

    def __post_init__(self) -> None:
        """Refuses settings under which nothing is learnt."""
        for name in (
            "learning_rate",
            "adam_epsilon",
            "batch_size",
            "n_step",
            "target_period",
            "huber_threshold",
            "reward_clip",
            "batches_per_reply",
            "publish_period",
            "torch_threads",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)} must be above 0")
        if not 0 <= self.discount <= 1:
            raise ValueError(f"discount={self.discount} must be within 0 and 1")
        if (
            min(self.importance_exponent, self.max_gradient_norm, self.average_updates)
            < 0
        ):
            raise ValueError(
                f"importance_exponent={self.importance_exponent} and "
                f"max_gradient_norm={self.max_gradient_norm} and average_updates="
                f"{self.average_updates} must not be negative"
            )


@dataclass(frozen=True, kw_only=True)
class CloningConfig:
    """Behaviour cloning. Defaults are the paper's (appendix A.2) but for the zeros."""

    mixture: int = 10
    """Components of the Gaussian mixture over continuous actions; 0 clones the grid's
    actions by a softmax."""

    learning_rate: float = 1e-4
    """Adam's step size."""

    adam_epsilon: float = 1e-8
    """Added to Adam's denominator."""

    batch_size: int = 256
    """Expert actions per update."""

    max_gradient_norm: float = 0.0
    """Gradients are scaled down to this norm over all parameters; 0 means never."""

    average_updates: int = 0
    """The policy has the mean of the weights over about this many updates
    (exponential); 0 is the network itself."""

    torch_threads: int = 1
    """Threads of torch in the learner's process."""

    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the network's matrix products; weights and losses are float32 either way."""

    device: str = "cpu"
    """Where torch computes: cpu, cuda, cuda:1, ..., or auto: CUDA where there is."""

    seed: int = 0
    """Seed of the network's first weights."""

    def __post_init__(self) -> None:
        """Refuses settings under which nothing is learnt."""
        for name in ("learning_rate", "adam_epsilon", "batch_size", "torch_threads"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)} must be above 0")
        for name in ("mixture", "max_gradient_norm", "average_updates"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)} must not be negative")
