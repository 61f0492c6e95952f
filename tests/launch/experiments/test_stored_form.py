"""Runs stored when all on-policy algorithms had one record, with 41 keys, are read as they were trained."""

from typing import Any

import pytest

from headway.config.schema import plain
from headway.contracts import HeadwayError
from headway.registry import hashed_parameters
from headway.store.run_configuration import upgraded
from headway_launch.experiments.compose import compose, resolve
from headway_launch.experiments.parameters import cell_parameters, flat, full_mapping, identity

MODEL = {
    "hidden": [64, 64], "activation": "tanh", "actor_gain": 0.01, "initial_logits": [], "log_std": -0.5,
    "core": "none", "gru_size": 64, "sequence_length": 16,
}  # fmt: skip
EVERY_KEY = {
    "critic_update": "adam", "policies": "independent", "shared_until": 0.0, "apart_lr": 1.0, "model": MODEL,
    "critic_actions": "none", "target_every": 4, "gamma": 0.99, "gae_lambda": 0.95, "lr": 0.0005,
    "critic_lr": None, "lr_end": 1.0, "epochs": 5, "minibatches": 8, "clip": 0.2, "kl_coeff": 0.0,
    "kl_target": 0.01, "kl_bound": 0.01, "accept_ratio": 0.1, "cg_iterations": 10, "cg_damping": 0.1,
    "line_search_steps": 10, "fisher_share": 1.0, "kfac_damping": 0.01, "kfac_decay": 0.95, "kfac_every": 1,
    "kfac_length": "exact", "kfac_momentum": 0.0, "critic_kl_bound": 0.3, "entropy_coeff": 0.01,
    "value_clip": None, "grad_clip": 0.5, "normalise_advantages": True, "normalise_observations": True,
    "normalise_values": True, "precision": "float32", "piece_samples": 5120,
}  # fmt: skip
STORED: dict[str, dict[str, Any]] = {
    "mappo": {"critic": "central", "update": "ppo", "order": "simultaneous"},
    "itrpo": {"critic": "local", "update": "trpo", "order": "simultaneous"},
    "hatrpo": {"critic": "central", "update": "trpo", "order": "sequential"},
    "coma": {
        "critic": "counterfactual", "update": "a2c", "order": "simultaneous", "epochs": 1, "minibatches": 1
    },
    "maacktr": {
        "critic": "local", "update": "kfac", "critic_update": "kfac", "order": "simultaneous",
        "policies": "shared", "lr": 0.25, "epochs": 1, "minibatches": 1,
    },
    "a3c": {
        "critic": "local", "update": "a2c", "order": "simultaneous", "epochs": 1, "minibatches": 1,
        "application": "arrival",
    },
    "custom": {"critic": "central", "update": "kfac", "order": "sequential", "kfac_every": 3},
}  # fmt: skip


def _stored(name: str, **changes: object) -> dict[str, Any]:
    """Return the configuration of a run of an algorithm as it was stored."""
    today = full_mapping(compose(["env=trivial", f"algo={name}"]), (1,))
    return {**today, "algo": {"name": name, **EVERY_KEY, **STORED[name], **changes}}


@pytest.mark.parametrize("name", STORED)
def test_a_stored_run_is_the_run_of_the_same_settings_today_in_the_same_cell(name: str) -> None:
    stored = _stored(name)
    experiment = resolve(upgraded(stored))
    assert identity(full_mapping(experiment, (1,))) == identity(upgraded(stored))
    heeded: dict[str, Any] = plain(experiment.algo_config)
    assert heeded.pop("agent_id") is False
    assert heeded == {key: stored["algo"][key] for key in heeded}
    left_out = set(stored["algo"]) - set(heeded)
    assert len(left_out) >= 10
    # It keeps its cell, whose key is a digest of its parameters; today's run of the same settings has it too.
    kept = {key: stored[key] for key in ("env_steps", "device", "env", "algo", "rollout")}
    parameters = {key: str(value) for key, value in flat(kept)}
    assert hashed_parameters(name, parameters) == parameters
    today = cell_parameters(experiment)
    assert hashed_parameters(name, {key: str(value) for key, value in today.items()}) == parameters


@pytest.mark.parametrize(
    ("name", "changes", "today"),
    [
        ("mappo", {"kl_target": 0.2, "cg_damping": 3.0}, {"kl_target": 0.01}),
        ("itrpo", {"lr": 0.1, "critic_lr": 0.3, "clip": 0.3}, {"lr": 0.0005, "critic_lr": 0.3}),
        ("mappo", {"model": {**MODEL, "gru_size": 3}}, {}),
    ],
)
def test_values_without_use_are_forgotten(name: str, changes: dict[str, Any], today: dict[str, Any]) -> None:
    config = resolve(upgraded(_stored(name, **changes))).algo_config
    assert config.model.gru_size == 64
    assert {key: getattr(config, key) for key in today} == today


def test_keys_that_no_algorithm_has_are_kept_and_refused() -> None:
    with pytest.raises(HeadwayError, match=r"algo\.sharpness is not a key of mappo"):
        resolve(upgraded(_stored("mappo", sharpness=3)))


def test_the_former_name_of_the_workers_timeout_is_read() -> None:
    stored = _stored("mappo")
    del stored["backend"]["worker_timeout_s"]
    stored["backend"]["patience_s"] = 30.0
    assert resolve(upgraded(stored)).config.backend.worker_timeout_s == 30.0
