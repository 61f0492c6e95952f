"""Traffic of the intersection agrees with an independent reconstruction; a small part of the benchmark
`crossing`."""

from functools import partial
from importlib.util import find_spec
from itertools import accumulate, cycle
from types import SimpleNamespace

import pytest

from benchmarks import crossing
from benchmarks.crossing import BANDS, SCENARIOS, outside, run_episodes, speeds

pytestmark = pytest.mark.skipif(find_spec("libsumo") is None, reason="SUMO (headway[sumo]) is not installed")
BY_NAME = {scenario.name: scenario for scenario in SCENARIOS}


@pytest.mark.parametrize(
    "name",
    [
        "SUMO's humans",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("SUMO's humans, 1,600 veh/h", "humans")),
    ],
)
def test_traffic_lies_within_its_bands(name: str) -> None:
    """Three episodes, in bands widened for their number; there is no crash."""
    scenario = BY_NAME[name]
    found = run_episodes(scenario, episodes=3)
    assert outside(scenario, found, episodes=3) == []
    assert (found["collisions"], found["length"]) == (0, 1500)


def test_bands_distinguish_scenarios() -> None:
    """Most rows lie outside the bands of most other rows, which differ in demand or driver."""
    apart = 0
    for scenario in SCENARIOS:
        for other in SCENARIOS:
            known = {name: value for name, value in other.expected.items() if name in scenario.expected}
            found = {**dict.fromkeys(BANDS, 0.0), **scenario.expected}
            missed = [name for name in outside(other, found) if name in known]
            apart += scenario is not other and bool(missed)
    assert apart >= 0.8 * len(SCENARIOS) * (len(SCENARIOS) - 1)


def test_the_speed_report_prints_rates_of_median_times_and_the_median_overhead(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rounds of 3, 4 and 9 s with the environment and 2, 2 and 6 s without it: the overheads are 50, 100 and
    50 %. `speeds` itself asserts that both runs end with the same number of vehicles."""
    clock = accumulate(cycle([0.0, 3.0, 0.0, 2.0, 0.0, 4.0, 0.0, 2.0, 0.0, 9.0, 0.0, 6.0]))
    monkeypatch.setattr(crossing, "time", SimpleNamespace(process_time=lambda: next(clock)))
    monkeypatch.setattr(crossing, "speeds", partial(speeds, rounds=3, steps=120))
    crossing._report_speed()
    rows = [line.strip("| ").split(" | ") for line in capsys.readouterr().out.splitlines()[3:]]
    assert [row[0] for row in rows] == ["1,600 veh/h", "3,200 veh/h"]
    assert all(float(row[1]) > 0 for row in rows)
    assert [row[2:] for row in rows] == [["30", "60", "50%"]] * 2
