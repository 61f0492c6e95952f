"""The learner as a whole: stacks, absent agents, stream ends, and resuming from a checkpoint."""

import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from covering import quick_or_slow
from numpy.typing import NDArray
from torch import Tensor

from headway.contracts import Box, Discrete, EnvSpec, HeadwayError, Trajectory
from headway_algos import components
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.layout import Layout, zero_where_absent
from headway_algos.batches.policy_batch import PolicyBatch
from headway_algos.batches.stream_ends import Truncations
from headway_algos.components import CRITICS, ORDERS, UPDATES, Component, component
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.networks.actor import Actor
from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
from headway_algos.on_policy.critics.estimate import CriticEstimate
from headway_algos.on_policy.critics.value import ValueCritic
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.updates import Update
from headway_algos.on_policy.updates.gradient_update import GradientUpdate
from headway_algos.registry import configure

Fabricate = Callable[..., Trajectory]
Poison = Callable[[Trajectory], Trajectory]
Change = Callable[[Trajectory], None]

DISCRETE = EnvSpec(
    "made", tuple("abcd"), 3, Discrete(3), groups=tuple("xyxx"), has_action_mask=True, agents_come_and_go=True
)
WITH_STATE = replace(DISCRETE, state_size=5)
TEAM = replace(WITH_STATE, shared_reward=True)
BOX = replace(DISCRETE, action_space=Box((-1.0, -1.0), (1.0, 1.0)), has_action_mask=False)
TEAM_BOX = replace(TEAM, action_space=BOX.action_space, has_action_mask=False)
MODEL = ModelConfig(hidden=(8, 8), actor_gain=0.5)
SETTINGS: dict[str, Any] = {
    "policies": "independent", "model": MODEL, "precision": "float64", "lr": 3e-3, "minibatches": 3,
    "epochs": 2,
}  # fmt: skip
IPPO = configure("ippo", **SETTINGS, kl_coeff=0.2, value_clip=5.0)
MAPPO = configure("mappo", **SETTINGS)
OTHERS = replace(MAPPO, critic_actions="others")
COMA = configure("coma", **SETTINGS, gae_lambda=0.8, target_every=2)
IA2C, MAA2C = configure("ia2c", **SETTINGS), configure("maa2c", **SETTINGS)
ITRPO, MATRPO = configure("itrpo", **SETTINGS), configure("matrpo", **SETTINGS)
HAPPO, HATRPO = configure("happo", **SETTINGS, kl_coeff=0.2), configure("hatrpo", **SETTINGS)
MAACKTR = configure("maacktr", model=MODEL, precision="float64", kfac_every=2, kfac_momentum=0.5)
INDEPENDENT_ACKTR = replace(MAACKTR, policies="independent")
HAA2C = configure("custom", **SETTINGS, critic="central", update="a2c", order="sequential")
CASES: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    "ippo": (IPPO, DISCRETE),
    "ippo box": (IPPO, BOX),
    "ippo shared": (replace(IPPO, policies="shared"), DISCRETE),
    "ippo groups": (replace(IPPO, policies="groups"), DISCRETE),
    "mappo": (MAPPO, DISCRETE),
    "mappo state": (MAPPO, WITH_STATE),
    "mappo team": (replace(MAPPO, policies="groups"), TEAM),
    "mappo team shared box": (replace(MAPPO, policies="shared"), TEAM_BOX),
    "mappo others": (OTHERS, WITH_STATE),
    "mappo others team": (OTHERS, TEAM),
    "mappo others team box": (OTHERS, TEAM_BOX),
    "coma": (COMA, DISCRETE),
    "coma groups": (replace(COMA, policies="groups"), WITH_STATE),
    "coma team": (COMA, TEAM),
    "coma team shared": (replace(COMA, policies="shared"), replace(DISCRETE, shared_reward=True)),
    "counterfactual in turns": (
        configure("custom", **SETTINGS, critic="counterfactual", update="trpo", order="sequential"),
        TEAM,
    ),
    "ia2c": (IA2C, DISCRETE),
    "ia2c groups box": (replace(IA2C, policies="groups"), BOX),
    "maa2c shared": (replace(MAA2C, policies="shared"), WITH_STATE),
    "itrpo": (ITRPO, DISCRETE),
    "itrpo groups box": (replace(ITRPO, policies="groups"), BOX),
    "matrpo shared": (replace(MATRPO, policies="shared", fisher_share=0.5), WITH_STATE),
    "maacktr": (MAACKTR, DISCRETE),
    "maacktr independent box": (INDEPENDENT_ACKTR, BOX),
    "maacktr groups, by factors": (replace(MAACKTR, policies="groups", kfac_length="factors"), DISCRETE),
    "k-fac in turns, central": (
        configure(
            "custom", **SETTINGS, critic="central", update="kfac", critic_update="kfac", order="sequential"
        ),
        TEAM_BOX,
    ),
    "k-fac with a counterfactual critic": (
        configure("custom", **SETTINGS, critic="counterfactual", update="kfac", critic_update="kfac"),
        WITH_STATE,
    ),
    "happo": (HAPPO, TEAM),
    "happo box": (HAPPO, BOX),
    "happo groups": (replace(HAPPO, policies="groups"), TEAM),
    "hatrpo": (HATRPO, TEAM),
    "hatrpo box": (HATRPO, BOX),
    "haa2c": (HAA2C, DISCRETE),
}
QUICK = (
    "ippo groups", "mappo others team box", "coma team shared", "ia2c groups box", "itrpo", "maacktr",
    "happo", "k-fac in turns, central",
)  # fmt: skip
"""Every critic, update, order, kind of action and sharing of policies."""
every_case = pytest.mark.parametrize(("config", "spec"), quick_or_slow(CASES, *QUICK))


def _numbers(module: torch.nn.Module) -> dict[str, NDArray[Any]]:
    return {name: value.detach().numpy().copy() for name, value in module.state_dict().items()}


def _tensors(learner: OnPolicyLearner) -> dict[str, NDArray[Any]]:
    """Every tensor that learning changes, with leading axis P."""
    named = _flat(learner.state_dict())
    return {name: value.detach().numpy().copy() for name, value in named.items()}


def _flat(state: Any, path: str = "") -> dict[str, Tensor]:  # noqa: ANN401 - tensors, nested
    if isinstance(state, Tensor):
        return {path.strip(): state}
    if not isinstance(state, dict | list):
        return {}
    items = state.items() if isinstance(state, dict) else enumerate(state)
    return {n: t for key, value in items for n, t in _flat(value, f"{path} {key}").items()}


def _assert_close(
    got: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]], rtol: float = 1e-9
) -> None:
    assert got.keys() == expected.keys()
    for name in got:
        np.testing.assert_allclose(got[name], expected[name], rtol=rtol, atol=0.1 * rtol, err_msg=name)


def _rounding(config: AlgoConfig, spec: EnvSpec) -> float:
    """Tolerance for rounding errors, which grow by standardising nearly equal advantages of few rows, and
    further by several epochs of PPO on ratios of Gaussians."""
    return 1e-7 if (config, spec) in ((IPPO, BOX), (HAPPO, BOX)) else 1e-9


def _joined(parts: list[Trajectory]) -> Trajectory:
    names = Trajectory.__dataclass_fields__
    return Trajectory(*(np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names))


RECURRENT = ModelConfig(hidden=(8,), core="gru", gru_size=4, sequence_length=5)
STACKED: dict[str, tuple[AlgoConfig, EnvSpec]] = {
    **CASES,
    "ippo recurrent": (replace(IPPO, model=RECURRENT, value_clip=None), DISCRETE),
    "mappo recurrent shared": (replace(MAPPO, model=RECURRENT, policies="shared"), TEAM),
    "coma recurrent": (replace(COMA, model=RECURRENT), TEAM),
    "itrpo recurrent groups": (replace(ITRPO, model=RECURRENT, policies="groups"), DISCRETE),
    "hatrpo recurrent": (replace(HATRPO, model=RECURRENT), TEAM),
}


@pytest.mark.parametrize(("config", "spec"), quick_or_slow(STACKED, *QUICK[:4], "itrpo recurrent groups"))
def test_a_seed_trains_the_same_alone_and_in_a_stack_of_three(
    fabricate: Fabricate, config: AlgoConfig, spec: EnvSpec
) -> None:
    """Although the others have more rows, or hardly any. Bit for bit this is tested with `PerSeedLearner`."""
    hidden_size = config.model.gru_size if config.model.core == "gru" else 0
    seeds, rtol = (3, 5, 7), _rounding(config, spec)
    stacked = OnPolicyLearner(config, spec, seeds, "cpu")
    alone = [OnPolicyLearner(config, spec, (seed,), "cpu") for seed in seeds]
    for iteration in range(1, 4):
        parts = [
            fabricate(spec, 8, 3, 10 * iteration + r, absent, idle=0.2, leaves=0.02, hidden_size=hidden_size)
            for r, absent in enumerate((0.0, 0.5, 0.95))
        ]
        info = stacked.update(_joined(parts), iteration, 0.1 * iteration)
        for r, learner in enumerate(alone):
            for name, value in learner.update(parts[r], iteration, 0.1 * iteration).items():
                np.testing.assert_allclose(info[name][r], value[0], rtol=rtol, atol=0.1 * rtol, err_msg=name)
    together = _tensors(stacked)
    for r, learner in enumerate(alone):
        networks = {name: len(value) for name, value in _tensors(learner).items()}
        mine = {
            name: value[r * networks[name] : (r + 1) * networks[name]] for name, value in together.items()
        }
        _assert_close(mine, _tensors(learner), rtol)


def _of_agents(made: Trajectory, agents: slice) -> Trajectory:
    without_agents = ("states", "final_states")
    parts = {name: getattr(made, name) for name in Trajectory.__dataclass_fields__}
    return Trajectory(**{n: v if n in without_agents else v[:, :, agents] for n, v in parts.items()})


each_by_itself = pytest.mark.parametrize(
    ("config", "spec"),
    [
        (IPPO, DISCRETE),
        (IPPO, BOX),
        (MAPPO, WITH_STATE),
        (IA2C, DISCRETE),
        (IA2C, BOX),
        (ITRPO, DISCRETE),
        (ITRPO, BOX),
        (MATRPO, WITH_STATE),
        (INDEPENDENT_ACKTR, DISCRETE),
        (INDEPENDENT_ACKTR, BOX),
    ],
)


@each_by_itself
def test_an_independent_policy_trains_the_same_alone_and_among_others(
    fabricate: Fabricate, config: AlgoConfig, spec: EnvSpec
) -> None:
    among = OnPolicyLearner(config, spec, (5,), "cpu")
    alone = OnPolicyLearner(config, replace(spec, agents=("a",), groups=("x",)), (5,), "cpu")
    for iteration in range(1, 4):
        made = fabricate(spec, 8, 3, seed=iteration, absent=0.4, idle=0.2)
        made.alive[:, :, 0] |= made.alive[:, :, 1]  # numbers of valid rows differ
        made.acting[:, :, 0] = made.alive[:-1, :, 0]
        among.update(made, iteration, 0.0)
        alone.update(_of_agents(made, slice(0, 1)), iteration, 0.0)
    _assert_close({name: value[:1] for name, value in _tensors(among).items()}, _tensors(alone))


@each_by_itself
def test_other_agents_experience_changes_no_independent_policy(
    fabricate: Fabricate, config: AlgoConfig, spec: EnvSpec
) -> None:
    results = []
    for other_seed in (1, 2):
        learner = OnPolicyLearner(config, spec, (5,), "cpu")
        made, other = fabricate(spec, 8, 3, seed=0, absent=0.3), fabricate(spec, 8, 3, other_seed, 0.6)
        for name in ("observations", "alive", "actions", "rewards", "acting", "log_probs"):
            getattr(made, name)[:, :, [0, 1, 3]] = getattr(other, name)[:, :, [0, 1, 3]]
        if spec.has_action_mask:
            made.action_masks[:, :, [0, 1, 3]] = other.action_masks[:, :, [0, 1, 3]]
        learner.update(made, 1, 0.0)
        results.append(_tensors(learner))
    for name, value in results[0].items():
        np.testing.assert_allclose(value[2], results[1][name][2], rtol=1e-12, atol=1e-12, err_msg=name)
        if "actor network.weights" in name:
            assert (value[0] != results[1][name][0]).any()


@every_case
def test_poisoned_rows_without_experience_change_nothing(
    fabricate: Fabricate, poisoned: Poison, config: AlgoConfig, spec: EnvSpec
) -> None:
    clean, bad = (OnPolicyLearner(config, spec, (1, 2), "cpu") for _ in range(2))
    for iteration in range(1, 3):
        made = fabricate(spec, 10, 6, seed=iteration, absent=0.4, idle=0.3, leaves=0.05)
        made.acting[:, :, 1] &= iteration < 2  # and one who never acts
        expected = clean.update(made, iteration, 0.0)
        for name, value in bad.update(poisoned(made), iteration, 0.0).items():
            np.testing.assert_array_equal(value, expected[name], err_msg=name)
    for name, value in _tensors(bad).items():
        np.testing.assert_array_equal(value, _tensors(clean)[name], err_msg=name)
        assert np.isfinite(value).all(), name


@pytest.mark.parametrize(
    ("config", "spec"),
    [
        (IPPO, DISCRETE),
        (IPPO, BOX),
        (IPPO, replace(DISCRETE, shared_reward=True)),
        (IPPO, replace(DISCRETE, shared_in_groups=True)),
        (IA2C, DISCRETE),
        (ITRPO, BOX),
        (MAACKTR, replace(DISCRETE, shared_reward=True)),
    ],
)
def test_unused_slots_change_nothing(
    fabricate: Fabricate,
    poisoned: Poison,
    monkeypatch: pytest.MonkeyPatch,
    config: AlgoConfig,
    spec: EnvSpec,
) -> None:
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
        expected = tight.update(_of_agents(made, slice(0, 4)), iteration, 0.0)
        for name, value in wide.update(poisoned(made), iteration, 0.0).items():
            np.testing.assert_allclose(value, expected[name], rtol=1e-9, err_msg=name)
    _assert_close(_tensors(wide), _tensors(tight))


def test_padding_of_unequal_groups_changes_nothing(fabricate: Fabricate) -> None:
    """The large group trains the same beside a group of one as beside a group of its size."""
    config = replace(IPPO, policies="groups")
    padded = replace(DISCRETE, agents=tuple("abcd"), groups=tuple("xxxy"))
    equal = replace(DISCRETE, agents=tuple("abcdef"), groups=tuple("xxxyyy"))
    large = fabricate(equal, 8, 3, seed=0, absent=0.2, idle=0.2)
    results = []
    for spec, made in ((equal, large), (padded, _of_agents(large, slice(0, 4)))):
        learner = OnPolicyLearner(config, spec, (1,), "cpu")
        learner.update(made, 1, 0.0)
        results.append({name: value[:1] for name, value in _tensors(learner).items()})
    _assert_close(results[1], results[0])


@every_case
def test_training_resumed_from_a_checkpoint_is_exact(
    fabricate: Fabricate, tmp_path: Path, config: AlgoConfig, spec: EnvSpec
) -> None:
    config = replace(config, lr_end=0.1, precision="float32")
    first, second = (OnPolicyLearner(config, spec, (1, 2), "cpu") for _ in range(2))
    made = [fabricate(spec, 8, 6, seed=i, absent=0.3, idle=0.2) for i in range(4)]
    for iteration in (1, 2):
        first.update(made[iteration - 1], iteration, iteration / 4)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for iteration in (3, 4):
        infos = [learner.update(made[iteration - 1], iteration, iteration / 4) for learner in (first, second)]
        for name in infos[0]:
            np.testing.assert_array_equal(infos[0][name], infos[1][name], err_msg=name)
    for name, value in _tensors(first).items():
        np.testing.assert_array_equal(value, _tensors(second)[name], err_msg=name)
    for name, array in first.acting_parameters().items():
        np.testing.assert_array_equal(array, second.acting_parameters()[name], err_msg=name)


def test_a_state_of_another_shape_is_refused() -> None:
    small = OnPolicyLearner(IPPO, DISCRETE, (1,), "cpu")
    with pytest.raises(RuntimeError, match="size mismatch"):
        small.load_state_dict(OnPolicyLearner(IPPO, DISCRETE, (1, 2), "cpu").state_dict())


def test_a_saved_state_is_not_changed_by_loading_it_elsewhere(fabricate: Fabricate) -> None:
    """Two learners may start from one state."""
    source = OnPolicyLearner(IPPO, DISCRETE, (1,), "cpu")
    source.update(fabricate(DISCRETE, 8, 3, seed=0), 1, 0.0)
    buffer = io.BytesIO()
    torch.save(source.state_dict(), buffer)
    buffer.seek(0)
    state = torch.load(buffer, weights_only=True)
    results = []
    for _ in range(2):
        learner = OnPolicyLearner(IPPO, DISCRETE, (1,), "cpu")
        learner.load_state_dict(state)
        learner.update(fabricate(DISCRETE, 8, 3, seed=1), 2, 0.0)
        results.append(_tensors(learner))
    for name, value in results[0].items():
        np.testing.assert_array_equal(value, results[1][name], err_msg=name)


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


def test_critic_update_and_order_are_three_choices(
    fabricate: Fabricate, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    _assert_close(results[1], results[0])


@pytest.mark.parametrize("kind", ["critic", "update", "critic_update", "order"])
def test_components_of_other_packages_train(
    kind: str, fabricate: Fabricate, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    _assert_close(*numbers)


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


def _above_par(viewpoints: int) -> Component:
    return Component("", AlgoConfig, partial(RewardAbovePar, viewpoints=viewpoints))


@pytest.mark.parametrize("viewpoints", [1, 4])
def test_a_custom_critic_joins_by_name(
    fabricate: Fabricate, monkeypatch: pytest.MonkeyPatch, viewpoints: int
) -> None:
    """The learner uses its advantages, of agents or of the team, and stores its state."""
    own: dict[str, Any] = {"critic": "above par"}
    monkeypatch.setitem(CRITICS, "above par", _above_par(viewpoints))
    first, other = (OnPolicyLearner(replace(MAPPO, **own, lr_end=0.5), TEAM, (1, 2), "cpu") for _ in range(2))
    start = _numbers(first.actor)
    made = [fabricate(TEAM, 6, 4, seed=seed, absent=0.2) for seed in (0, 1)]
    info = first.update(made[0], 1, 1.0)
    by_replica = made[0].rewards.astype(np.float64).reshape(6, 2, 2, 4)
    np.testing.assert_allclose(info["critic/par"], by_replica.mean(axis=(0, 2, 3)), rtol=1e-12)
    assert isinstance(first.critic, RewardAbovePar)
    assert (first.critic.share, first.critic.seen) == (0.5, 6)
    assert (_numbers(first.actor)["network.weights.0"] != start["network.weights.0"]).any(axis=(1, 2)).all()
    other.load_state_dict(first.state_dict())
    for learner in (first, other):
        learner.update(made[1], 2, 0.0)
    assert other.state_dict()["critic"]["seen"] == 12
    _assert_close(_numbers(other.actor), _numbers(first.actor))


def test_all_agents_of_a_team_get_the_teams_advantage(
    fabricate: Fabricate, monkeypatch: pytest.MonkeyPatch
) -> None:
    own: dict[str, Any] = {"critic": "above par"}
    results = []
    for viewpoints in (1, 4):
        monkeypatch.setitem(CRITICS, "above par", _above_par(viewpoints))
        learner = OnPolicyLearner(replace(MAPPO, **own), TEAM, (1, 2), "cpu")
        learner.update(fabricate(TEAM, 6, 4, seed=0, absent=0.2), 1, 0.0)
        results.append(_numbers(learner.actor))
    _assert_close(results[1], results[0])


@pytest.mark.parametrize(("progress", "share"), [(0.0, 1.0), (0.5, 0.55), (1.0, 0.1)])
def test_learning_rates_are_annealed_linearly(fabricate: Fabricate, progress: float, share: float) -> None:
    config = replace(IPPO, lr=1e-3, critic_lr=2e-3, lr_end=0.1)
    learner = OnPolicyLearner(config, DISCRETE, (1,), "cpu")
    for _ in range(2):  # from the base each time, not from the last
        learner.update(fabricate(DISCRETE, 4, 2, seed=0), 1, progress)
    assert isinstance(learner.policy_update, GradientUpdate)
    assert isinstance(learner.critic, ValueCritic)
    assert learner.policy_update.optimiser.lr == pytest.approx(1e-3 * share)
    assert learner.critic.regression.optimiser.lr == pytest.approx(2e-3 * share)


def _changed_by(config: AlgoConfig, spec: EnvSpec, made: Trajectory, change: Change) -> bool:
    results = []
    for _ in range(2):
        learner = OnPolicyLearner(config, spec, (1,), "cpu")
        learner.update(made, 1, 0.0)
        results.append(_tensors(learner))
        change(made)
    return any((results[0][name] != results[1][name]).any() for name in results[0] if "moments" not in name)


@pytest.mark.parametrize("natural", [False, True])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_only_truncation_bootstraps_and_from_the_final_observation(
    fabricate: Fabricate, natural: bool, which: int
) -> None:
    """Not from the next episode's first observation, which is otherwise unused at the trajectory's end."""
    config, spec = [(IPPO, DISCRETE), (MAPPO, DISCRETE), (MAPPO, TEAM)][which]
    made = fabricate(spec, 6, 2, seed=0, ends=0.0)
    made.terminated[-1], made.truncated[-1] = natural, not natural

    def another_end(made: Trajectory) -> None:
        made.final_observations[-1] += 1
        made.final_states[-1] += 1

    def another_start(made: Trajectory) -> None:
        made.observations[-1] += 1
        made.states[-1] += 1

    assert _changed_by(config, spec, made, another_end) == (not natural)
    assert not _changed_by(config, spec, made, another_start)


def _values(learner: OnPolicyLearner, scene: CriticBatch) -> NDArray[np.float64]:
    """Values (M, C, W) by the learner's critic."""
    assert isinstance(learner.critic, ValueCritic)
    return learner.critic.values(learner.critic.rows(scene), len(scene.observations))


def _final_values(learner: OnPolicyLearner, made: Trajectory) -> NDArray[np.float64]:
    """Bootstrap values of truncated streams, (T, C, N)."""
    truncations = Truncations.of(made, 1)
    return truncations.put(
        _values(learner, CriticBatch.after_truncations(made, truncations)), made.rewards.shape
    )


@pytest.mark.parametrize("spec", [DISCRETE, WITH_STATE])
def test_a_central_critic_bootstraps_from_the_team_when_one_agent_is_truncated(
    fabricate: Fabricate, poisoned: Poison, spec: EnvSpec
) -> None:
    """Agent 1 is truncated and the episode continues: it bootstraps from the value of the next state."""
    made = poisoned(fabricate(spec, 5, 2, seed=0, ends=0.0))
    made.truncated[2, :, 1] = True
    made.final_observations[2, :, 1] = 0.5
    learner = OnPolicyLearner(MAPPO, spec, (1,), "cpu")
    final = _final_values(learner, made)
    after, alive = made.observations[3:4].copy(), made.alive[3:4].copy()
    after[:, :, 1], alive[:, :, 1] = 0.5, True
    expected = _values(
        learner, CriticBatch(zero_where_absent(after, alive), made.states[3:4], alive, alive, None)
    )
    np.testing.assert_allclose(final[2, :, 1], expected[0, :, 1], rtol=1e-12)


def test_an_agent_absent_when_truncated_bootstraps_from_its_final_observation(fabricate: Fabricate) -> None:
    """The contract guarantees one wherever `truncated` is set."""
    made = fabricate(DISCRETE, 4, 1, seed=0, ends=0.0)
    made.alive[3, :, 1] = made.acting[3, :, 1] = False
    made.truncated[3] = True
    learner = OnPolicyLearner(IPPO, DISCRETE, (1,), "cpu")
    everyone = np.ones((1, 1, 4), np.bool_)
    at_end = CriticBatch(made.final_observations[3:], made.final_states[3:], everyone, everyone, None)
    np.testing.assert_allclose(_final_values(learner, made)[3], _values(learner, at_end)[0], rtol=1e-12)


@every_case
def test_an_iteration_without_live_agents_changes_no_policy(
    fabricate: Fabricate, config: AlgoConfig, spec: EnvSpec
) -> None:
    learner = OnPolicyLearner(config, spec, (1,), "cpu")
    learner.update(fabricate(spec, 6, 2, seed=0), 1, 0.0)
    before = _tensors(learner)
    info = learner.update(fabricate(spec, 6, 2, seed=1, absent=1.1), 2, 0.0)
    for name, value in _tensors(learner).items():
        if name.startswith("actor"):
            np.testing.assert_array_equal(value, before[name], err_msg=name)
    # Metrics of training that did not take place are missing, instead of 0.
    assert not any(np.isinf(value).any() for value in info.values())
    if config.update in ("ppo", "a2c"):
        assert np.isnan(info["policy/entropy"]).all()


@pytest.mark.parametrize("normalise", [True, False])
def test_values_are_in_units_of_return(fabricate: Fabricate, normalise: bool) -> None:
    """With a constant reward of 50 at the end of each episode, the critic learns 50 in either case."""
    config = replace(
        IPPO, normalise_values=normalise, lr=1e-9, critic_lr=0.1, epochs=20, minibatches=1, value_clip=None
    )
    learner = OnPolicyLearner(config, DISCRETE, (1,), "cpu")
    for iteration in range(1, 13):
        made = fabricate(DISCRETE, 8, 4, seed=iteration, ends=1.1)
        made.rewards[:], made.terminated[:], made.truncated[:] = 50, True, False
        learner.update(made, iteration, 0.0)
    np.testing.assert_allclose(_values(learner, CriticBatch.of_steps(made)), 50, rtol=0.05)


def test_value_errors_are_clipped(fabricate: Fabricate) -> None:
    """Errors beyond the bound have no gradient: with a tiny bound the critic stays unchanged."""
    results = {}
    for name, bound in (("cut", 1e-12), ("whole", None)):
        learner = OnPolicyLearner(
            replace(IPPO, value_clip=bound, normalise_values=False), DISCRETE, (1,), "cpu"
        )
        before = _tensors(learner)
        info = learner.update(fabricate(DISCRETE, 8, 3, seed=0), 1, 0.0)
        after = _tensors(learner)
        results[name] = any(
            (after[name] != value).any()
            for name, value in before.items()
            if name.startswith("critic networks network")
        )
        assert bound is None or info["critic/loss"][0] <= bound
    assert results == {"cut": False, "whole": True}


def test_a_missing_gpu_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(HeadwayError, match="device=auto or device=cpu"):
        OnPolicyLearner(IPPO, DISCRETE, (1,), "cuda")
    assert OnPolicyLearner(IPPO, DISCRETE, (1,), "auto").device.type == "cpu"


def test_an_unknown_device_is_refused_in_one_line() -> None:
    with pytest.raises(HeadwayError, match="'gpu' is not a device; use device=auto, cpu or cuda"):
        OnPolicyLearner(IPPO, DISCRETE, (1,), "gpu")


@pytest.mark.parametrize(
    ("policies", "owner"),
    [("independent", "agent c"), ("groups", "group y"), ("shared", "all agents")],
)
@pytest.mark.parametrize("spec", [DISCRETE, BOX])
def test_a_policy_that_is_no_longer_finite_is_named(
    fabricate: Fabricate, policies: Literal["independent", "groups", "shared"], owner: str, spec: EnvSpec
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
def test_an_absurd_learning_rate_ends_in_one_line(fabricate: Fabricate, spec: EnvSpec) -> None:
    config = replace(MAPPO, lr=1e30, precision="float32", normalise_values=False)
    learner = OnPolicyLearner(config, spec, (1,), "cpu")

    def learn() -> None:
        for iteration in range(1, 20):
            learner.update(fabricate(spec, 8, 3, seed=iteration), iteration, 0.0)

    with pytest.raises(HeadwayError, match=r"mappo diverged: the (policy of .*|critic of) seed 1"):
        learn()


@pytest.mark.parametrize("config", [IPPO, MATRPO, MAA2C, COMA, MAACKTR])
def test_a_critic_that_is_no_longer_finite_is_named_whatever_the_update(
    fabricate: Fabricate, config: AlgoConfig
) -> None:
    """A trust region would reject every step on its values, and train on without effect."""
    learner = OnPolicyLearner(config, TEAM, (4, 6), "cpu")
    made = fabricate(TEAM, 4, 4, seed=0)
    for tensor in learner.critic.state_dict()["networks"].values():
        tensor[len(tensor) // 2 :] = np.nan  # of the second seed
    with pytest.raises(HeadwayError, match=r"diverged: the critic of seed 6 .* at iteration 7; lower algo"):
        learner.update(made, 7, 0.0)
