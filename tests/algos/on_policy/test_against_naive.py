"""Whole updates of the algorithms against one plain network after another, in float64.

The naive learner has no stacks: torch.nn modules, torch.optim.Adam, torch.distributions and loops over
(agent, step, copy). It shares with Headway the initial weights and the order of minibatches.
"""

from collections.abc import Sequence, Sized
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from covering import quick_or_slow
from learned import alone
from made_trajectories import BOX, DISCRETE, TEAM, fabricate, naive_advantages, poisoned
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal, kl_divergence

from headway.contracts import EnvSpec, Trajectory, generator
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.networks.mlp import StackedMLP
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

Row = tuple[int, int, int]
"""Agent, step, copy."""
Array = NDArray[np.float64]
DOUBLE = torch.float64

BOX_STATE = replace(BOX, state_size=5)
SETTINGS: dict[str, Any] = {
    "model": ModelConfig(hidden=(7, 6), actor_gain=0.5), "precision": "float64", "epochs": 2,
    "minibatches": 3, "lr": 3e-3, "critic_lr": 1e-3, "lr_end": 0.2, "piece_samples": 40,
}  # fmt: skip
TRUST: dict[str, Any] = {
    **{key: value for key, value in SETTINGS.items() if key != "lr"},
    "model": ModelConfig(hidden=(5,), actor_gain=0.5),
    "cg_iterations": 80,
}
CASES: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    "ippo with penalty and value clip": (
        configure("ippo", **SETTINGS, policies="independent", kl_coeff=0.2, value_clip=0.5),
        DISCRETE,
    ),
    "ippo box, relu": (
        configure(
            "ippo", **{**SETTINGS, "model": ModelConfig((7,), "relu", 0.5)}, kl_coeff=0.2, grad_clip=None
        ),
        BOX_STATE,
    ),
    "ippo groups, nothing normalised": (
        configure(
            "ippo", **SETTINGS, policies="groups", normalise_advantages=False, normalise_observations=False,
            normalise_values=False,
        ),
        DISCRETE,
    ),
    "mappo": (configure("mappo", **SETTINGS, policies="independent"), DISCRETE),
    "mappo box with state, shared": (configure("mappo", **SETTINGS, policies="shared"), BOX_STATE),
    "mappo team": (configure("mappo", **SETTINGS, policies="groups", value_clip=0.5), TEAM),
    "ia2c": (configure("ia2c", **SETTINGS), DISCRETE),
    "ia2c box groups": (configure("ia2c", **SETTINGS, policies="groups"), BOX_STATE),
    "maa2c team": (configure("maa2c", **SETTINGS), TEAM),
    "itrpo": (configure("itrpo", **TRUST), DISCRETE),
    "itrpo box": (configure("itrpo", **TRUST), BOX_STATE),
    "matrpo team, shared, wide": (
        configure("matrpo", **TRUST, policies="shared", kl_bound=0.3, accept_ratio=0.7),
        TEAM,
    ),
    "happo": (configure("happo", **SETTINGS, kl_coeff=0.2), DISCRETE),
    "happo box": (configure("happo", **SETTINGS), BOX_STATE),
    "hatrpo groups, box": (configure("hatrpo", **TRUST, policies="groups"), BOX_STATE),
    "hatrpo team": (configure("hatrpo", **TRUST), TEAM),
    "haa2c": (configure("custom", **SETTINGS, critic="central", update="a2c", order="sequential"), DISCRETE),
}  # fmt: skip


class Moments:
    """Mean and standard deviation of all rows, computed from stored rows."""

    def __init__(self) -> None:
        self.seen: list[Array] = []

    def include(self, rows: list[Array]) -> None:
        self.seen += rows

    def mean_std(self) -> tuple[Array | float, Array | float]:
        if not self.seen:
            return 0.0, np.sqrt(1 + 1e-8)
        every = np.array(self.seen)
        return every.mean(axis=0), np.sqrt(every.var(axis=0) + 1e-8)

    def normalise(self, row: Array) -> Array:
        mean, std = self.mean_std()
        return np.clip((row - mean) / std, -10, 10)


def _vector(tensors: Sequence[Tensor]) -> Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


@dataclass
class Rows:
    """Observations and actions of a policy, and the weights of the actions' log-probabilities."""

    inputs: Tensor
    masks: Tensor | None
    actions: Tensor
    behaviour: Tensor
    weights: Tensor

    def one(self, i: int) -> "Rows":
        row = slice(i, i + 1)
        masks = None if self.masks is None else self.masks[row]
        return Rows(self.inputs[row], masks, self.actions[row], self.behaviour[row], self.weights[row])


@dataclass
class Policy:
    agents: list[int]
    network: nn.Sequential
    log_std: nn.Parameter | None
    adam: torch.optim.Adam
    moments: Moments
    kl_coeff: float

    def parameters(self) -> list[nn.Parameter]:
        return [*self.network.parameters(), *([] if self.log_std is None else [self.log_std])]

    def distribution(self, rows: Rows) -> Any:  # noqa: ANN401 - torch leaves it untyped
        outputs, masks = self.network(rows.inputs), rows.masks
        if self.log_std is not None:
            return Independent(Normal(outputs, self.log_std.exp().expand_as(outputs)), 1)
        return Categorical(logits=outputs if masks is None else outputs.masked_fill(~masks, -400.0))


@dataclass
class Value:
    viewers: list[int]
    """Agents that it values; [0] for a team's critic."""
    network: nn.Sequential
    adam: torch.optim.Adam
    inputs: Moments
    returns: Moments


class Naive:
    """One replica: one agent and one row at a time."""

    def __init__(self, config: AlgoConfig, spec: EnvSpec, seed: int, like: OnPolicyLearner) -> None:
        self.config, self.spec, self.seed = config, spec, seed
        n = spec.num_agents
        groups = {
            "independent": [[i] for i in range(n)],
            "shared": [list(range(n))],
            "groups": [[0, 2, 3], [1]],
        }[config.policies]
        self.team = config.critic == "central" and spec.shared_reward
        self.policies = [self._policy(k, agents, like) for k, agents in enumerate(groups)]
        self.values = [
            self._value(k, viewers, like) for k, viewers in enumerate([[0]] if self.team else groups)
        ]

    def _policy(self, k: int, agents: list[int], like: OnPolicyLearner) -> Policy:
        network, log_std = alone(like.actor.network, k), None
        if like.actor.log_std is not None:
            log_std = nn.Parameter(like.actor.log_std.data[k, :, 0].clone())
        tensors = [*network.parameters(), *([] if log_std is None else [log_std])]
        adam = torch.optim.Adam(tensors, self.config.lr, eps=1e-5)
        return Policy(agents, network, log_std, adam, Moments(), getattr(self.config, "kl_coeff", 0.0))

    def _value(self, k: int, viewers: list[int], like: OnPolicyLearner) -> Value:
        network = alone(like.critic.networks.network, k)
        adam = torch.optim.Adam(network.parameters(), self.config.critic_lr or 0.0, eps=1e-5)
        return Value(viewers, network, adam, Moments(), Moments())

    def update(self, made: Trajectory, iteration: int, progress: float) -> None:
        share = 1 - (1 - self.config.lr_end) * progress
        for policy in self.policies:
            policy.adam.param_groups[0]["lr"] = self.config.lr * share
        for value in self.values:
            value.adam.param_groups[0]["lr"] = (self.config.critic_lr or 0.0) * share
        advantages, values = self._advantages(made)
        self.factor = np.ones(made.rewards.shape[:2])
        order = list(range(len(self.policies)))
        if self.config.order == "sequential":
            order = generator(self.seed, "agent order", iteration).permutation(len(order)).tolist()
        for k in order:
            self._improve(k, self.policies[k], made, advantages, iteration, share)
        for k, value in enumerate(self.values):
            self._fit(k, value, made, advantages + values, iteration)
        self._absorb(made)

    def _seen(self, made: Trajectory, n: int, t: int, c: int, final: bool = False) -> Array:
        """Return the input of agent n's critic at step t, or at a time at which step t ended some streams."""
        over = (
            (made.terminated[t, c] | made.truncated[t, c]) if final else np.zeros(self.spec.num_agents, bool)
        )
        at = t + 1 if final else t
        each = [
            made.final_observations[t, c, i] if over[i]
            else made.observations[at, c, i] if made.alive[at, c, i]
            else np.zeros(self.spec.observation_size)
            for i in range(self.spec.num_agents)
        ]  # fmt: skip
        if self.config.critic == "local":
            return each[n].astype(np.float64)
        # Whose values differ, though one network gives them all, are shown who they are by what they see.
        own = [each[n]] if not self.team else []
        # Agents that left before the step, or terminated by it, are no part of what is left to value.
        for i in np.flatnonzero(over):
            if made.terminated[t, c, i] or not made.alive[t, c, i]:
                each[i] = np.zeros(self.spec.observation_size)
        if self.spec.state_size:
            state: Array = (made.final_states[t, c] if over.all() else made.states[at, c]).astype(np.float64)
            return np.concatenate([state, *own])
        return np.concatenate([*each, *own]).astype(np.float64)

    def _worth(self, value: Value, seen: Array) -> float:
        if self.config.normalise_observations:
            seen = value.inputs.normalise(seen)
        with torch.no_grad():
            worth = float(value.network(torch.from_numpy(seen))[0])
        if self.config.normalise_values:
            mean, std = value.returns.mean_std()
            worth = worth * float(std) + float(mean)
        return worth

    def _advantages(self, made: Trajectory) -> tuple[Array, Array]:
        """(T, C, N) each; a team's in every column."""
        steps, copies, agents = made.rewards.shape
        advantages, kept = np.zeros((steps, copies, agents)), np.zeros((steps, copies, agents))
        for value in self.values:
            for n in value.viewers:
                for c in range(copies):
                    worth = np.array(
                        [self._worth(value, self._seen(made, n, t, c)) for t in range(steps + 1)]
                    )
                    terminated, truncated = made.terminated[:, c, n], made.truncated[:, c, n]
                    present = made.alive[:, c, n]
                    if self.team:
                        ended = (made.terminated[:, c] | made.truncated[:, c]).all(axis=1)
                        terminated = np.array(made.terminated[:, c].all(axis=1))
                        truncated, present = ended & ~terminated, np.ones(steps + 1, bool)
                    if not present[-1] and present.any():
                        # What follows is unknown: the agent is worth what it was when last seen.
                        worth[-1] = worth[np.flatnonzero(present)[-1]]
                        present = np.append(present[:-1], True)
                    cut = truncated & ~terminated
                    final = np.array(
                        [
                            self._worth(value, self._seen(made, n, t, c, True)) if cut[t] else 0.0
                            for t in range(steps)
                        ]
                    )
                    columns = slice(None) if self.team else slice(n, n + 1)
                    one = naive_advantages(
                        made.rewards[:, c, n].astype(np.float64), worth, final, terminated, truncated,
                        present, self.config.gamma, self.config.gae_lambda,
                    )  # fmt: skip
                    advantages[:, c, columns] = one[:, None]
                    kept[:, c, columns] = worth[:-1, None]
        return advantages, kept

    def _rows(self, agents: list[int], chosen: NDArray[np.bool_]) -> list[Row]:
        """Agent by agent, then step, then copy."""
        steps, copies = chosen.shape[:2]
        return [(n, t, c) for n in agents for t in range(steps) for c in range(copies) if chosen[t, c, n]]

    def _batches(self, rows: Sized, purpose: str, k: int, iteration: int) -> list[list[int]]:
        random, parts, batches = generator(self.seed, purpose, k, iteration), self.config.minibatches, []
        for _ in range(self.config.epochs):
            order = random.permutation(len(rows)).tolist()
            edges = [len(rows) * part // parts for part in range(parts + 1)]
            batches += [order[a:b] for a, b in pairwise(edges)]
        return batches

    def _improve(
        self, k: int, policy: Policy, made: Trajectory, advantages: Array, iteration: int, share: float
    ) -> None:
        config = self.config
        rows = self._rows(policy.agents, made.alive[:-1] & made.acting)
        observations = [made.observations[t, c, n].astype(np.float64) for n, t, c in rows]
        if config.normalise_observations:
            observations = [policy.moments.normalise(row) for row in observations]
        inputs = torch.tensor(np.array(observations))
        actions = torch.tensor(np.array([made.actions[t, c, n] for n, t, c in rows]))
        behaviour = torch.tensor([made.log_probs[t, c, n] for n, t, c in rows], dtype=DOUBLE)
        weights = np.array([advantages[t, c, n] for n, t, c in rows])
        if config.normalise_advantages:
            weights = (weights - weights.mean()) / (weights.std() + 1e-8)
        if config.order == "sequential":
            weights = weights * [self.factor[t, c] for _, t, c in rows]
        masks = None
        if self.spec.has_action_mask:
            masks = torch.tensor(np.array([made.action_masks[t, c, n] for n, t, c in rows]))
        seen = Rows(inputs, masks, actions, behaviour, torch.tensor(weights))
        with torch.no_grad():
            old = self._detached(policy.distribution(seen))
        if config.update == "a2c":
            self._one_step(policy, seen)
        elif config.update == "trpo":
            self._trusted_step(policy, seen, old, config.kl_bound * share**2)
        else:
            self._epochs(k, policy, seen, old, iteration)
        with torch.no_grad():
            ratio = (policy.distribution(seen).log_prob(actions) - behaviour).exp()
        for (_, t, c), one in zip(rows, ratio.tolist(), strict=True):
            self.factor[t, c] *= one if config.order == "sequential" else 1

    def _one_step(self, policy: Policy, rows: Rows) -> None:
        loss = torch.zeros((), dtype=DOUBLE)
        for i in range(len(rows.inputs)):
            row = rows.one(i)
            one = policy.distribution(row)
            loss = loss - (one.log_prob(row.actions) * row.weights)[0]
            loss = loss - self.config.entropy_coeff * one.entropy()[0]
        self._descend(policy.adam, policy.parameters(), loss / len(rows.inputs))

    def _trusted_step(self, policy: Policy, rows: Rows, old: Distribution, bound: float) -> None:
        """The Fisher matrix as the Hessian of the divergence, column by column, and a direct solution."""
        config, parameters = self.config, policy.parameters()
        start = _vector(parameters).detach()

        def surrogate() -> Tensor:
            now = policy.distribution(rows)
            gained: Tensor = (now.log_prob(rows.actions) - rows.behaviour).exp() * rows.weights
            return (gained + config.entropy_coeff * now.entropy()).mean()

        def divergence() -> Tensor:
            result: Tensor = kl_divergence(old, policy.distribution(rows))
            return result.mean()

        first = surrogate()
        gradient = _vector(torch.autograd.grad(first, parameters))
        slope = _vector(torch.autograd.grad(divergence(), parameters, create_graph=True))
        columns = [
            torch.autograd.grad(s, parameters, retain_graph=True, materialize_grads=True) for s in slope
        ]
        fisher = torch.stack([_vector(column) for column in columns])
        damped = fisher + config.cg_damping * torch.eye(len(start), dtype=DOUBLE)
        direction = torch.linalg.solve(damped, gradient)
        step = (2 * bound / (direction @ damped @ direction)).sqrt() * direction
        with torch.no_grad():
            for halvings in range(config.line_search_steps + 1):
                size = 0.5**halvings
                nn.utils.vector_to_parameters(start + size * step, parameters)
                enough = surrogate() - first >= config.accept_ratio * size * (gradient @ step)
                if enough and divergence() <= bound:
                    return
            nn.utils.vector_to_parameters(start, parameters)

    def _epochs(self, k: int, policy: Policy, rows: Rows, old: Distribution, iteration: int) -> None:
        config = self.config
        for batch in self._batches(rows.weights, "actor minibatch", k, iteration):
            loss = torch.zeros((), dtype=DOUBLE)
            for i in batch:
                row = rows.one(i)
                one = policy.distribution(row)
                ratio = (one.log_prob(row.actions) - row.behaviour).exp()[0]
                clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
                loss = loss - torch.minimum(ratio * row.weights[0], clipped * row.weights[0])
                loss = loss - config.entropy_coeff * one.entropy()[0]
                loss = loss + policy.kl_coeff * kl_divergence(self._row(old, i), one)[0]
            self._descend(policy.adam, policy.parameters(), loss / len(batch))
        with torch.no_grad():
            kl = float(kl_divergence(old, policy.distribution(rows)).mean())
        policy.kl_coeff *= 1.5 if kl > 2 * config.kl_target else 0.5 if kl < config.kl_target / 2 else 1

    def _detached(self, distribution: Any) -> Any:  # noqa: ANN401 - torch leaves it untyped
        if isinstance(distribution, Categorical):
            return Categorical(logits=distribution.logits.clone())
        normal = distribution.base_dist
        return Independent(Normal(normal.loc.clone(), normal.scale.clone()), 1)

    def _row(self, distribution: Any, i: int) -> Distribution:  # noqa: ANN401 - torch leaves it untyped
        if isinstance(distribution, Categorical):
            return Categorical(logits=distribution.logits[i : i + 1])
        normal = distribution.base_dist
        return Independent(Normal(normal.loc[i : i + 1], normal.scale[i : i + 1]), 1)

    def _descend(self, adam: torch.optim.Adam, tensors: list[nn.Parameter], loss: Tensor) -> None:
        for tensor, gradient in zip(tensors, torch.autograd.grad(loss, tensors), strict=True):
            tensor.grad = gradient
        if self.config.grad_clip is not None:
            nn.utils.clip_grad_norm_(tensors, self.config.grad_clip)
        adam.step()

    def _present(self, made: Trajectory) -> NDArray[np.bool_]:
        return np.ones_like(made.alive[:-1]) if self.team else made.alive[:-1]

    def _fit(self, k: int, value: Value, made: Trajectory, returns: Array, iteration: int) -> None:
        rows = self._rows(value.viewers, self._present(made))
        seen = [self._seen(made, n, t, c) for n, t, c in rows]
        if self.config.normalise_observations:
            seen = [value.inputs.normalise(row) for row in seen]
        targets = np.array([returns[t, c, n] for n, t, c in rows])
        if self.config.normalise_values:
            value.returns.include(list(targets))
            mean, std = value.returns.mean_std()
            targets = (targets - mean) / std
        for batch in self._batches(rows, "critic minibatch", k, iteration):
            loss = torch.zeros((), dtype=DOUBLE)
            for i in batch:
                error = (value.network(torch.from_numpy(seen[i]))[0] - targets[i]) ** 2
                bound = self.config.value_clip
                loss = loss + (error if bound is None else error.clamp(max=bound))
            self._descend(value.adam, list(value.network.parameters()), loss / len(batch))

    def _absorb(self, made: Trajectory) -> None:
        for policy in self.policies:
            rows = self._rows(policy.agents, made.alive[:-1])
            policy.moments.include([made.observations[t, c, n].astype(np.float64) for n, t, c in rows])
        for value in self.values:
            rows = self._rows(value.viewers, self._present(made))
            value.inputs.include([self._seen(made, n, t, c) for n, t, c in rows])


def _assert_same(stacked: StackedMLP, p: int, network: nn.Sequential) -> None:
    expected = list(network.parameters())
    for i, (weight, bias) in enumerate(zip(stacked.weights, stacked.biases, strict=True)):
        torch.testing.assert_close(weight[p], expected[2 * i], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(bias[p, :, 0], expected[2 * i + 1], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("config", "spec"), quick_or_slow(CASES, "ippo box, relu", "mappo team", "itrpo", "haa2c")
)
def test_an_update_equals_the_naive_one(config: AlgoConfig, spec: EnvSpec) -> None:
    seeds, copies = (4, 8), 2
    learner = OnPolicyLearner(config, spec, seeds, "cpu")
    replicas = []
    for r, seed in enumerate(seeds):
        replicas.append((r, Naive(config, spec, seed, OnPolicyLearner(config, spec, (seed,), "cpu"))))
    for iteration in (1, 2):
        made = fabricate(spec, 8, 2 * copies, seed=iteration, absent=0.2, idle=0.2, leaves=0.03)
        learner.update(poisoned(made), iteration, iteration / 4)
        for r, naive in replicas:
            naive.update(made.of_copies(r * copies, copies), iteration, iteration / 4)
    for r, naive in replicas:
        for k, policy in enumerate(naive.policies):
            p = r * len(naive.policies) + k
            _assert_same(learner.actor.network, p, policy.network)
            if getattr(config, "kl_coeff", 0.0) > 0:
                assert float(learner.policy_update.state_dict()["kl_coeff"][p]) == pytest.approx(
                    policy.kl_coeff, rel=1e-12
                )
            if policy.log_std is not None and learner.actor.log_std is not None:
                torch.testing.assert_close(
                    learner.actor.log_std[p, :, 0], policy.log_std, rtol=1e-10, atol=1e-10
                )
        for k, value in enumerate(naive.values):
            _assert_same(learner.critic.networks.network, r * len(naive.values) + k, value.network)
