"""Wrappers without a batched form: around the ParallelEnv, with its infos, and rules behind them."""

import pickle
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from numpy.typing import NDArray
from same_game import prepared
from scripted import Scripted

from headway.adapters.conformance import play
from headway.adapters.parallel_entry import parallel_entry
from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch, episode_seed
from headway.contracts import BatchedEnv, HeadwayError, Observations, RuleEntry, WrapperEntry, child_seeds
from headway.rollout.episodes import evaluate_rule
from headway.wrappers import parallel
from headway.wrappers.black_death import BlackDeath
from headway.wrappers.listed import ListedWrapper, listed_wrappers
from headway.wrappers.observations import NoArguments
from headway.wrappers.supersuit import supersuit_entries
from headway.wrappers.wrapped_env import wrapped_entry
from headway_envs.registry import ENTRIES

FIGHTERS = ["archer_0", "archer_1", "knight_0"]
SHORT = {"agents": 4, "steps": 12}
"""Arguments of `visitors`."""
STACK = {"name": "frame_stack_v1", "stack_size": 2}
DELAY = {"name": "delay_observations_v0", "delay": 1}
KEEPS_THE_GAME: dict[str, list[Any]] = {
    "delay": [DELAY],
    "maximum": [{"name": "max_observation_v0", "memory": 2}],
    "reshape": [{"name": "reshape_v0", "shape": [2, 2]}],
    "dtype": [{"name": "dtype_v0", "dtype": "float64"}],
    "pad observations": ["pad_observations_v0"],
    "pad actions": ["pad_action_space_v0"],
    "NaN to nothing": [{"name": "nan_noop_v0", "no_op_action": 0}],
    "NaN to random": ["nan_random_v0"],
    "NaN to zeros": ["nan_zeros_v0"],
    "around delay": [DELAY, "agent_indicator_v0", STACK],
    "within delay": ["agent_indicator_v0", STACK, DELAY],
}


@pytest.mark.parametrize("case", KEEPS_THE_GAME)
def test_wrappers_pass_infos_on(case: str) -> None:
    """Everything except observations is unchanged; `visitors` uses every key. Observations are those of
    SuperSuit's wrappers, wherever the list is split."""
    entry = ENTRIES["visitors"]
    make, config = entry.parallel_env, entry.config(**SHORT)
    assert make is not None
    plain = play(lambda copies: ParallelEnvBatch(lambda: make(config), copies, "visitors"))
    wrappers = KEEPS_THE_GAME[case]
    whole = play(
        lambda copies: ParallelEnvBatch(lambda: _through(make(config), wrappers), copies, "visitors")
    )
    wrapped = pickle.loads(pickle.dumps(prepared("visitors", entry, wrappers, **SHORT)))
    assert wrapped.parallel is not None
    other = play(wrapped.batch)
    assert other.spec.metrics == plain.spec.metrics
    for name in ("alive", "acting", "action_masks", "rewards", "terminated", "truncated", "states"):
        np.testing.assert_array_equal(getattr(other.trajectory, name), getattr(plain.trajectory, name), name)
    np.testing.assert_array_equal(other.metrics, plain.metrics)
    live = plain.trajectory.alive
    np.testing.assert_array_equal(other.trajectory.observations[live], whole.trajectory.observations[live])


def _through(env: Any, wrappers: list[Any]) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    """An environment in SuperSuit's wrappers."""
    for wrapper in listed_wrappers(wrappers):
        env = wrapper.entry.wrap(env, wrapper.arguments)
    return env


def test_the_longest_batched_tail_stays_batched_with_a_notice() -> None:
    wrapped = prepared("visitors", ENTRIES["visitors"], KEEPS_THE_GAME["around delay"])
    assert wrapped.parallel is not None
    assert [name for name, _ in wrapped.parallel.wrappers] == ["delay_observations_v0"]
    assert len(wrapped.batched) == 2
    assert wrapped.notices == (
        "delay_observations_v0 has no batched form: visitors is played as a ParallelEnv, one copy after "
        "another; it has no snapshots: episodes restart on resume",
    )
    assert wrapped.batch(1).spec.observation_size == 2 * (4 + 6)
    within = prepared("visitors", ENTRIES["visitors"], KEEPS_THE_GAME["within delay"])
    assert within.parallel is not None
    assert len(within.parallel.wrappers) == 3
    assert within.batched == ()


def test_a_delayed_stack_is_the_previous_stack() -> None:
    """SuperSuit's frame stack overwrites the stored observations of its delay, which alone delays nothing."""
    now, late = (_through(_duel({"archer_1": 2}, 5), wrappers) for wrappers in ([STACK], [STACK, DELAY]))
    before = {agent: seen.copy() for agent, seen in now.reset(seed=0)[0].items()}
    assert not any(seen.any() for seen in late.reset(seed=0)[0].values())
    while now.agents:
        actions = dict.fromkeys(now.agents, 0)
        seen_now, seen_late = now.step(actions)[0], late.step(actions)[0]
        for agent, seen in seen_late.items():
            np.testing.assert_array_equal(seen, before[agent])
        before = {agent: seen.copy() for agent, seen in seen_now.items()}


def losing(key: str) -> WrapperEntry:
    """A wrapper that drops a key from infos."""
    from pettingzoo.utils import BaseParallelWrapper

    class Dropping(BaseParallelWrapper):  # type: ignore[misc]
        def step(self, actions: Mapping[str, Any]) -> tuple[Any, ...]:
            *rest, infos = self.env.step(actions)
            return (*rest, {agent: without(info) for agent, info in infos.items()})

        def reset(self, seed: int | None = None, options: object = None) -> tuple[Any, Any]:
            observations, infos = self.env.reset(seed=seed)
            return observations, {agent: without(info) for agent, info in infos.items()}

    def without(info: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in info.items() if name != key}

    return WrapperEntry("drops", NoArguments, lambda env, arguments: Dropping(env))


@pytest.fixture
def dropping(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> ListedWrapper:
    entry = losing(request.param)
    monkeypatch.setattr(parallel, "wrapper_entry", lambda name: entry)
    return ListedWrapper("dropping_v0", entry, NoArguments(), "env.wrappers[0]")


@pytest.mark.parametrize("dropping", ["alive", "acting", "action_mask", "slot_ended"], indirect=True)
def test_dropping_info_keys_is_refused(dropping: ListedWrapper, request: pytest.FixtureRequest) -> None:
    entry = wrapped_entry("visitors", ENTRIES["visitors"], [dropping])
    lost = request.node.callspec.params["dropping"]
    with pytest.raises(HeadwayError, match=rf"\[0\]: dropping_v0 drops {lost} from the infos of visitors"):
        entry.prepare(ENTRIES["visitors"].config())


@pytest.mark.parametrize("dropping", ["episode_metrics"], indirect=True)
def test_missing_metrics_are_an_error(dropping: ListedWrapper) -> None:
    entry = wrapped_entry("visitors", ENTRIES["visitors"], [dropping])
    wrapped = entry.prepare(ENTRIES["visitors"].config())
    with pytest.raises(HeadwayError, match="declares episode_metrics, but an episode ended without them"):
        play(wrapped.batch)


@pytest.mark.parametrize(
    ("name", "wrapper", "message"),
    [
        ("visitors", "clip_actions_v0", r"\[0\]: clip_actions_v0 cannot wrap visitors: AttributeError"),
        ("tracking", {"name": "reshape_v0", "shape": [3]}, "new shape .3,. must have as many elements"),
    ],
)
def test_an_unsuitable_wrapper_is_named_before_training(name: str, wrapper: object, message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        prepared(name, ENTRIES[name], [wrapper])


@pytest.mark.parametrize("skips", [True, False])
def test_skipping_steps_is_refused_if_agents_idle(skips: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wrappers of any name and package are refused."""
    entry = replace(losing("nothing"), skips_steps=skips)
    monkeypatch.setattr(parallel, "wrapper_entry", lambda name: entry)
    wrapped = wrapped_entry("bus", ENTRIES["bus"], [ListedWrapper("twice_v0", entry, NoArguments(), "[0]")])
    with pytest.raises(HeadwayError, match="twice_v0 keeps `acting`") if skips else nullcontext():
        wrapped.prepare(ENTRIES["bus"].config())


@pytest.mark.parametrize("frames", [2, [1, 3]])
def test_skipped_frames_are_steps_of_an_environment_without_draws(frames: int | list[int]) -> None:
    """A step is some steps with the same actions; the seed decides how many if they are drawn."""
    entry = ENTRIES["tracking"]
    make = entry.parallel_env
    assert make is not None
    plain = make(entry.config())
    skipping, again = (
        _through(make(entry.config()), [{"name": "frame_skip_v0", "num_frames": frames}]) for _ in range(2)
    )
    for env in (plain, skipping, again):
        env.reset(seed=3)
    actions, counts = dict.fromkeys(plain.agents, np.full(2, 0.1, np.float32)), set()
    for _ in range(12):
        seen, paid, *_ = skipping.step(actions)
        assert again.step(actions)[1] == paid
        total, count, reached = 0.0, 0, False
        while not reached:
            observed, rewards, *_ = plain.step(actions)
            total, count = total + rewards["agent_0"], count + 1
            reached = bool((observed["agent_0"] == seen["agent_0"]).all())
        assert paid["agent_0"] == pytest.approx(total)
        counts.add(count)
    assert counts == ({2} if frames == 2 else {1, 2, 3})


def test_supersuit_wrappers_that_skip_steps_are_marked() -> None:
    assert [name for name, entry in supersuit_entries().items() if entry.skips_steps] == ["frame_skip_v0"]


def test_the_failing_wrapper_of_a_list_is_named() -> None:
    with pytest.raises(HeadwayError, match=r"env.wrappers\[1\]: color_reduction_v0 cannot wrap bus: Assert"):
        prepared("bus", ENTRIES["bus"], [DELAY, "color_reduction_v0"])


def test_without_a_parallel_env_only_batched_wrappers_work() -> None:
    entry = replace(ENTRIES["matrix"], parallel_env=None)
    assert prepared("matrix", entry, ["agent_indicator_v0"]).batch(2).spec.observation_size == 4
    with pytest.raises(
        HeadwayError, match="observations_v0 has no batched form, and matrix has no ParallelEnv"
    ):
        prepared("matrix", entry, ["agent_indicator_v0", DELAY])


@pytest.mark.parametrize(
    ("name", "wrappers"),
    [
        ("bus", ["agent_indicator_v0"]),
        ("tracking", ["agent_indicator_v0"]),
        ("bus", [DELAY]),
        ("visitors", [DELAY]),
    ],
)
def test_rules_inspect_the_unwrapped_environment(name: str, wrappers: list[Any]) -> None:
    """They read the same observations and get the same returns in the same episodes."""
    entry = ENTRIES[name]
    rule, small = {"bus": ("headway_holding_0.9", {"end_hour": 8})}.get(name, ("optimal", {}))
    wrapped = wrapped_entry(name, entry, listed_wrappers(wrappers))
    shared = wrapped.prepare(entry.config(**small))
    rows = evaluate_rule(wrapped.make, wrapped.rules[rule].make, shared, root=3, episodes=2)
    if shared.parallel is None:
        expected = evaluate_rule(entry.make, entry.rules[rule].make, shared.prepared, root=3, episodes=2)
        assert rows == expected
        return
    expected = [_played(name, rule, shared.prepared, index) for index in range(2)]
    assert [row["return"] for row in rows] == pytest.approx(expected, rel=1e-6)


def _played(name: str, rule: str, shared: object, index: int) -> float:
    """Return of a rule on the native environment, in the episode with the adapter's derived seed."""
    entry = ENTRIES[name]
    env, played = entry.make(shared, 1), entry.rules[rule].make(shared)
    seed = episode_seed(int(child_seeds(3, "evaluation", index, 1)[0]), 0)
    observed, total = env.reset(np.array([seed], dtype=np.uint64)), 0.0
    while True:
        outcome, observed = env.step(played.act(env, observed))
        total += float(outcome.rewards.mean(axis=1, dtype=np.float64)[0])
        if outcome.episode_ended[0]:
            return total


def test_wrappers_that_change_actions_leave_only_random() -> None:
    listed = listed_wrappers([{"name": "scale_actions_v0", "scale": 2.0}])
    wrapped = wrapped_entry("tracking", ENTRIES["tracking"], listed)
    assert list(wrapped.rules) == ["random"]
    shared = wrapped.prepare(ENTRIES["tracking"].config())
    rows = evaluate_rule(wrapped.make, wrapped.rules["random"].make, shared, root=0, episodes=1)
    assert np.isfinite(float(rows[0]["return"]))


class Defend:
    """A rule of another package's environment, written as a ParallelEnv."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        assert isinstance(env, ParallelEnvBatch)
        assert observed.observations.shape[-1] == 3
        return np.ones(observed.alive.shape, dtype=np.int64)


def test_rules_of_an_adapted_environment_get_the_adapter() -> None:
    rules = {"defend": RuleEntry("all defend", lambda config: Defend())}
    entry = parallel_entry("duel", "duel", NoArguments, _broken_duel, rules=rules)
    wrapped = wrapped_entry("duel", entry, listed_wrappers([STACK, "agent_indicator_v0"]))
    make = pickle.loads(pickle.dumps(wrapped.make))  # as workers get it
    env, rule = make(wrapped.prepare(NoArguments()), 2), wrapped.rules["defend"]
    assert rule.summary == "all defend"
    observed = env.reset(np.zeros(2, dtype=np.uint64))
    assert observed.observations.shape == (2, 3, 2 * 3 + 3)
    outcome, _ = env.step(rule.make(wrapped.prepare(NoArguments())).act(env, observed))
    np.testing.assert_array_equal(outcome.rewards, np.full((2, 3), 2.0))


def test_a_rule_that_cannot_inspect_the_environment_is_an_error() -> None:
    """`trivial` has a hand-written ParallelEnv without a native batch."""
    wrapped = wrapped_entry("trivial", ENTRIES["trivial"], listed_wrappers([DELAY]))
    shared = wrapped.prepare(ENTRIES["trivial"].config())
    with pytest.raises(
        HeadwayError, match="rule 'optimal' of trivial cannot inspect the environment behind these wrappers"
    ):
        wrapped.rules["optimal"].make(shared)
    assert evaluate_rule(wrapped.make, wrapped.rules["random"].make, shared, root=0, episodes=1)


def _duel(falls: Mapping[str, int], steps: int) -> Scripted:
    """Three fighters get 1 + their action; a fighter falls at step `falls[fighter]`, and the rest are cut off
    after `steps`."""

    def fight(env: Scripted) -> None:
        for agent in env.agents if env.steps else ():
            env.rewards[agent] = 1.0 + env.given[-1][agent]
            env.terminated[agent] = falls.get(agent) == env.steps

    bounds = dict.fromkeys(FIGHTERS, spaces.Box(0, 1000, (3,), np.float32))
    return Scripted(fight, bounds, agents=FIGHTERS, length=steps)


@pytest.mark.parametrize(
    ("falls", "steps"),
    [
        ({"archer_1": 2}, 5),
        ({"archer_0": 4, "archer_1": 2, "knight_0": 3}, 9),
        ({"archer_0": 5, "archer_1": 2}, 5),
    ],
    ids=["cut off", "all fall", "fall at the end"],
)
def test_black_death_equals_supersuit_until_the_last_step(falls: dict[str, int], steps: int) -> None:
    mine, theirs = BlackDeath(_duel(falls, steps)), supersuit.black_death_v3(_duel(falls, steps))
    one, other = mine.reset(seed=1)[0], theirs.reset(seed=1)[0]
    while mine.agents:
        assert sorted(one) == sorted(other) == FIGHTERS
        for agent in one:
            np.testing.assert_array_equal(one[agent], other[agent])
        actions = dict.fromkeys(mine.agents, 1)
        one, paid, terminated, truncated, infos = mine.step(actions)
        other, paid_too, *_ = theirs.step(actions)
        assert paid == paid_too
        assert sorted(infos) == sorted(one)
        if mine.agents:
            assert not any((*terminated.values(), *truncated.values()))
    assert theirs.agents, "SuperSuit ends with the others now: its own black_death_v3 can be used"
    cut = len(falls) < len(FIGHTERS)
    assert set(truncated.values()) == {cut}
    assert set(terminated.values()) == {not cut}


def _deadly_duel(config: NoArguments) -> Scripted:
    return _duel({"archer_1": 2, "knight_0": 4}, steps=6)


@pytest.mark.parametrize(
    "wrappers",
    [
        [STACK],
        ["agent_indicator_v0"],
        [{"name": "agent_indicator_v0", "type_only": True}],
        [{"name": "clip_reward_v0", "upper_bound": 1.5}],
        ["normalize_obs_v0", STACK, "agent_indicator_v0", {"name": "scale_reward_v0", "scale": 3.0}],
    ],
)
def test_batched_forms_equal_supersuit_if_agents_die(wrappers: list[Any]) -> None:
    options = AdapterOptions(agents_come_and_go=True)
    wrapped = prepared("duel", parallel_entry("duel", "a duel", NoArguments, _deadly_duel, options), wrappers)
    assert wrapped.parallel is None
    one = play(wrapped.batch)
    other = play(
        lambda copies: ParallelEnvBatch(
            lambda: _through(_deadly_duel(NoArguments()), wrappers), copies, "duel", options
        )
    )
    twins, whole = one.trajectory, other.trajectory
    assert not twins.alive.all()
    for name in ("alive", "acting", "rewards", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(twins, name), getattr(whole, name), name)
    np.testing.assert_array_equal(twins.observations[twins.alive], whole.observations[whole.alive])
    # An agent that ended earlier is marked again without a final observation.
    over = (twins.terminated | twins.truncated) & twins.alive[:-1]
    np.testing.assert_array_equal(twins.final_observations[over], whole.final_observations[over])


def _two_in_turn(config: NoArguments) -> Scripted:
    """The agent in slot b leaves at step 2; another one takes the slot at step 3."""

    def take_turns(env: Scripted) -> None:
        env.infos = {agent: {"alive": agent == "a" or env.steps != 2} for agent in env.agents}
        if env.steps == 2:
            env.infos["b"]["slot_ended"] = "truncated"

    return Scripted(take_turns, length=6)


@pytest.mark.parametrize("name", ["frame_stack_v1", "frame_stack_v2", "delay_observations_v0"])
def test_an_agent_does_not_observe_what_another_saw_in_its_slot(name: str) -> None:
    arguments = {"delay": 2} if name.startswith("delay") else {"stack_size": 3}
    wrappers, options = [{"name": name, **arguments}], AdapterOptions(agents_come_and_go=True)
    entry = parallel_entry("turns", "two agents", NoArguments, _two_in_turn, options)
    wrapped = prepared("turns", entry, wrappers)
    through = play(
        lambda copies: ParallelEnvBatch(
            lambda: _through(_two_in_turn(NoArguments()), wrappers), copies, "turns", options
        )
    )
    for track in (play(wrapped.batch).trajectory, through.trajectory):
        steps_seen = track.observations[3:6, 0, 1].reshape(3, -1, 3)[..., 1]
        expected = [[0, 0, 3], [0, 3, 4], [3, 4, 5]]
        np.testing.assert_array_equal(steps_seen, [[0], [0], [3]] if "delay" in arguments else expected)


def _broken_duel(config: NoArguments) -> Scripted:
    """An observation has NaN at step 3."""
    duel = _duel({}, steps=6)
    fight = duel.script

    def spoil(env: Scripted) -> None:
        fight(env)
        if env.steps == 3:
            env.observations["knight_0"][1] = np.nan

    duel.script = spoil
    return duel


@pytest.mark.parametrize("wrappers", [[STACK], [STACK, DELAY], ["agent_indicator_v0"]])
def test_nan_in_a_wrapped_environment_is_named(wrappers: list[Any]) -> None:
    """The error names the first step whose wrapped observations contain NaN."""
    entry = parallel_entry("broken", "duel", NoArguments, _broken_duel)
    shared = prepared("broken", entry, wrappers)
    step = 4 if DELAY in wrappers else 3
    with pytest.raises(HeadwayError, match=f"nan as observation of agent knight_0 in copy 0 at step {step}"):
        play(shared.batch)
