"""The loops that `slipstream bench learner` compares with: plain, eager, float32.

Double DQN as torchrl's manual writes it: `DQNLoss` runs the networks, `HardUpdate`
copies the target, and Adam is as it comes. It neither weighs by importance nor clips,
which is less work than ours does. Cloning with `torch.distributions`, as one would
write it first. They get the same arrays, and the network of the same weights and
outputs in two forms: plain, which forms keys, values and all outputs of every layer as
one would write it first, and ours.

They run in a process of their own: a learner's process tells the C library to keep
freed memory (`learner.training.keep_memory`), which would be theirs, too.
"""

import copy
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, final

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch import distributions as D

from actors.mixture import LARGEST, SMALLEST, action_limits
from learner.cloning import CloningBatch, CloningLearner
from learner.learner import Batch, Learner
from learner.network import QNetwork, to_torch
from learner.network_blocks import CrossBlock, LatentBlock, mask_bias
from sim.dynamics import ActionConfig
from sim.observation import Observation

Turn = Callable[[], object]
Lasted = Callable[[int], float]  # so many calls; the seconds that one took
_CPU = torch.device("cpu")


@final
class PlainBlock(nn.Module):
    """A layer of attention and feed-forward, written as one would first."""

    query_norm: nn.LayerNorm
    query: nn.Linear  # this and the next two: of a cross block
    key: nn.Linear
    value: nn.Linear
    query_key_value: nn.Linear  # of a latent block
    out: nn.Linear
    feedforward_norm: nn.LayerNorm
    expand: nn.Linear
    contract: nn.Linear

    def __init__(self, block: CrossBlock | LatentBlock) -> None:
        """Takes the block's layers over."""
        nn.Module.__init__(self)
        self.heads = block.heads
        for name, layer in block.named_children():
            self.add_module(name, layer)

    def forward(
        self,
        latents: Tensor,
        tokens: Tensor | None = None,
        bias: Tensor | None = None,
        some: Tensor | None = None,
        *,
        pooled: bool = False,
    ) -> Tensor:
        """`CrossBlock.forward`, or without bias `LatentBlock.forward`."""
        normed = self.query_norm(latents)
        if bias is not None:
            q, k, v = self.query(normed), self.key(tokens), self.value(tokens)
        else:
            q, k, v = self.query_key_value(normed).chunk(3, -1)
            if tokens is not None:  # the mask, of a layer among tokens
                bias, some = mask_bias(tokens), tokens.any(-1)[:, None, None]

        def split(x: Tensor) -> Tensor:
            return x.view(*x.shape[:2], self.heads, -1).transpose(1, 2)

        mask = None if bias is None else bias[:, None]
        y = F.scaled_dot_product_attention(split(q), split(k), split(v), attn_mask=mask)
        told = self.out(y.transpose(1, 2).reshape(latents.shape))
        latents = latents + (told if some is None else told * some)
        hidden = F.gelu(self.expand(self.feedforward_norm(latents)), approximate="tanh")
        y = latents + self.contract(hidden)
        return y.mean(dim=1) if pooled else y


def plain_network(network: QNetwork) -> QNetwork:
    """A copy with the same weights and outputs, of plain layers."""
    plain = copy.deepcopy(network)
    for name in ("tokens", "cross", "latent"):
        blocks = [PlainBlock(block) for block in getattr(plain, name)]
        setattr(plain, name, nn.ModuleList(blocks))
    return plain


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


def lasted(turn: Turn, clock: Callable[[], float]) -> Lasted:
    """How long a contestant of this process takes."""

    def run(times: int) -> float:
        begin = clock()
        for _ in range(times):
            turn()
        return (clock() - begin) / times

    return run


@final
class Apart:
    """Contestants in a process of their own, which make their turns when asked to."""

    def __init__(self, make: Callable[..., dict[str, Turn]]) -> None:
        """Starts the process; `make` is a function of a module, run there."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(make, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def contestants(self, threads: int, *words: object) -> dict[str, Lasted]:
        """What `make` makes of these words, timed there."""
        self._pipe.send((threads, words))
        names: list[str] = self._pipe.recv()

        def of(name: str) -> Lasted:
            return lambda times: self._lasted(name, times)

        return {name: of(name) for name in names}

    def _lasted(self, name: str, times: int) -> float:
        self._pipe.send((name, times))
        return float(self._pipe.recv())

    def close(self) -> None:
        """Ends the process."""
        self._pipe.close()
        self._process.join()


def _serve(make: Callable[..., dict[str, Turn]], pipe: Connection) -> None:
    """Answers until the other end is closed."""
    contestants: dict[str, Lasted] = {}
    while True:
        try:
            first, second = pipe.recv()
        except EOFError:
            return
        if isinstance(first, str):
            pipe.send(contestants[first](second))
            continue
        torch.set_num_threads(first)
        clock = time.process_time if first == 1 else time.perf_counter
        turns = make(*second)
        contestants = {name: lasted(turn, clock) for name, turn in turns.items()}
        pipe.send(list(contestants))
