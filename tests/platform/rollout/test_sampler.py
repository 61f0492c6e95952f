"""The sampler: rows of the trajectory, ends of episodes, seeds and noise."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rehearsal import parameters_of, plan_of_toy

from headway.contracts import (
    BatchedEnv,
    Discrete,
    EnvSpec,
    HeadwayError,
    Observations,
    StepResult,
    Trajectory,
    TrajectoryLayout,
    child_seeds,
    generator,
)
from headway.contracts.acting_policy import Parameters
from headway.rollout import episodes
from headway.rollout.episodes import EvaluationRequest, evaluate_policy, evaluate_rule
from headway.rollout.plan import EVALUATION_BLOCK, RolloutPlan, Shard
from headway.rollout.policy_player import PolicyPlayer
from headway.rollout.sampler import Episode, Sampler

AGENTS = 2


class Clock:
    """Observations are (copy, episode, step), rewards the action plus the agent's index.

    Episodes of copy c last c + 2 steps; even episodes are truncated, odd ones terminated.
    """

    def __init__(self, prepared: object, copies: int) -> None:
        self.seeds = np.zeros(copies, np.uint64)
        self.episodes, self.steps = np.zeros((2, copies), np.int64)
        self.observations = np.zeros((copies, AGENTS, 3), np.float32)  # one array, overwritten at each step
        self.paid = np.zeros((copies, AGENTS), np.float32)

    @property
    def spec(self) -> EnvSpec:
        return EnvSpec("clock", ("a", "b"), 3, Discrete(5), state_size=1, metrics=("episode", "parity"))

    @property
    def num_copies(self) -> int:
        return len(self.seeds)

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        self.seeds[:] = seeds
        return self._observe()

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        self.steps += 1
        self.paid[:] = actions + np.arange(AGENTS)
        ended = self.steps == np.arange(self.num_copies) + 2
        final = self._observe().observations.copy()
        everyone = np.broadcast_to(ended[:, None], self.paid.shape)
        even = self.episodes[:, None] % 2 == 0
        metrics = np.stack([self.episodes, self.episodes % 2], axis=1).astype(np.float64)
        outcome = StepResult(
            rewards=self.paid, terminated=everyone & ~even, truncated=everyone & even,
            acting=np.ones_like(everyone), episode_ended=ended, final_observations=final,
            final_states=final[:, 0, 2:] * 100, metrics=metrics,
        )  # fmt: skip
        self.episodes[ended] += 1
        self.steps[ended] = 0
        return outcome, self._observe()

    def snapshot(self) -> None:
        raise NotImplementedError

    def restore(self, snapshot: object) -> Observations:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def _observe(self) -> Observations:
        rows = np.stack([np.arange(self.num_copies), self.episodes, self.steps], axis=1)
        self.observations[:] = rows[:, None]
        return Observations(
            self.observations, self.observations[:, 0, 2:] * 100, np.ones_like(self.paid, np.bool_)
        )


@dataclass(frozen=True)
class StepPolicy:
    """Acts by the step in the observation, so that actions can be checked; records the batch sizes."""

    rows: list[int]

    def parameter_shapes(self, replicas: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        return {"shift": ((replicas,), np.dtype(np.int64))}

    def noise(self, generator: np.random.Generator, steps: int) -> NDArray[np.float64]:
        return generator.random((steps, AGENTS))

    def act(
        self, parameters: Parameters, observed: Observations, noise: NDArray[np.float64] | None
    ) -> tuple[NDArray[Any], NDArray[np.float64]]:
        self.rows.append(len(observed.observations))
        actions = observed.observations[..., 2].astype(np.int64)
        return actions, np.zeros(actions.shape) if noise is None else noise


def _sampled(
    seeds: tuple[int, ...], copies: int, steps: int, iterations: int = 1
) -> tuple[RolloutPlan, list[Trajectory], list[list[Episode]]]:
    plan = RolloutPlan(Clock, (), None, Clock(None, 1).spec, StepPolicy([]), seeds, copies, steps, copies)
    layout = TrajectoryLayout(plan.spec, steps, len(seeds) * copies)
    trajectory = Trajectory.allocate(layout)
    sampler = Sampler(plan, plan.whole, trajectory)
    sampler.begin("env")
    trajectories, episodes = [], []
    parameters = {"shift": np.zeros(len(seeds), np.int64)}
    for iteration in range(1, iterations + 1):
        episodes.append(sampler.collect(iteration, parameters))
        kept = Trajectory.allocate(layout)
        for name in layout.arrays:
            getattr(kept, name)[...] = getattr(trajectory, name)
        trajectories.append(kept)
    return plan, trajectories, episodes


def test_row_t_is_observed_before_action_t_and_the_last_row_after_the_last_step() -> None:
    _, (first, second), _ = _sampled((5,), 2, 7, iterations=2)
    # Copy 0's episodes last two steps, copy 1's three.
    assert first.observations[:, 0, 0, 2].tolist() == [0, 1, 0, 1, 0, 1, 0, 1]
    assert first.observations[:, 1, 1, 2].tolist() == [0, 1, 2, 0, 1, 2, 0, 1]
    assert first.observations[:, 1, 0, 1].tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    np.testing.assert_array_equal(first.actions, first.observations[:-1, :, :, 2])
    np.testing.assert_array_equal(first.rewards, first.actions + np.arange(AGENTS))
    np.testing.assert_array_equal(first.states[..., 0], first.observations[..., 0, 2] * 100)
    for name in ("observations", "states", "alive"):
        np.testing.assert_array_equal(getattr(second, name)[0], getattr(first, name)[-1], err_msg=name)


def test_truncation_and_termination_are_distinct_and_final_observations_precede_the_reset() -> None:
    _, (first,), _ = _sampled((5,), 2, 7)
    assert first.truncated[:, 0].all(axis=1).tolist() == [False, True, False, False, False, True, False]
    assert first.terminated[:, 0].all(axis=1).tolist() == [False, False, False, True, False, False, False]
    assert first.terminated[:, 1].any(axis=1).tolist() == [False] * 5 + [True, False]
    over = first.truncated | first.terminated
    assert (first.final_observations[over][:, 2] == np.nonzero(over)[1] + 2).all()  # the step after the last
    ended = over.all(axis=2)
    np.testing.assert_array_equal(first.episode_ended, ended)
    assert (first.final_states[ended][:, 0] == 100 * (np.nonzero(ended)[1] + 2)).all()


def test_episode_rows_count_across_iterations() -> None:
    _, _, (first, second) = _sampled((5, 6), 2, 4, iterations=2)
    # Episodes of batch row c last c + 2 steps: those of replica 1 four and five.
    assert [(e.replica, e.row["copy"], e.row["length"], e.row["episode"]) for e in first] == [
        (0, 0, 2, 0), (0, 1, 3, 0), (0, 0, 2, 1), (1, 0, 4, 0),
    ]  # fmt: skip
    assert [(e.replica, e.row["copy"], e.row["length"], e.row["episode"]) for e in second] == [
        (1, 1, 5, 0), (0, 0, 2, 2), (0, 1, 3, 1), (0, 0, 2, 3), (1, 0, 4, 1),
    ]  # fmt: skip
    for episode in first + second:
        length = int(episode.row["length"])
        assert episode.row["return"] == sum(range(length)) + 0.5 * length  # the mean over both agents
        assert episode.row["parity"] == int(episode.row["episode"]) % 2
        assert list(episode.row) == ["copy", "length", "return", "episode", "parity"]


def test_seeds_and_noise_belong_to_global_copies() -> None:
    plan = RolloutPlan(Clock, (), None, Clock(None, 1).spec, StepPolicy([]), (5, 6), 3, 4, 1)
    trajectory = Trajectory.allocate(TrajectoryLayout(plan.spec, 4, 6))
    sampler = Sampler(plan, Shard(0, 2, 1, 2), trajectory)  # copies 1 and 2 of both replicas
    sampler.begin("env")
    expected = [child_seeds(seed, "env", copy, 1)[0] for seed in (5, 6) for copy in (1, 2)]
    assert isinstance(sampler.env, Clock)
    assert sampler.env.seeds.tolist() == expected
    sampler.collect(9, {"shift": np.zeros(2, np.int64)})
    for row, seed, copy in ((1, 5, 1), (2, 5, 2), (4, 6, 1), (5, 6, 2)):
        drawn = plan.policy.noise(generator(seed, "action", copy, 9), 4)
        np.testing.assert_array_equal(trajectory.log_probs[:, row], drawn)
    for row in (0, 3):  # rows of another worker
        assert not trajectory.log_probs[:, row].any()
        assert not trajectory.alive[:, row].any()


@pytest.mark.parametrize(
    ("copies", "block", "rows", "state"), [(5, 2, [6, 6, 3], 1), (4, 4, [12], 1), (3, 1, [3, 3, 3], 0)]
)
def test_actions_come_in_blocks_of_all_replicas(copies: int, block: int, rows: list[int], state: int) -> None:
    policy = StepPolicy([])
    plan = RolloutPlan(Clock, (), None, Clock(None, 1).spec, policy, (5, 6, 7), copies, 4, block)
    shown = np.arange(3 * copies * AGENTS * 3, dtype=np.float32).reshape(-1, AGENTS, 3)
    observed = Observations(
        shown, np.zeros((len(shown), state), np.float32), np.ones(shown.shape[:2], np.bool_)
    )
    noise = shown[..., 0].astype(np.float64)
    actions, log_probs = PolicyPlayer(plan, copies, block).act({}, observed, noise)
    assert policy.rows == rows
    np.testing.assert_array_equal(actions, shown[..., 2])
    np.testing.assert_array_equal(log_probs, noise)


def test_evaluation_plays_first_episodes_on_seeds_of_their_own() -> None:
    made: list[Clock] = []

    def make(prepared: object, copies: int) -> BatchedEnv:
        made.append(Clock(prepared, copies))
        return made[-1]

    plan = RolloutPlan(make, (), None, Clock(None, 1).spec, StepPolicy([]), (5, 6), 3, 4, 1)
    rows = evaluate_policy(plan, {}, EvaluationRequest(77, first=20, count=4, greedy=True))
    assert made[0].seeds.tolist() == child_seeds(77, "evaluation", 20, 4).tolist() * 2
    assert [[row["episode_seed"] for row in replica] for replica in rows] == [[20, 21, 22, 23]] * 2
    assert [row["length"] for replica in rows for row in replica] == list(range(2, 10))
    assert all(row["episode"] == 0 for replica in rows for row in replica)

    class Still:
        def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
            return np.zeros(observed.alive.shape, np.int64)

    made.clear()
    steps: list[tuple[int, int]] = []
    played = evaluate_rule(
        make, lambda prepared: Still(), None, 77, 24, lambda step, ended: steps.append((step, ended))
    )
    assert steps == [(step, int(step > 1)) for copies in (10, 10, 4) for step in range(1, copies + 2)]
    assert [row["episode_seed"] for row in played] == list(range(24))
    made.pop(0)  # made to read the limit of copies
    faced = np.concatenate([env.seeds for env in made])
    assert faced.tolist() == child_seeds(77, "evaluation", 0, 24).tolist()


def test_training_arguments_are_used_for_sampling_and_never_for_evaluation() -> None:
    made: list[object] = []

    def make(prepared: object, copies: int) -> BatchedEnv:
        made.append(prepared)
        return Clock(prepared, copies)

    plan = RolloutPlan(make, (), "reported", Clock(None, 1).spec, StepPolicy([]), (5,), 3, 4, 1)
    plan = replace(plan, training_prepared="learned from")
    trajectory = Trajectory.allocate(TrajectoryLayout(plan.spec, 4, 3))
    Sampler(plan, plan.whole, trajectory)
    evaluate_policy(plan, {}, EvaluationRequest(77, 0, 2, greedy=True))
    assert made == ["learned from", "reported"]
    Sampler(replace(plan, training_prepared=None), plan.whole, trajectory)
    assert made[2] == "reported"


def test_sampled_evaluation_depends_on_the_seed_and_greedy_does_not_draw() -> None:
    # Both replicas have the same parameters, so only their noise differs.
    plan = plan_of_toy("visitors", seeds=(5, 6))
    alone = parameters_of(plan_of_toy("visitors", seeds=(5,)))
    parameters = {name: np.concatenate([array, array]) for name, array in alone.items()}
    greedy = evaluate_policy(plan, parameters, EvaluationRequest(77, 0, 5, greedy=True))
    assert greedy[0] == greedy[1]
    sampled = evaluate_policy(plan, parameters, EvaluationRequest(77, 0, 5, greedy=False))
    assert sampled[0] != sampled[1]
    assert [row["length"] for row in sampled[0]] == [row["length"] for row in greedy[0]]  # the same days


def test_a_random_rule_does_not_repeat_its_draws_in_the_next_block() -> None:
    drawn: list[float] = []

    class Drawing:
        def __init__(self) -> None:
            self.generator = np.random.default_rng(0)

        def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
            drawn.append(self.generator.random())
            return np.zeros(observed.alive.shape, np.int64)

    evaluate_rule(Clock, lambda prepared: Drawing(), None, 77, 2 * EVALUATION_BLOCK)
    assert len(set(drawn)) == len(drawn) > 2


def test_an_endless_episode_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "MAX_STEPS", 6)
    plan = RolloutPlan(Clock, (), None, Clock(None, 1).spec, StepPolicy([]), (5,), 8, 4, 1)
    with pytest.raises(HeadwayError, match=r"evaluation episode 5 has not ended in 6 steps; .*truncated"):
        evaluate_policy(plan, {}, EvaluationRequest(77, first=0, count=8, greedy=True))
