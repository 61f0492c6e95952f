"""Traffic at the crossing matches reference values; a small part of the benchmark `crossing`."""

from importlib.util import find_spec

import pytest

from benchmarks.crossing import BANDS, LIGHT, SCENARIOS, outside, play, speeds

pytestmark = pytest.mark.skipif(find_spec("libsumo") is None, reason="SUMO (headway[sumo]) is not installed")
BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}


@pytest.mark.parametrize("name", ["SUMO's humans", "SUMO's humans, 1,600 veh/h", "humans"])
def test_traffic_lies_within_its_bands(name: str) -> None:
    """Three episodes, with correspondingly wider bands, and no collisions."""
    scenario = BY_NAME[name]
    found = play(scenario, episodes=3)
    assert outside(scenario, found, episodes=3) == []
    assert (found["collisions"], found["length"]) == (0, 1500)


def test_bands_distinguish_scenarios() -> None:
    """Most scenarios lie outside the bands of those with another demand or driver."""
    apart = 0
    for scenario in SCENARIOS:
        for other in SCENARIOS:
            known = {name: value for name, value in other.expected.items() if name in scenario.expected}
            found = {**dict.fromkeys(BANDS, 0.0), **scenario.expected}
            missed = [name for name in outside(other, found) if name in known]
            apart += scenario is not other and bool(missed)
    assert apart >= 0.8 * len(SCENARIOS) * (len(SCENARIOS) - 1)


def test_steps_with_and_without_the_environment_move_the_same_traffic() -> None:
    """`speeds` asserts that both end with the same number of vehicles."""
    whole, bare, added, vehicles = speeds(LIGHT, rounds=1, steps=150)
    assert min(whole, bare) > 0
    assert added == pytest.approx(bare / whole - 1)
    assert vehicles > 0
