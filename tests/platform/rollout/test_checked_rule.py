"""Actions of rules that are not in the action space, against one line that names the rule."""

from contextlib import closing
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, HeadwayError, MultiDiscrete, Observations
from headway.registry import env_entries, rule_entry
from headway.rollout.checked_rule import CheckedRule
from headway.rollout.episodes import evaluate_rule

BOX = Box((-1.0, -1.0), (1.0, 1.0))


@dataclass(frozen=True)
class Fixed:
    """A rule that always returns the same actions."""

    actions: object

    def act(self, env: object, observed: object) -> NDArray[Any]:
        return cast(NDArray[Any], self.actions)  # also what no rule may return


def act(actions: object, space: ActionSpace) -> NDArray[Any]:
    """Return the checked actions for two copies with two agents each, of which the last is not alive."""
    alive = np.array([[True, True], [True, False]])
    observed = Observations(np.zeros((2, 2, 1), np.float32), np.zeros((2, 0), np.float32), alive)
    env: Any = SimpleNamespace(spec=SimpleNamespace(action_space=space))
    return CheckedRule("nearest", Fixed(actions)).act(env, observed)


@pytest.mark.parametrize(
    ("actions", "space"),
    [
        (np.array([[0, 2], [1, 9]]), Discrete(3)),
        ([[0, 2], [1, -1]], Discrete(3)),
        (np.array([[True, False], [True, False]]), Discrete(3)),
        (np.array([[[1, 2], [0, 0]], [[1, 0], [9, 9]]]), MultiDiscrete((2, 3))),
        (np.array([[[5.0, 0], [0, 0]], [[0, 0], [np.nan, 0]]]), BOX),
    ],
)
def test_actions_of_live_agents_are_in_the_space(actions: object, space: ActionSpace) -> None:
    np.testing.assert_array_equal(act(actions, space), np.asarray(actions))


@pytest.mark.parametrize(
    ("actions", "space", "problem"),
    [
        ([[0, 6], [1, 0]], Discrete(3), r"action 6; Discrete\(3\) has 0 to 2"),
        ([[0, 0], [-1, 0]], Discrete(3), r"action -1; Discrete\(3\) has 0 to 2"),
        ([0, 1], Discrete(3), r"actions of shape \(2,\), not \(2, 2\)"),
        ([[0.5, 1], [0, 0]], Discrete(3), r"actions of type float64; Discrete\(3\) has 0 to 2"),
        (None, Discrete(3), r"actions of shape \(\), not \(2, 2\)"),
        ([[[1, 3], [0, 0]], [[1, 0], [0, 0]]], MultiDiscrete((2, 3)), r"action 3; MultiDiscrete\(2, 3\)"),
        (np.full((2, 2, 2), np.nan), BOX, "action nan; a Box has finite numbers"),
        (np.zeros((2, 2)), BOX, r"actions of shape \(2, 2\), not \(2, 2, 2\)"),
    ],
)
def test_other_actions_are_one_line(actions: object, space: ActionSpace, problem: str) -> None:
    with pytest.raises(HeadwayError, match=f"^rule nearest returned {problem}.*; correct the rule$"):
        act(actions, space)


@pytest.mark.parametrize("env", ["bus", "merge", "tracking", "matrix"])
def test_every_rule_of_an_environment_passes(env: str) -> None:
    """One rule of the merges has actions of its own, as a base of `lookahead` too."""
    entry = env_entries()[env]
    prepared = entry.prepare(entry.config())
    for rule in entry.rules:
        assert evaluate_rule(entry.make, rule_entry(entry, rule).make, prepared, 7, 1)


@pytest.mark.parametrize("env", ["bus_published", "intersection", "merge_two_lane"])
def test_every_rule_passes_in_the_first_step(env: str) -> None:
    """Rules of a Box are among them; one step, because whole episodes of SUMO take long."""
    entry = env_entries()[env]
    prepared = entry.prepare(entry.config())
    for name in entry.rules:
        with closing(entry.make(prepared, 1)) as made:
            observed = made.reset(np.zeros(1, np.uint64))
            made.step(rule_entry(entry, name).make(prepared).act(made, observed))
