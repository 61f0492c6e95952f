"""Gradients of asynchronous workers: their values, staleness, and that policies learn from them."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, Normal

from headway.contracts import Box, Discrete, EnvSpec, HeadwayError, Trajectory
from headway.rollout.async_collector import SerialContributors
from headway.rollout.episodes import evaluate_rule
from headway.rollout.plan import RolloutPlan
from headway.training.modes import AsynchronousMode
from headway_algos.config import ModelConfig
from headway_algos.on_policy.a3c_learner import A2CContributor, AsynchronousA2CLearner
from headway_algos.registry import ENTRIES, configure
from headway_envs.toy.entry import ENTRIES as TOYS

DOUBLE = torch.float64
DISCRETE = EnvSpec("made", ("a", "b", "c"), 3, Discrete(3), has_action_mask=True, agents_come_and_go=True)
BOX = replace(DISCRETE, action_space=Box((-1.0, -1.0), (1.0, 1.0)), has_action_mask=False)
CONFIG = configure(
    "a3c", policies="independent", model=ModelConfig(hidden=(6,), actor_gain=0.5), precision="float64",
    lr=1e-2, critic_lr=3e-3, lr_end=0.5, entropy_coeff=0.3, grad_clip=0.2, normalise_advantages=False,
    normalise_observations=False, normalise_values=False,
)  # fmt: skip
SEED = 4
Made = Callable[..., Trajectory]
Arrays = Mapping[str, NDArray[Any]]
Advantages = Callable[..., NDArray[np.float64]]


class NaiveAgent:
    """An agent's actor and critic as torch.nn modules with published parameters."""

    def __init__(self, published: Arrays, agent: int) -> None:
        self.agent = agent
        self.actor, self.critic = _module(published, "actor", agent), _module(published, "critic", agent)
        self.log_std: nn.Parameter | None = None
        if "actor.log_std" in published:
            self.log_std = nn.Parameter(torch.tensor(published["actor.log_std"][agent, :, 0]))
        self.adams = {
            "actor": torch.optim.Adam(self.tensors("actor"), CONFIG.lr, eps=1e-5),
            "critic": torch.optim.Adam(self.tensors("critic"), CONFIG.critic_lr or 0.0, eps=1e-5),
        }

    def tensors(self, part: str) -> list[nn.Parameter]:
        if part == "critic":
            return list(self.critic.parameters())
        return [*self.actor.parameters(), *([] if self.log_std is None else [self.log_std])]

    def gradients(self, made: Trajectory, advantages_of: Advantages) -> dict[str, tuple[Tensor, ...]]:
        """Return the gradients of each part's loss, over the steps at which the agent was present, or
        acted."""
        n, losses = self.agent, {name: torch.zeros((), dtype=DOUBLE) for name in ("actor", "critic")}
        there, acted = made.alive[:-1, :, n].sum(), (made.alive[:-1] & made.acting)[:, :, n].sum()
        for c in range(made.rewards.shape[1]):
            present = made.alive[:, c, n]
            seen = [torch.tensor(made.observations[t, c, n], dtype=DOUBLE) for t in range(len(present))]
            final = [torch.tensor(row, dtype=DOUBLE) for row in made.final_observations[:, c, n]]
            worth = [self.critic(row)[0] for row in seen]
            values = np.array([value.item() for value in worth])
            ends = np.array([self.critic(row).item() for row in final])
            if not present[-1] and present.any():
                # What follows is unknown: the agent is worth what it was when last seen.
                values[-1] = values[np.flatnonzero(present)[-1]]
                present = np.append(present[:-1], True)
            advantages = advantages_of(
                made.rewards[:, c, n].astype(np.float64), values, ends,
                made.terminated[:, c, n], made.truncated[:, c, n], present, CONFIG.gamma, CONFIG.gae_lambda,
            )  # fmt: skip
            for t in np.flatnonzero(present[:-1]):
                target = advantages[t] + values[t]
                losses["critic"] = losses["critic"] + (worth[t] - target) ** 2 / there
                if made.acting[t, c, n]:
                    masks = made.action_masks[t, c, n] if len(made.action_masks) else None
                    policy = self.policy(seen[t], masks)
                    gain = policy.log_prob(torch.tensor(made.actions[t, c, n])) * float(advantages[t])
                    losses["actor"] = losses["actor"] - (gain + 0.3 * policy.entropy()) / acted
        return {part: torch.autograd.grad(loss, self.tensors(part)) for part, loss in losses.items()}

    def policy(self, seen: Tensor, masks: NDArray[np.bool_] | None) -> Any:  # noqa: ANN401 - torch leaves it untyped
        outputs = self.actor(seen)
        if self.log_std is not None:
            return Independent(Normal(outputs, self.log_std.exp()), 1)
        return Categorical(logits=outputs.masked_fill(~torch.tensor(masks), -400.0))

    def apply(self, gradients: Mapping[str, tuple[Tensor, ...]], share: float) -> None:
        for part, adam in self.adams.items():
            for tensor, gradient in zip(self.tensors(part), gradients[part], strict=True):
                tensor.grad = gradient.clone()
            nn.utils.clip_grad_norm_(self.tensors(part), 0.2)
            adam.param_groups[0]["lr"] = share * (CONFIG.lr if part == "actor" else CONFIG.critic_lr or 0.0)
            adam.step()


def _module(published: Arrays, part: str, agent: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i in range(2):
        weight, bias = (published[f"{part}.network.{kind}.{i}"][agent] for kind in ("weights", "biases"))
        linear = nn.Linear(weight.shape[1], weight.shape[0], dtype=DOUBLE)
        linear.weight.data, linear.bias.data = torch.tensor(weight), torch.tensor(bias[:, 0])
        layers += [linear, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def _assert_alike(naive: NaiveAgent, published: Arrays) -> None:
    expected = NaiveAgent(published, naive.agent)
    for part in ("actor", "critic"):
        for mine, theirs in zip(naive.tensors(part), expected.tensors(part), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("spec", [DISCRETE, BOX])
def test_unused_slots_change_no_contribution(
    fabricate: Made,
    poisoned: Callable[[Trajectory], Trajectory],
    monkeypatch: pytest.MonkeyPatch,
    spec: EnvSpec,
) -> None:
    """Equal to a worker that computes every slot, for two, one, no and three agents."""
    shared = replace(CONFIG, policies="shared", normalise_observations=True, normalise_values=True)
    roomy = replace(spec, agents=tuple("abcdefgh"))
    leaving_out, whole = (A2CContributor(shared, roomy, (SEED,)) for _ in range(2))
    monkeypatch.setattr(whole.learner, "_drop_unused_slots", lambda trajectory: trajectory)
    published = AsynchronousA2CLearner(shared, roomy, (SEED,), "cpu").published()
    for number, last in enumerate((2, 1, 0, 3), start=1):
        made = fabricate(roomy, 8, 2, seed=number, absent=0.3, idle=0.2, leaves=0.05)
        made.alive[:, :, last:] = False
        made.alive[0, 0, :last] = made.acting[0, 0, :last] = True
        made.acting[:] &= made.alive[:-1]
        leaving_out.adopt(published)
        whole.adopt(published)
        found, expected = (each.contribute(poisoned(made), number) for each in (leaving_out, whole))
        assert found.arrays.keys() == expected.arrays.keys()
        for name, array in expected.arrays.items():
            np.testing.assert_allclose(found.arrays[name], array, rtol=1e-9, atol=1e-12, err_msg=name)
        for name, metric in expected.metrics.items():
            np.testing.assert_allclose(found.metrics[name], metric, rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("spec", [DISCRETE, BOX])
def test_a_stale_gradient_is_applied_to_the_current_parameters(
    fabricate: Made, poisoned: Callable[[Trajectory], Trajectory], naive_advantages: Advantages, spec: EnvSpec
) -> None:
    """Two workers start from the same parameters; the second gradient arrives after the first was applied.

    Against plain modules, row by row; an agent without data in the second rollout stays unchanged.
    """
    learner = AsynchronousA2CLearner(CONFIG, spec, (SEED,), "cpu")
    workers = [A2CContributor(CONFIG, spec, (SEED,)) for _ in range(2)]
    rollouts = [fabricate(spec, 9, 2, seed, absent=0.2, idle=0.2, leaves=0.1) for seed in (1, 2)]
    rollouts[1].alive[..., 2] = rollouts[1].acting[..., 2] = False
    published = learner.published()
    agents = [NaiveAgent(published, n) for n in range(3)]
    for agent in agents:
        seen = rollouts if agent.agent < 2 else rollouts[:1]
        gradients = [agent.gradients(made, naive_advantages) for made in seen]  # all before any step
        for gradient, share in zip(gradients, (1.0, 0.75), strict=False):
            agent.apply(gradient, share)
    contributions = []
    for worker, made in zip(workers, rollouts, strict=True):
        worker.adopt(published)
        contributions.append(worker.contribute(poisoned(made), 1))
    for contribution, progress in zip(contributions, (0.0, 0.5), strict=True):
        learner.apply(contribution, 1, progress)
    for agent in agents:
        _assert_alike(agent, learner.published())


def test_contributions_of_compiled_kernels_equal_torch_and_stay_unchanged(fabricate: Made) -> None:
    """Workers use compiled kernels in float32, torch in float64."""
    found, expected = [], []
    for precision, contributions in (("float32", found), ("float64", expected)):
        config = replace(CONFIG, precision=precision, grad_clip=None)
        worker = A2CContributor(config, BOX, (SEED,))
        for seed in (1, 2):
            worker.adopt(AsynchronousA2CLearner(config, BOX, (SEED,), "cpu").published())
            contributions.append(worker.contribute(fabricate(BOX, 9, 2, seed), 1).arrays)
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.keys() == theirs.keys()
        for name, array in theirs.items():
            np.testing.assert_allclose(ours[name], array, rtol=1e-3, atol=1e-5, err_msg=name)
        assert all(np.any(array) for name, array in ours.items() if "gradient" in name)


def test_a_workers_gradient_depends_on_the_adopted_parameters_only(fabricate: Made) -> None:
    """Regardless of its earlier contributions."""
    learner = AsynchronousA2CLearner(CONFIG, BOX, (SEED,), "cpu")
    used, fresh = (A2CContributor(CONFIG, BOX, (SEED,)) for _ in range(2))
    published = learner.published()
    for seed in (1, 2):
        used.adopt(published)
        used.contribute(fabricate(BOX, 9, 2, seed), 1)
    made = fabricate(BOX, 9, 2, 3)
    given = [worker.adopt(published) for worker in (used, fresh)]
    for name, array in given[0].items():
        np.testing.assert_array_equal(array, given[1][name])
    one, other = (worker.contribute(made, 2).arrays for worker in (used, fresh))
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


def test_divergence_in_a_worker_names_the_contribution(fabricate: Made) -> None:
    worker = A2CContributor(CONFIG, BOX, (SEED,))
    published = AsynchronousA2CLearner(CONFIG, BOX, (SEED,), "cpu").published()
    published["critic.network.weights.0"][:] = np.nan
    worker.adopt(published)
    with pytest.raises(HeadwayError, match=rf"a3c diverged: .* seed {SEED} .* at contribution 7;"):
        worker.contribute(fabricate(BOX, 9, 2, 1), 7)


def test_normalisers_cover_the_data_of_all_workers(fabricate: Made) -> None:
    config = replace(CONFIG, normalise_observations=True, normalise_values=True)
    learner = AsynchronousA2CLearner(config, DISCRETE, (SEED,), "cpu")
    workers = [A2CContributor(config, DISCRETE, (SEED,)) for _ in range(2)]
    rollouts = [fabricate(DISCRETE, 9, 2, seed, absent=0.2) for seed in (1, 2)]
    published = learner.published()
    for worker in workers:
        worker.adopt(published)
    for worker, made in zip(workers, rollouts, strict=True):
        learner.apply(worker.contribute(made, 1), 1, 0.0)
    after = learner.published()
    for n in range(3):
        seen = np.concatenate([m.observations[:-1, :, n][m.alive[:-1, :, n]] for m in rollouts]).astype(float)
        for part in ("actor.moments", "critic.input_moments"):
            np.testing.assert_allclose(after[f"{part}.mean"][n, 0], seen.mean(axis=0))
            np.testing.assert_allclose(after[f"{part}.variance"][n, 0], seen.var(axis=0))
        assert after["critic.return_moments.count"][n, 0, 0] == len(seen)


def test_published_parameters_are_copies(fabricate: Made) -> None:
    """A rollout may be repeated, or stored in a checkpoint, while other workers' updates are applied."""
    learner = AsynchronousA2CLearner(CONFIG, BOX, (SEED,), "cpu")
    worker = A2CContributor(CONFIG, BOX, (SEED,))
    published = learner.published()
    kept = {name: array.copy() for name, array in published.items()}
    worker.adopt(published)
    learner.apply(worker.contribute(fabricate(BOX, 9, 2, 1), 1), 1, 0.0)
    for name, array in published.items():
        np.testing.assert_array_equal(array, kept[name])
    assert not np.array_equal(learner.published()["actor.network.weights.0"], kept["actor.network.weights.0"])


@pytest.mark.parametrize("setting", [{"epochs": 2}, {"minibatches": 2}, {"shared_until": 0.5}])
def test_settings_without_effect_are_refused(setting: Mapping[str, Any]) -> None:
    with pytest.raises(TypeError, match=next(iter(setting))):
        configure("a3c", **setting)


def _learned(
    env: str, arguments: Mapping[str, Any], settings: Mapping[str, Any], iterations: int
) -> tuple[float, float, float]:
    """Returns of greedy, random and optimal play, after training with four workers in turns, so that
    gradients are stale by three updates."""
    toy, entry, copies, steps = TOYS[env], ENTRIES["a3c"], 8, 32
    prepared, config = toy.prepare(toy.config(**arguments)), entry.config(**settings)
    spec = toy.make(prepared, 1).spec
    policy = entry.acting_policy(config, spec)
    learner = entry.learner(config, spec, (SEED,), "cpu")
    assert isinstance(learner, AsynchronousA2CLearner)
    assert entry.contributor is not None
    plan = RolloutPlan(
        toy.make, (), prepared, spec, policy, (SEED,), copies, steps, copies // 4,
        make_contributor=partial(entry.contributor, config, spec, (SEED,)),
    )  # fmt: skip
    contributors = SerialContributors(plan)
    mode = AsynchronousMode(learner, contributors, iterations=1000)
    contributors.begin()
    for iteration in range(1, iterations + 1):
        done = mode.iterate(iteration, (iteration - 1) / iterations)
    assert done.metrics["staleness/mean"][0] == 3
    (learned,) = contributors.evaluate(77, 20, True, learner.acting_parameters())
    contributors.close()
    played = [
        evaluate_rule(toy.make, toy.rules[rule].make, prepared, 77, 20) for rule in ("random", "optimal")
    ]
    greedy, random, best = (
        float(np.mean([float(row["return"]) for row in rows])) for rows in (learned, *played)
    )
    return greedy, random, best


def test_stale_gradients_reach_the_optimum_of_a_matrix_game() -> None:
    game = {"payoff": ((11.0, 6.0, 4.0), (6.0, 5.0, 3.0), (4.0, 3.0, 2.0))}
    assert _learned("matrix", game, {"lr": 1e-2, "entropy_coeff": 0.1}, 20)[0] == 11.0


@pytest.mark.slow
def test_stale_gradients_reach_nearly_the_optimal_tracking_cost() -> None:
    """The cost is at most 1.6 times the optimal one; random play costs hundreds of times as much."""
    # A standard deviation of 0.3 in [-1, 1]: good actions take a small part of the range.
    model = ModelConfig(hidden=(32, 32), activation="relu", log_std=-1.2)
    settings = {
        "policies": "shared", "model": model, "gamma": 0.8, "lr": 5e-3, "lr_end": 0.02, "entropy_coeff": 0.0,
        "normalise_observations": False,
    }  # fmt: skip
    greedy, random, best = _learned("tracking", {"steps": 20}, settings, 60)
    assert greedy > 1.6 * best
    assert random < 100 * best


@pytest.mark.slow
def test_stale_gradients_come_near_the_optimum_with_agents_that_come_and_go() -> None:
    """Training closes at least 0.96 of the gap between random and optimal play."""
    settings = {"policies": "shared", "gamma": 0.9, "lr": 3e-3, "lr_end": 0.1}
    greedy, random, best = _learned("visitors", {}, settings, 20)
    assert (greedy - random) / (best - random) > 0.96
