"""A2C's gradients found in workers, and applied by a learner as they come."""

from collections.abc import Sequence
from ctypes import CDLL
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Contribution, EnvSpec, HeadwayError, Trajectory
from headway.contracts.acting_policy import Parameters
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.optim.adam import StackedAdam
from headway_algos.recipes.a3c import A3CConfig


@dataclass(frozen=True)
class _Shared:
    """What of a learner its workers have, too: it is told by these names."""

    learner: OnPolicyLearner
    actor: GradientUpdate
    critic: ValueCritic

    @classmethod
    def of(cls, learner: OnPolicyLearner) -> "_Shared":
        update, critic = learner.policy_update, learner.critic
        assert isinstance(update, GradientUpdate)
        assert isinstance(critic, ValueCritic)
        return cls(learner, update, critic)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All that learning changes but the optimisers, as it is now."""
        modules = {"actor": self.learner.actor, "critic": self.critic.networks}
        return {
            f"{part}.{name}": tensor
            for part, module in modules.items()
            for name, tensor in module.state_dict().items()
        }

    @property
    def optimisers(self) -> dict[str, StackedAdam]:
        """Of the actor's gradients, and of the critic's."""
        regression = self.critic.regression.optimiser
        assert isinstance(regression, StackedAdam)
        return {"actor": self.actor.optimiser, "critic": regression}

    @property
    def moments(self) -> dict[str, RunningStatistics]:
        """Normalisers, which batches are added to."""
        networks = self.critic.networks
        return {
            "observations": self.learner.actor.moments,
            "inputs": networks.input_moments,
            "returns": networks.return_moments,
        }


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Names of glibc's `mallopt`."""


def _give_back_large_blocks() -> None:
    """Have this process's larger tensors in memory of their own, where glibc says what is where. Else what an
    environment allocates between a contribution's tensors (SUMO does) keeps the next ones from taking their
    places: a worker grew by some 20 MB (`benchmarks crossing`)."""
    mallopt = getattr(CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, 400_000)
        mallopt(_TRIM_THRESHOLD, 32 << 20)


class A2CContributor:
    """Learns on a copy, which the next copy replaces: what comes of it are the gradients, before any clip,
    and the moments of its batch (see `headway.contracts.Contributor`)."""

    def __init__(self, config: A3CConfig, spec: EnvSpec, seeds: Sequence[int]) -> None:
        torch.set_num_threads(1)
        _give_back_large_blocks()
        self.learner = OnPolicyLearner(replace(config, grad_clip=None), spec, seeds, "cpu")
        self.shared = _Shared.of(self.learner)

    def adopt(self, published: Parameters) -> Parameters:
        """See `headway.contracts.Contributor`."""
        for name, tensor in self.shared.tensors.items():
            tensor.copy_(torch.as_tensor(published[name]))
        return self.learner.acting_parameters()

    def contribute(self, trajectory: Trajectory, number: int) -> Contribution:
        """See `headway.contracts.Contributor`."""
        optimisers = self.shared.optimisers
        counts = {part: optimiser.counts.copy() for part, optimiser in optimisers.items()}
        try:
            metrics = self.learner.update(trajectory, number, 0.0)
        except HeadwayError as error:
            raise HeadwayError(str(error).replace("iteration", "contribution")) from error
        arrays: dict[str, NDArray[Any]] = {}
        for part, optimiser in optimisers.items():
            arrays[f"{part}.active"] = optimiser.counts > counts[part]
            for i, gradient in enumerate(optimiser.gradient.parts):
                arrays[f"{part}.gradient_{i}"] = gradient.numpy().copy()
        for name, moments in self.shared.moments.items():
            if moments.latest is not None:
                arrays[name] = np.stack(
                    [np.broadcast_to(each, moments.mean.shape) for each in moments.latest]
                )
        return Contribution(arrays, metrics)

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's
        """What the critic of policies that remember carries on."""
        return self.shared.critic.networks.carried

    def restore(self, snapshot: Any) -> None:  # noqa: ANN401 - the contract's
        """Inverse of `snapshot`."""
        self.shared.critic.networks.carried = snapshot


class AsynchronousA2CLearner(OnPolicyLearner):
    """Policies, critics and optimisers that all workers share (see `headway.contracts.AsynchronousLearner`).

    By `update` it learns in step, as one worker alone does.
    """

    def __init__(self, config: A3CConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        super().__init__(config, spec, seeds, device)
        self.in_turns = config.application == "in_turns"
        self.shared = _Shared.of(self)

    def published(self) -> dict[str, NDArray[Any]]:
        """Actor, critic and normalisers."""
        return {name: tensor.cpu().numpy().copy() for name, tensor in self.shared.tensors.items()}

    def apply(self, contribution: Contribution, iteration: int, progress: float) -> None:
        """One step along gradients, clipped, that may be of earlier parameters than those that move."""
        share = 1 - (1 - self.config.lr_end) * progress
        arrays = contribution.arrays
        for part, optimiser in self.shared.optimisers.items():
            optimiser.anneal(share)
            optimiser.begin()
            for i, parameter in enumerate(optimiser.parameters):
                parameter.grad = torch.as_tensor(arrays[f"{part}.gradient_{i}"]).to(parameter.device)
            optimiser.step(arrays[f"{part}.active"])
        for name, moments in self.shared.moments.items():
            if name in arrays:
                count, mean, squares = torch.as_tensor(arrays[name], device=self.device)
                moments.add(count[..., :1], mean, squares)
        self.stack.refuse_divergence(
            self.acting_parameters(), self.config.name, iteration, "lower algo.lr and algo.critic_lr"
        )
