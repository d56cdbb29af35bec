"""Several updates in one call, on tensors that stay where they are.

A GPU computes the small networks here faster than a host can start their kernels,
about 700 an update. So K updates are captured as one CUDA graph, which is started in
one call: what changes from call to call, batches, the averaging's share, whether the
target is due, lies in tensors of fixed place that are written before. The first calls
are not captured: they allocate what libraries allocate once, and are ordinary updates.

Without CUDA the same K updates run one by one from the same tensors, which is what the
tests compare with. The graph itself has not been run: no GPU was at hand.
"""

from collections.abc import Callable
from typing import Final, NamedTuple, final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from learner.config import LearnerConfig

_UNCAPTURED: Final = 3  # calls before the capture, as torch's manual has it


class Inputs(NamedTuple):
    """A batch on the device."""

    tm1: tuple[Tensor, ...]  # the observation's fields, at s_tm1
    a_tm1: Int[Tensor, " batch"]
    r_t: Float[Tensor, " batch"]
    discount_t: Float[Tensor, " batch"]
    t: tuple[Tensor, ...]  # and at s_t
    probabilities: Float[Tensor, " batch"]

    def tensors(self) -> list[Tensor]:
        """All of them, in one order."""
        rest = [self.a_tm1, self.r_t, self.discount_t, self.probabilities]
        return [*self.tm1, *self.t, *rest]

    def map(self, change: Callable[[Tensor], Tensor]) -> "Inputs":
        """Each tensor changed."""
        return Inputs(
            tm1=tuple(map(change, self.tm1)),
            a_tm1=change(self.a_tm1),
            r_t=change(self.r_t),
            discount_t=change(self.discount_t),
            t=tuple(map(change, self.t)),
            probabilities=change(self.probabilities),
        )


class Outcome(NamedTuple):
    """What an update computed, on the device."""

    told: Float[Tensor, " 4"]  # loss, mean and greatest value, gradient's norm
    priorities: Float[Tensor, " batch"]


def in_groups(config: LearnerConfig, device: torch.device) -> bool:
    """Whether several updates are to go in one call."""
    wanted = config.grouped == "always" or (
        config.grouped == "auto" and device.type == "cuda"
    )
    return wanted and config.batches_per_reply > 1


@final
class UpdateGroup:
    """K updates, K being the number of shares of the first call."""

    def __init__(
        self,
        *,
        descend: Callable[[Inputs], Outcome],
        follow_average: Callable[[Tensor], object],
        follow_target: Callable[[Tensor], object],
        graph: bool,
    ) -> None:
        """Keeps what an update consists of; `graph` captures it, on CUDA."""
        self._descend = descend
        self._follow_average = follow_average
        self._follow_target = follow_target
        self._graph = torch.cuda.CUDAGraph() if graph else None
        self._calls = 0
        self._held: Inputs | None = None  # what the updates read: all batches
        self._batches: list[Inputs] = []  # its parts
        self._shares = self._due = torch.empty(0)
        self._outcomes: list[Outcome] = []

    def run(
        self, inputs: Inputs, *, shares: list[float], due: list[float]
    ) -> list[Outcome]:
        """K updates; what they return is overwritten by the next call.

        Args:
            inputs: K batches of the same size, one after another; of the same shapes
                at each call.
            shares: by which the average follows, after each.
            due: 1 where the target becomes the network after it, else 0.
        """
        self._write(inputs, shares, due)
        self._calls += 1
        if self._graph is None:
            self._outcomes = self._updates()
        elif self._calls <= _UNCAPTURED:
            self._outcomes = self._beside()
        else:
            if self._calls == _UNCAPTURED + 1:
                with torch.cuda.graph(self._graph):
                    self._outcomes = self._updates()
            self._graph.replay()
        return self._outcomes

    def _write(self, inputs: Inputs, shares: list[float], due: list[float]) -> None:
        """Into the tensors that the updates read."""
        if self._held is None:
            self._held = inputs.map(torch.empty_like)
            self._batches = _split(self._held, len(shares))
            self._shares = torch.empty(len(shares), device=inputs.r_t.device)
            self._due = torch.empty_like(self._shares)
        torch._foreach_copy_(self._held.tensors(), inputs.tensors())
        self._shares.copy_(torch.tensor(shares))
        self._due.copy_(torch.tensor(due))

    def _updates(self) -> list[Outcome]:
        outcomes = []
        for index, inputs in enumerate(self._batches):
            outcomes.append(self._descend(inputs))
            self._follow_average(self._shares[index])
            self._follow_target(self._due[index])
        return outcomes

    def _beside(self) -> list[Outcome]:
        """On a stream of their own, as a capture runs."""
        stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            outcomes = self._updates()
        torch.cuda.current_stream().wait_stream(stream)
        return outcomes


def _split(inputs: Inputs, count: int) -> list[Inputs]:
    """Views of equal parts."""
    size = len(inputs.r_t) // count

    def part(start: int) -> Inputs:
        return inputs.map(lambda tensor: tensor[start : start + size])

    return [part(index * size) for index in range(count)]
