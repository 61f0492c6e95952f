"""Names, refusals and imports of the registry."""

import subprocess
import sys
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from covering import pairwise

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, MultiDiscrete, Observations
from headway_algos.acting.mlp import MLPActingPolicy
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import ENTRIES, configure

SPEC = EnvSpec("made", ("a", "b", "c"), 3, Discrete(2), groups=("x", "y", "x"))


def test_making_an_acting_policy_and_using_it_imports_no_torch() -> None:
    code = """
import pickle, sys
import numpy as np
from headway.contracts import Discrete, EnvSpec, Observations
from headway_algos.registry import ENTRIES, configure
spec = EnvSpec("made", ("a", "b"), 3, Discrete(2))
entry = ENTRIES["mappo"]
policy = pickle.loads(pickle.dumps(entry.acting_policy(entry.config(), spec)))
parameters = {name: np.ones(shape, dtype) for name, (shape, dtype) in policy.parameter_shapes(1).items()}
observed = Observations(np.zeros((4, 2, 3), np.float32), np.zeros((4, 0), np.float32), np.ones((4, 2), bool))
actions, log_probs = policy.act(parameters, observed, policy.noise(np.random.default_rng(0), 4))
print(actions.shape, 'torch' in sys.modules)
"""
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "(4, 2) False"


@pytest.mark.parametrize("name", ENTRIES)
def test_every_entry_has_its_name_and_a_source(name: str) -> None:
    entry = ENTRIES[name]
    assert entry.config().name == name
    assert "arXiv:" in entry.source
    assert "\n" not in entry.summary


def _runs(name: str, policies: str, space: ActionSpace) -> bool:
    """Return whether an algorithm runs with these policies and actions."""
    sequential = name in ("happo", "hatrpo") and policies == "shared"
    only = {"coma": Discrete, "madqn": Discrete, "ddpg": Box}.get(name, ActionSpace)
    return not sequential and isinstance(space, only)


@pytest.mark.parametrize(
    ("name", "policies", "space"),
    pairwise(ENTRIES, ["independent", "shared", "groups"], [Discrete(2), Box((-1.0,), (1.0,))], where=_runs),
)
def test_every_entry_makes_learners_and_acting_policies(name: str, policies: str, space: ActionSpace) -> None:
    entry, spec = ENTRIES[name], replace(SPEC, action_space=space)
    config = entry.config(policies=policies)
    assert entry.refuses(config, spec) is None
    learner, acting = entry.learner(config, spec, (0, 1), "cpu"), entry.acting_policy(config, spec)
    given = learner.acting_parameters()
    assert {name: (a.shape, a.dtype) for name, a in given.items()} == acting.parameter_shapes(2)
    assert all(a.flags.c_contiguous for a in given.values())


@pytest.mark.parametrize("name", ENTRIES)
def test_several_choices_at_once_are_refused_only_where_values_are_compared(name: str) -> None:
    entry = ENTRIES[name]
    line = entry.refuses(entry.config(), replace(SPEC, action_space=MultiDiscrete((2, 3))))
    if name not in ("coma", "madqn", "ddpg"):
        assert line is None
        return
    assert line is not None
    assert line.startswith(f"{name} takes ")
    assert "made has MultiDiscrete ones; use " in line
    assert line.endswith("algo=mappo" if name == "coma" else "algo=ippo")


def test_a_counterfactual_critic_refuses_all_but_discrete_actions() -> None:
    for name, settings in (("coma", {}), ("custom", {"critic": "counterfactual"})):
        config, spec = configure(name, **settings), replace(SPEC, action_space=Box((-1.0,), (1.0,)))
        line = ENTRIES[name].refuses(config, spec)
        assert line is not None
        assert f"{name} takes Discrete actions" in line
        assert "made has Box ones; use an algorithm with a local or central critic" in line


@pytest.mark.parametrize("critic", ["local", "counterfactual"])
def test_critic_actions_are_for_central_critics_only(critic: str) -> None:
    with pytest.raises(TypeError, match="critic_actions"):
        configure("custom", critic=critic, critic_actions="others")
    assert configure("custom", critic="central", critic_actions="others").critic_actions == "others"


@pytest.mark.parametrize(
    ("name", "changes", "instead"),
    [
        ("happo", {}, "algo=mappo"),
        ("hatrpo", {}, "algo=matrpo"),
        ("custom", {"update": "a2c", "order": "sequential"}, "algo.order=simultaneous"),
    ],
)
def test_sequential_order_needs_several_policies(name: str, changes: dict[str, Any], instead: str) -> None:
    entry = ENTRIES[name]
    for policies in ("independent", "groups"):
        assert entry.refuses(entry.config(**changes, policies=policies), SPEC) is None
    shared = entry.config(**changes, policies="shared")
    ungrouped, one_group = replace(SPEC, groups=()), replace(SPEC, groups=("x",) * 3)
    of_one = entry.config(**changes, policies="groups")
    for config, spec, several in (
        (shared, SPEC, "independent, algo.policies=groups,"),
        (shared, ungrouped, "independent,"),
        (of_one, one_group, "independent,"),
    ):
        line = entry.refuses(config, spec)
        assert line is not None
        for part in (name, f"use algo.policies={several} or {instead}"):
            assert part in line
        assert "\n" not in line


def test_a_name_is_a_composition() -> None:
    """The table of the algorithms: critic, update, order."""
    table = {
        "ia2c": ("local", "a2c", "simultaneous"),
        "ippo": ("local", "ppo", "simultaneous"),
        "itrpo": ("local", "trpo", "simultaneous"),
        "maa2c": ("central", "a2c", "simultaneous"),
        "maacktr": ("local", "kfac", "simultaneous"),
        "coma": ("counterfactual", "a2c", "simultaneous"),
        "mappo": ("central", "ppo", "simultaneous"),
        "matrpo": ("central", "trpo", "simultaneous"),
        "happo": ("central", "ppo", "sequential"),
        "hatrpo": ("central", "trpo", "sequential"),
    }
    for name, composition in table.items():
        config = ENTRIES[name].config()
        assert (config.critic, config.update, config.order) == composition


COUNTERFACTUAL, TRPO, KFAC = {"critic": "counterfactual"}, {"update": "trpo"}, {"update": "kfac"}
IMPOSSIBLE: list[dict[str, Any]] = [
    {"gamma": 1.1}, {"gae_lambda": -0.1}, {"lr": 0.0}, {"critic_lr": 0.0}, {"lr_end": 2.0}, {"epochs": 0},
    {"minibatches": 0}, {"clip": 0.0}, {"kl_coeff": -1.0}, {"kl_target": 0.0}, {"value_clip": 0.0},
    {"grad_clip": 0.0}, {"piece_samples": 0}, {**COUNTERFACTUAL, "target_every": 0},
    {**TRPO, "kl_bound": 0.0}, {**TRPO, "accept_ratio": 1.0}, {**TRPO, "accept_ratio": -0.1},
    {**TRPO, "cg_iterations": 0}, {**TRPO, "cg_damping": 0.0}, {**TRPO, "line_search_steps": -1},
    {**TRPO, "fisher_share": 0.0}, {**TRPO, "fisher_share": 1.5},
    {**KFAC, "kfac_damping": 0.0}, {**KFAC, "kfac_decay": 1.0}, {**KFAC, "kfac_every": 0},
    {**KFAC, "kfac_momentum": 1.0}, {"critic_update": "kfac", "critic_kl_bound": 0.0},
]  # fmt: skip
"""Settings, the last of which is to blame."""


@pytest.mark.parametrize("wrong", IMPOSSIBLE)
def test_impossible_numbers_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{list(wrong)[-1]} must"):
        configure("custom", **wrong)


@pytest.mark.parametrize(
    "wrong", [{"hidden": (8, 0)}, {"actor_gain": 0.0}, {"gru_size": 0}, {"sequence_length": 0}]
)
def test_impossible_networks_are_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))}"):
        ModelConfig(**wrong)


def test_a_network_without_hidden_layers_is_linear() -> None:
    config = configure("custom", model=ModelConfig(hidden=()))
    learner, acting = OnPolicyLearner(config, SPEC, (0,), "cpu"), MLPActingPolicy.of(config, SPEC)
    assert learner.acting_parameters().keys() == acting.parameter_shapes(1).keys()
    assert "weight_1" not in learner.acting_parameters()


@pytest.mark.parametrize("policies", ["independent", "shared"])
def test_policies_start_near_the_initial_logits(policies: Any) -> None:  # noqa: ANN401 - a literal
    config = configure(
        "custom",
        policies=policies,
        model=ModelConfig(initial_logits=(0.0, 1.0), actor_gain=1e-9),
        precision="float64",
    )
    learner, acting = OnPolicyLearner(config, SPEC, (0, 1), "cpu"), MLPActingPolicy.of(config, SPEC)
    observed = Observations(
        np.ones((2, 3, 3), np.float32), np.zeros((2, 0), np.float32), np.ones((2, 3), np.bool_)
    )
    actions, log_probs = acting.act(learner.acting_parameters(), observed, None)
    assert (actions == 1).all()
    np.testing.assert_allclose(np.exp(log_probs), 1 / (1 + np.exp(-1)), rtol=1e-6)


@pytest.mark.parametrize("space", [Discrete(3), Box((-1.0,), (1.0,))])
def test_initial_logits_that_do_not_fit_are_refused(space: Any) -> None:  # noqa: ANN401 - any space
    entry = ENTRIES["ippo"]
    config = entry.config(model=ModelConfig(initial_logits=(0.0, 1.0)))
    assert entry.refuses(config, SPEC) is None
    line = entry.refuses(config, replace(SPEC, action_space=space))
    assert line is not None
    assert "initial_logits has 2 entries" in line
    assert "[]" in line
    assert ("give one per action" in line) == isinstance(space, Discrete)


def test_a_spread_is_refused_where_actions_have_none() -> None:
    entry = ENTRIES["ippo"]
    config = entry.config(model=ModelConfig(log_std=-1.0))
    assert entry.refuses(config, replace(SPEC, action_space=Box((-1.0,), (1.0,)))) is None
    line = entry.refuses(config, SPEC)
    assert line == (
        "algo.model.log_std is the spread of Box actions, and made has Discrete ones; leave it out"
    )


def test_entropy_of_imitation_is_refused_where_actions_are_continuous() -> None:
    entry = ENTRIES["ippo"]
    config = entry.config(imitation_entropy_coeff=0.2)
    assert entry.refuses(config, SPEC) is None
    line = entry.refuses(config, replace(SPEC, action_space=Box((-1.0,), (1.0,))))
    assert line == (
        "algo.imitation_entropy_coeff is for discrete actions, and made has Box ones, whose spread is "
        "algo.model.log_std; leave it out"
    )


NAMED = [name for name in ENTRIES if name not in ("a3c", "custom", "madqn", "ddpg")]


@pytest.mark.parametrize("name", NAMED)
def test_a_named_algorithm_equals_the_custom_composition_of_its_components(name: str) -> None:
    kinds = ("critic", "update", "critic_update", "order")
    named = asdict(configure(name))
    composed = asdict(configure("custom", **{kind: named[kind] for kind in kinds}))
    assert {**composed, "name": name} == named
    assert ENTRIES["custom"].rollout(configure("custom", update=named["update"])) == ENTRIES[name].rollout(
        configure(name)
    )


@pytest.mark.parametrize(
    ("name", "changes", "follow"),
    [
        # HAA2C: the order needs several policies, which cannot begin as one.
        ("maa2c", {"order": "sequential"}, {"policies", "shared_until", "apart_lr"}),
        ("mappo", {"order": "sequential"}, {"policies", "shared_until", "apart_lr"}),
        ("ia2c", {"critic": "central"}, {"critic_actions"}),
        ("maacktr", {"critic": "central"}, {"critic_actions"}),
        ("maacktr", {"critic_update": "adam"}, {"critic_lr", "critic_kl_bound", "grad_clip"}),
        ("mappo", {"update": "a2c"}, {"epochs", "minibatches", "clip", "kl_coeff", "kl_target"}),
    ],
)
def test_a_composition_differs_from_its_neighbour_in_the_changed_component_only(
    name: str, changes: dict[str, str], follow: set[str]
) -> None:
    """The keys of that component may have other values, or exist in one of the two only."""
    named = asdict(configure(name))
    kinds = ("critic", "update", "critic_update", "order")
    other = asdict(configure("custom", **{**{kind: named[kind] for kind in kinds}, **changes}))
    differing = {key for key in named.keys() | other.keys() if named.get(key, "no") != other.get(key, "no")}
    assert differing == {"name", *changes, *follow}


def test_steps_of_each_optimiser_have_its_usual_size() -> None:
    """Learning rates of Adam, 5e-4, are not step sizes of natural gradients, 0.25, nor the reverse."""
    sizes = {"adam": {AlgoConfig.lr}, "kfac": {0.25}}
    for update, kind in (("ppo", "adam"), ("a2c", "adam"), ("kfac", "kfac")):
        for critic_update in ("adam", "kfac"):
            config = configure("custom", update=update, critic_update=critic_update)
            assert config.lr in sizes[kind]
            assert (config.critic_lr or config.lr) in sizes[critic_update]
