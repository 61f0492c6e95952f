"""No key of an algorithm does nothing: its learner reads every key that it offers, or refuses the value."""

import pickle
import sys
from dataclasses import fields, replace
from typing import Any

import pytest
from covering import quick_or_slow
from made_trajectories import fabricate

from headway.config.schema import build, describe
from headway.contracts import Box, Discrete, EnvSpec, HeadwayError
from headway_algos.components import CRITIC_UPDATES, CRITICS, ORDERS, UPDATES
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.optim.config import KroneckerConfig
from headway_algos.recipes import Recipe, recipes
from headway_algos.registry import ENTRIES, configure

DISCRETE = EnvSpec("made", tuple("abc"), 3, Discrete(2), state_size=2, groups=tuple("xyx"))
BOX = replace(DISCRETE, action_space=Box((-1.0, -1.0), (1.0, 1.0)))
UNITS = 4
# Values beside which keys apply that do nothing by default, as far as an algorithm has them.
APPLYING = {"kl_coeff": 0.2, "shared_until": 0.5, "apart_lr": 0.5, "learning_starts": 2, "updates": 2}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    **{name: (name, {}) for name in ENTRIES},
    **{f"custom, {name}": ("custom", {"update": name, "critic_update": "kfac"}) for name in UPDATES},
    "custom, trpo": ("custom", {"update": "trpo", "critic_update": "kfac", "critic_lr": None}),
    "maacktr, adam": ("maacktr", {"critic_update": "adam"}),
}


def _recording(record: Any, read: set[str], prefix: str = "") -> Any:  # noqa: ANN401 - any record
    """Return an equal record that adds to `read` every key that is read, except by validation."""

    def get(self: object, name: str) -> Any:  # noqa: ANN401 - any attribute
        frame, callers = sys._getframe(1), []
        while frame is not None and len(callers) < 4:  # validation reads every key
            callers.append((frame.f_globals["__name__"], frame.f_code.co_name))
            frame = frame.f_back
        validates = any(function == "__post_init__" for _, function in callers)
        if callers[0][0] != "dataclasses" and not validates:
            read.add(f"{prefix}{name}")
        return object.__getattribute__(self, name)

    kind = type("Recording", (type(record),), {"__getattribute__": get})
    recorded = object.__new__(kind)
    for each in fields(record):
        value = getattr(record, each.name)
        nested = each.name == "model"
        object.__setattr__(recorded, each.name, _recording(value, read, "model.") if nested else value)
    return recorded


def _read_keys(name: str, settings: dict[str, Any], spec: EnvSpec) -> set[str]:
    """Return the keys that an algorithm reads while its learner and policy are made, imitate a rule if they
    can, and are updated twice."""
    read: set[str] = set()
    entry, config = ENTRIES[name], _recording(configure(name, **settings), read)
    learner = entry.learner(config, spec, (1,), "cpu")
    entry.acting_policy(config, spec)
    size = UNITS if getattr(config.model, "core", "none") == "gru" else 0
    if entry.starts:
        learner.imitate(fabricate(spec, 6, 2, 9, hidden_size=size), 1, 1)
    for iteration, progress in enumerate((0.0, 0.6)):
        learner.update(fabricate(spec, 6, 2, iteration, hidden_size=size), iteration + 1, progress)
    return read


@pytest.mark.parametrize(("name", "choices"), quick_or_slow(CASES, "mappo", "itrpo", "custom, kfac"))
def test_every_key_is_read(name: str, choices: dict[str, Any]) -> None:
    record = ENTRIES[name].record_for(choices)
    keys = {each.name for each in fields(record)}
    settings: dict[str, Any] = {key: value for key, value in APPLYING.items() if key in keys} | choices
    settings["policies"] = "independent"
    if issubclass(record, AlgoConfig):
        recurrent = not issubclass(record, KroneckerConfig)
        core: dict[str, Any] = {"core": "gru", "gru_size": UNITS} if recurrent else {}
        settings["model"] = ModelConfig(hidden=(4,), **core)
    read = set()
    for spec in (DISCRETE, BOX):
        if ENTRIES[name].refuses(configure(name, **settings), spec) is None:
            read |= _read_keys(name, settings, spec)
    offered = {row.key for row in describe(record)} - {"name"}
    if issubclass(record, KroneckerConfig):  # refused: see below
        offered -= {"model.gru_size", "model.sequence_length"}
    if ENTRIES[name].refuses(configure(name, **settings), BOX) is not None:
        offered -= {"model.log_std"}
    assert offered - read == set()


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("ippo", {"kl_target": 0.02}, "kl_target applies to the penalty: set kl_coeff too"),
        ("ippo", {"apart_lr": 0.5}, "apart_lr applies after shared_until"),
        ("matrpo", {"lr": 1e-3, "critic_lr": 1e-2}, "lr or critic_lr, not both"),
        ("custom", {"critic": "none", "update": "a2c", "epochs": 2}, "epochs applies to a critic: leave it"),
        ("custom", {"critic": "none", "update": "kfac", "minibatches": 2}, "minibatches applies to a critic"),
        ("custom", {"critic": "none", "update": "kfac", "critic_lr": 1e-3}, "critic_lr applies to a critic"),
        ("custom", {"critic": "none", "update": "trpo", "lr": 1e-3}, "lr applies to a critic"),
        ("maacktr", {"model": {"core": "gru"}}, "model.core must be none with kfac"),
        ("mappo", {"model": {"gru_size": 3}}, "algo.model.gru_size applies only with core=gru: set it too"),
        ("mappo", {"model": {"sequence_length": 3}}, "algo.model.sequence_length applies only with core=gru"),
    ],
)
def test_values_without_effect_are_refused(name: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        build(ENTRIES[name].record_for(settings), settings, "algo", name)


def test_an_infinite_initial_logit_is_refused() -> None:
    """Its policy would have no probabilities: infinity minus infinity is NaN."""
    settings = {"model": {"initial_logits": [float("inf"), 0.0]}}
    with pytest.raises(HeadwayError, match=r"algo\.model\.initial_logits must hold finite numbers"):
        build(ENTRIES["ippo"].record_for(settings), settings, "algo", "ippo")


def test_an_algorithm_has_its_components_keys_and_no_others() -> None:
    def own(record: type[AlgoConfig]) -> set[str]:
        return {each.name for each in fields(record)}

    for recipe in (each for each in recipes().values() if isinstance(each, Recipe)):
        config: Any = configure(recipe.name)
        expected = {"name", "critic", "update", "order"} | own(recipe.config)
        for kind, components in (
            ("critic", CRITICS), ("update", UPDATES), ("critic_update", CRITIC_UPDATES), ("order", ORDERS)
        ):  # fmt: skip
            expected |= own(components[getattr(config, kind)].config)
        assert {each.name for each in fields(config)} == expected - set(recipe.fixed)


def test_a_choice_brings_its_keys_and_takes_away_those_of_the_other() -> None:
    assert not hasattr(configure("custom", update="trpo"), "clip")
    assert configure("custom", update="trpo", cg_damping=0.3).cg_damping == 0.3
    assert configure("mappo", critic_update="kfac", critic_kl_bound=0.2).critic_kl_bound == 0.2
    assert not hasattr(configure("maacktr"), "grad_clip")
    assert configure("maacktr", critic_update="adam", grad_clip=None).grad_clip is None


@pytest.mark.parametrize("name", ENTRIES)
def test_a_record_is_pickled_for_other_processes(name: str) -> None:
    config = configure(name, lr=0.125)
    again = pickle.loads(pickle.dumps(config))
    assert again == config
    assert replace(again, gamma=0.5).gamma == 0.5
