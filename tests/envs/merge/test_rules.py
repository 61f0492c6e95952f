"""Rules, and the effect of the supervisor."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from merging import make
from played import assert_allowed, first_episodes, repeated

from headway_envs.merge.entry import ENTRIES, RULES
from headway_envs.merge.env import MergeBatchedEnv
from headway_envs.merge.kernel.layout import AS_HUMAN, IDLE, LEFT, SLOWER, SPEED_STEP


def _metrics(env: MergeBatchedEnv, rule_name: str) -> dict[str, np.ndarray]:
    return first_episodes(env, RULES[rule_name].make(env.prepared), env.observed())


@pytest.mark.parametrize("name", ENTRIES)
@pytest.mark.parametrize("rule", RULES)
def test_rules_act_within_the_masks(name: str, rule: str) -> None:
    """Only `idm_mobil` returns an action outside the action space, which the environment supports."""
    env = make(name, copies=4)
    player, observed = RULES[rule].make(env.prepared), env.observed()
    for _ in range(100):
        actions = player.act(env, observed)
        if rule == "idm_mobil":
            assert (actions == AS_HUMAN).all()
        else:
            assert_allowed(actions, observed)
        _, observed = env.step(actions)


def test_the_closest_actions_follow_human_drivers_and_leave_the_state_alone() -> None:
    """Speeds differ by less than a step of target speeds as long as no vehicle brakes below 10 m/s."""
    human, discrete = (make(copies=50, density=1) for _ in range(2))
    rules = [RULES[name].make(human.prepared) for name in ("idm_mobil", "idm_mobil_actions")]
    for _ in range(10):
        before = discrete.world.cars.copy()
        actions = rules[1].act(discrete, discrete.observed())
        assert (discrete.world.cars == before).all()
        discrete.step(actions)
        human.step(rules[0].act(human, human.observed()))
    cavs = human.observed().alive
    speeds = [env.world.cars["speed"][:, : cavs.shape[1]][cavs] for env in (human, discrete)]
    assert np.abs(speeds[0] - speeds[1]).max() < SPEED_STEP
    assert np.corrcoef(*speeds)[0, 1] > 0.5


def test_the_warm_up_compiles_the_rule() -> None:
    """In a process of its own: other tests compile it too."""
    code = (
        "from headway_envs.merge.kernel import warm, drivers; warm(); "
        "print(len(drivers.write_human_actions.signatures))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


@pytest.mark.parametrize(("beside", "changes"), [(100.0, True), (378.0, False), (365.0, False)])
def test_the_closest_action_is_a_change_of_lane_if_the_highway_has_a_gap(
    beside: float, changes: bool
) -> None:
    """A CAV 40 m before the end of the ramp, and a human driver on the highway, far behind or in its way."""
    env = make(copies=1, density=1, cavs=1)
    cars = env.world.cars[0]
    for place, (x, y, lane) in enumerate([(380.0, 4.0, 2), (beside, 0.0, 1 if beside > 320 else 0)]):
        car = cars[place]
        car["x"], car["y"], car["lane"], car["target_lane"] = x, y, lane, lane
        car["speed"] = car["target_speed"] = car["desired_speed"] = 20.0
    placed = replace(env.observed(), action_masks=None)
    action = RULES["idm_mobil_actions"].make(env.prepared).act(env, placed)[0, 0]
    assert action == (LEFT if changes else SLOWER)


@pytest.mark.parametrize("name", ENTRIES)
def test_the_rules_differ(name: str) -> None:
    """Idle CAVs always hit the end of the ramp; those driven as humans hardly ever crash, and earn most."""
    metrics = {rule: _metrics(make(name, copies=200), rule) for rule in RULES}
    assert (metrics["idle"]["crash_rate"] == 1).all()
    assert (metrics["idle"]["ramp_merge_rate"] == 0).all()
    assert metrics["idm_mobil"]["crash_rate"].mean() < 0.1
    assert 0.2 < metrics["always_left"]["crash_rate"].mean() < 0.6
    assert metrics["always_left"]["ramp_merge_rate"].mean() > 0.4
    # With five actions a vehicle cannot brake below 10 m/s, and hits the end of the ramp more often.
    assert 0.1 < metrics["idm_mobil_actions"]["crash_rate"].mean() < 0.5
    means = {rule: metrics[rule]["reward"].mean() for rule in RULES}
    assert means["idm_mobil_actions"] > means["always_left"]
    assert max(means, key=lambda rule: means[rule]) == "idm_mobil"
    for values in metrics.values():
        assert ((values["merge_rate"] >= 0) & (values["merge_rate"] <= 1)).all()
        assert (values["min_speed_ms"] <= values["mean_speed_ms"]).all()
        assert (values["interventions"] == 0).all()


@pytest.mark.parametrize(
    ("preset", "rule", "without", "with_it"),
    [("clean", "random", (0.5, 0.9), (0.05, 0.45)), ("paper", "always_left", (0.2, 0.6), (0.0, 0.3))],
)
def test_the_supervisor_prevents_crashes(
    preset: str, rule: str, without: tuple[float, float], with_it: tuple[float, float]
) -> None:
    """Random and always-left driving crash often without it, and far less often with it."""
    rates = []
    for supervisor, (low, high) in ((False, without), (True, with_it)):
        metrics = _metrics(make(copies=200, preset=preset, supervisor=supervisor), rule)
        rates.append(metrics["crash_rate"].mean())
        assert low <= rates[-1] <= high
        assert (metrics["interventions"].sum() > 0) == supervisor
    assert rates[1] < 0.7 * rates[0]


def test_the_supervisor_keeps_safe_actions() -> None:
    """A single CAV far from the end of the ramp has no collision to prevent."""
    env = make(copies=16, density=1, cavs=1, supervisor=True)
    repeated(env, IDLE, 5)
    assert (env.world.episodes["interventions"] == 0).all()
