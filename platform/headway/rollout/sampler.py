"""Stepping environments with policies: the loop that workers, and the serial backend, run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Observations, StepResult, Trajectory, child_seeds, generator
from headway.contracts.acting_policy import Parameters
from headway.events import Row
from headway.rollout.nan_check import check_finite
from headway.rollout.plan import RolloutPlan, Shard
from headway.rollout.policy_player import PolicyPlayer


@dataclass(frozen=True)
class Episode:
    """One finished episode."""

    replica: int
    row: Row
    """`copy`, `length`, `return` (the mean over agents of their summed rewards) and the metrics."""


def in_order(episodes: Iterable[Episode]) -> list[Episode]:
    """By replica, copy and time, given each copy's in the order of time: so that the last bits of their
    means are the same on every backend."""
    return sorted(episodes, key=lambda episode: (episode.replica, episode.row["copy"]))


class Tally:
    """Lengths and returns of the episodes that C copies are in."""

    def __init__(self, copies: int, metric_names: Sequence[str]) -> None:
        self.metric_names = metric_names
        self.lengths = np.zeros(copies, np.int64)
        self.returns = np.zeros(copies)

    def add(self, outcome: StepResult) -> list[tuple[int, dict[str, float | int | str]]]:
        """Count a step; (copy, row) of each episode that ended with it."""
        self.lengths += 1
        # What `mean` and `any` come to, without what they cost where copies are few.
        self.returns += np.add.reduce(outcome.rewards, axis=1, dtype=np.float64) / outcome.rewards.shape[1]
        if not np.count_nonzero(outcome.episode_ended):
            return []
        ended = []
        for copy in np.flatnonzero(outcome.episode_ended).tolist():
            row: dict[str, float | int | str] = {
                "length": int(self.lengths[copy]),
                "return": float(self.returns[copy]),
            }
            row.update(zip(self.metric_names, outcome.metrics[copy].tolist(), strict=True))
            ended.append((copy, row))
        self.lengths[outcome.episode_ended] = 0
        self.returns[outcome.episode_ended] = 0
        return ended


class Sampler:
    """The copies of one shard, and their part of the trajectory."""

    def __init__(self, plan: RolloutPlan, shard: Shard, trajectory: Trajectory, own: bool = False) -> None:
        """`plan`: of all replicas; `own`: the trajectory is of this shard alone, and not of all copies."""
        self.plan_of_all, self.shard = plan, shard
        self.plan = plan.of_replicas(shard.first_replica, shard.replicas)
        self.env = self.plan.make_for_training(shard.count)
        self.acting = PolicyPlayer(self.plan, shard.count, plan.block)
        if own:
            self.views = part_of(trajectory, shard.replicas, Shard(0, shard.replicas, 0, shard.count))
        else:
            self.views = part_of(trajectory, plan.replicas, shard)
        self.observed: Observations | None = None
        self.tally = Tally(shard.replicas * shard.count, plan.spec.metrics)

    def begin(self, purpose: str = "env") -> None:
        """Start the first episodes, on seeds of the global copies."""
        seeds = [child_seeds(seed, purpose, self.shard.first, self.shard.count) for seed in self.plan.seeds]
        self.observed = self.env.reset(np.concatenate(seeds))
        self.acting.forget()

    def snapshot(self) -> Any:  # noqa: ANN401 - opaque, plain
        """Where this sampler stands between two iterations, or None if the environment cannot tell."""
        if not self.plan.spec.snapshots:
            return None
        return {
            "env": self.env.snapshot(),
            "lengths": self.tally.lengths.copy(),
            "returns": self.tally.returns.copy(),
            **self.acting.snapshot(),
        }

    def restore(self, snapshot: Any) -> None:  # noqa: ANN401
        """Go on from a snapshot."""
        self.observed = self.env.restore(snapshot["env"])
        self.tally.lengths[:] = snapshot["lengths"]
        self.tally.returns[:] = snapshot["returns"]
        self.acting.restore(snapshot)

    def collect(self, iteration: int, parameters: Parameters) -> list[Episode]:
        """Fill this sampler's part of the trajectory, by the parameters of all replicas; the episodes that
        ended meanwhile."""
        assert self.observed is not None, "begin or restore first"
        parameters = self.plan_of_all.parameters_of(parameters, self.shard.first_replica, self.shard.replicas)
        observed, views, spec = self.observed, self.views, self.plan.spec
        noise = self._noise(iteration)
        episodes = []
        check_finite(spec, None, observed, 0, self._name_copy)
        if self.acting.memory is not None:
            views["hidden_states"][0] = self._by_replica(self.acting.memory)
            views["begins"][0] = self._by_replica(self.acting.begins)
        for t in range(self.plan.steps):
            self._store_observed(t, observed)
            actions, log_probs = self.acting.act(parameters, observed, noise[t])
            views["actions"][t] = self._by_replica(actions)
            views["log_probs"][t] = self._by_replica(log_probs)
            outcome, observed = self.env.step(actions)
            check_finite(spec, outcome, observed, t + 1, self._name_copy)
            for name in ("rewards", "terminated", "truncated", "acting"):
                views[name][t] = self._by_replica(getattr(outcome, name))
            if np.count_nonzero(outcome.terminated) or np.count_nonzero(outcome.truncated):
                views["final_observations"][t] = self._by_replica(outcome.final_observations)
                views["final_states"][t] = self._by_replica(outcome.final_states)
            self.acting.heed(outcome)
            episodes += [self._episode(copy, row) for copy, row in self.tally.add(outcome)]
        self._store_observed(self.plan.steps, observed)
        self.observed = observed
        return episodes

    def _noise(self, iteration: int) -> NDArray[np.float64]:
        """(T, C, N, ...), from streams of (seed, copy, iteration): a repeated iteration repeats its draws."""
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
        return array.reshape(self.plan.replicas, self.shard.count, *array.shape[1:])

    def _name_copy(self, row: int) -> str:
        replica, copy = divmod(row, self.shard.count)
        return f"copy {self.shard.first + copy} of seed {self.plan.seeds[replica]}"

    def _episode(self, copy: int, row: dict[str, float | int | str]) -> Episode:
        replica = self.shard.first_replica + copy // self.shard.count
        return Episode(replica, {"copy": self.shard.first + copy % self.shard.count, **row})


def part_of(trajectory: Trajectory, replicas: int, shard: Shard) -> dict[str, NDArray[Any]]:
    """Writable views (T, shard.replicas, shard.count, ...) of the arrays of a trajectory of so many
    replicas."""
    of_replicas = slice(shard.first_replica, shard.first_replica + shard.replicas)
    of_copies = slice(shard.first, shard.first + shard.count)
    views = {}
    for field in fields(trajectory):
        array = getattr(trajectory, field.name)
        split = array.reshape(array.shape[0], replicas, array.shape[1] // replicas, *array.shape[2:])
        views[field.name] = split[:, of_replicas, of_copies]
    return views
