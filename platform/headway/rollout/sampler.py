"""The sampler: the loop that steps environments with policies, in workers and in the serial backend."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, Observations, StepResult, Trajectory, child_seeds, generator
from headway.contracts.acting_policy import Parameters
from headway.events import Row
from headway.rollout.forks import end_if_forked
from headway.rollout.nan_check import check_finite
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.policy_player import PolicyPlayer
from headway.rollout.scaled_actions import ScaledActions


@dataclass(frozen=True)
class Episode:
    """One finished episode."""

    replica: int
    row: Row
    """`copy`, `length`, `return` (the mean over agents of their summed rewards) and the metrics."""


def sort_episodes(episodes: Iterable[Episode]) -> list[Episode]:
    """Sort episodes by replica and copy; the episodes of one copy stay in order of time.

    With a fixed order, means over episodes have the same last bits on every backend.
    """
    return sorted(episodes, key=lambda episode: (episode.replica, episode.row["copy"]))


class Tally:
    """Running lengths and returns of the current episodes of C copies."""

    def __init__(self, copies: int, metric_names: Sequence[str]) -> None:
        self.metric_names = metric_names
        self.lengths = np.zeros(copies, np.int64)
        self.returns = np.zeros(copies)

    def add(self, outcome: StepResult) -> list[tuple[int, Row]]:
        """Add a step; return (copy, row) of each episode that ended with it."""
        self.lengths += 1
        # On small arrays `add.reduce` and `count_nonzero` are faster than the equivalent `mean` and `any`.
        self.returns += np.add.reduce(outcome.rewards, axis=1, dtype=np.float64) / outcome.rewards.shape[1]
        if not np.count_nonzero(outcome.episode_ended):
            return []
        ended: list[tuple[int, Row]] = []
        for copy in np.flatnonzero(outcome.episode_ended).tolist():
            metrics = zip(self.metric_names, outcome.metrics[copy].tolist(), strict=True)
            row = {"length": int(self.lengths[copy]), "return": float(self.returns[copy]), **dict(metrics)}
            ended.append((copy, row))
        self.lengths[outcome.episode_ended] = 0
        self.returns[outcome.episode_ended] = 0
        return ended


class Sampler:
    """Steps the copies of one shard and writes their part of the trajectory."""

    def __init__(self, plan: RolloutPlan, shard: Shard, trajectory: Trajectory) -> None:
        """`plan` covers all replicas. `trajectory` holds all copies, or those of this shard only."""
        self.full_plan, self.shard = plan, shard
        self.plan = plan.of_replicas(shard.first_replica, shard.replicas)
        self.env = self.plan.make_for_training(shard.count)
        self.player = PolicyPlayer(self.plan, shard.count, plan.block)
        if trajectory.rewards.shape[1] == shard.replicas * shard.count:
            self.views = shard_views(trajectory, shard.replicas, Shard(0, shard.replicas, 0, shard.count))
        else:
            self.views = shard_views(trajectory, plan.replicas, shard)
        self.observed: Observations | None = None
        self._shape = (shard.replicas, shard.count)
        self.tally = Tally(shard.replicas * shard.count, plan.spec.metrics)

    def begin(self, purpose: str) -> None:
        """Start new episodes, with seeds derived from (seed, purpose, global copy index)."""
        seeds = [child_seeds(seed, purpose, self.shard.first, self.shard.count) for seed in self.plan.seeds]
        self.observed = self.env.reset(np.concatenate(seeds))
        self.player.reset()

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Return the state between two iterations; None if the environment has no snapshots."""
        if not self.plan.spec.snapshots:
            return None
        return {
            "env": self.env.snapshot(),
            "lengths": self.tally.lengths.copy(),
            "returns": self.tally.returns.copy(),
            **self.player.snapshot(),
        }

    def restore(self, snapshot: Any) -> None:  # noqa: ANN401
        """Continue from a snapshot."""
        self.observed = self.env.restore(snapshot["env"])
        self.tally.lengths[:] = snapshot["lengths"]
        self.tally.returns[:] = snapshot["returns"]
        self.player.restore(snapshot)

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Fill this shard's part of the trajectory; return the episodes that ended.

        `parameters` are those of all replicas.
        """
        assert self.observed is not None, "begin or restore first"
        parameters = self.full_plan.parameters_of(parameters, self.shard.first_replica, self.shard.replicas)
        observed, views, spec = self.observed, self.views, self.plan.spec
        noise = self._noise(iteration)
        episodes, process_id = [], os.getpid()
        check_finite(spec, None, observed, 0, self._name_copy)
        if self.player.hidden_states is not None:
            views["hidden_states"][0] = self._by_replica(self.player.hidden_states)
            views["begins"][0] = self._by_replica(self.player.begins)
            views["episode_begins"][0] = self._by_replica(self.tally.lengths == 0)
        for t in range(self.plan.steps):
            self._store_observed(t, observed)
            actions, log_probs = self.player.act(parameters, observed, noise[t])
            if iteration <= self.plan.rule_iterations:
                # The policy acted too, for its hidden states, which its learner needs.
                actions, log_probs = self._rule_actions(observed), np.zeros_like(log_probs)
            views["actions"][t] = self._by_replica(actions)
            views["log_probs"][t] = self._by_replica(log_probs)
            outcome, observed = self.env.step(actions)
            end_if_forked(process_id)
            check_finite(spec, outcome, observed, t + 1, self._name_copy)
            for name in ("rewards", "terminated", "truncated", "acting", "episode_ended"):
                views[name][t] = self._by_replica(getattr(outcome, name))
            # Streams end rarely, and final observations are as large as all observations of a step.
            if np.count_nonzero(outcome.terminated) or np.count_nonzero(outcome.truncated):
                views["final_observations"][t] = self._by_replica(outcome.final_observations)
                views["final_states"][t] = self._by_replica(outcome.final_states)
            self.player.reset_ended(outcome)
            episodes += [self._episode(copy, row) for copy, row in self.tally.add(outcome)]
        self._store_observed(self.plan.steps, observed)
        self.observed = observed
        return episodes

    def _rule_actions(self, observed: Observations) -> NDArray[Any]:
        """Return the rule's actions in the units of policies, and within the bounds of a Box."""
        rule, env, space = self.plan.rule, self.env, self.plan.spec.action_space
        assert rule is not None
        if isinstance(env, ScaledActions):
            actions = env.in_policy_units(rule.act(env.inner, observed))
        else:
            actions = rule.act(env, observed)
        # The environment would clip them itself, but learners learn from the actions stored.
        if isinstance(space, Box):
            actions = np.clip(actions, space.low, space.high).astype(np.float32)
        return actions

    def _noise(self, iteration: int) -> NDArray[np.float64]:
        """Draw action noise (T, C, N, ...) from one random stream per (seed, copy, iteration).

        A repeated iteration therefore repeats its draws.
        """
        draws = [
            self.plan.policy.noise(generator(seed, "action", copy, iteration), self.plan.steps)
            for seed in self.plan.seeds
            for copy in range(self.shard.first, self.shard.first + self.shard.count)
        ]
        return np.stack(draws, axis=1)

    def _store_observed(self, t: int, observed: Observations) -> None:
        self.views["observations"][t] = self._by_replica(observed.observations)
        self.views["states"][t] = self._by_replica(observed.states)
        self.views["alive"][t] = self._by_replica(observed.alive)
        if observed.action_masks is not None:
            self.views["action_masks"][t] = self._by_replica(observed.action_masks)

    def _by_replica(self, array: NDArray[Any]) -> NDArray[Any]:
        return array.reshape(self._shape + array.shape[1:])

    def _name_copy(self, row: int) -> str:
        replica, copy = divmod(row, self.shard.count)
        return f"copy {self.shard.first + copy} of seed {self.plan.seeds[replica]}"

    def _episode(self, copy: int, row: Row) -> Episode:
        replica = self.shard.first_replica + copy // self.shard.count
        return Episode(replica, {"copy": self.shard.first + copy % self.shard.count, **row})


def shard_views(trajectory: Trajectory, replicas: int, shard: Shard) -> dict[str, NDArray[Any]]:
    """Return writable views (T, shard.replicas, shard.count, ...) of a trajectory's arrays by name.

    `replicas` is the number of replicas in the trajectory.
    """
    replica_slice = slice(shard.first_replica, shard.first_replica + shard.replicas)
    copy_slice = slice(shard.first, shard.first + shard.count)
    views = {}
    for field in fields(trajectory):
        array = getattr(trajectory, field.name)
        split = array.reshape(array.shape[0], replicas, array.shape[1] // replicas, *array.shape[2:])
        views[field.name] = split[:, replica_slice, copy_slice]
    return views
