"""The off-policy learner: remember, draw, improve; the same for every method, over one stack of policies."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_stack import Stack, resolve_device
from headway_algos.grouping import Grouping
from headway_algos.networks.mlp import StackedMLP, acting_arrays
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.off_policy.replay_buffer import Batch, ReplayBuffer
from headway_algos.off_policy.transitions import TransitionMaker
from headway_algos.replay_config import ReplayConfig


class Method(Protocol):
    """How a stack of policies is improved from batches of transitions."""

    METRICS: ClassVar[tuple[str, ...]]
    """Names of what `learn` reports."""
    network: StackedMLP
    """The one that acts."""

    def learn(self, batch: Batch, active: NDArray[np.bool_]) -> dict[str, Tensor]:
        """One step of the networks that are `active` (P,), on normalised observations; metrics (P,)."""
        ...

    def anneal(self, share: float) -> None:
        """Take steps of `share` of their configured size from now on."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that it carries on."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        ...


MakeMethod = Callable[[Any, EnvSpec, Sequence[int], int, torch.device], Method]
"""(config, environment, seeds of the replicas, policies of each, device)"""


class OffPolicyLearner:
    """Experience in, better parameters out, from a memory of all transitions so far (see
    `headway.contracts.LearnerWithReplay`)."""

    def __init__(
        self, config: ReplayConfig, spec: EnvSpec, seeds: Sequence[int], device: str, method: MakeMethod
    ) -> None:
        self.config, self.spec, self.seeds = config, spec, tuple(seeds)
        self.device, self.dtype = resolve_device(device), getattr(torch, config.precision)
        self.grouping = Grouping.of(config.policies, spec)
        self.stack = Stack(self.grouping, spec, self.seeds)
        self.layout = Layout(self.grouping, len(seeds), self.device, self.dtype)
        policies = len(seeds) * self.grouping.num_policies
        self.method = method(config, spec, self.seeds, self.grouping.num_policies, self.device)
        self.moments = RunningStatistics(policies, spec.observation_size).to(self.device)
        self.maker = TransitionMaker(spec, config.gamma, config.n_step)
        self.memory = ReplayBuffer(spec, policies, config.capacity, self.device)
        self.policy_of = np.empty(spec.num_agents, np.int64)
        """(N,): which of a replica's K policies each agent follows."""
        for policy, members in enumerate(self.grouping.members):
            self.policy_of[members[members >= 0]] = policy
        self.env_steps = 0
        """Of each seed, so far."""
        self.progress, self.scheduled_steps = 0.0, 0
        """Share of training, and environment steps, done before the last update: schedules go by these."""

    @property
    def exploration(self) -> float:
        """How much is explored until the next update: what the schedule, of either kind, has for the
        beginning of the iteration before, since no more is known of the budget."""
        return self.config.exploration(self.progress, self.scheduled_steps)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """The acting network's tensors, its normaliser and how much it explores, by the names of the acting
        policy."""
        network, stack = self.method.network, len(self.memory.filled)
        tensors = {
            "observation_mean": self.moments.mean.to(self.dtype),
            "observation_scale": self.moments.scale.to(self.dtype),
            "exploration": torch.full((stack, 1, 1), self.exploration, dtype=self.dtype),
        }
        for i, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
            tensors[f"weight_{i}"], tensors[f"bias_{i}"] = weight, bias
        return acting_arrays(tensors)

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """One iteration: its transitions are remembered, then `updates` batches learned from."""
        explored = self.exploration
        self.method.anneal(1 - (1 - self.config.lr_end) * progress)
        self._absorb(trajectory)
        self._remember(trajectory)
        info = self._learn(iteration)
        steps, copies = trajectory.rewards.shape[:2]
        self.progress, self.scheduled_steps = progress, self.env_steps
        self.env_steps += steps * copies // len(self.seeds)
        self.stack.refuse_divergence(
            self.acting_parameters(), self.config.name, iteration, "lower algo.lr, scale rewards down"
        )
        held = torch.from_numpy(self.memory.filled)
        metrics = {name: self.stack.per_replica(value) for name, value in info.items()}
        return metrics | {
            "memory/transitions": self.stack.per_replica(held),
            "policy/exploration": np.full(len(self.seeds), explored),
        }

    def _absorb(self, trajectory: Trajectory) -> None:
        """Update the normaliser from this iteration."""
        if self.config.normalise_observations:
            alive = trajectory.alive[:-1]
            rows = self.layout.rows(trajectory.observations[:-1], alive)
            self.moments.include(rows, self.layout.selection(alive))

    def _remember(self, trajectory: Trajectory) -> None:
        transitions = self.maker.transitions(trajectory)
        copies, agents = np.divmod(transitions.streams, self.spec.num_agents)
        replicas = copies // (trajectory.rewards.shape[1] // len(self.seeds))
        self.memory.add(replicas * self.grouping.num_policies + self.policy_of[agents], transitions)

    def _learn(self, iteration: int) -> dict[str, Tensor]:
        """Means over the steps taken, 0 where there was none."""
        active = self.memory.filled >= self.config.learning_starts
        sums = {
            name: torch.zeros(len(active), device=self.device, dtype=self.dtype)
            for name in self.method.METRICS
        }
        if not active.any():
            return sums
        policies = range(self.grouping.num_policies)
        random = [generator(seed, "replay", k, iteration) for seed in self.seeds for k in policies]
        updates = self.config.updates
        for places in self.memory.draws(random, active, (updates, self.config.batch_size)):
            batch = self.memory.batch(places, self.dtype)
            for name, value in self.method.learn(self._normalised(batch), active).items():
                sums[name] += value / updates
        return sums

    def _normalised(self, batch: Batch) -> Batch:
        if not self.config.normalise_observations:
            return batch
        return replace(
            batch,
            observations=self.moments.normalised(batch.observations),
            next_observations=self.moments.normalised(batch.next_observations),
        )

    def state_dict(self) -> dict[str, Any]:
        """The networks, and how far training is."""
        return {
            "method": self.method.state_dict(),
            "moments": self.moments.state_dict(),
            "progress": self.progress,
            "scheduled_steps": self.scheduled_steps,
            "env_steps": self.env_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of `state_dict`; raises RuntimeError where shapes differ."""
        self.method.load_state_dict(state["method"])
        self.moments.load_state_dict(state["moments"])
        self.progress, self.scheduled_steps = state["progress"], state["scheduled_steps"]
        self.env_steps = state["env_steps"]

    def experience(self) -> dict[str, Any]:
        """The transitions held, and the decisions still open."""
        return {"memory": self.memory.state_dict(), "open": self.maker.state_dict()}

    def load_experience(self, experience: dict[str, Any]) -> None:
        """Inverse of `experience`."""
        self.memory.load_state_dict(experience["memory"])
        self.maker.load_state_dict(experience["open"])
