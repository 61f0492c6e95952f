"""The stack of policies that a learner trains: device, metrics per replica, and divergence check."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory, generator
from headway_algos.agent_id import agent_ids
from headway_algos.batches.layout import Layout
from headway_algos.config import LearnerConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.normalisation import RunningStatistics


def resolve_device(device: str) -> torch.device:
    """Return the torch device; `auto` is a GPU if available. Raises HeadwayError for an unavailable one."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise HeadwayError("device: cuda needs a GPU, and torch finds none; use device=auto or device=cpu")
    try:
        return torch.device(device)
    except RuntimeError:
        raise HeadwayError(f"device: {device!r} is not a device; use device=auto, cpu or cuda") from None


class PolicyStack:
    """P = R x K policies, replica-major: what learners have in common."""

    config: LearnerConfig

    def __init__(self, config: LearnerConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> None:
        """`seeds` (R,): one per replica. Observations of `self.spec` include the agents' indices, if any."""
        self.config, self.agent_ids = config, agent_ids(config, spec)
        size = spec.observation_size + self.agent_ids.shape[1]
        self.spec, self.seeds = replace(spec, observation_size=size), tuple(seeds)
        self.device, self.dtype = resolve_device(device), getattr(torch, config.precision)
        self.grouping = Grouping.of(config.policies, self.spec)
        self.layout = Layout(self.grouping, len(seeds), self.device, self.dtype)

    def generators(self, purpose: str, iteration: int) -> list[np.random.Generator]:
        """Return a generator per policy (P,), for one purpose of one iteration."""
        policies = range(self.grouping.num_policies)
        return [generator(seed, purpose, k, iteration) for seed in self.seeds for k in policies]

    def include_observations(self, moments: RunningStatistics, trajectory: Trajectory) -> None:
        """Include the observations of live agents in the statistics, if observations are normalised."""
        if self.config.normalise_observations:
            alive = trajectory.alive[:-1]
            rows = self.layout.rows(trajectory.observations[:-1], alive)
            moments.include(rows, self.layout.selection(alive))

    def raise_if_diverged(self, acting: Mapping[str, NDArray[Any]], when: str) -> None:
        """Raise HeadwayError, naming policy and seed, if acting parameters (P, ., .) are not all finite.

        `when`: for instance "iteration 7".
        """
        for array in acting.values():
            broken = ~np.isfinite(array).all(axis=(1, 2))
            if broken.any():
                replica, policy = divmod(int(broken.argmax()), self.grouping.num_policies)
                owner = self.grouping.owner(policy, self.spec)
                raise HeadwayError(
                    f"{self.config.name} diverged: the policy of {owner}, seed {self.seeds[replica]}, is not "
                    f"finite after {when}; {remedy(self.config)}"
                )


def remedy(config: LearnerConfig, of_critic: bool = False) -> str:
    """Return what to change when the policies or the critic diverge, in keys that the algorithm has."""
    values = {key.name: getattr(config, key.name) for key in fields(config)}
    names = ["lr", "kl_bound"]
    if of_critic:
        names = ["lr" if values.get("critic_lr") is None else "critic_lr", "critic_kl_bound"]
    clipped = values.get("grad_clip") is not None
    lower = " or ".join(f"algo.{name}" for name in [*names, *["grad_clip"] * clipped] if name in values)
    unbounded = "grad_clip" in values and not clipped
    return f"lower {lower}" + (", or bound the gradients by algo.grad_clip" if unbounded else "")


def mean_per_replica(values: Tensor, replicas: int) -> NDArray[np.float64]:
    """Return the mean over each replica's networks, (R,), of values (P,).

    NaN, of networks that took no step, is left out; the mean is NaN if there is nothing else.
    """
    table = values.double().cpu().numpy().reshape(replicas, -1)
    known = ~np.isnan(table)
    count = known.sum(axis=1)
    total = np.where(known, table, 0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
