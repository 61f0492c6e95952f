"""The stack of policies that a learner trains."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.agent_id import agent_ids
from headway_algos.batches.device import resolve_device
from headway_algos.batches.layout import Layout
from headway_algos.config import LearnerConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.normalisation import RunningStatistics


class PolicyStack:
    """Base of the learners: P = R x K policies, replica-major."""

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
