"""COMA's critic, values that see the others' actions, and local ones of teams, against loops over agents.

The loops evaluate one network of one replica at a time, as float64 matrices. They share with Headway only the
random numbers for actions sampled where none were taken.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from covering import quick_or_slow
from made_trajectories import DISCRETE, STATE, TEAM, end_episodes, fabricate, naive_advantages, poisoned
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, Trajectory, generator
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.critics.counterfactual import CounterfactualCritic
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.return_regression import ReturnNetworks
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

Array = NDArray[np.float64]

TEAM_BLIND = replace(DISCRETE, shared_reward=True)
TEAMS = replace(DISCRETE, shared_in_groups=True)
BOX = replace(STATE, action_space=Box((-0.5, -1.0), (0.5, 1.0)), has_action_mask=False)
SETTINGS: dict[str, Any] = {
    "model": ModelConfig(hidden=(7, 6), actor_gain=0.5), "precision": "float64", "epochs": 2,
    "minibatches": 2, "lr": 1e-2, "gamma": 0.9, "gae_lambda": 0.7, "piece_samples": 40,
}  # fmt: skip
COMA = configure("coma", **SETTINGS, target_every=2)
OTHERS = configure("mappo", **SETTINGS, critic_actions="others")
LOCAL = configure("ippo", **SETTINGS)
CASES: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    "coma": (COMA, DISCRETE),
    "coma state, shared": (replace(COMA, policies="shared"), STATE),
    "coma groups, nothing normalised": (
        replace(COMA, policies="groups", normalise_observations=False, normalise_values=False), STATE
    ),
    "coma team": (COMA, TEAM),
    "coma team without state, groups": (replace(COMA, policies="groups"), TEAM_BLIND),
    "coma team, no masks": (COMA, replace(TEAM, has_action_mask=False)),
    "coma, a team per group": (COMA, TEAMS),
    "others": (OTHERS, DISCRETE),
    "others state, shared": (replace(OTHERS, policies="shared"), STATE),
    "others box": (OTHERS, BOX),
    "others team": (OTHERS, TEAM),
    "others team box, groups": (replace(OTHERS, policies="groups"), replace(BOX, shared_reward=True)),
    "local team": (LOCAL, TEAM),
    "local team, shared": (replace(LOCAL, policies="shared"), TEAM),
    "local, a team per group": (LOCAL, TEAMS),
}  # fmt: skip
SEEDS, COPIES, STEPS = (4, 8), 2, 9


@dataclass
class Moment:
    """Observations and actions of one copy's agents."""

    observations: Array
    state: Array
    present: NDArray[np.bool_]
    joint: NDArray[np.bool_]
    """Whose observations and actions stand in the joint input: not those of agents that are gone."""
    masks: NDArray[np.bool_]
    actions: NDArray[Any]


def _forward(weights: list[Array], biases: list[Array], row: Array) -> Array:
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        row = weight @ row + bias[:, 0]
        row = np.tanh(row) if i < len(weights) - 1 else row
    return row


class Loops:
    """Replica r's critic and policies, one row at a time."""

    def __init__(self, learner: OnPolicyLearner, r: int) -> None:
        self.learner, self.config, self.spec, self.r = learner, learner.config, learner.spec, r
        n = self.spec.num_agents
        self.policy_of = {"independent": list(range(n)), "shared": [0] * n, "groups": [0, 1, 0, 0]}[
            self.config.policies
        ]
        self.policies = max(self.policy_of) + 1
        self.one_network = self.spec.shared_reward and self.config.critic != "local"

    def _tensor(self, tensor: torch.Tensor, p: int) -> Array:
        return tensor.detach().double().numpy()[p]

    def policy(self, moment: Moment, n: int) -> tuple[Array, Array]:
        """Network outputs of agent n's policy, and the chances that they give."""
        actor, p = self.learner.actor, self.r * self.policies + self.policy_of[n]
        row = moment.observations[n]
        if self.config.normalise_observations:
            mean, variance = (
                self._tensor(actor.moments.mean, p)[0],
                self._tensor(actor.moments.variance, p)[0],
            )
            row = np.clip((row - mean) / np.sqrt(variance + 1e-8), -10, 10)
        weights = [self._tensor(weight, p) for weight in actor.network.weights]
        outputs = _forward(weights, [self._tensor(bias, p) for bias in actor.network.biases], row)
        chances = np.zeros(len(outputs))
        if isinstance(self.spec.action_space, Discrete):
            allowed = np.flatnonzero(moment.masks[n])
            chances[allowed] = np.exp(outputs[allowed]) / np.exp(outputs[allowed]).sum()
        return outputs, chances

    def encoded(self, action: Any) -> list[float]:  # noqa: ANN401 - a number or a vector
        if isinstance(self.spec.action_space, Box):
            bounds = zip(action, self.spec.action_space.low, self.spec.action_space.high, strict=True)
            return [min(max(float(a), low), high) for a, low, high in bounds]
        return [float(u == action) for u in range(3)]

    def worth(self, networks: ReturnNetworks, moment: Moment, n: int) -> Array:
        """The critic's outputs from agent n's viewpoint."""
        k = 0 if self.one_network else self.policy_of[n]
        p = self.r * (1 if self.one_network else self.policies) + k
        counterfactual, local = self.config.critic == "counterfactual", self.config.critic == "local"
        joint = np.where(moment.joint[:, None], moment.observations, 0)
        seen = list(moment.state) if self.spec.state_size else list(joint.ravel())
        if local:
            seen = []
        if not self.one_network or counterfactual:
            seen += list(moment.observations[n])
        row = np.array(seen)
        if self.config.normalise_observations:
            moments = networks.input_moments
            mean, variance = self._tensor(moments.mean, p)[0], self._tensor(moments.variance, p)[0]
            row = np.clip((row - mean) / np.sqrt(variance + 1e-8), -10, 10)
        for other in range(0 if local else self.spec.num_agents):
            known = other != n and moment.joint[other]
            block = self.encoded(moment.actions[other])
            row = np.append(row, block if known else np.zeros(len(block)))
        if counterfactual:
            row = np.append(row, [float(agent == n) for agent in range(self.spec.num_agents)])
        weights = [self._tensor(weight, p) for weight in networks.network.weights]
        outputs = _forward(weights, [self._tensor(bias, p) for bias in networks.network.biases], row)
        if self.config.normalise_values:
            moments = networks.return_moments
            std = np.sqrt(self._tensor(moments.variance, p)[0, 0] + 1e-8)
            outputs = outputs * std + self._tensor(moments.mean, p)[0, 0]
        return outputs

    def draw(self, moment: Moment, noise: Array) -> Moment:
        """The moment with actions: the first whose summed chances exceed the noise, or mean + std noise."""
        actions: list[Any] = []
        for n in range(self.spec.num_agents):
            outputs, chances = self.policy(moment, n)
            if isinstance(self.spec.action_space, Discrete):
                actions.append(next(u for u in range(3) if chances[: u + 1].sum() > noise[n]))
            else:
                assert self.learner.actor.log_std is not None
                p = self.r * self.policies + self.policy_of[n]
                std = np.exp(self._tensor(self.learner.actor.log_std, p)[:, 0])
                actions.append(np.float32(outputs + std * noise[n]))
        return replace(moment, actions=np.array(actions))


def _moment(made: Trajectory, t: int, c: int, ended: NDArray[np.bool_] | None = None) -> Moment:
    """Step t of copy c; with `ended`, what came after step t - 1, where the streams of those agents ended."""
    present, joint = made.alive[t, c].copy(), made.alive[t, c].copy()
    observations, state = made.observations[t, c].astype(np.float64), made.states[t, c]
    masks = made.action_masks[t, c].copy() if len(made.action_masks) else np.ones((4, 3), bool)
    if ended is not None:
        present = present | ended
        joint[ended] = made.alive[t - 1, c, ended] & ~made.terminated[t - 1, c, ended]
        observations[ended] = made.final_observations[t - 1, c, ended]
        if len(made.action_masks):
            for n in np.flatnonzero(ended):
                known = made.action_masks[:t, c, n][made.alive[:t, c, n]]
                masks[n] = known[-1] if len(known) else True
        state = made.final_states[t - 1, c] if ended.all() else state
    observations[~present], masks[~present] = 0, True
    actions = made.actions[t, c] if t < len(made.actions) and ended is None else np.zeros(4)
    return Moment(observations, state.astype(np.float64), present, joint, masks, actions)


def _expected(learner: OnPolicyLearner, made: Trajectory, r: int, iteration: int) -> tuple[Array, ...]:
    """Advantages, values and returns (T, E, N) of replica r by loops.

    A team's return ends with the episode, and agents that are gone await what their teammates do.
    """
    loops, critic, config, spec = Loops(learner, r), learner.critic, learner.config, learner.spec
    assert isinstance(critic, CounterfactualCritic | ValueCritic)
    counterfactual = isinstance(critic, CounterfactualCritic)
    lagging = critic.target if isinstance(critic, CounterfactualCritic) else critic.networks
    steps, copies, agents = made.rewards.shape
    mates = np.zeros((agents, agents), bool)
    if spec.shared_reward or spec.shared_in_groups:
        names = np.zeros(agents) if spec.shared_reward else np.array(spec.groups)
        mates = names[:, None] == names
    random = generator(learner.seeds[r], "critic bootstrap actions", iteration)
    size = () if isinstance(spec.action_space, Discrete) else (2,)
    draw = random.random if isinstance(spec.action_space, Discrete) else random.standard_normal
    noise = draw((copies, agents, *size))

    def ahead(moment: Moment, n: int) -> float:
        """The worth of a moment with drawn actions: the mean over one's own where Q is known."""
        outputs = loops.worth(lagging, moment, n)
        return float(loops.policy(moment, n)[1] @ outputs) if counterfactual else float(outputs[0])

    values, q, chances = np.zeros((3, steps + 1, copies, agents, 3))
    for c in range(copies):
        for n in range(agents):
            for t in range(steps):
                moment = _moment(made, t, c)
                q[t, c, n] = loops.worth(critic.networks, moment, n)
                chances[t, c, n] = loops.policy(moment, n)[1] if counterfactual else 0
                values[t, c, n] = loops.worth(lagging, moment, n)
            values[steps, c, n] = ahead(loops.draw(_moment(made, steps, c), noise[c]), n)
    final = np.zeros((steps, copies, agents))
    ended = made.terminated | made.truncated
    for t in range(steps):
        for c in range(copies):
            if (made.truncated[t, c] & ~made.terminated[t, c]).any():
                moment = loops.draw(_moment(made, t + 1, c, ended[t, c]), draw((agents, *size)))
                final[t, c] = [ahead(moment, n) for n in range(agents)]
                for n in np.flatnonzero(~moment.joint):
                    if (there := mates[n] & moment.joint).any():
                        final[t, c, n] = final[t, c, there].mean()
    taken = made.actions if counterfactual else np.zeros((steps, copies, agents), np.int64)
    over, cut = made.terminated, made.truncated & ~made.terminated
    if mates.any():
        everyone = ended.all(axis=2, keepdims=True)
        over = np.repeat(made.terminated.all(axis=2, keepdims=True), agents, axis=2)
        cut = everyone & ~over
    advantages, kept, returns = np.zeros((3, steps, copies, agents))
    for c in range(copies):
        here = made.alive[:, c].copy()
        last = values[steps, c, :, 0].copy()
        for n in np.flatnonzero(~here[-1]):
            if (there := mates[n] & here[-1]).any():
                last[n] = values[steps, c, there, 0].mean()
            elif here[:, n].any():
                # What follows is unknown: the agent is worth what it was when last seen.
                seen = np.flatnonzero(here[:, n])[-1]
                outputs = values[seen, c, n]
                last[n] = chances[seen, c, n] @ outputs if counterfactual else outputs[0]
        for n in range(agents):
            alive = made.alive[:-1, c, n]
            u = np.where(alive, taken[:, c, n], 0)
            of_taken = values[np.arange(steps), c, n, u]
            returns[:, c, n] = of_taken + naive_advantages(
                made.rewards[:, c, n].astype(np.float64), np.append(of_taken, last[n]), final[:, c, n],
                over[:, c, n], cut[:, c, n], np.append(alive, True), config.gamma, config.gae_lambda,
            )  # fmt: skip
            kept[:, c, n] = q[np.arange(steps), c, n, u]
            baseline = np.array([chances[t, c, n] @ q[t, c, n] for t in range(steps)])
            usual = baseline if counterfactual else of_taken
            said = kept[:, c, n] if counterfactual else returns[:, c, n]
            advantages[:, c, n] = np.where(alive, said - usual, 0)
    return advantages, kept, returns


@pytest.mark.parametrize(
    ("config", "spec"), quick_or_slow(CASES, "coma groups, nothing normalised", "others team box, groups")
)
def test_estimates_equal_the_loops(config: AlgoConfig, spec: EnvSpec) -> None:
    """Before training, and with target network, critic and normalisers that differ: returns come from the
    target network, advantages from the critic, and the baseline from the policy's chances of allowed actions.
    """
    learner = OnPolicyLearner(config, spec, SEEDS, "cpu")
    for iteration in (1, 2, 3):
        made = fabricate(spec, STEPS, 2 * COPIES, seed=iteration, absent=0.25, idle=0.2, leaves=0.04)
        made.truncated[3, 0] = ~made.terminated[3, 0]  # somewhere a whole episode is cut
        end_episodes(made)
        estimate = learner.critic.estimate(poisoned(made), learner.behaviour, iteration)
        for r in range(2):
            part = slice(r * COPIES, (r + 1) * COPIES)
            expected = _expected(learner, made.of_copies(r * COPIES, COPIES), r, iteration)
            here = made.alive[:-1, part]
            np.testing.assert_array_equal(estimate.present[:, part], here)
            got = (estimate.advantages, estimate.values, estimate.returns)
            for name, mine, theirs in zip(("advantages", "values", "returns"), got, expected, strict=True):
                np.testing.assert_allclose(
                    mine[:, part][here], theirs[here], rtol=1e-10, atol=1e-10, err_msg=f"{iteration} {name}"
                )
        learner.update(poisoned(made), iteration, 0.0)


def _rows_of(learner: OnPolicyLearner, estimate: CriticEstimate, p: int) -> tuple[torch.Tensor, ...]:
    """Inputs, actions and returns of the rows that network p is trained on."""
    critic = learner.critic
    assert isinstance(critic, CounterfactualCritic)
    assert estimate.taken is not None
    rows = torch.from_numpy(critic.layout.selection(estimate.present)[p])
    returns = critic.layout.rows(estimate.returns)[p]
    return estimate.inputs[p][rows], estimate.taken[p][rows], returns[rows]


@pytest.mark.parametrize("spec", [STATE, TEAM])
def test_only_q_of_the_action_taken_is_trained(spec: EnvSpec) -> None:
    """Two steps on the whole batch against torch's Adam with one network at a time; outputs for actions not
    taken have no gradient."""
    config = replace(COMA, epochs=2, minibatches=1, normalise_values=False, grad_clip=0.3)
    learner = OnPolicyLearner(config, spec, SEEDS, "cpu")
    critic = learner.critic
    assert isinstance(critic, CounterfactualCritic)
    made = poisoned(fabricate(spec, STEPS, 2 * COPIES, seed=0, absent=0.3))
    estimate = critic.estimate(made, learner.behaviour, 1)
    network, expected = critic.networks.network, []
    tensors = [*network.weights, *network.biases]
    for p in range(len(estimate.inputs)):
        inputs, taken, returns = _rows_of(learner, estimate, p)
        mine = [torch.nn.Parameter(tensor[p].detach().clone()) for tensor in tensors]
        adam = torch.optim.Adam(mine, config.lr, eps=1e-5)
        for _ in range(2):
            x, layers = inputs.T, len(network.weights)
            for i in range(layers):
                x = mine[i] @ x + mine[layers + i]
                x = x.tanh() if i < layers - 1 else x
            loss = sum((x[u, row] - returns[row]) ** 2 for row, u in enumerate(taken.tolist())) / len(taken)
            adam.zero_grad()
            torch.as_tensor(loss).backward()
            torch.nn.utils.clip_grad_norm_(mine, 0.3)
            adam.step()
        expected.append(mine)
    critic.fit(estimate, 1)
    for p, mine in enumerate(expected):
        for tensor, parameter in zip(tensors, mine, strict=True):
            torch.testing.assert_close(tensor[p], parameter, rtol=1e-10, atol=1e-10)


def _copied(learner: OnPolicyLearner) -> bool:
    critic = learner.critic
    assert isinstance(critic, CounterfactualCritic)
    pairs = zip(critic.networks.network.weights, critic.target.network.weights, strict=True)
    same = [torch.equal(a, b) for a, b in pairs]
    assert all(same) or not any(same)
    std, target_std = critic.networks.return_moments.std, critic.target.return_moments.std
    assert torch.equal(std, target_std) == all(same)
    return all(same)


@pytest.mark.parametrize("every", [1, 2, 3])
def test_the_target_network_is_copied_on_schedule_also_after_resuming(every: int) -> None:
    config = replace(COMA, target_every=every)
    learner = OnPolicyLearner(config, TEAM, (1, 2), "cpu")
    copied = []
    for iteration in range(1, 8):
        learner.update(fabricate(TEAM, 6, 4, seed=iteration), iteration, 0.0)
        copied.append(_copied(learner))
        resumed = OnPolicyLearner(config, TEAM, (1, 2), "cpu")
        resumed.load_state_dict(learner.state_dict())
        assert _copied(resumed) == copied[-1]
        learner = resumed
    assert copied == [(iteration - 1) % every == 0 for iteration in range(1, 8)]


def test_continuous_actions_are_refused() -> None:
    with pytest.raises(
        ValueError, match="needs Discrete actions, which made does not have; use critic: local"
    ):
        OnPolicyLearner(COMA, BOX, (1,), "cpu")
