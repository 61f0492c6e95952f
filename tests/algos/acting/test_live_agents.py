"""An agent's action does not depend on who else is alive, on the block or on the stack, to the last bit."""

from typing import Any, Literal

import numpy as np
import pytest
from covering import pairwise
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, MultiDiscrete, Observations
from headway_algos.acting.exploration import EpsilonGreedyPolicy, OrnsteinUhlenbeckPolicy
from headway_algos.acting.gru import GRUActingPolicy
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.config import ModelConfig
from headway_algos.registry import configure

SLOTS, COPIES, SIZE = 32, 3, 5
MODEL = ModelConfig(hidden=(9, 7))
Precision = Literal["float32", "float64"]
Policies = Literal["independent", "shared"]
Policy = MLPActingPolicy | GRUActingPolicy | EpsilonGreedyPolicy | OrnsteinUhlenbeckPolicy
Result = tuple[NDArray[Any], NDArray[np.float64], NDArray[Any] | None]
KINDS = ("discrete", "several", "box", "gated discrete", "gated box", "epsilon-greedy", "ornstein-uhlenbeck")


def _spec(space: ActionSpace) -> EnvSpec:
    names = tuple(f"slot_{i}" for i in range(SLOTS))
    masked = not isinstance(space, Box)
    return EnvSpec("made", names, SIZE, space, has_action_mask=masked, agents_come_and_go=True)


def _policy(kind: str, precision: Precision, policies: Policies = "shared") -> Policy:
    space: ActionSpace = Box((-1.0, -2.0), (1.0, 2.0))
    if kind.endswith(("discrete", "greedy")):
        space = Discrete(4)
    elif kind == "several":
        space = MultiDiscrete((2, 2))
    config = configure("custom", policies=policies, model=MODEL, precision=precision)
    flat = MLPActingPolicy.of(config, _spec(space))
    if kind.startswith("gated"):
        return GRUActingPolicy(flat, 6)
    if kind == "epsilon-greedy":
        return EpsilonGreedyPolicy(flat)
    if kind == "ornstein-uhlenbeck":
        return OrnsteinUhlenbeckPolicy(flat, 0.2, 0.3)
    return flat


def _parameters(policy: Policy, replicas: int) -> dict[str, NDArray[Any]]:
    draw = np.random.default_rng(5)
    shapes = policy.parameter_shapes(replicas)
    drawn = {name: draw.normal(0, 0.6, shape).astype(dtype) for name, (shape, dtype) in shapes.items()}
    if "exploration" in drawn:
        drawn["exploration"] = np.abs(drawn["exploration"]) % 1
    return drawn


def _observations(
    policy: Policy, alive: NDArray[np.bool_]
) -> tuple[Observations, NDArray[Any], NDArray[Any] | None]:
    """Observations with NaN in empty slots, noise, and hidden states."""
    draw, copies, masks, hidden = np.random.default_rng(7), len(alive), None, None
    observations = draw.normal(0, 2, (copies, SLOTS, SIZE)).astype(np.float32)
    observations[~alive] = np.nan
    stack = policy.perceptron if isinstance(policy, EpsilonGreedyPolicy | OrnsteinUhlenbeckPolicy) else policy
    flat = stack if isinstance(stack, MLPActingPolicy) else stack.perceptron
    if flat.spec.has_action_mask:
        masks = draw.random((copies, SLOTS, 4)) < 0.4
        masks[..., [0, 2]] = True  # one option of every choice
        masks[~alive] = False
    noise = np.stack([policy.noise(draw, 1)[0] for _ in range(copies)])
    if isinstance(policy, GRUActingPolicy | OrnsteinUhlenbeckPolicy):
        hidden = draw.normal(0, 1, (copies, SLOTS, policy.hidden_size)).astype(policy.hidden_dtype)
    return Observations(observations, np.zeros((copies, 0), np.float32), alive, masks), noise, hidden


def _act(
    policy: Policy,
    parameters: dict[str, NDArray[Any]],
    observed: Observations,
    hidden: NDArray[Any] | None,
    noise: NDArray[Any] | None,
) -> Result:
    if isinstance(policy, GRUActingPolicy | OrnsteinUhlenbeckPolicy):
        assert hidden is not None
        return policy.act_from(parameters, observed, hidden, noise)
    return *policy.act(parameters, observed, noise), None


def _part(observed: Observations, copies: slice, alive: NDArray[np.bool_]) -> Observations:
    masks = None if observed.action_masks is None else observed.action_masks[copies]
    return Observations(observed.observations[copies], observed.states[copies], alive, masks)


def _alive(copies: int, count: int) -> NDArray[np.bool_]:
    """Alive mask with `count` live agents over all copies."""
    alive = np.zeros(copies * SLOTS, np.bool_)
    alive[np.random.default_rng(3).permutation(copies * SLOTS)[:count]] = True
    return alive.reshape(copies, SLOTS)


@pytest.mark.parametrize(
    ("kind", "precision", "policies", "greedy", "count"),
    pairwise(KINDS, ["float32", "float64"], ["shared", "independent"], [False, True], [0, 1, 40, 96]),
)
def test_an_agent_acts_as_if_alone_in_its_copy(
    kind: str, precision: Precision, policies: Policies, greedy: bool, count: int
) -> None:
    policy, alive = _policy(kind, precision, policies), _alive(COPIES, count)
    parameters = _parameters(policy, 1)
    observed, drawn, hidden = _observations(policy, alive)
    before, seen = None if hidden is None else hidden.copy(), observed.observations.copy()
    noise = None if greedy else drawn
    together = _act(policy, parameters, observed, hidden, noise)
    for copy, agent in np.argwhere(alive)[::5]:
        only, block = np.zeros((1, SLOTS), np.bool_), slice(copy, copy + 1)
        only[0, agent] = True
        alone = _act(
            policy,
            parameters,
            _part(observed, block, only),
            None if hidden is None else hidden[block],
            None if noise is None else noise[block],
        )
        for mine, all_of_them in zip(alone, together, strict=True):
            if mine is not None and all_of_them is not None:
                np.testing.assert_array_equal(mine[0, agent], all_of_them[copy, agent])
    assert all(np.isfinite(part).all() for part in together if part is not None)
    assert together[0].dtype != np.int64 or ((together[0] >= 0) & (together[0] < 4)).all()
    np.testing.assert_array_equal(observed.observations, seen)
    if hidden is not None:
        assert together[2] is not None
        np.testing.assert_array_equal(hidden, before)
        np.testing.assert_array_equal(together[2][~alive], hidden[~alive])
        assert together[2].dtype == hidden.dtype


@pytest.mark.parametrize("kind", KINDS)
def test_a_replica_in_a_stack_acts_bit_for_bit_as_alone(kind: str) -> None:
    """Replicas with few, many and no live agents act in a stack as they do alone."""
    policy = _policy(kind, "float32")
    counts = (7, COPIES * SLOTS, 0, 2)
    alive = np.concatenate([_alive(COPIES, count) for count in counts])
    parameters = _parameters(policy, len(counts))
    observed, noise, hidden = _observations(policy, alive)
    together = _act(policy, parameters, observed, hidden, noise)
    for r in range(len(counts)):
        block = slice(r * COPIES, (r + 1) * COPIES)
        mine = {name: array[r : r + 1] for name, array in parameters.items()}
        one = _part(observed, block, observed.alive[block])
        alone = _act(policy, mine, one, None if hidden is None else hidden[block], noise[block])
        for part, whole in zip(alone, together, strict=True):
            if part is None or whole is None:
                assert part is whole
            else:
                np.testing.assert_array_equal(part, whole[block])
