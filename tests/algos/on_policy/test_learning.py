"""Learning bars: each algorithm comes close to a known optimum within seconds."""

from typing import Any

import pytest
from toy_training import mean_return, return_of_rule, share_of_optimum, train_toy

from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.registry import ENTRIES
from headway_algos.replay_config import NetworkConfig

pytestmark = pytest.mark.slow

CONFIGS = {name: entry.config() for name, entry in ENTRIES.items()}
ON_POLICY = {
    name: config
    for name, config in CONFIGS.items()
    if isinstance(config, AlgoConfig) and ENTRIES[name].contributor is None
}
"""Synchronous algorithms; for the others see `test_asynchronous`."""
ALGORITHMS = [name for name, config in ON_POLICY.items() if name != "custom" and config.critic != "local"]
"""Synchronous algorithms without a local critic; `test_defaults` trains the others, with the same updates."""
CONTINUOUS = [name for name in ALGORITHMS if name != "coma"]
"""Algorithms that take Box actions."""
UPDATE = {name: config.update for name, config in ON_POLICY.items()}
IN_TURNS = {name for name, config in ON_POLICY.items() if config.order == "sequential"}
"""Algorithms that need one policy per agent, trained on its own experience only."""


MATRIX_SETTINGS = {
    "policies": "independent", "minibatches": 1, "lr": 1e-2, "lr_end": 0.1, "entropy_coeff": 0.3
}  # fmt: skip
NATURAL_LR = {"lr": 0.25}
"""Settings of K-FAC; the learning rate is a share of the natural gradient."""
CLIMBING: dict[str, tuple[dict[str, float], int]] = {
    "ppo": ({}, 45),
    "a2c": ({"lr": 2e-2, "lr_end": 0.5, "entropy_coeff": 0.7}, 120),
    "trpo": ({"kl_bound": 0.1, "entropy_coeff": 0.5}, 45),
    "kfac": ({**NATURAL_LR, "kl_bound": 0.1, "entropy_coeff": 0.5}, 45),
}
"""Further settings and number of iterations, by update."""


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_climbing_game_is_played_at_its_safe_equilibrium(algorithm: str) -> None:
    """7 of 11: independent improvement is kept from the best payoff by the penalty of -30 next to it, and
    reaches 7 through 5 and 6 (Claus and Boutilier 1998). The entropy bonus prevents stopping at 6."""
    changes, iterations = CLIMBING[UPDATE[algorithm]]
    settings = {**MATRIX_SETTINGS, **changes}
    evaluated = train_toy("matrix", {}, algorithm, settings, (16, 16, iterations))
    assert mean_return(evaluated) == 7.0


@pytest.mark.parametrize("algorithm", CONTINUOUS)
def test_tracking_costs_little_more_than_the_linear_quadratic_regulator(algorithm: str) -> None:
    """The cost is at most 1.6 times the optimal one with a shared policy, and twice with independent ones;
    untrained policies cost hundreds of times as much."""
    in_turns = algorithm in IN_TURNS
    settings: dict[str, Any] = {
        "policies": "independent" if in_turns else "shared",
        "agent_id": False,
        # A standard deviation of 0.3 in [-1, 1]: good actions take a small part of the range.
        "model": ModelConfig(hidden=(32, 32), activation="relu", log_std=-1.2),
        "gamma": 0.8,
        "lr": 5e-3,
        "lr_end": 0.02,
        "entropy_coeff": 0.0,
        "minibatches": 4,
        "normalise_observations": False,
    }
    iterations = 60 if in_turns else 35
    if UPDATE[algorithm] == "a2c":
        settings, iterations = {**settings, "minibatches": 1, "lr": 1e-2}, 120
    if UPDATE[algorithm] == "trpo":
        settings["kl_bound"] = 0.1 if algorithm not in IN_TURNS else 0.05
    if UPDATE[algorithm] == "kfac":
        settings, iterations = {**settings, **NATURAL_LR, "minibatches": 1, "kl_bound": 0.03}, 60
    episode = {"steps": 20}
    evaluated = train_toy("tracking", episode, algorithm, settings, (8, 40, iterations))
    best = return_of_rule("tracking", episode, "optimal")
    assert mean_return(evaluated) > (2.0 if in_turns else 1.6) * best
    assert mean_return(train_toy("tracking", episode, algorithm, settings, (8, 40, 1))) < 100 * best


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_visitors_are_nearly_optimal_and_never_choose_forbidden_options(algorithm: str) -> None:
    """With agents that come, go and retire, training closes at least 0.96 of the gap between random and
    optimal play, 0.88 with independent policies."""
    settings: dict[str, Any] = {"policies": "shared", "gamma": 0.9, "lr": 3e-3, "lr_end": 0.1}
    iterations = 10
    if UPDATE[algorithm] == "a2c":
        settings, iterations = {**settings, "lr": 5e-3, "epochs": 4}, 40
    if UPDATE[algorithm] == "kfac":
        settings |= NATURAL_LR
    if algorithm in IN_TURNS:
        settings, iterations = {**settings, "policies": "independent", "lr": 2e-3, "epochs": 3}, 20
    evaluated = train_toy("visitors", {}, algorithm, settings, (4, 64, iterations))
    assert share_of_optimum("visitors", {}, evaluated) > (0.88 if algorithm in IN_TURNS else 0.96)
    assert all(row["disallowed"] == 0 for row in evaluated)


RECALL: dict[str, tuple[dict[str, Any], int]] = {
    "ippo": ({"minibatches": 4, "lr": 1e-2, "lr_end": 0.05}, 25),
    "ia2c": ({"minibatches": 1, "lr": 2e-2, "lr_end": 0.1}, 40),
}
"""Settings and number of iterations, for steps on sequences and on the whole batch."""


CUED = {"agents": 2, "steps": 4}


def _recalled(algorithm: str, model: ModelConfig) -> float:
    settings, iterations = RECALL[algorithm]
    chosen = {**settings, "policies": "independent", "model": model}
    return mean_return(train_toy("recall", CUED, algorithm, chosen, (16, 24, iterations)))


@pytest.mark.parametrize("algorithm", RECALL)
def test_recurrent_policies_recall_the_first_observation_at_the_end(algorithm: str) -> None:
    """Always, of two cues."""
    recurrent = ModelConfig((16,), core="gru", gru_size=16, sequence_length=12)
    assert _recalled(algorithm, recurrent) == 1.0


def test_policies_without_recurrence_recall_no_better_than_chance() -> None:
    assert 0.2 <= _recalled("ippo", ModelConfig((16,))) <= 0.8


def test_counterfactual_credit_finds_each_agents_part_in_a_teams_reward() -> None:
    """More than 0.75 of the way from random to optimal, although nine tenths of the reward, the share of ten
    agents that choose right, depend on the others."""
    team = {"agents": 10, "steps": 50}
    settings = {
        "critic": "counterfactual", "policies": "shared", "agent_id": False, "gamma": 0.5, "gae_lambda": 0.5,
        "lr": 3e-3,
    }  # fmt: skip
    evaluated = train_toy("trivial", team, "custom", settings, (4, 50, 15))
    assert share_of_optimum("trivial", team, evaluated) > 0.75


def test_q_learning_plays_matrix_without_a_trap_at_its_optimum() -> None:
    """11 of 11, each agent by its own values, with the other as part of the environment."""
    game = {"payoff": ((11.0, 6.0, 4.0), (6.0, 5.0, 3.0), (4.0, 3.0, 2.0))}
    settings = {
        "policies": "independent", "lr": 5e-2, "updates": 8, "batch_size": 32, "learning_starts": 64,
    }  # fmt: skip
    evaluated = train_toy("matrix", game, "madqn", settings, (8, 8, 30))
    assert mean_return(evaluated) == 11.0


REPLAYED = {
    "policies": "shared", "agent_id": False, "lr": 2e-3, "updates": 30, "batch_size": 64,
    "learning_starts": 200, "target_every": 50,
}  # fmt: skip


@pytest.mark.parametrize("double", [True, False])
def test_q_learning_of_visitors_is_nearly_optimal(double: bool) -> None:
    """With agents that come and go, training closes at least 0.94 of the gap between random and
    optimal play."""
    settings = {**REPLAYED, "gamma": 0.9, "double": double}
    evaluated = train_toy("visitors", {}, "madqn", settings, (4, 32, 20))
    assert share_of_optimum("visitors", {}, evaluated) > 0.94
    assert all(row["disallowed"] == 0 for row in evaluated)


@pytest.mark.parametrize("n_step", [1, 3])
def test_q_learning_of_trivial_comes_near_its_optimum(n_step: int) -> None:
    """Training on the team reward of three agents closes at least 0.85 of the gap between random and optimal
    play."""
    team = {"agents": 3, "steps": 50}
    settings = {**REPLAYED, "gamma": 0.5, "n_step": n_step}
    evaluated = train_toy("trivial", team, "madqn", settings, (4, 50, 20))
    assert share_of_optimum("trivial", team, evaluated) > 0.85


def test_deterministic_policies_track_at_little_more_than_the_optimal_cost() -> None:
    """The cost is at most 4 times that of the linear-quadratic regulator; untrained policies cost hundreds of
    times as much."""
    settings = {
        "policies": "shared", "agent_id": False, "model": NetworkConfig((32, 32), "tanh"), "gamma": 0.6,
        "lr": 1e-3,
        "critic_lr": 5e-3, "lr_end": 0.02, "updates": 40, "learning_starts": 200, "tau": 0.05,
        "loss": "huber", "exploration_start": 0.5, "normalise_observations": False,
        "normalise_rewards": False,
    }  # fmt: skip
    episode = {"steps": 20}
    best = return_of_rule("tracking", episode, "optimal")
    assert mean_return(train_toy("tracking", episode, "ddpg", settings, (8, 20, 45))) > 4 * best
    assert mean_return(train_toy("tracking", episode, "ddpg", settings, (8, 20, 1))) < 100 * best
