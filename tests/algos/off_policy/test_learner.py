"""The learner: each policy by itself, from its own experience, and on again from where it stood."""

import io
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from headway.contracts import (
    ActionSpace,
    Box,
    Discrete,
    EnvSpec,
    HeadwayError,
    LearnerWithReplay,
    Trajectory,
    TrajectoryLayout,
)
from headway_algos.off_policy.learner import OffPolicyLearner
from headway_algos.registry import ENTRIES
from headway_algos.replay_config import DDPGConfig, MADQNConfig, NetworkConfig, ReplayConfig

Fabricate = Callable[..., Trajectory]
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


def _numbers(state: Any, path: str = "") -> dict[str, NDArray[Any]]:  # noqa: ANN401 - tensors, nested
    if isinstance(state, torch.Tensor):
        return {path: state.detach().numpy().copy()}
    if not isinstance(state, dict | list):
        return {}
    items = state.items() if isinstance(state, dict) else enumerate(state)
    return {name: value for key, part in items for name, value in _numbers(part, f"{path} {key}").items()}


def _tensors(learner: OffPolicyLearner) -> dict[str, NDArray[Any]]:
    """Every tensor that learning changes, with leading axis P."""
    return _numbers(learner.state_dict())


def _assert_close(got: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]]) -> None:
    assert got.keys() == expected.keys()
    for name in got:
        np.testing.assert_allclose(got[name], expected[name], rtol=1e-10, atol=1e-10, err_msg=name)


def _joined(parts: list[Trajectory]) -> Trajectory:
    return Trajectory(
        *(
            np.concatenate([getattr(part, field.name) for part in parts], axis=1)
            for field in fields(Trajectory)
        )
    )


def _of_agents(made: Trajectory, agents: slice) -> Trajectory:
    by_agent = {field.name for field in fields(Trajectory)} - {"states", "final_states"}
    return Trajectory(
        *(
            getattr(made, field.name)[:, :, agents] if field.name in by_agent else getattr(made, field.name)
            for field in fields(Trajectory)
        )
    )


@every_case
@pytest.mark.parametrize("policies", ["independent", "shared", "groups"])
def test_a_seed_trains_the_same_alone_and_in_a_stack_of_three(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec, policies: Policies
) -> None:
    config = replace(config, policies=policies)
    among, alone = _learner(config, spec, (4, 5, 6)), _learner(config, spec, (5,))
    for iteration in (1, 2, 3):
        parts = [fabricate(spec, 8, 2, seed=10 * iteration + r, absent=0.3, idle=0.3) for r in range(3)]
        together = among.update(_joined(parts), iteration, iteration / 9)
        single = alone.update(parts[1], iteration, iteration / 9)
        for name in single:
            np.testing.assert_allclose(together[name][1], single[name][0], rtol=1e-9, err_msg=name)
    policies_each = among.grouping.num_policies
    mine = {n: v[policies_each : 2 * policies_each] for n, v in _tensors(among).items()}
    _assert_close(mine, _tensors(alone))


@every_case
def test_an_independent_policy_trains_the_same_alone_and_among_others(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec
) -> None:
    among = _learner(config, spec, (4,))
    alone = _learner(config, replace(spec, agents=("a",), groups=("x",)), (4,))
    start = _tensors(alone)
    for iteration in (1, 2, 3):
        made = fabricate(spec, 10, 2, seed=iteration, absent=0.2, idle=0.3)
        among.update(made, iteration, 0.0)
        alone.update(_of_agents(made, slice(0, 1)), iteration, 0.0)
    _assert_close({name: value[:1] for name, value in _tensors(among).items()}, _tensors(alone))
    assert any((_tensors(alone)[name] != value).any() for name, value in start.items() if "weights" in name)


@every_case
@pytest.mark.parametrize("policies", ["independent", "shared"])
def test_poisoned_rows_without_experience_change_nothing(
    fabricate: Fabricate,
    poisoned: Callable[[Trajectory], Trajectory],
    config: ReplayConfig,
    spec: EnvSpec,
    policies: Policies,
) -> None:
    clean, bad = (_learner(replace(config, policies=policies), spec, (1, 2)) for _ in range(2))
    for iteration in (1, 2):
        made = fabricate(spec, 9, 4, seed=iteration, absent=0.4, idle=0.4, leaves=0.05)
        infos = [
            learner.update(part, iteration, 0.0) for learner, part in ((clean, made), (bad, poisoned(made)))
        ]
        for name, value in infos[0].items():
            np.testing.assert_array_equal(infos[1][name], value, err_msg=name)
    for name, value in _tensors(clean).items():
        np.testing.assert_array_equal(_tensors(bad)[name], value, err_msg=name)


@every_case
def test_training_resumed_from_a_checkpoint_is_exact(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec
) -> None:
    config = replace(config, lr_end=0.1, precision="float32")
    first, second = (_learner(config, spec, (1, 2)) for _ in range(2))
    assert isinstance(first, LearnerWithReplay)
    made = [fabricate(spec, 8, 6, seed=i, absent=0.3, idle=0.4) for i in range(4)]
    for iteration in (1, 2):
        first.update(made[iteration - 1], iteration, iteration / 4)
    kept = first.replay_state()
    assert len(kept["open"]["streams"]) > 0
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True))
    second.load_replay_state(kept)
    for iteration in (3, 4):
        infos = [learner.update(made[iteration - 1], iteration, iteration / 4) for learner in (first, second)]
        for name in infos[0]:
            np.testing.assert_array_equal(infos[0][name], infos[1][name], err_msg=name)
    for name, value in _tensors(first).items():
        np.testing.assert_array_equal(value, _tensors(second)[name], err_msg=name)
    for name, array in first.acting_parameters().items():
        np.testing.assert_array_equal(array, second.acting_parameters()[name], err_msg=name)


@every_case
def test_nothing_is_learned_before_there_is_enough_to_draw_from(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec
) -> None:
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
def test_with_normalised_rewards_their_unit_does_not_matter(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec, normalised: bool
) -> None:
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


def test_the_scale_of_rewards_is_the_root_mean_square_of_what_is_stored(fabricate: Fabricate) -> None:
    learner = _learner(MADQN, DISCRETE, (1,))
    assert learner.replay.return_scale().tolist() == [1, 1, 1]
    learner.update(fabricate(DISCRETE, 10, 3, seed=0, ends=0.3), 1, 0.0)
    returns = learner.replay.arrays["returns"].view(3, -1).numpy()
    for p, filled in enumerate(learner.replay.filled.tolist()):
        expected = np.sqrt(np.mean(returns[p, :filled] ** 2))
        assert float(learner.replay.return_scale()[p]) == pytest.approx(expected, rel=1e-12)


def test_exploration_follows_its_schedule_and_is_reported(fabricate: Fabricate) -> None:
    config = replace(MADQN, exploration_start=0.8, exploration_end=0.2, exploration_share=0.5)
    learner, reported, acted = _learner(config, DISCRETE, (1, 2)), [], []
    for iteration in range(1, 6):
        acted.append(float(learner.acting_parameters()["exploration"].max()))
        info = learner.update(fabricate(DISCRETE, 4, 2, seed=iteration), iteration, (iteration - 1) / 4)
        reported.append(info["policy/exploration"].tolist())
    assert reported == [[value] * 2 for value in acted]
    np.testing.assert_allclose(acted, [0.8, 0.8, 0.5, 0.2, 0.2])


@pytest.mark.parametrize("decay", [None, 8.0])
def test_exploration_of_both_schedules_lags_by_one_iteration(
    fabricate: Fabricate, decay: float | None
) -> None:
    """Also where training goes on from a checkpoint."""
    config = replace(MADQN, exploration_start=0.8, exploration_end=0.2, exploration_decay_steps=decay)
    learner = _learner(config, DISCRETE, (1, 2))
    for iteration in (1, 2, 3):
        done = iteration - 1
        learner.update(fabricate(DISCRETE, 4, 4, seed=iteration), iteration, done / 9)
        assert learner.env_steps == 8 * iteration
        assert learner.exploration == config.exploration(done / 9, 8 * done)
        other = _learner(config, DISCRETE, (1, 2))
        other.load_state_dict(learner.state_dict())
        assert other.exploration == learner.exploration


@pytest.mark.parametrize(("progress", "share"), [(0.0, 1.0), (0.5, 0.55), (1.0, 0.1)])
def test_learning_rates_are_annealed_linearly(fabricate: Fabricate, progress: float, share: float) -> None:
    learner = _learner(replace(DDPG, lr_end=0.1), BOX, (1,))
    learner.update(fabricate(BOX, 4, 2, seed=0), 1, progress)
    method: Any = learner.method
    assert method.actor_optimiser.lr == pytest.approx(1e-3 * share)
    assert method.critic_optimiser.lr == pytest.approx(1e-3 * share)


@every_case
def test_policies_that_are_no_longer_finite_are_named(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec
) -> None:
    learner = _learner(config, spec, (4, 6))
    with torch.no_grad():
        learner.method.network.weights[0][5, 0, 0] = np.nan
    with pytest.raises(HeadwayError) as caught:
        learner.update(fabricate(spec, 2, 2, seed=0), 7, 0.0)
    message = str(caught.value)
    assert (
        f"{config.name} diverged: the policy of agent c, seed 6, is not finite after iteration 7" in message
    )
    assert "lower algo.lr" in message
    assert "\n" not in message


@every_case
def test_an_absurd_learning_rate_ends_in_one_line(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec
) -> None:
    wild = replace(config, lr=1e30, precision="float32", grad_clip=None, loss="squared")
    learner = _learner(wild if wild.name == "madqn" else replace(wild, critic_lr=1e30), spec, (1,))

    def learn() -> None:
        for iteration in range(1, 20):
            learner.update(fabricate(spec, 8, 3, seed=iteration), iteration, 0.0)

    with pytest.raises(HeadwayError, match=r"diverged: the policy of agent .*, seed 1"):
        learn()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"gamma": 1.1}, "gamma"),
        ({"n_step": 0}, "n_step"),
        ({"lr": 0.0}, "lr"),
        ({"lr_end": 2.0}, "lr_end"),
        ({"capacity": 0}, "capacity"),
        ({"learning_starts": 0}, "learning_starts"),
        ({"learning_starts": 70_000}, "learning_starts"),
        ({"batch_size": 0}, "batch_size"),
        ({"updates": 0}, "updates"),
        ({"target_every": 0}, "target_every"),
        ({"tau": 0.0}, "tau"),
        ({"tau": 1.5}, "tau"),
        ({"grad_clip": 0.0}, "grad_clip"),
        ({"exploration_start": -0.1}, "exploration_start"),
        ({"exploration_end": -0.1}, "exploration_end"),
        ({"exploration_start": 0.1, "exploration_end": 0.2}, "exploration_end"),
        ({"exploration_share": 1.1}, "exploration_share"),
        ({"exploration_decay_steps": 0.0}, "exploration_decay_steps"),
    ],
)
@pytest.mark.parametrize("config", [MADQNConfig, DDPGConfig])
def test_impossible_numbers_are_named(config: type[Any], wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named} must"):
        config(**wrong)


@pytest.mark.parametrize(
    ("config", "wrong", "named"),
    [
        (MADQNConfig, {"exploration_start": 1.5}, "exploration_start"),
        (DDPGConfig, {"critic_lr": 0.0}, "critic_lr"),
        (DDPGConfig, {"ou_theta": 1.5}, "ou_theta"),
        (DDPGConfig, {"saturation_coeff": -0.1}, "saturation_coeff"),
        (DDPGConfig, {"ou_sigma": -1.0}, "ou_sigma"),
        (NetworkConfig, {"hidden": (8, 0)}, "hidden"),
    ],
)
def test_impossible_numbers_of_one_are_named(config: type[Any], wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named}"):
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


@every_case
@pytest.mark.parametrize("policies", ["independent", "shared", "groups"])
@pytest.mark.parametrize("iterations", [1, 6])
def test_replay_bytes_are_predicted(
    fabricate: Fabricate, config: ReplayConfig, spec: EnvSpec, policies: Policies, iterations: int
) -> None:
    """Of a seed whose agents act at every step, memories full or not."""
    config = replace(config, policies=policies, n_step=1)
    learner, steps = _learner(config, spec, (1,)), 12 * 2
    for iteration in range(iterations):
        learner._store(fabricate(spec, 12, 2, seed=iteration))
    real = sum(array.nbytes for array in learner.replay_state()["memory"]["arrays"].values())
    assert real == pytest.approx(
        ENTRIES[config.name].replay_bytes(config, spec, iterations * steps), rel=0.15
    )


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
