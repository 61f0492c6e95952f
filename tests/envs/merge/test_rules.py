"""The rules, and the supervisor as a factor of its own."""

from collections.abc import Callable

import numpy as np
import pytest

from headway.adapters.pettingzoo import ParallelEnvBatch
from headway_envs.merge.entry import ENTRIES, RULES
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import AS_HUMAN

Make = Callable[..., MergeBatchedEnv]


def _metrics(env: MergeBatchedEnv, rule_name: str) -> dict[str, np.ndarray]:
    """The metrics of each copy's first episode."""
    rule, observed = RULES[rule_name].make(env.prepared), env.observed()
    first = np.full((env.num_copies, len(env.spec.metrics)), np.nan)
    for _ in range(100):
        outcome, observed = env.step(rule.act(env, observed))
        new = outcome.episode_ended & np.isnan(first[:, 0])
        first[new] = outcome.metrics[new]
    assert np.isfinite(first).all()
    return dict(zip(env.spec.metrics, first.T, strict=True))


@pytest.mark.parametrize("name", ENTRIES)
@pytest.mark.parametrize("rule", RULES)
def test_rules_act_within_the_masks(make: Make, name: str, rule: str) -> None:
    """`idm_mobil` alone asks for something outside of the action space, which the environment knows."""
    env = make(name, copies=4)
    player, observed = RULES[rule].make(env.prepared), env.observed()
    for _ in range(100):
        actions = player.act(env, observed)
        assert actions.shape == observed.alive.shape
        if rule == "idm_mobil":
            assert (actions == AS_HUMAN).all()
        else:
            assert observed.action_masks is not None
            allowed = np.take_along_axis(observed.action_masks, actions[..., None], axis=-1)[..., 0]
            assert allowed[observed.alive].all()
        _, observed = env.step(actions)


@pytest.mark.parametrize("name", ENTRIES)
def test_the_rules_are_told_apart(make: Make, name: str) -> None:
    """Idling always hits the ramp's end; those who drive as humans hardly ever crash, and earn the most."""
    metrics = {rule: _metrics(make(name, copies=200), rule) for rule in RULES}
    assert (metrics["idle"]["crash_rate"] == 1).all()
    assert (metrics["idle"]["ramp_merge_rate"] == 0).all()
    assert metrics["idm_mobil"]["crash_rate"].mean() < 0.1
    assert 0.2 < metrics["always_left"]["crash_rate"].mean() < 0.6
    assert metrics["always_left"]["ramp_merge_rate"].mean() > 0.4
    means = {rule: metrics[rule]["reward"].mean() for rule in RULES}
    assert max(means, key=lambda rule: means[rule]) == "idm_mobil"
    for values in metrics.values():
        assert ((values["merge_rate"] >= 0) & (values["merge_rate"] <= 1)).all()
        assert (values["min_speed_ms"] <= values["mean_speed_ms"]).all()
        assert (values["interventions"] == 0).all()


@pytest.mark.parametrize("preset", ["clean", "paper"])
@pytest.mark.parametrize("rule", ["random", "always_left"])
def test_the_supervisor_prevents_crashes(make: Make, preset: str, rule: str) -> None:
    """Without it, whoever drives at random or always to the left crashes often; with it, far less often."""
    rates = {}
    for supervisor in (False, True):
        metrics = _metrics(make(copies=200, preset=preset, supervisor=supervisor), rule)
        rates[supervisor] = metrics["crash_rate"].mean()
        assert (metrics["interventions"].sum() > 0) == supervisor
    bands = {"random": ((0.5, 0.9), (0.05, 0.45)), "always_left": ((0.2, 0.6), (0.0, 0.3))}
    for supervisor, (low, high) in zip((False, True), bands[rule], strict=True):
        assert low <= rates[supervisor] <= high, rates
    assert rates[True] < 0.7 * rates[False]


def test_the_supervisor_leaves_what_is_safe_alone(make: Make) -> None:
    """One CAV, alone on its ramp far from its end: nothing to prevent."""
    env = make(copies=16, density=1, cavs=1, supervisor=True)
    for _ in range(5):
        env.step(np.ones((16, 1), np.int64))
    assert (env.world.episodes["interventions"] == 0).all()


def test_idm_mobil_says_where_it_cannot_play(make: Make) -> None:
    adapted = ParallelEnvBatch(lambda: ENTRIES["merge"].parallel_env(make().prepared.config), 1, "merge")
    with pytest.raises(TypeError, match="idm_mobil needs a MergeBatchedEnv, not ParallelEnvBatch"):
        RULES["idm_mobil"].make(None).act(adapted, adapted.reset(np.zeros(1, np.uint64)))
