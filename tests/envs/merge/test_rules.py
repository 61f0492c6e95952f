"""Rules, and the effect of the supervisor."""

from collections.abc import Callable

import numpy as np
import pytest

from headway.adapters.pettingzoo import ParallelEnvBatch
from headway_envs.merge.entry import ENTRIES, RULES
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import AS_HUMAN

Make = Callable[..., MergeBatchedEnv]


def _metrics(env: MergeBatchedEnv, rule_name: str) -> dict[str, np.ndarray]:
    """Return the metrics of each copy's first episode."""
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
    """Only `idm_mobil` returns an action outside the action space, which the environment supports."""
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
def test_the_rules_differ(make: Make, name: str) -> None:
    """Idle CAVs always hit the end of the ramp; those driven as humans hardly ever crash, and earn most."""
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


@pytest.mark.parametrize(("preset", "rule"), [("clean", "random"), ("paper", "always_left")])
def test_the_supervisor_prevents_crashes(make: Make, preset: str, rule: str) -> None:
    """Random and always-left driving crash often without it, and far less often with it."""
    rates = {}
    for supervisor in (False, True):
        metrics = _metrics(make(copies=200, preset=preset, supervisor=supervisor), rule)
        rates[supervisor] = metrics["crash_rate"].mean()
        assert (metrics["interventions"].sum() > 0) == supervisor
    bands = {"random": ((0.5, 0.9), (0.05, 0.45)), "always_left": ((0.2, 0.6), (0.0, 0.3))}
    for supervisor, (low, high) in zip((False, True), bands[rule], strict=True):
        assert low <= rates[supervisor] <= high, rates
    assert rates[True] < 0.7 * rates[False]


def test_the_supervisor_keeps_safe_actions(make: Make) -> None:
    """A single CAV far from the end of the ramp has no collision to prevent."""
    env = make(copies=16, density=1, cavs=1, supervisor=True)
    for _ in range(5):
        env.step(np.ones((16, 1), np.int64))
    assert (env.world.episodes["interventions"] == 0).all()


def test_idm_mobil_refuses_other_environments(make: Make) -> None:
    adapted = ParallelEnvBatch(lambda: ENTRIES["merge"].parallel_env(make().prepared.config), 1, "merge")
    with pytest.raises(TypeError, match="idm_mobil needs a MergeBatchedEnv, not ParallelEnvBatch"):
        RULES["idm_mobil"].make(None).act(adapted, adapted.reset(np.zeros(1, np.uint64)))
