"""The rule `lookahead` on games with a known optimum, and on an unpredictable one."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.contracts import BatchedEnv, Box, Discrete, EnvSpec, HeadwayError, Observations, StepResult
from headway.rollout.episodes import evaluate_rule
from headway.rollout.lookahead import Lookahead

STEPS = 6


class Game:
    """C copies of a game of two agents with a shared reward, all at the same step.

    A lamp that was once lit stays lit to the end of the episode, or longer (`LASTING`). Coins are thrown per
    copy and step; they follow from the copy's seed.
    """

    ALLOWED: NDArray[np.bool_] | None = None
    SPACE: Discrete | Box = Discrete(2)
    LASTING = False

    def __init__(self, prepared: object, copies: int) -> None:
        self.num_copies, agents = copies, ("a", "b")
        self.spec = EnvSpec("game", agents, 1, self.SPACE, shared_reward=True, has_action_mask=True)
        self.seeds, self.lit = np.zeros(copies, np.uint64), np.zeros((copies, 2), np.bool_)
        self.time = 0

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        self.seeds, self.lit[:], self.time = seeds.copy(), False, 0
        return self.observed()

    def observed(self) -> Observations:
        nothing, all_ = np.zeros((self.num_copies, 2, 1), np.float32), np.ones((self.num_copies, 2), np.bool_)
        masks = np.ones((self.num_copies, 2, 2), np.bool_)
        if self.ALLOWED is not None:
            masks[:] = self.ALLOWED
        return Observations(nothing, nothing[:, 0, :0], all_, masks)

    def coins(self) -> NDArray[np.int64]:
        thrown = [np.random.default_rng([int(seed), self.time]).integers(2) for seed in self.seeds]
        return np.array(thrown)

    def reward(self, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the team's reward (C,)."""
        raise NotImplementedError

    def step(self, actions: NDArray[np.int64]) -> tuple[StepResult, Observations]:
        rewards = np.repeat(self.reward(actions)[:, None], 2, axis=1).astype(np.float32)
        self.lit |= actions == 1
        self.time += 1
        ended = np.full(self.num_copies, self.time == STEPS)
        flags = np.repeat(ended[:, None], 2, axis=1)
        seen = self.observed()
        result = StepResult(
            rewards, flags, np.zeros_like(flags), np.ones_like(flags), ended, seen.observations, seen.states,
            np.zeros((self.num_copies, 0)),
        )  # fmt: skip
        if self.time == STEPS:
            self.time = 0
            self.lit[:] &= self.LASTING
        return result, seen

    def branch_from(self, source: "Game", rows: NDArray[np.int64], seeds: NDArray[np.uint64]) -> Observations:
        self.seeds, self.time = seeds.copy(), source.time
        self.lit[:] = source.lit[rows]
        return self.observed()

    def close(self) -> None:
        """Nothing is held."""


class Lamps(Game):
    """Lighting a lamp costs 2 and each lit lamp pays 1 in every later step, so that it pays until two steps
    before the last one."""

    def reward(self, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        return self.lit.sum(axis=1) - 2.0 * ((actions == 1) & ~self.lit).sum(axis=1)


class OneOfTwo(Game):
    """Exactly one agent must act."""

    def reward(self, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.array([0.0, 1.0, -1.0])[actions.sum(axis=1)]


class FirstMasked(OneOfTwo):
    """`OneOfTwo`, with an action mask by which the first agent must not act."""

    ALLOWED = np.array([[True, False], [True, True]])


class Coins(Game):
    """The first agent is paid 1 if it names the coin of this step, which is thrown after its choice."""

    def reward(self, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        return (actions[:, 0] == self.coins()).astype(np.float64)


class Gamble(Game):
    """Action 1 of the first agent wins or loses 1, by the coin of this step."""

    def reward(self, actions: NDArray[np.int64]) -> NDArray[np.float64]:
        return actions[:, 0] * (2.0 * self.coins() - 1.0)


class OpenCoins(Coins):
    """`Coins`, whose branches take over from their source the coins that it will throw."""

    def branch_from(self, source: "Game", rows: NDArray[np.int64], seeds: NDArray[np.uint64]) -> Observations:
        return super().branch_from(source, rows, source.seeds[rows])


@dataclass
class Idle:
    """Takes action 0, and counts the decisions."""

    decisions: int = 0

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[np.int64]:
        self.decisions += 1
        return np.zeros(observed.alive.shape, np.int64)


def played(game: Callable[..., BatchedEnv], steps: int, samples: int = 3, episodes: int = 2) -> list[float]:
    make = partial(Lookahead, game, None, Idle(), steps, samples)
    rows = evaluate_rule(game, lambda prepared: make(), None, 5, episodes)
    return [float(row["return"]) for row in rows]


@pytest.mark.parametrize(
    ("steps", "best"),
    [
        # Lit at once, each of two lamps costs 2 and pays in the 5 steps behind: 2 x (5 - 2).
        (3 + 1, 6.0),
        # A horizon of 3 steps sees no more than 2 payments for the price of 2.
        (3, 0.0),
    ],
)
def test_the_optimum_is_reached_if_the_horizon_shows_it(steps: int, best: float) -> None:
    assert played(Lamps, steps) == [best, best]


def test_rewards_after_the_end_of_an_episode_do_not_count() -> None:
    """The horizon extends beyond the end: a lamp is not lit in the last steps for what the next
    episode pays."""

    class Lasting(Lamps):
        LASTING = True

    env = Lasting(None, 1)
    rule = Lookahead(Lasting, None, Idle(), 20, 2)
    observed = env.reset(np.zeros(1, np.uint64))
    for _ in range(STEPS - 3):
        _, observed = env.step(np.zeros((1, 2), np.int64))
    assert rule.act(env, observed).tolist() == [[0, 0]]


def test_agents_choose_one_after_another() -> None:
    """If all chose against the base rule's actions at once, both would act and earn -1 in each step."""
    assert played(OneOfTwo, 1) == [STEPS, STEPS]
    assert played(FirstMasked, 1) == [STEPS, STEPS]


def test_what_will_be_drawn_is_not_foreseen() -> None:
    """Half of the coins are named, as by any rule: 1,200 throws, four standard deviations. With the source's
    own coins in the branches all would be."""
    mean = np.mean(played(Coins, 1, samples=1, episodes=200)) / STEPS
    assert abs(mean - 0.5) < 4 * 0.5 / np.sqrt(200 * STEPS)
    assert played(OpenCoins, 1, samples=1) == [STEPS, STEPS]


def test_chance_differences_seldom_change_an_action() -> None:
    """Seven of 8 futures must win for a difference of 2 standard errors, which happens in 9 of 256 decisions;
    more than half of them win in 93."""
    env = Gamble(None, 1)
    rule = Lookahead(Gamble, None, Idle(), 1, 8)
    observed = env.reset(np.zeros(1, np.uint64))
    gambled = sum(int(rule.act(env, observed)[0, 0]) for _ in range(256))
    assert 0 < gambled < 9 + 4 * 3


def test_no_choice_is_no_simulation() -> None:
    class Fixed(Lamps):
        ALLOWED = np.array([[True, False], [True, False]])

    base = Idle()
    env = Fixed(None, 4)
    Lookahead(Fixed, None, base, 5, 2).act(env, env.reset(np.arange(4, dtype=np.uint64)))
    assert base.decisions == 1


def test_many_copies_are_played_as_one_is() -> None:
    """The copies are simulated in several batches; a choice in one does not depend on the others."""
    env, alone = Lamps(None, 21), Lamps(None, 1)
    many = Lookahead(Lamps, None, Idle(), 4, 2).act(env, env.reset(np.arange(21, dtype=np.uint64)))
    one = Lookahead(Lamps, None, Idle(), 4, 2).act(alone, alone.reset(np.zeros(1, np.uint64)))
    assert (many == one).all()
    assert one.tolist() == [[1, 1]]


def test_continuous_actions_are_refused_in_one_line() -> None:
    class Continuous(Lamps):
        SPACE = Box((0.0,), (1.0,))

    env = Continuous(None, 1)
    with pytest.raises(HeadwayError, match="tries every action, and game has no Discrete space; leave it"):
        Lookahead(Continuous, None, Idle(), 4, 2).act(env, env.reset(np.zeros(1, np.uint64)))
