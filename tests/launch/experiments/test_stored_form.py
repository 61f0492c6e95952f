"""Runs stored when all on-policy algorithms had one record, with 41 keys, keep their cells."""

from typing import Any

import pytest

from headway.registry import algo_entries, hashed_parameters
from headway.store.run_configuration import upgraded
from headway_launch.experiments.compose import compose, resolve
from headway_launch.experiments.parameters import cell_parameters, flat, full_mapping

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


@pytest.mark.parametrize("name", STORED)
def test_a_run_of_the_same_settings_today_is_in_the_same_cell(name: str) -> None:
    """The key of a cell is a digest of its parameters."""
    then = {"name": name, **EVERY_KEY, **STORED[name]}
    components = [f"algo.{key}={then[key]}" for key in ("critic", "update", "order") if name == "custom"]
    mapping = full_mapping(compose(["env=trivial", f"algo={name}", *components]), (1,))
    algo = {"agent_id": False, **{key: then[key] for key in mapping["algo"] if key in then}}
    assert len(set(then) - set(algo)) >= 10
    today = {key: str(value) for key, value in cell_parameters(resolve({**mapping, "algo": algo})).items()}
    kept = {key: mapping[key] for key in ("env_steps", "device", "env", "rollout")}
    parameters = {key: str(value) for key, value in flat({**kept, "algo": then})}
    assert hashed_parameters(name, parameters) == hashed_parameters(name, today) == parameters


@pytest.mark.parametrize("name", algo_entries())
def test_a_stored_configuration_is_accepted(name: str) -> None:
    env = "tracking" if name == "ddpg" else "trivial"
    mapping = full_mapping(compose([f"env={env}", f"algo={name}"]), (1,))
    assert resolve(upgraded(mapping)).algo_config == resolve(mapping).algo_config
