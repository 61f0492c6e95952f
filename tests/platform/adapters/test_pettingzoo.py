"""PettingZoo environments as batches: alive masks, ends of streams, errors."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from numpy.typing import NDArray
from scripted import Script, Scripted, Space

from headway.adapters.conformance import CHECKS, play
from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch, episode_seed
from headway.contracts import Box, Discrete, HeadwayError, MultiDiscrete
from headway.contracts.errors import EnvironmentRaisedError
from tests.robustness.misbehaving import parallel_env


def batch(script: Script = lambda env: None, agents_come_and_go: bool | None = None) -> ParallelEnvBatch:
    options = AdapterOptions(agents_come_and_go=agents_come_and_go)
    return ParallelEnvBatch(lambda: Scripted(script), 2, "scripted", options)


def at(step: int, change: Callable[[Scripted], object]) -> Script:
    """Return a script that changes the environment's answer at one step."""

    def script(env: Scripted) -> None:
        if env.steps == step:
            change(env)

    return script


def play_steps(env: ParallelEnvBatch, steps: int) -> None:
    env.reset(seeds(env.num_copies))
    for _ in range(steps):
        env.step(NOTHING[: env.num_copies])


def seeds(count: int = 2) -> NDArray[np.uint64]:
    return np.arange(count, dtype=np.uint64)


NOTHING = np.zeros((2, 2), dtype=np.int64)


def test_each_episode_has_its_own_seed() -> None:
    env = batch()
    observed = env.reset(seeds())
    first = [episode_seed(copy, 0) % 1000 for copy in range(2)]
    np.testing.assert_array_equal(observed.observations[:, 0, 0], first)
    for _ in range(3):
        outcome, observed = env.step(NOTHING)
        assert not outcome.episode_ended.any()
    outcome, observed = env.step(NOTHING)
    assert outcome.episode_ended.all()
    assert outcome.truncated.all()
    assert not outcome.terminated.any()
    np.testing.assert_array_equal(outcome.final_observations[:, 0, :2], [[first[0], 4], [first[1], 4]])
    second = [episode_seed(copy, 1) % 1000 for copy in range(2)]
    np.testing.assert_array_equal(observed.observations[:, 0, :2], [[second[0], 0], [second[1], 0]])
    assert first != second


def kill_b_at_two(env: Scripted) -> None:
    if env.steps == 2:
        env.terminated["b"] = True
        env.rewards["b"] = -5.0


def test_a_dead_agent_is_absent_until_the_next_episode() -> None:
    env = batch(kill_b_at_two, agents_come_and_go=True)
    env.reset(seeds())
    env.step(NOTHING)
    outcome, observed = env.step(NOTHING)
    np.testing.assert_array_equal(outcome.terminated[0], [False, True])
    np.testing.assert_array_equal(outcome.rewards[0], [1, -5])
    np.testing.assert_array_equal(outcome.final_observations[0, 1, 1:], [2, 1])
    np.testing.assert_array_equal(observed.alive[0], [True, False])
    outcome, observed = env.step(NOTHING)
    np.testing.assert_array_equal(outcome.rewards[0], [1, 0])
    np.testing.assert_array_equal(outcome.acting[0], [True, False])
    assert not (outcome.terminated | outcome.truncated).any()
    assert not observed.alive[0, 1]
    outcome, observed = env.step(NOTHING)
    np.testing.assert_array_equal(outcome.truncated[0], [True, False])
    np.testing.assert_array_equal(outcome.terminated[0], [False, True])
    assert outcome.episode_ended.all()
    assert observed.alive.all()


def test_a_dead_agent_that_stays_listed_is_absent_too() -> None:
    class Listing(Scripted):
        def step(self, actions: dict[str, Any]) -> tuple[Any, ...]:
            answer = super().step(actions)
            if self.steps < self.length:
                self.agents = list(self.possible_agents)
            return answer

    options = AdapterOptions(agents_come_and_go=True)
    env = ParallelEnvBatch(partial(Listing, kill_b_at_two), 1, "scripted", options)
    env.reset(seeds(1))
    present = [env.step(NOTHING[:1])[1].alive[0].tolist() for _ in range(3)]
    assert present == [[True, True], [True, False], [True, False]]


def test_only_present_agents_get_actions() -> None:
    made = Scripted(kill_b_at_two)
    env = ParallelEnvBatch(lambda: made, 1, "scripted", AdapterOptions(agents_come_and_go=True))
    env.reset(seeds(1))
    for _ in range(4):
        env.step(np.array([[1, 0]]))
    assert made.given == [{"a": 1, "b": 0}, {"a": 1, "b": 0}, {"a": 1}, {"a": 1}]


def leave_at_two(env: Scripted) -> None:
    """Leave without termination or truncation, which PettingZoo's tests forbid and some environments do."""
    if env.steps == 2:
        env.agents.remove("b")


def test_an_absent_agent_is_truncated_with_its_last_observation() -> None:
    env = batch(leave_at_two, agents_come_and_go=True)
    env.reset(seeds())
    for _ in range(3):
        outcome, _ = env.step(NOTHING)
        assert not (outcome.terminated | outcome.truncated).any()
    outcome, _ = env.step(NOTHING)
    assert outcome.truncated.all()
    np.testing.assert_array_equal(outcome.final_observations[0, :, 1:], [[4, 0], [2, 1]])


def away_at_one_and_two(env: Scripted) -> None:
    """Absent rows are NaN; the key is omitted when the agent is back."""
    if env.steps in (1, 2):
        env.infos["b"] = {"alive": False}
        env.observations["b"] = np.full(3, np.nan)
    if env.steps == 2:
        env.infos["a"] = {"acting": False}


def test_infos_set_alive_and_acting() -> None:
    env = batch(away_at_one_and_two, agents_come_and_go=True)
    assert env.reset(seeds()).alive.all()
    outcome, observed = env.step(NOTHING)
    assert outcome.acting.all()
    np.testing.assert_array_equal(observed.alive[0], [True, False])
    outcome, observed = env.step(NOTHING)
    np.testing.assert_array_equal(outcome.acting[0], [False, False])
    outcome, observed = env.step(NOTHING)
    np.testing.assert_array_equal(outcome.acting[0], [True, False])
    assert observed.alive.all()


def test_masks_and_metrics_are_read_from_infos() -> None:
    def script(env: Scripted) -> None:
        env.infos["a"] = {"action_mask": np.array([env.steps % 2 == 0, True])}
        if env.steps == env.length:
            env.infos["b"] = {"episode_metrics": {"score": 7.5}}

    env = ParallelEnvBatch(lambda: Scripted(script, episode_metrics=("score", "other")), 2, "scripted")
    assert env.spec.has_action_mask
    assert env.spec.metrics == ("score", "other")
    observed = env.reset(seeds())
    for step in range(1, 5):
        outcome, observed = env.step(NOTHING)
        assert observed.action_masks is not None
        row = [(step % 4) % 2 == 0, True]
        np.testing.assert_array_equal(observed.action_masks[0], [row, [True, True]])
    np.testing.assert_array_equal(outcome.metrics[0], [7.5, np.nan])


@pytest.mark.parametrize(("space", "options"), [(spaces.Discrete(2), 2), (spaces.MultiDiscrete([2, 3]), 5)])
def test_a_live_agent_without_allowed_actions_is_an_error(space: Space, options: int) -> None:
    """With several choices, the first one without an allowed option is an error too."""

    def script(env: Scripted) -> None:
        mask = np.ones(options)
        mask[:2] = env.steps != 1
        env.infos["b"] = {"action_mask": mask}

    made = partial(Scripted, script, action_spaces=dict.fromkeys("ab", space))
    env = ParallelEnvBatch(made, 2, "scripted")
    env.reset(seeds())
    with pytest.raises(HeadwayError, match="leaves agent 'b' of copy 0 without an allowed action at step 1"):
        env.step(np.zeros((2, 2, *(space.shape or ())), dtype=np.int64))


@pytest.mark.parametrize(
    ("place", "fault", "reason"),
    [
        ("reset", "observations None", "TypeError"),
        ("step", "observations None", "TypeError"),
        ("reset", "infos None", "AttributeError"),
        ("step", "infos None", "AttributeError"),
        ("reset", "info no dictionary", "TypeError"),
        ("step", "info no dictionary", "TypeError"),
        ("reset", "answer None", "TypeError"),
        ("step", "answer None", "TypeError"),
        ("reset", "one value less", "not enough values to unpack"),
        ("step", "one value less", "not enough values to unpack"),
        ("reset", "agents None", "TypeError"),
        ("step", "agents None", "TypeError"),
        ("step", "reward a word", "could not convert string to float"),
        ("step", "reward a list", "setting an array element with a sequence"),
        ("step", "flag an array", "truth value of an array"),
    ],
)
def test_an_answer_of_another_form_is_an_error(place: str, fault: str, reason: str) -> None:
    made = partial(parallel_env, fault, place, at=3, spares_session=False)
    env = ParallelEnvBatch(made, 1, "misbehaving")
    with pytest.raises(
        HeadwayError, match=r"'misbehaving' returned a value at step \d that cannot"
    ) as failure:
        play_steps(env, 8)
    assert reason in str(failure.value)
    assert "return (observations, " in str(failure.value)


def test_an_error_of_the_environment_s_own_is_named_with_its_place() -> None:
    for place in ("reset", "step"):
        env = ParallelEnvBatch(partial(parallel_env, "raise KeyError", place, 3, "", False), 1, "misbehaving")
        line = rf"environment 'misbehaving' raised KeyError: 'agent' in {place} \(misbehaving\.py, line \d+\)"
        with pytest.raises(EnvironmentRaisedError, match=line):
            play_steps(env, 8)


def test_termination_takes_precedence_over_truncation() -> None:
    env = batch(at(4, lambda env: env.terminated.update(dict.fromkeys(env.agents, True))))
    env.reset(seeds())
    for _ in range(4):
        outcome, _ = env.step(NOTHING)
    assert outcome.terminated.all()
    assert not outcome.truncated.any()


def test_absent_agents_get_the_shared_reward() -> None:
    def script(env: Scripted) -> None:
        env.rewards = dict.fromkeys(env.agents, 2.5 + env.steps)
        if env.steps == 2:
            env.terminated["a"] = True  # the first, whose slot a team's critic reads

    def make(copies: int) -> ParallelEnvBatch:
        options = AdapterOptions(shared_reward=True, agents_come_and_go=True)
        return ParallelEnvBatch(lambda: Scripted(script), copies, "scripted", options)

    env = make(2)
    env.reset(seeds())
    paid = [env.step(NOTHING)[0].rewards[0].tolist() for _ in range(4)]
    assert paid == [[3.5, 3.5], [4.5, 4.5], [5.5, 5.5], [6.5, 6.5]]
    CHECKS["shared reward"](make, play(make))


def test_spaces_that_differ_are_refused_until_padded() -> None:
    def differing() -> Scripted:
        return Scripted(
            observation_spaces={"a": spaces.Box(-9, 2**31, (3,)), "b": spaces.Box(-9, 2**31, (5,))},
            action_spaces={"a": spaces.Discrete(2), "b": spaces.Discrete(4)},
        )

    with pytest.raises(HeadwayError, match=r"different observation spaces \(a: .*; b: .*pad_observations_v0"):
        ParallelEnvBatch(differing, 1, "scripted")
    with pytest.raises(HeadwayError, match=r"different action spaces \(a: .*; b: .*pad_action_space_v0"):
        ParallelEnvBatch(lambda: supersuit.pad_observations_v0(differing()), 1, "scripted")
    env = ParallelEnvBatch(
        lambda: supersuit.pad_action_space_v0(supersuit.pad_observations_v0(differing())), 1, "scripted"
    )
    assert env.spec.observation_size == 5
    assert env.spec.action_space == Discrete(4)
    env.reset(seeds(1))
    env.step(np.array([[3, 3]]))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"observation_spaces": dict.fromkeys("ab", spaces.Discrete(3))}, "agent 'a' observes a Discrete"),
        ({"observation_spaces": dict.fromkeys("ab", spaces.Dict({}))}, r"info\['action_mask'\]"),
        ({"action_spaces": dict.fromkeys("ab", spaces.Tuple(()))}, "agent 'a' acts in a Tuple"),
    ],
)
def test_spaces_of_other_kinds_are_refused(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        ParallelEnvBatch(lambda: Scripted(**keywords), 1, "scripted")


@pytest.mark.parametrize(
    ("space", "kind", "actions", "given"),
    [
        (spaces.Discrete(3, start=5), Discrete(3), [[0, 2]], [5, 7]),
        (spaces.MultiDiscrete([2, 4]), MultiDiscrete((2, 4)), [[[1, 3], [0, 2]]], [[1, 3], [0, 2]]),
        (
            spaces.Box(-1, 1, (1, 2), np.float64),
            Box((-1.0, -1.0), (1.0, 1.0)),
            [[[0.5, 3.0], [-3.0, 0.0]]],
            [[[0.5, 1.0]], [[-1.0, 0.0]]],
        ),
    ],
)
def test_actions_are_converted_to_the_environment_space(
    space: Space, kind: object, actions: list[Any], given: list[Any]
) -> None:
    made = Scripted(action_spaces=dict.fromkeys("ab", space))
    env = ParallelEnvBatch(lambda: made, 1, "scripted")
    assert env.spec.action_space == kind
    env.reset(seeds(1))
    env.step(np.array(actions))
    for agent, expected in zip("ab", given, strict=True):
        np.testing.assert_array_equal(made.given[0][agent], expected)
        assert space.contains(made.given[0][agent])


def test_observations_of_more_axes_are_flattened() -> None:
    made = Scripted(observation_spaces=dict.fromkeys("ab", spaces.Box(-9, 2**31, (2, 3))))
    env = ParallelEnvBatch(lambda: made, 1, "scripted")
    assert env.spec.observation_size == 6
    np.testing.assert_array_equal(env.reset(seeds(1)).observations[0, 1, 1:], [0, 1, 0, 0, 0])


def _leave_out(name: str, agent: str, at: int) -> Script:
    """At step `at`, b ends, and `agent` is left out of the mapping `name`."""

    def script(env: Scripted) -> None:
        if env.steps == 2:
            env.terminated["b"] = True
        if env.steps == at:
            del getattr(env, name)[agent]

    return script


@pytest.mark.parametrize("name", ["observation", "reward"])
@pytest.mark.parametrize("shared_reward", [False, True])
def test_a_live_agent_without_an_answer_is_an_error(name: str, shared_reward: bool) -> None:
    """This holds while another agent is absent; an agent that has ended needs neither."""
    options = AdapterOptions(shared_reward=shared_reward, agents_come_and_go=True)
    for agent, at in (("b", 1), ("a", 3)):
        made = partial(Scripted, _leave_out(f"{name}s", agent, at))
        env = ParallelEnvBatch(made, 1, "scripted", options)
        env.reset(seeds(1))
        line = f"'scripted' returned no {name} for agent '{agent}' at step {at}; return one for every agent"
        with pytest.raises(HeadwayError, match=line):
            play_steps(env, at)


def test_leaving_early_must_be_declared() -> None:
    with pytest.raises(HeadwayError, match="'scripted': agent 'b' of copy 0 is not alive at step 2"):
        play_steps(batch(kill_b_at_two), 2)


LEAVING = {"slot_ended": "truncated", "alive": False}


@pytest.mark.parametrize(
    ("script", "line"),
    [
        # Whether actions are masked is decided once: later masks would be ignored.
        (at(2, lambda e: e.infos.update(b={"action_mask": [1, 0]})), "mask for agent 'b' at step 2 but none"),
        (at(1, lambda e: e.observations.update(b=np.zeros(4))), r"'b': \(4,\).*should get 3 numbers"),
        (at(0, lambda e: e.agents.append("c")), "agent 'c', which is not in its possible_agents"),
        (at(0, lambda e: e.observations.pop("a")), "no observation for agent 'a' at step 0"),
        (at(1, lambda e: e.observations.update(c=np.zeros(3))), "an observation for agent 'c' at step 1"),
        (at(1, lambda e: e.rewards.update(c=1.0)), "returned a reward for agent 'c' at step 1, which is not"),
        (at(1, lambda e: e.infos.update(b={"slot_ended": True})), "True as slot_ended of agent 'b'; write"),
        # The value of a truncated agent's last observation is part of its return.
        (at(1, lambda e: (e.observations.pop("b"), e.truncated.update(b=True))), "observation for agent 'b'"),
        (at(1, lambda e: (e.observations.pop("b"), e.infos.update(b=LEAVING))), "observation for agent 'b'"),
    ],
)  # fmt: skip
def test_answers_that_cannot_be_used_are_errors(script: Script, line: str) -> None:
    with pytest.raises(HeadwayError, match=line):
        play_steps(batch(script, agents_come_and_go=True), 2)


def test_an_environment_without_agents_is_refused() -> None:
    with pytest.raises(HeadwayError, match="has no possible_agents"):
        ParallelEnvBatch(lambda: Scripted(agents=()), 1, "scripted")


def test_wrong_numbers_of_copies_and_seeds_are_errors() -> None:
    with pytest.raises(HeadwayError, match="at least 1 copy, not 0"):
        ParallelEnvBatch(Scripted, 0, "scripted")
    with pytest.raises(ValueError, match="one seed per copy: 2, not 3"):
        batch().reset(seeds(3))


def test_there_are_no_snapshots() -> None:
    env = batch()
    assert not env.spec.snapshots
    with pytest.raises(HeadwayError, match="has no snapshots"):
        env.snapshot()


def test_the_global_state_is_used_if_there_is_one() -> None:
    class WithState(Scripted):
        def state(self) -> NDArray[np.float64]:
            return np.array([self.start, self.steps], dtype=np.float64)

    assert batch().spec.state_size == 0
    env = ParallelEnvBatch(WithState, 1, "scripted")
    observed = env.reset(seeds(1))
    first, second = (episode_seed(0, episode) % 1000 for episode in (0, 1))
    np.testing.assert_array_equal(observed.states, [[first, 0]])
    for _ in range(4):
        outcome, observed = env.step(NOTHING[:1])
    np.testing.assert_array_equal(outcome.final_states, [[first, 4]])
    np.testing.assert_array_equal(observed.states, [[second, 0]])


def test_a_state_that_cannot_be_used_is_an_error() -> None:
    class Late(Scripted):
        def state(self) -> object:
            return [np.zeros(2), [0, 1], np.zeros(1)][self.steps]

    env = ParallelEnvBatch(Late, 1, "scripted")
    np.testing.assert_array_equal(env.reset(seeds(1)).states, [[0, 0]])
    np.testing.assert_array_equal(env.step(NOTHING[:1])[1].states, [[0, 1]])
    with pytest.raises(HeadwayError, match=r"returned a state at step 2 that is not 2 numbers"):
        env.step(NOTHING[:1])


@pytest.mark.parametrize("steps", [0, 2])
def test_an_error_in_the_environment_s_state_is_named_with_its_place(steps: int) -> None:
    class Raising(Scripted):
        def state(self) -> NDArray[np.float64]:
            if self.steps == steps:
                raise ValueError("no state")
            return np.zeros(2)

    with pytest.raises(
        EnvironmentRaisedError, match=r"raised ValueError: no state in state \(test_pettingzoo"
    ):
        play_steps(ParallelEnvBatch(Raising, 1, "scripted"), 2)


def reassign_slot_b(env: Scripted) -> None:
    """The agent in slot b leaves at step 2; another one takes the slot at step 3."""
    env.infos["b"] = {"alive": env.steps != 2}
    if env.steps == 2:
        env.infos["b"]["slot_ended"] = "truncated"


def test_a_slot_can_hold_several_agents_in_turn() -> None:
    env = batch(reassign_slot_b, agents_come_and_go=True)
    observed = env.reset(seeds())
    ends, alive = [], []
    for _ in range(4):
        outcome, observed = env.step(NOTHING)
        ends.append((bool(outcome.terminated[0, 1]), bool(outcome.truncated[0, 1])))
        alive.append(bool(observed.alive[0, 1]))
        assert not outcome.terminated[0, 0]
        if len(ends) == 2:
            assert outcome.final_observations[0, 1, 1] == 2
            assert not outcome.episode_ended.any()
    assert ends == [(False, False), (False, True), (False, False), (False, True)]
    assert alive == [True, False, True, True]  # the last is of the next episode
