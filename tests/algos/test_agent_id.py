"""The agent's index as an input: who gets one, and what policies and critics read then."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_trajectories import fabricate
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, Observations
from headway.contracts.acting_policy import RecurrentPolicy, hidden_size
from headway_algos.agent_id import MAX_AGENTS, agent_ids
from headway_algos.config import AlgoConfig
from headway_algos.registry import ENTRIES, configure
from headway_algos.replay_config import MADQNConfig

AGENTS = ("a", "b", "c")
SPEC = EnvSpec("made", AGENTS, 4, Discrete(3), has_action_mask=True)
SEEDS = (4, 9)
EYE: NDArray[np.float32] = np.eye(3, dtype=np.float32)


def test_the_index_is_a_position_among_the_agents_of_a_policy() -> None:
    shared = configure("custom", policies="shared")
    np.testing.assert_array_equal(agent_ids(shared, SPEC), EYE)
    grouped = replace(SPEC, groups=("x", "y", "x"))
    np.testing.assert_array_equal(
        agent_ids(configure("custom", policies="groups"), grouped), [[1, 0], [1, 0], [0, 1]]
    )
    np.testing.assert_array_equal(agent_ids(MADQNConfig(policies="shared"), SPEC), EYE)


@pytest.mark.parametrize("config", [AlgoConfig, MADQNConfig])
def test_by_default_alike_agents_that_stay_get_an_index(config: Any) -> None:  # noqa: ANN401 - a record's class
    def columns(spec: EnvSpec, **changes: Any) -> int:  # noqa: ANN401 - settings
        return agent_ids(config(**changes), spec).shape[1]

    assert columns(SPEC) == 3
    assert columns(SPEC, agent_id=False) == 0
    assert columns(SPEC, policies="independent") == 0
    assert columns(replace(SPEC, agents=("alone",))) == 0
    visitors = replace(SPEC, agents_come_and_go=True)
    assert columns(visitors) == 0
    assert columns(visitors, agent_id=True) == 3
    for count, expected in ((MAX_AGENTS, MAX_AGENTS), (MAX_AGENTS + 1, 0)):
        assert columns(replace(SPEC, agents=tuple(map(str, range(count))))) == expected


def test_policies_that_split_later_get_none() -> None:
    assert agent_ids(configure("custom", shared_until=0.5, policies="groups"), SPEC).shape[1] == 0
    with pytest.raises(ValueError, match="agent_id must be false or null with shared_until"):
        configure("custom", shared_until=0.5, agent_id=True)


def test_an_index_within_policies_of_one_agent_is_refused() -> None:
    for name in ("ippo", "madqn"):
        entry = ENTRIES[name]
        line = entry.refuses(entry.config(policies="independent", agent_id=True), SPEC)
        assert line is not None
        assert "algo.agent_id=true needs a policy with several agents" in line


def _shown(observations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return observations (..., 3, D) of an environment that shows each agent its index, (..., 3, D + 3)."""
    index = np.zeros((*observations.shape[:-1], 3), np.float32)
    for agent in range(3):
        index[..., agent, agent] = 1
    return np.concatenate([observations, index], axis=-1)


@pytest.mark.parametrize(
    ("name", "space", "settings"),
    [
        pytest.param("ippo", Discrete(3), {}, marks=pytest.mark.slow),
        ("ippo", Discrete(3), {"model": {"hidden": (8,), "core": "gru", "gru_size": 4}}),
        ("maacktr", Box((-1.0,), (1.0,)), {}),
        pytest.param("itrpo", Discrete(3), {}, marks=pytest.mark.slow),
        ("madqn", Discrete(3), {"learning_starts": 4, "updates": 3}),
        pytest.param(
            "ddpg", Box((-1.0,), (1.0,)), {"learning_starts": 4, "updates": 3}, marks=pytest.mark.slow
        ),
    ],
)
def test_an_index_equals_one_in_the_environments_observations(
    name: str, space: Discrete | Box, settings: dict[str, Any]
) -> None:
    """Policies act and learn alike, to the bit."""
    entry, spec = (
        ENTRIES[name],
        replace(SPEC, action_space=space, has_action_mask=isinstance(space, Discrete)),
    )
    model = settings.pop("model", {"hidden": (8,)})
    make = type(entry.config().model)
    told, shown = (
        entry.config(policies="shared", agent_id=given, model=make(**model), **settings)
        for given in (True, False)
    )
    wide = replace(spec, observation_size=spec.observation_size + 3)
    policies = entry.acting_policy(told, spec), entry.acting_policy(shown, wide)
    learners = entry.learner(told, spec, SEEDS, "cpu"), entry.learner(shown, wide, SEEDS, "cpu")
    for iteration in range(2):
        own = fabricate(spec, 12, 4, iteration, ends=0.2, hidden_size=hidden_size(policies[0]))
        other = replace(
            own, observations=_shown(own.observations), final_observations=_shown(own.final_observations)
        )
        acted = []
        for learner, policy, trajectory in zip(learners, policies, (own, other), strict=True):
            learner.update(trajectory, iteration + 1, iteration / 2)
            observed = Observations(trajectory.observations[3], trajectory.states[3], trajectory.alive[3])
            noise = np.stack([policy.noise(np.random.default_rng(copy), 1)[0] for copy in range(4)])
            if isinstance(policy, RecurrentPolicy):
                hidden = np.full((4, 3, policy.hidden_size), 0.1, policy.hidden_dtype)
                acted.append(policy.act_from(learner.acting_parameters(), observed, hidden, noise)[:2])
            else:
                acted.append(policy.act(learner.acting_parameters(), observed, noise))
        for one, two in zip(*acted, strict=True):
            np.testing.assert_array_equal(one, two)
        first, second = (learner.acting_parameters() for learner in learners)
        assert all(np.array_equal(first[key], second[key]) for key in second)
        shapes = {key: array.shape for key, array in first.items()}
        assert shapes == {key: shape for key, (shape, _) in policies[0].parameter_shapes(len(SEEDS)).items()}


@pytest.mark.parametrize("name", ["mappo", "coma"])
def test_joint_inputs_of_critics_leave_the_index_out(name: str) -> None:
    """A central critic without a state reads all observations, whose order identifies the agents."""
    entry = ENTRIES[name]
    for shared_reward in (True, False):
        spec = replace(SPEC, shared_reward=shared_reward)
        sizes = []
        for given in (True, False):
            learner = entry.learner(entry.config(agent_id=given), spec, (1,), "cpu")
            learner.update(fabricate(spec, 6, 2, 0), 1, 0.0)
            sizes.append(learner.state_dict()["critic"]["networks"]["network.weights.0"].shape[-1])
        own = 3 if name == "mappo" and not shared_reward else 0
        assert sizes[0] - sizes[1] == own, "its own observation has the index once"
