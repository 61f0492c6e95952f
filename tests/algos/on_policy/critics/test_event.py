"""The critic that separates what other agents did until an agent's next decision."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from made_trajectories import DISCRETE, fabricate
from numpy.typing import NDArray

from headway_algos.config import ModelConfig
from headway_algos.on_policy.critics.critic_inputs import events_until_next_decision
from headway_algos.on_policy.critics.event import EventCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

SETTINGS: dict[str, Any] = {"model": ModelConfig(hidden=(16,)), "precision": "float64", "policies": "shared"}


def naive_sums(
    values: NDArray[Any], decides: NDArray[Any], ends: NDArray[Any], groups: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the sums event by event: follow the stream from each step until the agent decides again."""
    steps, copies, agents, _ = values.shape
    sums = np.zeros(values.shape)
    for t, c, agent in np.ndindex(steps, copies, agents):
        for later in range(t, steps):
            if later > t and decides[later, c, agent]:
                break
            for other in range(agents):
                if other != agent and groups[other] == groups[agent] and decides[later, c, other]:
                    sums[t, c, agent] += values[later, c, other]
            if ends[later, c, agent]:
                break
    return sums


def test_events_are_the_others_decisions_until_the_next_own_one() -> None:
    random = np.random.default_rng(5)
    values = random.normal(size=(40, 3, 5, 2)).astype(np.float32)
    decides, ends = random.random((40, 3, 5)) < 0.3, random.random((40, 3, 5)) < 0.05
    groups = np.array([0, 1, 0, 0, 1])
    unused = np.where(decides[..., None], values, np.float32(np.nan))
    sums = events_until_next_decision(unused, decides, ends, groups)
    np.testing.assert_allclose(sums, naive_sums(values, decides, ends, groups), atol=1e-4)


def test_advantages_are_those_of_the_local_critic_less_the_contribution_of_the_mean_event() -> None:
    """Also after training, with inputs that are computed agent by agent."""
    spec, settings = DISCRETE, {**SETTINGS, "normalise_observations": False}
    made = fabricate(spec, 12, 4, seed=3, absent=0.2)
    local = OnPolicyLearner(configure("ippo", **settings), spec, (1,), "cpu")
    event = OnPolicyLearner(configure("custom", **settings, critic="event"), spec, (1,), "cpu")
    agents, critic = spec.num_agents, event.critic
    assert isinstance(critic, EventCritic)
    for iteration in range(3):
        plain = local.critic.estimate(made, local.behaviour, iteration)
        found = critic.estimate(made, event.behaviour, iteration)
        np.testing.assert_array_equal(found.values, plain.values)
        np.testing.assert_array_equal(found.returns, plain.returns)
        alive = made.alive[:-1]
        decides, ends = alive & made.acting, made.terminated | made.truncated
        observed = np.where(alive[..., None], made.observations[:-1], 0.0)
        chosen = np.eye(3)[np.where(alive, made.actions, 0)]
        groups = np.array(spec.groups)
        event_of = np.concatenate([observed, chosen, np.ones((*chosen.shape[:3], 1))], axis=-1)
        sums = naive_sums(event_of, decides, ends, groups)
        count = sums[..., -1:]
        means = sums[..., :-1] / np.maximum(count, 1)
        inputs = torch.from_numpy(np.concatenate([observed, means, count / agents], axis=-1)).flatten(0, 2)[
            None
        ]
        networks = critic.events.networks
        with torch.no_grad():
            outputs = networks.network(inputs)[0, 0] * networks.return_moments.std[0, 0]
            outputs = (outputs + networks.return_moments.mean[0, 0]).numpy().reshape(alive.shape)
        expected = np.where(alive, plain.advantages - outputs, 0.0)
        np.testing.assert_allclose(found.advantages, expected, atol=1e-6)
        local.critic.fit(plain, iteration)
        assert np.isfinite(critic.fit(found, iteration)["events_loss"]).all()


def test_what_others_did_is_not_credited() -> None:
    """If rewards are the others' actions alone, little of the advantages is left."""
    spec = replace(DISCRETE, groups=())
    made = fabricate(spec, 200, 4, seed=3)
    made.acting[:], made.terminated[:], made.truncated[:] = True, False, False
    made.rewards[:] = made.actions.sum(axis=2, keepdims=True) - made.actions
    config = configure("custom", **SETTINGS, critic="event", gamma=0.0, lr=5e-3, epochs=20)
    critic = OnPolicyLearner(config, spec, (1,), "cpu")
    before = critic.critic.estimate(made, critic.behaviour, 0).advantages.std()
    for iteration in range(10):
        critic.critic.fit(critic.critic.estimate(made, critic.behaviour, iteration), iteration)
    assert critic.critic.estimate(made, critic.behaviour, 10).advantages.std() < 0.2 * before


def test_the_two_networks_share_no_random_stream() -> None:
    event = OnPolicyLearner(configure("custom", critic="event", policies="shared"), DISCRETE, (1,), "cpu")
    critic = event.critic
    assert isinstance(critic, EventCritic)
    own, events = (each.networks.network.state_dict() for each in (critic, critic.events))
    assert own["weights.1"].shape == events["weights.1"].shape
    assert not torch.equal(own["weights.1"], events["weights.1"])
    shuffled = [each._generators(1)[0].permutation(100).tolist() for each in (critic, critic.events)]
    assert shuffled[0] != shuffled[1]
