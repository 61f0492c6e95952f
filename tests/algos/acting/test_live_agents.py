"""With mostly empty slots, live agents act as if all were computed, and empty slots hold zeros."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from covering import pairwise
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, Observations
from headway_algos.acting.exploration import EpsilonGreedyPolicy, ExploringStack, OrnsteinUhlenbeckPolicy
from headway_algos.acting.gru import GRUActingPolicy
from headway_algos.acting.live_agents import MIN_SLOTS_PER_AGENT, ActingResult
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.config import AlgoConfig, ModelConfig

SLOTS, COPIES, SIZE = 32, 3, 5
MODEL = ModelConfig(hidden=(9, 7))
Precision = Literal["float32", "float64"]
Policies = Literal["independent", "shared"]
Policy = MLPActingPolicy | GRUActingPolicy | EpsilonGreedyPolicy | OrnsteinUhlenbeckPolicy
KINDS = ("discrete", "box", "gated discrete", "gated box", "epsilon-greedy", "ornstein-uhlenbeck")


def _spec(space: ActionSpace) -> EnvSpec:
    names = tuple(f"slot_{i}" for i in range(SLOTS))
    masked = isinstance(space, Discrete)
    return EnvSpec("made", names, SIZE, space, has_action_mask=masked, agents_come_and_go=True)


def _policy(kind: str, precision: Precision = "float64", policies: Policies = "shared") -> Policy:
    space = Discrete(4) if kind.endswith(("discrete", "greedy")) else Box((-1.0, -2.0), (1.0, 2.0))
    config = AlgoConfig(policies=policies, model=MODEL, precision=precision)
    flat = MLPActingPolicy.of(config, _spec(space))
    if kind.startswith("gated"):
        return GRUActingPolicy(flat, 6)
    if kind == "epsilon-greedy":
        return EpsilonGreedyPolicy(ExploringStack(flat))
    if kind == "ornstein-uhlenbeck":
        return OrnsteinUhlenbeckPolicy(ExploringStack(flat), 0.2, 0.3)
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
    draw, spec = np.random.default_rng(7), _flat(policy).spec
    copies, masks, hidden = len(alive), None, None
    observations = draw.normal(0, 2, (copies, SLOTS, SIZE)).astype(np.float32)
    observations[~alive] = np.nan
    if isinstance(spec.action_space, Discrete):
        masks = draw.random((copies, SLOTS, 4)) < 0.6
        masks[..., 2] |= ~masks.any(axis=-1)
        masks[~alive] = False
    noise = np.stack([policy.noise(draw, 1)[0] for _ in range(copies)])
    if isinstance(policy, GRUActingPolicy | OrnsteinUhlenbeckPolicy):
        hidden = draw.normal(0, 1, (copies, SLOTS, policy.hidden_size)).astype(policy.hidden_dtype)
    return Observations(observations, np.zeros((copies, 0), np.float32), alive, masks), noise, hidden


def _flat(policy: Policy) -> MLPActingPolicy:
    if isinstance(policy, EpsilonGreedyPolicy | OrnsteinUhlenbeckPolicy):
        return policy.stack.flat
    return policy.flat if isinstance(policy, GRUActingPolicy) else policy


def _act(
    policy: Policy,
    parameters: dict[str, NDArray[Any]],
    observed: Observations,
    hidden: NDArray[Any] | None,
    noise: NDArray[Any] | None,
) -> ActingResult:
    if isinstance(policy, GRUActingPolicy | OrnsteinUhlenbeckPolicy):
        assert hidden is not None
        return policy.act_from(parameters, observed, hidden, noise)
    return *policy.act(parameters, observed, noise), None


def _alive(copies: int, count: int) -> NDArray[np.bool_]:
    """Alive mask with `count` live agents over all copies."""
    alive = np.zeros(copies * SLOTS, np.bool_)
    alive[np.random.default_rng(3).permutation(copies * SLOTS)[:count]] = True
    return alive.reshape(copies, SLOTS)


@pytest.mark.parametrize(
    ("kind", "precision", "greedy", "count"),
    pairwise(KINDS, ["float32", "float64"], [False, True], [0, 1, COPIES * SLOTS // MIN_SLOTS_PER_AGENT]),
)
def test_live_agents_act_as_if_every_slot_were_computed(
    kind: str, precision: Precision, greedy: bool, count: int
) -> None:
    policy, alive = _policy(kind, precision), _alive(COPIES, count)
    parameters = _parameters(policy, 1)
    observed, drawn, hidden = _observations(policy, alive)
    before = None if hidden is None else hidden.copy()
    noise = None if greedy else drawn
    found = _act(policy, parameters, observed, hidden, noise)
    expected = policy.act_on_all_slots(parameters, observed, hidden, noise)
    tolerance = 1e-5 if precision == "float32" else 1e-12
    for mine, whole in zip(found[:2], expected[:2], strict=True):
        assert (mine.dtype, mine.shape) == (whole.dtype, whole.shape)
        np.testing.assert_allclose(mine[alive], whole[alive], rtol=tolerance, atol=tolerance)
        assert not mine[~alive].any()
        assert np.isfinite(mine).all()
    if hidden is not None:
        assert found[2] is not None
        assert expected[2] is not None
        np.testing.assert_array_equal(hidden, before)
        np.testing.assert_array_equal(found[2][~alive], hidden[~alive])
        np.testing.assert_allclose(found[2][alive], expected[2][alive], rtol=tolerance, atol=tolerance)
        assert found[2].dtype == hidden.dtype


@pytest.mark.parametrize("kind", KINDS)
def test_a_replica_in_a_stack_acts_bit_for_bit_as_alone(kind: str) -> None:
    """In a stack with replicas of few, many and no agents."""
    policy = _policy(kind, "float32")
    counts = (7, COPIES * SLOTS, 0, 2)
    alive = np.concatenate([_alive(COPIES, count) for count in counts])
    parameters = _parameters(policy, len(counts))
    observed, noise, hidden = _observations(policy, alive)
    together = _act(policy, parameters, observed, hidden, noise)
    for r in range(len(counts)):
        block = slice(r * COPIES, (r + 1) * COPIES)
        one = Observations(
            observed.observations[block],
            observed.states[block],
            observed.alive[block],
            None if observed.action_masks is None else observed.action_masks[block],
        )
        mine = {name: array[r : r + 1] for name, array in parameters.items()}
        alone = _act(policy, mine, one, None if hidden is None else hidden[block], noise[block])
        for part, whole in zip(alone, together, strict=True):
            if part is None or whole is None:
                assert part is whole
            else:
                np.testing.assert_array_equal(part, whole[block])


@pytest.mark.parametrize("count", [COPIES * SLOTS // MIN_SLOTS_PER_AGENT + 1, COPIES * SLOTS])
def test_all_slots_are_computed_if_few_are_empty(count: int) -> None:
    policy = _policy("discrete", "float32")
    observed, noise, _ = _observations(policy, _alive(COPIES, count))
    parameters = _parameters(policy, 1)
    found = _act(policy, parameters, observed, None, noise)
    for mine, whole in zip(
        found[:2], policy.act_on_all_slots(parameters, observed, None, noise)[:2], strict=True
    ):
        np.testing.assert_array_equal(mine, whole)


def test_empty_slots_are_skipped_only_with_many_slots_and_one_shared_policy() -> None:
    shared = _policy("discrete")
    assert isinstance(shared, MLPActingPolicy)
    assert shared.single_agent is not None
    assert replace(shared, spec=replace(shared.spec, agents_come_and_go=False)).single_agent is None
    assert replace(shared, spec=replace(shared.spec, agents=shared.spec.agents[1:])).single_agent is None
    assert _policy("discrete", policies="independent").single_agent is None
    assert _policy("ornstein-uhlenbeck", policies="independent").single_agent is None
