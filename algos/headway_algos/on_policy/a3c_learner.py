"""A3C: workers compute A2C's gradients, and a learner applies them (Mnih et al. 2016, arXiv:1602.01783)."""

from collections.abc import Sequence
from ctypes import CDLL
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Contribution, EnvSpec, Trajectory
from headway.contracts.acting_policy import Parameters
from headway_algos.batches.divergence import raise_if_diverged
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.on_policy.a3c_config import A3CConfig
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.updates.config import GradientUpdateConfig
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.optim.adam import StackedAdam


@dataclass(frozen=True)
class _Shared:
    """Parts of a learner that workers replicate, by the names under which they are published."""

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
        """Tensors of actor and critic, normalisers included, by part and name."""
        modules = {"actor": self.learner.actor, "critic": self.critic.networks}
        return {
            f"{part}.{name}": tensor
            for part, module in modules.items()
            for name, tensor in module.state_dict().items()
        }

    @property
    def optimisers(self) -> dict[str, StackedAdam]:
        """Optimisers of actor and critic."""
        regression = self.critic.optimiser
        assert isinstance(regression, StackedAdam)
        return {"actor": self.actor.optimiser, "critic": regression}

    @property
    def moments(self) -> dict[str, RunningStatistics]:
        """Running statistics of observations, critic inputs and returns."""
        networks = self.critic.networks
        return {
            "observations": self.learner.actor.moments,
            "inputs": networks.input_moments,
            "returns": networks.return_moments,
        }


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameter numbers M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc's `mallopt`."""


def _return_large_blocks() -> None:
    """Make glibc's malloc return freed large tensors to the system; no effect with other C libraries.

    Otherwise allocations of an environment (SUMO) in between fragment the heap, and a worker grew by about
    20 MB (`benchmarks crossing`).
    """
    mallopt = getattr(CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, 400_000)
        mallopt(_TRIM_THRESHOLD, 32 << 20)


class A2CContributor:
    """A `headway.contracts.Contributor` of unclipped gradients and of the batch's running statistics.

    It updates a local copy of the learner, which the next published parameters replace.
    """

    def __init__(self, config: GradientUpdateConfig, spec: EnvSpec, seeds: Sequence[int]) -> None:
        torch.set_num_threads(1)
        _return_large_blocks()
        config = replace(config, grad_clip=None)
        self.learner = OnPolicyLearner(config, spec, seeds, "cpu", unit="contribution")
        self.shared = _Shared.of(self.learner)

    def adopt(self, published: Parameters) -> Parameters:
        """Copy the published tensors and return the acting parameters."""
        for name, tensor in self.shared.tensors.items():
            tensor.copy_(torch.as_tensor(published[name]))
        return self.learner.acting_parameters()

    def contribute(self, trajectory: Trajectory, number: int) -> Contribution:
        """Return the gradients of actor and critic on this trajectory.

        Raises HeadwayError if learning diverged.
        """
        optimisers = self.shared.optimisers
        counts = {part: optimiser.counts.copy() for part, optimiser in optimisers.items()}
        metrics = self.learner.update(trajectory, number, 0.0)
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
        """Return the hidden states of a recurrent critic at the end of the last trajectory."""
        return self.shared.critic.networks.carried

    def restore(self, snapshot: Any) -> None:  # noqa: ANN401 - the contract's
        """Restore the result of `snapshot`."""
        self.shared.critic.networks.carried = snapshot


class AsynchronousA2CLearner(OnPolicyLearner):
    """A `headway.contracts.AsynchronousLearner` that applies workers' gradients to shared parameters.

    Its `update` trains synchronously, as with a single worker.
    """

    def __init__(self, config: A3CConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        super().__init__(config, spec, seeds, device)
        self.in_turns = config.application == "in_turns"
        self.shared = _Shared.of(self)

    def published(self) -> dict[str, NDArray[Any]]:
        """Return copies of the tensors of actor, critic and normalisers."""
        return {name: tensor.cpu().numpy().copy() for name, tensor in self.shared.tensors.items()}

    def apply(self, contribution: Contribution, iteration: int, progress: float) -> None:
        """Clip the contributed gradients, which may stem from older parameters, and take one step."""
        share = self.config.lr_factor(progress)
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
        raise_if_diverged(self, self.acting_parameters(), f"iteration {iteration}")
