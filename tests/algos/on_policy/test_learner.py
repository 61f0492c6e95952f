"""The learner as a whole: absent agents, components of others, and what it refuses.

That its updates are right, `test_against_naive` shows; that no seed depends on its stack, and that training
is resumed exactly, `test_per_seed_learner`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from learned import assert_close, assert_equal, of_agents, tensors
from made_trajectories import BOX, DISCRETE, STATE, TEAM, fabricate, poisoned
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import EnvSpec, HeadwayError, Trajectory
from headway_algos import components
from headway_algos.batches.layout import Layout
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.components import CRITICS, ORDERS, UPDATES, Component, component
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.updates import Update
from headway_algos.registry import configure

TEAM_BOX = replace(TEAM, action_space=BOX.action_space, has_action_mask=False)
MODEL = ModelConfig(hidden=(8, 8), actor_gain=0.5)
SETTINGS: dict[str, Any] = {
    "policies": "independent", "model": MODEL, "precision": "float64", "lr": 3e-3, "minibatches": 3,
    "epochs": 2,
}  # fmt: skip
IPPO = configure("ippo", **SETTINGS, kl_coeff=0.2, value_clip=5.0)
MAPPO = configure("mappo", **SETTINGS)
COMA = configure("coma", **SETTINGS, gae_lambda=0.8, target_every=2)
IA2C, MAA2C = configure("ia2c", **SETTINGS), configure("maa2c", **SETTINGS)
ITRPO, MATRPO = configure("itrpo", **SETTINGS), configure("matrpo", **SETTINGS)
HAPPO, HATRPO = configure("happo", **SETTINGS, kl_coeff=0.2), configure("hatrpo", **SETTINGS)
MAACKTR = configure("maacktr", model=MODEL, precision="float64", kfac_every=2, kfac_momentum=0.5)
KFAC: dict[str, Any] = {**SETTINGS, "update": "kfac", "critic_update": "kfac"}
RECURRENT = ModelConfig(hidden=(8,), core="gru", gru_size=4, sequence_length=5)
every_case = pytest.mark.parametrize(
    ("config", "spec"),
    [
        (replace(IPPO, policies="groups"), DISCRETE),
        (replace(IPPO, model=RECURRENT, value_clip=None, policies="groups"), BOX),
        (replace(MAPPO, critic_actions="others"), TEAM_BOX),
        (replace(MAPPO, model=RECURRENT, policies="shared", critic_actions="others"), TEAM),
        (replace(COMA, policies="shared"), replace(DISCRETE, shared_reward=True)),
        (replace(COMA, model=RECURRENT), TEAM),
        (replace(IA2C, policies="groups"), BOX),
        (ITRPO, DISCRETE),
        (MAACKTR, DISCRETE),
        (HAPPO, TEAM),
        (replace(HATRPO, model=RECURRENT, cg_iterations=2), TEAM),
        (configure("custom", **KFAC, critic="central", order="sequential"), TEAM_BOX),
        (configure("custom", **KFAC, critic="counterfactual"), STATE),
        (replace(configure("custom", **SETTINGS, critic="event"), policies="shared"), BOX),
        (configure("custom", **SETTINGS | {"model": RECURRENT}, critic="event"), DISCRETE),
    ],
)
"""Every critic, update, order, kind of action and sharing of policies."""


def _units(config: AlgoConfig) -> int:
    return config.model.gru_size if config.model.core == "gru" else 0


def _numbers(module: torch.nn.Module) -> dict[str, NDArray[Any]]:
    return tensors(module.state_dict())


def _tensors(learner: OnPolicyLearner) -> dict[str, NDArray[Any]]:
    """Every tensor that learning changes, with leading axis P."""
    return tensors(learner.state_dict())


@pytest.mark.parametrize(
    ("config", "spec"),
    [
        (IPPO, DISCRETE), (MAPPO, STATE), (IA2C, BOX), (ITRPO, BOX), (MATRPO, STATE),
        (replace(MAACKTR, policies="independent"), DISCRETE),
    ],
)  # fmt: skip
def test_an_independent_policy_trains_alone_as_among_others(config: AlgoConfig, spec: EnvSpec) -> None:
    among = OnPolicyLearner(config, spec, (5,), "cpu")
    alone = OnPolicyLearner(config, replace(spec, agents=("a",), groups=("x",)), (5,), "cpu")
    for iteration in range(1, 4):
        made = fabricate(spec, 8, 3, seed=iteration, absent=0.4, idle=0.2)
        made.alive[:, :, 0] |= made.alive[:, :, 1]  # numbers of valid rows differ
        made.acting[:, :, 0] = made.alive[:-1, :, 0]
        among.update(made, iteration, 0.0)
        alone.update(of_agents(made, slice(0, 1)), iteration, 0.0)
    assert_close({name: value[:1] for name, value in _tensors(among).items()}, _tensors(alone))


@every_case
def test_poisoned_rows_without_experience_change_nothing(config: AlgoConfig, spec: EnvSpec) -> None:
    clean, bad = (OnPolicyLearner(config, spec, (1, 2), "cpu") for _ in range(2))
    for iteration in range(1, 3):
        made = fabricate(spec, 10, 6, iteration, 0.4, idle=0.3, leaves=0.05, hidden_size=_units(config))
        made.acting[:, :, 1] &= iteration < 2  # and one who never acts
        expected = clean.update(made, iteration, 0.0)
        for name, value in bad.update(poisoned(made), iteration, 0.0).items():
            np.testing.assert_array_equal(value, expected[name], err_msg=name)
    assert_equal(_tensors(bad), _tensors(clean))
    assert all(np.isfinite(value).all() for value in _tensors(bad).values())


@pytest.mark.parametrize(
    ("config", "spec"),
    [
        (IPPO, DISCRETE), (IPPO, BOX), (IPPO, replace(DISCRETE, shared_reward=True)),
        (IPPO, replace(DISCRETE, shared_in_groups=True)), (IA2C, DISCRETE), (ITRPO, BOX),
        (MAACKTR, replace(DISCRETE, shared_reward=True)),
    ],
)  # fmt: skip
def test_unused_slots_do_nothing(monkeypatch: pytest.MonkeyPatch, config: AlgoConfig, spec: EnvSpec) -> None:
    """A learner that trims unused slots, a different number per iteration and once all, trains the same as
    one that trims none. One agent appears after the last step, when the others have left: the team's value
    there depends on that agent only."""
    shared = replace(config, policies="shared")
    roomy = replace(spec, agents=tuple("abcdefghi"), groups=tuple("xyxxyyzxz"))
    tight, wide = OnPolicyLearner(shared, spec, (1, 2), "cpu"), OnPolicyLearner(shared, roomy, (1, 2), "cpu")
    monkeypatch.setattr(tight, "_drop_unused_slots", lambda trajectory: trajectory)
    for iteration, last in ((1, 4), (2, 2), (3, 0), (4, 3)):
        made = fabricate(roomy, 8, 6, seed=iteration, absent=0.3, idle=0.2, leaves=0.05)
        made.alive[:, :, last:] = False
        if last:
            made.alive[0, 0, last - 1] = made.acting[0, 0, last - 1] = True
        if last == 3:
            made.alive[:-1, :, 2] = made.alive[-1, :, :2] = False
            made.alive[-1, :, 2] = True
        made.acting[:] &= made.alive[:-1]
        expected = tight.update(of_agents(made, slice(0, 4)), iteration, 0.0)
        for name, value in wide.update(poisoned(made), iteration, 0.0).items():
            np.testing.assert_allclose(value, expected[name], rtol=1e-9, err_msg=name)
    assert_close(_tensors(wide), _tensors(tight))


def test_a_state_of_another_shape_is_refused() -> None:
    small = OnPolicyLearner(IPPO, DISCRETE, (1,), "cpu")
    with pytest.raises(RuntimeError, match="size mismatch"):
        small.load_state_dict(OnPolicyLearner(IPPO, DISCRETE, (1, 2), "cpu").state_dict())


class PlainGradient:
    """One step of the policy gradient: a further update, with its own state."""

    def __init__(self, actor: Actor, config: AlgoConfig, layout: Layout) -> None:
        self.actor, self.lr, self.share, self.improvements = actor, config.lr, 1.0, 0

    def improve(
        self, rows: PolicyBatch, advantages: Tensor, generators: Sequence[np.random.Generator]
    ) -> dict[str, Tensor]:
        chosen = torch.from_numpy(rows.selected)
        log_probs = self.actor(rows.observations, rows.masks).log_prob(rows.actions)
        gains = torch.where(chosen, log_probs * advantages, 0).sum(1) / chosen.sum(1).clamp(min=1)
        parameters = list(self.actor.parameters())
        slopes = torch.autograd.grad(gains.sum(), parameters)
        with torch.no_grad():
            for parameter, slope in zip(parameters, slopes, strict=True):
                parameter += self.lr * self.share * slope
        self.improvements += 1
        return {"gain": gains.detach()}

    def anneal(self, share: float) -> None:
        self.share = share

    def state_dict(self) -> dict[str, Any]:
        return {"improvements": self.improvements}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.improvements = state["improvements"]


def _each_in_turn(
    update: Update,
    grouping: Grouping,
    rows: PolicyBatch,
    advantages: Tensor,
    generators: Sequence[np.random.Generator],
    order_generators: Sequence[np.random.Generator],
) -> dict[str, Tensor]:
    """An order that updates agents with independent policies one after another."""
    gains = torch.zeros(len(rows.selected), dtype=advantages.dtype)
    for p in range(len(rows.selected)):
        mine = np.zeros_like(rows.selected)
        mine[p] = rows.selected[p]
        gains += update.improve(replace(rows, selected=mine), advantages, generators)["gain"]
    return {"gain": gains}


def test_critic_update_and_order_are_three_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    """A further update and a further order join by name; a plain gradient step of independent policies is the
    same in sequential and simultaneous order."""
    monkeypatch.setitem(UPDATES, "gradient", Component("", AlgoConfig, PlainGradient))
    monkeypatch.setitem(ORDERS, "in turn", Component("", AlgoConfig, _each_in_turn))
    results = []
    for order in ("simultaneous", "in turn"):
        choices: dict[str, Any] = {"update": "gradient", "order": order}
        learner = OnPolicyLearner(replace(IPPO, **choices), DISCRETE, (1, 2), "cpu")
        start = _numbers(learner.actor)
        info = learner.update(fabricate(DISCRETE, 8, 6, seed=0, absent=0.3), 1, 0.0)
        assert info["policy/gain"].shape == (2,)
        results.append(_numbers(learner.actor))
        assert (results[-1]["network.weights.0"] != start["network.weights.0"]).any(axis=(1, 2)).all()
        improvements = learner.state_dict()["policy_update"]["improvements"]
        assert improvements == (1 if order == "simultaneous" else 8)
        other = OnPolicyLearner(replace(IPPO, **choices), DISCRETE, (1, 2), "cpu")
        other.load_state_dict(learner.state_dict())
        assert other.state_dict()["policy_update"]["improvements"] == improvements
    assert_close(results[1], results[0])


@pytest.mark.parametrize("kind", ["critic", "update", "critic_update", "order"])
def test_components_of_other_packages_train(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of each kind that does what Headway's own does, under another name, trains the same."""
    own = component(kind, getattr(IPPO, kind))
    point = SimpleNamespace(load=lambda: own, value="elsewhere:component")
    monkeypatch.setattr(components, "_others", lambda group: {"elsewhere": point} if group == kind else {})
    config = configure("custom", **{kind: "elsewhere"})
    numbers = []
    for each in (config, replace(config, **{kind: getattr(IPPO, kind)})):
        learner = OnPolicyLearner(each, DISCRETE, (1,), "cpu")
        start = _numbers(learner.actor)["network.weights.0"]
        learner.update(fabricate(DISCRETE, 8, 3, seed=0), 1, 0.0)
        numbers.append(_numbers(learner.actor))
        assert (numbers[-1]["network.weights.0"] != start).any()
    assert_close(*numbers)


class RewardAbovePar:
    """A critic without networks: reward minus the mean of earlier rewards; one viewpoint, or N."""

    exchangeable_agents = False

    def __init__(
        self,
        config: AlgoConfig,
        spec: EnvSpec,
        grouping: Grouping,
        seeds: Sequence[int],
        device: torch.device,
        dtype: torch.dtype,
        viewpoints: int = 4,
    ) -> None:
        self.par, self.share, self.seen, self.viewpoints = np.zeros(len(seeds)), 1.0, 0, viewpoints

    def estimate(self, trajectory: Trajectory, behaviour: BehaviourPolicy, iteration: int) -> CriticEstimate:
        rewards = trajectory.rewards[:, :, : self.viewpoints].astype(np.float64)
        values = np.repeat(self.par, rewards.shape[1] // len(self.par))[:, None] + np.zeros_like(rewards)
        there = np.ones_like(rewards, np.bool_)
        return CriticEstimate(rewards - values, values, rewards, there, torch.empty(0))

    def fit(self, estimate: CriticEstimate, iteration: int) -> dict[str, NDArray[np.float64]]:
        self.par = estimate.returns.reshape(len(estimate.returns), len(self.par), -1).mean(axis=(0, 2))
        return {"par": self.par}

    def update_normalisers(self, trajectory: Trajectory) -> None:
        self.seen += len(trajectory.rewards)

    def anneal(self, share: float) -> None:
        self.share = share

    def state_dict(self) -> dict[str, Any]:
        return {"networks": {}, "par": torch.from_numpy(self.par), "seen": self.seen}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.par, self.seen = state["par"].numpy(), state["seen"]


def test_a_custom_critic_joins_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """The learner uses its advantages and stores its state. A team's advantage is that of all its agents."""
    own: dict[str, Any] = {"critic": "above par"}
    made = [fabricate(TEAM, 6, 4, seed=seed, absent=0.2) for seed in (0, 1)]
    results = []
    for viewpoints in (1, 4):
        critic = partial(RewardAbovePar, viewpoints=viewpoints)
        monkeypatch.setitem(CRITICS, "above par", Component("", AlgoConfig, critic))
        config = replace(MAPPO, **own, lr_end=0.5)
        first, other = (OnPolicyLearner(config, TEAM, (1, 2), "cpu") for _ in range(2))
        start = _numbers(first.actor)["network.weights.0"]
        info = first.update(made[0], 1, 1.0)
        by_replica = made[0].rewards.astype(np.float64).reshape(6, 2, 2, 4)
        np.testing.assert_allclose(info["critic/par"], by_replica.mean(axis=(0, 2, 3)), rtol=1e-12)
        assert isinstance(first.critic, RewardAbovePar)
        assert (first.critic.share, first.critic.seen) == (0.5, 6)
        assert (_numbers(first.actor)["network.weights.0"] != start).any(axis=(1, 2)).all()
        other.load_state_dict(first.state_dict())
        for learner in (first, other):
            learner.update(made[1], 2, 0.0)
        assert other.state_dict()["critic"]["seen"] == 12
        assert_close(_numbers(other.actor), _numbers(first.actor))
        results.append(_numbers(first.actor))
    assert_close(*results)


@every_case
def test_an_iteration_without_live_agents_changes_no_policy(config: AlgoConfig, spec: EnvSpec) -> None:
    learner = OnPolicyLearner(config, spec, (1,), "cpu")
    learner.update(fabricate(spec, 6, 2, seed=0, hidden_size=_units(config)), 1, 0.0)
    before = _tensors(learner)
    info = learner.update(fabricate(spec, 6, 2, seed=1, absent=1.1, hidden_size=_units(config)), 2, 0.0)
    for name, value in _tensors(learner).items():
        if name.startswith("actor"):
            np.testing.assert_array_equal(value, before[name], err_msg=name)
    # Metrics of training that did not take place are missing, instead of 0.
    assert not any(np.isinf(value).any() for value in info.values())
    if config.update in ("ppo", "a2c"):
        assert np.isnan(info["policy/entropy"]).all()


@pytest.mark.parametrize("normalise", [True, False])
def test_values_are_in_units_of_return(normalise: bool) -> None:
    """The critic learns 50 from a constant reward of 50 at the end of each episode, in either case."""
    steps: dict[str, Any] = {"epochs": 20, "minibatches": 1, "lr": 1e-9, "critic_lr": 0.1}
    config = replace(IPPO, **steps, normalise_values=normalise, value_clip=None, precision="float32")
    learner = OnPolicyLearner(config, DISCRETE, (1,), "cpu")
    for iteration in range(1, 13):
        made = fabricate(DISCRETE, 8, 4, seed=iteration, ends=1.1)
        made.rewards[:], made.terminated[:], made.truncated[:] = 50, True, False
        learner.update(made, iteration, 0.0)
    np.testing.assert_allclose(learner.critic.estimate(made, learner.behaviour, 13).values, 50, rtol=0.05)


def test_missing_and_unknown_devices_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(HeadwayError, match="device=auto or device=cpu"):
        OnPolicyLearner(IPPO, DISCRETE, (1,), "cuda")
    assert OnPolicyLearner(IPPO, DISCRETE, (1,), "auto").device.type == "cpu"
    with pytest.raises(HeadwayError, match="'gpu' is not a device; use device=auto, cpu or cuda"):
        OnPolicyLearner(IPPO, DISCRETE, (1,), "gpu")


@pytest.mark.parametrize(
    ("policies", "owner", "spec"),
    [("independent", "agent c", BOX), ("groups", "group y", DISCRETE), ("shared", "all agents", DISCRETE)],
)
def test_a_policy_that_is_no_longer_finite_is_named(
    policies: Literal["independent", "groups", "shared"], owner: str, spec: EnvSpec
) -> None:
    learner = OnPolicyLearner(replace(IPPO, policies=policies), spec, (4, 6), "cpu")
    k = {"independent": 2, "groups": 1, "shared": 0}[policies]
    with torch.no_grad():
        learner.actor.network.weights[1][learner.grouping.num_policies + k, 0, 0] = np.nan
    with pytest.raises(HeadwayError) as caught:
        learner.update(fabricate(spec, 4, 2, seed=0), 7, 0.0)
    message = str(caught.value)
    assert f"ippo diverged: the policy of {owner}, seed 6, is not finite after iteration 7" in message
    assert "lower algo.lr" in message
    assert "algo.grad_clip" in message
    assert "\n" not in message


@pytest.mark.parametrize("spec", [DISCRETE, BOX])
def test_an_absurd_learning_rate_ends_in_one_line(spec: EnvSpec) -> None:
    config = replace(MAPPO, lr=1e30, precision="float32", normalise_values=False)
    learner = OnPolicyLearner(config, spec, (1,), "cpu")

    def learn() -> None:
        for iteration in range(1, 20):
            learner.update(fabricate(spec, 8, 3, seed=iteration), iteration, 0.0)

    with pytest.raises(HeadwayError, match=r"mappo diverged: the (policy of .*|critic of) seed 1"):
        learn()


@pytest.mark.parametrize("config", [IPPO, MATRPO, MAA2C, COMA, MAACKTR])
def test_a_critic_that_is_no_longer_finite_is_named_whatever_the_update(config: AlgoConfig) -> None:
    """A trust region would reject every step on its values, and train on without effect."""
    learner = OnPolicyLearner(config, TEAM, (4, 6), "cpu")
    made = fabricate(TEAM, 4, 4, seed=0)
    for tensor in learner.critic.state_dict()["networks"].values():
        tensor[len(tensor) // 2 :] = np.nan  # of the second seed
    with pytest.raises(HeadwayError, match=r"diverged: the critic of seed 6 .* at iteration 7; lower algo"):
        learner.update(made, 7, 0.0)
