"""The off-policy learner: store transitions, draw minibatches, update one stack of policies by any method."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory
from headway_algos.agent_id import trajectory_with_ids
from headway_algos.batches.divergence import raise_if_diverged
from headway_algos.batches.layout import mean_per_replica
from headway_algos.batches.nested_states import replica_state, same_shapes
from headway_algos.batches.policy_stack import PolicyStack
from headway_algos.networks.mlp import StackedMLP
from headway_algos.networks.network import acting_arrays
from headway_algos.networks.normalisation import RunningStatistics
from headway_algos.off_policy.replay_buffer import Batch, ReplayBuffer
from headway_algos.off_policy.transitions import TransitionBuilder
from headway_algos.replay_config import ReplayConfig


class Method(ABC):
    """Update of a stack of policies from batches of transitions; its state is that of its parts."""

    network: StackedMLP
    """The network that the acting policy uses."""

    @property
    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Networks, target networks and optimisers, by their names in states."""

    @abstractmethod
    def learn(self, batch: Batch, active: NDArray[np.bool_]) -> dict[str, Tensor]:
        """Take one step of the `active` (P,) networks on normalised observations; return metrics (P,)."""

    @abstractmethod
    def anneal(self, share: float) -> None:
        """Set the learning rates to `share` of their configured values."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything needed to continue exactly."""
        return {name: part.state_dict() for name, part in self.parts.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        for name, part in self.parts.items():
            part.load_state_dict(state[name])


MakeMethod = Callable[[Any, EnvSpec, Sequence[int], int, torch.device], Method]
"""(config, environment, seeds of the R replicas, K, device) -> method."""


class OffPolicyLearner(PolicyStack):
    """A learner of R replicas x K policies, with one replay buffer each.

    Implements `LearnerWithReplay` and `ContinuingLearner` of `headway.contracts`.
    """

    config: ReplayConfig

    def __init__(
        self, config: ReplayConfig, spec: EnvSpec, seeds: Sequence[int], device: str, method: MakeMethod
    ) -> None:
        super().__init__(config, spec, seeds, device)
        spec = self.spec
        policies = len(seeds) * self.grouping.num_policies
        self.method = method(config, spec, self.seeds, self.grouping.num_policies, self.device)
        self.moments = RunningStatistics(policies, spec.observation_size).to(self.device)
        self.transition_builder = TransitionBuilder(spec, config.gamma, config.n_step)
        self.replay = ReplayBuffer(spec, policies, config.capacity, self.device)
        self.env_steps = 0
        """Environment steps per seed so far, those of a rule left out."""
        self.progress, self.scheduled_steps = 0.0, 0
        """Share of training, and environment steps, done before the last update: inputs of the schedules."""

    @property
    def exploration(self) -> float:
        """Exploration until the next update: the schedule's value at the start of the last iteration."""
        return self.config.exploration(self.progress, self.scheduled_steps)

    def acting_parameters(self) -> dict[str, NDArray[Any]]:
        """Return network, observation normaliser and exploration, as named by the acting policy."""
        exploration = torch.full((len(self.replay.filled), 1, 1), self.exploration, dtype=self.dtype)
        return acting_arrays(self.method.network, self.moments, {"exploration": exploration})

    def update(
        self, trajectory: Trajectory, iteration: int, progress: float
    ) -> dict[str, NDArray[np.float64]]:
        """Store the iteration's transitions, then take `updates` gradient steps."""
        trajectory = trajectory_with_ids(trajectory, self.agent_ids)
        explored = self.exploration
        self.method.anneal(self.config.lr_factor(progress))
        self.include_observations(self.moments, trajectory)
        self._store(trajectory)
        info = self._learn(iteration)
        steps, copies = trajectory.rewards.shape[:2]
        self.progress, self.scheduled_steps = progress, self.env_steps
        self.env_steps += steps * copies // len(self.seeds)
        raise_if_diverged(self, self.acting_parameters(), f"iteration {iteration}")
        held = torch.from_numpy(self.replay.filled)
        metrics = {name: mean_per_replica(value, len(self.seeds)) for name, value in info.items()}
        return metrics | {
            "memory/transitions": mean_per_replica(held, len(self.seeds)),
            "policy/exploration": np.full(len(self.seeds), explored),
        }

    def begin_episodes(self) -> None:
        """Drop the open decisions: rewards of new episodes do not belong to them."""
        self.transition_builder.open = None

    def imitate(
        self, trajectory: Trajectory, iteration: int, iterations: int
    ) -> dict[str, NDArray[np.float64]]:
        """Store the rule's transitions and learn from them, with all schedules at their start."""
        metrics = self.update(trajectory, iteration, 0.0)
        self.env_steps = self.scheduled_steps = 0
        return metrics

    def start_from(self, state: dict[str, Any], replica: int, replicas: int, with_critic: bool) -> list[str]:
        """Implement `headway.contracts.StartingLearner.start_from`.

        The networks depend on one another, so all are taken over or none; the replay buffer starts empty.
        """
        own, taken = self.method.state_dict(), dict[str, Any]()
        if with_critic:
            parent = replica_state(state, replica, replicas, len(self.seeds))
            taken = {name: part for name, part in parent["method"].items() if "optimiser" not in name}
        if not taken or not same_shapes(taken, {name: own.get(name) for name in taken}):
            raise HeadwayError(
                f"start.run was trained with another algorithm or other networks than {self.config.name} "
                "has here; start from a run with the same"
            )
        self.method.load_state_dict({**own, **taken})
        self.moments.load_state_dict(parent["moments"])
        return []

    def _store(self, trajectory: Trajectory) -> None:
        transitions = self.transition_builder.transitions(trajectory)
        policies = self.grouping.policies(trajectory.rewards.shape[1], len(self.seeds))
        self.replay.add(policies.ravel()[transitions.streams], transitions)

    def _learn(self, iteration: int) -> dict[str, Tensor]:
        """Return metrics (P,) as means over the gradient steps; NaN for policies that took none."""
        active = self.replay.filled >= self.config.learning_starts
        sums: dict[str, Tensor] = {}
        stepped = torch.from_numpy(active).to(self.device)
        random = self.generators("replay", iteration)
        updates = self.config.updates
        scale = self.replay.return_scale().to(self.dtype) if self.config.normalise_rewards else None
        for slots in self.replay.draws(random, active, (updates, self.config.batch_size)):
            batch = self.replay.batch(slots, self.dtype)
            for name, value in self.method.learn(self._normalised(batch, scale), active).items():
                sums[name] = sums.get(name, 0) + value / updates
        if scale is not None:
            sums["critic/value"] *= scale  # in units of reward
        return {name: torch.where(stepped, value, torch.nan) for name, value in sums.items()}

    def _normalised(self, batch: Batch, scale: Tensor | None) -> Batch:
        """Return the batch with normalised observations, and with returns divided by `scale` (P,)."""
        if scale is not None:
            batch = replace(batch, returns=batch.returns / scale[:, None])
        if not self.config.normalise_observations:
            return batch
        return replace(
            batch,
            observations=self.moments.normalised(batch.observations),
            next_observations=self.moments.normalised(batch.next_observations),
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the states of networks, normaliser and schedules."""
        return {
            "method": self.method.state_dict(),
            "moments": self.moments.state_dict(),
            "progress": self.progress,
            "scheduled_steps": self.scheduled_steps,
            "env_steps": self.env_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`; raises RuntimeError if shapes differ."""
        self.method.load_state_dict(state["method"])
        self.moments.load_state_dict(state["moments"])
        self.progress, self.scheduled_steps = state["progress"], state["scheduled_steps"]
        self.env_steps = state["env_steps"]

    def replay_state(self) -> dict[str, Any]:
        """Return the stored transitions and the open decisions."""
        return {"memory": self.replay.state_dict(), "open": self.transition_builder.state_dict()}

    def load_replay_state(self, state: dict[str, Any]) -> None:
        """Restore the result of `replay_state`."""
        self.replay.load_state_dict(state["memory"])
        self.transition_builder.load_state_dict(state["open"])
