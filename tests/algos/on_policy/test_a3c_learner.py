"""Gradients of asynchronous workers: their values, staleness, and that policies learn from them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from learned import assert_close, tensors
from made_trajectories import fabricate, poisoned
from torch import nn
from toy_training import mean_return, return_of_rule, share_of_optimum, train_toy

from headway.contracts import Box, Discrete, EnvSpec, HeadwayError
from headway_algos.config import ModelConfig
from headway_algos.on_policy.a3c_learner import A2CContributor, AsynchronousA2CLearner
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.registry import configure

DOUBLE = torch.float64
DISCRETE = EnvSpec("made", ("a", "b", "c"), 3, Discrete(3), has_action_mask=True, agents_come_and_go=True)
BOX = replace(DISCRETE, action_space=Box((-1.0, -1.0), (1.0, 1.0)), has_action_mask=False)
NORMALISED = {
    name: configure(
        name, policies="independent", model=ModelConfig(hidden=(6,), actor_gain=0.5), precision="float64",
        lr=1e-2, critic_lr=3e-3, lr_end=0.5, entropy_coeff=0.3, grad_clip=0.2, normalise_advantages=False,
    ) for name in ("a3c", "ia2c")
}  # fmt: skip
CONFIG = replace(NORMALISED["a3c"], normalise_observations=False, normalise_values=False)
SEED = 4


@pytest.mark.parametrize("spec", [DISCRETE, BOX])
def test_unused_slots_change_no_contribution(monkeypatch: pytest.MonkeyPatch, spec: EnvSpec) -> None:
    """Equal to a worker that computes every slot, for two, one, no and three agents."""
    shared = replace(NORMALISED["a3c"], policies="shared")
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
def test_fresh_gradients_take_the_steps_of_a2c(spec: EnvSpec) -> None:
    """The oracle is `ia2c`, which `test_against_naive` compares with plain networks."""
    learner = AsynchronousA2CLearner(NORMALISED["a3c"], spec, (SEED,), "cpu")
    worker = A2CContributor(NORMALISED["a3c"], spec, (SEED,))
    plain = OnPolicyLearner(NORMALISED["ia2c"], spec, (SEED,), "cpu")
    for number in (1, 2, 3):
        made = fabricate(spec, 9, 2, number, absent=0.2, idle=0.2, leaves=0.1)
        worker.adopt(learner.published())
        learner.apply(worker.contribute(poisoned(made), number), number, number / 4)
        plain.update(made, number, number / 4)
    assert_close(tensors(learner.state_dict()), tensors(plain.state_dict()))


@pytest.mark.parametrize("spec", [DISCRETE, BOX])
def test_a_stale_gradient_is_applied_to_the_current_parameters(spec: EnvSpec) -> None:
    """Two workers start from the same parameters; the second gradient arrives after the first was applied.

    Against torch's Adam, agent by agent; one without data in the second rollout stays unchanged.
    """
    learner = AsynchronousA2CLearner(CONFIG, spec, (SEED,), "cpu")
    rollouts = [fabricate(spec, 9, 2, seed, absent=0.2, idle=0.2, leaves=0.1) for seed in (1, 2)]
    rollouts[1].alive[..., 2] = rollouts[1].acting[..., 2] = False
    published, contributions = learner.published(), []
    for made in rollouts:
        worker = A2CContributor(CONFIG, spec, (SEED,))
        worker.adopt(published)
        contributions.append(worker.contribute(made, 1))
    expected: list[list[nn.Parameter]] = []
    for part, adam in learner.shared.optimisers.items():
        lr = CONFIG.lr if part == "actor" else CONFIG.critic_lr or 0.0
        for n in range(3):
            expected.append([nn.Parameter(tensor[n].detach().clone()) for tensor in adam.parameters])
            plain = torch.optim.Adam(expected[-1], eps=1e-5)
            for contribution, share in list(zip(contributions, (1.0, 0.75), strict=True))[
                : 2 if n < 2 else 1
            ]:
                for i, parameter in enumerate(expected[-1]):
                    parameter.grad = torch.tensor(contribution.arrays[f"{part}.gradient_{i}"][n])
                nn.utils.clip_grad_norm_(expected[-1], 0.2)
                plain.param_groups[0]["lr"] = share * lr
                plain.step()
    for contribution, progress in zip(contributions, (0.0, 0.5), strict=True):
        learner.apply(contribution, 1, progress)
    got = [
        [tensor[n] for tensor in adam.parameters]
        for adam in learner.shared.optimisers.values()
        for n in range(3)
    ]
    for mine, theirs in zip(got, expected, strict=True):
        torch.testing.assert_close(mine, [tensor.detach() for tensor in theirs], rtol=1e-9, atol=1e-11)


def test_contributions_of_compiled_kernels_equal_torch_and_stay_unchanged() -> None:
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


def test_a_workers_gradient_depends_on_the_adopted_parameters_only() -> None:
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


def test_divergence_in_a_worker_names_the_contribution() -> None:
    worker = A2CContributor(CONFIG, BOX, (SEED,))
    published = AsynchronousA2CLearner(CONFIG, BOX, (SEED,), "cpu").published()
    published["critic.network.weights.0"][:] = np.nan
    worker.adopt(published)
    with pytest.raises(HeadwayError, match=rf"a3c diverged: .* seed {SEED} .* at contribution 7;"):
        worker.contribute(fabricate(BOX, 9, 2, 1), 7)


def test_normalisers_cover_the_data_of_all_workers() -> None:
    config = NORMALISED["a3c"]
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


def test_published_parameters_are_copies() -> None:
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


def test_stale_gradients_reach_the_optimum_of_a_matrix_game() -> None:
    game = {"payoff": ((11.0, 6.0, 4.0), (6.0, 5.0, 3.0), (4.0, 3.0, 2.0))}
    settings = {"lr": 1e-2, "entropy_coeff": 0.1}
    assert mean_return(train_toy("matrix", game, "a3c", settings, (8, 32, 20), SEED)) == 11.0


@pytest.mark.slow
def test_stale_gradients_reach_nearly_the_optimal_tracking_cost() -> None:
    """The cost is at most 1.6 times the optimal one; random play costs hundreds of times as much."""
    # A standard deviation of 0.15 in [-1, 1]: good actions take a small part of the range.
    model = ModelConfig(hidden=(32, 32), activation="relu", log_std=-1.9)
    settings = {
        "policies": "shared", "model": model, "gamma": 0.8, "lr": 5e-3, "lr_end": 0.02, "entropy_coeff": 0.0,
        "normalise_observations": False,
    }  # fmt: skip
    episode = {"steps": 20}
    random, best = (return_of_rule("tracking", episode, rule) for rule in ("random", "optimal"))
    assert mean_return(train_toy("tracking", episode, "a3c", settings, (8, 32, 60), SEED)) > 1.6 * best
    assert random < 100 * best


@pytest.mark.slow
def test_stale_gradients_come_near_the_optimum_with_agents_that_come_and_go() -> None:
    """Training closes at least 0.96 of the gap between random and optimal play."""
    settings = {"policies": "shared", "gamma": 0.9, "lr": 3e-3, "lr_end": 0.1}
    evaluated = train_toy("visitors", {}, "a3c", settings, (8, 32, 20), SEED)
    assert share_of_optimum("visitors", {}, evaluated) > 0.96
