"""The learner: each policy by itself, from its own experience."""

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from covering import pairwise
from learned import assert_close, assert_equal, of_agents, tensors
from made_trajectories import fabricate, poisoned
from numpy.typing import NDArray

from headway.contracts import ActionSpace, Box, Discrete, EnvSpec, HeadwayError, Trajectory, TrajectoryLayout
from headway_algos.off_policy.learner import OffPolicyLearner
from headway_algos.registry import ENTRIES
from headway_algos.replay_config import DDPGConfig, MADQNConfig, NetworkConfig, ReplayConfig

Policies = Literal["independent", "shared", "groups"]
AGENTS = ("a", "b", "c")
DISCRETE = EnvSpec(
    "made", AGENTS, 4, Discrete(3), groups=("x", "y", "x"), has_action_mask=True, agents_come_and_go=True,
    snapshots=True,
)  # fmt: skip
BOX = replace(DISCRETE, action_space=Box((-1.0, -2.0), (1.0, 2.0)), has_action_mask=False)
COMMON: dict[str, Any] = {
    "policies": "independent", "model": NetworkConfig((8,), "tanh"), "precision": "float64", "capacity": 60,
    "learning_starts": 5,
    "batch_size": 7, "updates": 4,
}  # fmt: skip
MADQN = MADQNConfig(**COMMON, target_every=3)
DDPG = DDPGConfig(**COMMON, lr=1e-3)
CASES = {
    "madqn": (MADQN, DISCRETE),
    "madqn n-step": (replace(MADQN, n_step=3), DISCRETE),
    "ddpg": (DDPG, BOX),
}
every_case = pytest.mark.parametrize(("config", "spec"), CASES.values(), ids=CASES)


def _learner(config: ReplayConfig, spec: EnvSpec, seeds: tuple[int, ...]) -> OffPolicyLearner:
    learner = ENTRIES[config.name].learner(config, spec, seeds, "cpu")
    assert isinstance(learner, OffPolicyLearner)
    return learner


def _tensors(learner: OffPolicyLearner) -> dict[str, NDArray[Any]]:
    """Every tensor that learning changes, with leading axis P."""
    return tensors(learner.state_dict())


@every_case
def test_an_independent_policy_trains_alone_as_among_others(config: ReplayConfig, spec: EnvSpec) -> None:
    among = _learner(config, spec, (4,))
    alone = _learner(config, replace(spec, agents=("a",), groups=("x",)), (4,))
    start = _tensors(alone)
    for iteration in (1, 2, 3):
        made = fabricate(spec, 10, 2, seed=iteration, absent=0.2, idle=0.3)
        among.update(made, iteration, 0.0)
        alone.update(of_agents(made, slice(0, 1)), iteration, 0.0)
    got = {name: value[:1] for name, value in _tensors(among).items()}
    assert_close(got, _tensors(alone), rtol=1e-10)
    assert any((_tensors(alone)[name] != value).any() for name, value in start.items() if "weights" in name)


@every_case
def test_poisoned_rows_without_experience_change_nothing(config: ReplayConfig, spec: EnvSpec) -> None:
    clean, bad = (_learner(config, spec, (1, 2)) for _ in range(2))
    for iteration in (1, 2):
        made = fabricate(spec, 9, 4, seed=iteration, absent=0.4, idle=0.4, leaves=0.05)
        expected = clean.update(made, iteration, 0.0)
        assert_equal(bad.update(poisoned(made), iteration, 0.0), expected)
    assert_equal(_tensors(bad), _tensors(clean))


@every_case
def test_nothing_is_learned_before_the_buffer_holds_enough(config: ReplayConfig, spec: EnvSpec) -> None:
    """Each policy waits for its own replay buffer to fill."""
    learner = _learner(replace(config, learning_starts=25), spec, (1,))
    before = [array.detach().clone() for array in learner.method.network.parameters()]
    made = fabricate(spec, 10, 3, seed=0, ends=0.3)
    made.acting[:, :, 0] = False
    made.acting[:, :, 1] &= np.arange(10)[:, None] < 5
    info = learner.update(made, 1, 0.0)
    assert info["critic/loss"][0] > 0
    held = learner.replay.filled
    assert held[0] == 0 < held[1] < 25 <= held[2]
    moved = [
        [bool((now[k] != then[k]).any()) for k in range(3)]
        for now, then in zip(learner.method.network.parameters(), before, strict=True)
    ]
    assert np.any(moved, axis=0).tolist() == [False, False, True]
    assert info["memory/transitions"][0] == held.mean()


@every_case
@pytest.mark.parametrize("normalised", [True, False])
def test_normalised_rewards_have_no_unit(config: ReplayConfig, spec: EnvSpec, normalised: bool) -> None:
    """Rewards eight times larger, a power of two, give values eight times larger; all else is the same."""
    config = replace(config, normalise_rewards=normalised)
    first, second = (_learner(config, spec, (1, 2)) for _ in range(2))
    infos = []
    for iteration in (1, 2, 3):
        made = fabricate(spec, 10, 4, seed=iteration, ends=0.3)
        scaled = replace(made, rewards=8 * made.rewards)
        infos = [learner.update(rows, iteration, 0.1) for learner, rows in ((first, made), (second, scaled))]
    same = [np.array_equal(value, _tensors(second)[name]) for name, value in _tensors(first).items()]
    assert all(same) == normalised
    if normalised:
        np.testing.assert_array_equal(infos[1]["critic/value"], 8 * infos[0]["critic/value"])


def test_the_scale_of_rewards_is_the_root_mean_square_of_stored_returns() -> None:
    learner = _learner(MADQN, DISCRETE, (1,))
    assert learner.replay.return_scale().tolist() == [1, 1, 1]
    learner.update(fabricate(DISCRETE, 10, 3, seed=0, ends=0.3), 1, 0.0)
    returns = learner.replay.arrays["returns"].view(3, -1).numpy()
    for p, filled in enumerate(learner.replay.filled.tolist()):
        expected = np.sqrt(np.mean(returns[p, :filled] ** 2))
        assert float(learner.replay.return_scale()[p]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("decay", [None, 8.0])
def test_exploration_of_both_schedules_lags_by_one_iteration_and_is_reported(decay: float | None) -> None:
    """The schedules also continue from a checkpoint."""
    config = replace(MADQN, exploration_start=0.8, exploration_end=0.2, exploration_decay_steps=decay)
    learner = _learner(config, DISCRETE, (1, 2))
    for iteration in (1, 2, 3):
        done = iteration - 1
        acted = float(learner.acting_parameters()["exploration"].max())
        info = learner.update(fabricate(DISCRETE, 4, 4, seed=iteration), iteration, done / 9)
        assert info["policy/exploration"].tolist() == [acted] * 2
        assert learner.env_steps == 8 * iteration
        assert learner.exploration == config.exploration(done / 9, 8 * done)
        assert float(learner.acting_parameters()["exploration"].max()) == learner.exploration
        other = _learner(config, DISCRETE, (1, 2))
        other.load_state_dict(learner.state_dict())
        assert other.exploration == learner.exploration


def test_learning_rates_are_annealed_linearly() -> None:
    learner = _learner(replace(DDPG, lr_end=0.1), BOX, (1,))
    for iteration, (progress, share) in enumerate(((0.0, 1.0), (0.5, 0.55), (1.0, 0.1)), start=1):
        learner.update(fabricate(BOX, 4, 2, seed=0), iteration, progress)
        method: Any = learner.method
        assert method.actor_optimiser.lr == pytest.approx(1e-3 * share)
        assert method.critic_optimiser.lr == pytest.approx(1e-3 * share)


@every_case
def test_policies_that_are_no_longer_finite_are_named(config: ReplayConfig, spec: EnvSpec) -> None:
    learner = _learner(config, spec, (4, 6))
    with torch.no_grad():
        learner.method.network.weights[0][5, 0, 0] = np.nan
    with pytest.raises(HeadwayError) as caught:
        learner.update(fabricate(spec, 2, 2, seed=0), 7, 0.0)
    blamed = f"{config.name} diverged: the policy of agent c, seed 6, is not finite after iteration 7; lower"
    assert str(caught.value).startswith(blamed)
    assert "\n" not in str(caught.value)


@every_case
def test_an_absurd_learning_rate_ends_in_one_line(config: ReplayConfig, spec: EnvSpec) -> None:
    wild = replace(config, lr=1e30, precision="float32", grad_clip=None, loss="squared")
    learner = _learner(wild if wild.name == "madqn" else replace(wild, critic_lr=1e30), spec, (1,))

    def learn() -> None:
        for iteration in range(1, 20):
            learner.update(fabricate(spec, 8, 3, seed=iteration), iteration, 0.0)

    with pytest.raises(HeadwayError, match=r"diverged: the policy of agent .*, seed 1"):
        learn()


OF_BOTH: list[dict[str, float]] = [
    {"gamma": 1.1}, {"n_step": 0}, {"lr": 0.0}, {"lr_end": 2.0}, {"capacity": 0}, {"learning_starts": 0},
    {"learning_starts": 70_000}, {"batch_size": 0}, {"updates": 0}, {"target_every": 0}, {"tau": 0.0},
    {"tau": 1.5}, {"grad_clip": 0.0}, {"exploration_start": -0.1}, {"exploration_end": -0.1},
    {"exploration_start": 0.1, "exploration_end": 0.2}, {"exploration_share": 1.1},
    {"exploration_decay_steps": 0.0},
]  # fmt: skip
"""Impossible values, the last of which is to blame."""
OF_DDPG = [{"critic_lr": 0.0}, {"ou_theta": 1.5}, {"ou_sigma": -1.0}, {"saturation_coeff": -0.1}]


@pytest.mark.parametrize(
    ("config", "wrong"),
    [
        *[(MADQNConfig, wrong) for wrong in [*OF_BOTH, {"exploration_start": 1.5}]],
        *[(DDPGConfig, wrong) for wrong in [*OF_BOTH, *OF_DDPG]],
        (NetworkConfig, {"hidden": (8, 0)}),
    ],
)
def test_impossible_numbers_are_named(config: type[Any], wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{list(wrong)[-1]} must"):
        config(**wrong)


@pytest.mark.parametrize(
    ("name", "space", "line"),
    [
        ("madqn", Box((-1.0,), (1.0,)), "madqn takes Discrete actions, .* made has Box ones; use algo=ddpg"),
        ("ddpg", Discrete(2), "ddpg takes Box actions, .* made has Discrete ones; use algo=madqn"),
        ("ddpg", Box((-1.0,), (np.inf,)), "ddpg takes bounded Box actions, .*algo=ippo"),
        ("ddpg", Box((-3.4028235e38,), (3.4028235e38,)), "ddpg takes bounded Box actions, .*algo=ippo"),
    ],
)
def test_actions_of_the_other_kind_are_refused_in_one_line(name: str, space: ActionSpace, line: str) -> None:
    entry, spec = ENTRIES[name], replace(BOX, action_space=space)
    reason = entry.refuses(entry.config(), spec)
    assert reason is not None
    assert "\n" not in reason
    with pytest.raises(HeadwayError, match=line):
        entry.acting_policy(entry.config(), spec)


@pytest.mark.parametrize(
    ("case", "policies", "iterations"), pairwise(CASES, ["independent", "shared", "groups"], [1, 6])
)
def test_replay_bytes_are_predicted(case: str, policies: Policies, iterations: int) -> None:
    """The prediction is compared with a seed whose agents act at every step, with full and partly filled
    buffers."""
    config, spec = CASES[case]
    config = replace(config, policies=policies, n_step=1)
    learner, steps = _learner(config, spec, (1,)), 12 * 2
    for iteration in range(iterations):
        learner._store(fabricate(spec, 12, 2, seed=iteration))
    real = sum(array.nbytes for array in learner.replay_state()["memory"]["arrays"].values())
    predicted = ENTRIES[config.name].replay_bytes(config, spec, iterations * steps)
    assert real == pytest.approx(predicted, rel=0.15)


def test_what_is_forbidden_is_worth_nothing_at_a_time_limit() -> None:
    """-1 per step for ever, in episodes cut after two steps: the allowed actions are worth -1 / (1 - gamma);
    of the third one nothing is ever learned."""
    spec = EnvSpec("made", ("a",), 1, Discrete(3), has_action_mask=True, snapshots=True)
    config = replace(MADQN, gamma=0.8, lr=1e-2, updates=16, normalise_observations=False)
    learner = _learner(config, spec, (1,))
    made = Trajectory.allocate(TrajectoryLayout(spec, 2, 8))
    made.alive[:], made.acting[:], made.rewards[:], made.truncated[1] = True, True, -1, True
    made.observations[:], made.final_observations[:], made.action_masks[..., :2] = 1, 1, True
    for iteration in range(1, 61):
        made.actions[:] = np.random.default_rng(iteration).integers(2, size=made.actions.shape)
        learner.update(made, iteration, 0.0)
    values = learner.method.network(torch.ones(1, 1, 1, dtype=torch.float64))[0, :2, 0]
    np.testing.assert_allclose(values.detach().numpy(), -5, atol=0.25)
