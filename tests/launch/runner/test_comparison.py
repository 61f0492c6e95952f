import sys

import pytest

from headway.events import Row
from headway.stats.intervals import paired_difference, paired_difference_over_seeds
from headway_launch.runner.comparison import gap_lines, print_comparison


def episodes(*returns: float) -> list[Row]:
    return [{"episode_seed": seed, "return": value, "wait": value / 2} for seed, value in enumerate(returns)]


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, list[str]]:
    """Return the printed cells of each metric, one per controller."""
    lines = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    return {metric: cells for metric, *cells in lines}


def test_one_seed_is_paired_by_episode(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [episodes(3.0, 5.0, 4.0)], {"hold": episodes(1.0, 2.0, 3.0)})
    shown = printed(capsys)
    expected = paired_difference([3.0, 5.0, 4.0], [1.0, 2.0, 3.0])
    assert shown.pop("metric") == ["ippo", "rule hold"]
    assert [cells[0] for cells in shown.values()] == ["3", "4", "", "", "", "", "2"]
    rule = {metric: cells[1] for metric, cells in shown.items()}
    assert (rule.pop("interval"), rule.pop("wait")) == ("t over episodes", "1")
    expected_cells = [3, 2.0, expected.estimate, expected.low, expected.high]
    assert [float(cell) for cell in rule.values()] == pytest.approx(expected_cells, rel=1e-5)


def test_several_seeds_are_compared_over_seeds_and_episodes(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [episodes(3.0, 5.0), episodes(2.0, 2.0)], {"hold": episodes(1.0, 2.0)})
    shown = printed(capsys)
    expected = paired_difference_over_seeds([[3.0, 5.0], [2.0, 2.0]], [[1.0, 2.0], [1.0, 2.0]])
    assert [shown[name][0] for name in ("metric", "episodes", "return")] == ["ippo, 2 seeds", "2", "3"]
    cells = [float(shown[name][1]) for name in ("learner minus rule", "95% low", "95% high")]
    assert cells == pytest.approx([expected.estimate, expected.low, expected.high], rel=1e-5)
    assert shown["interval"][1] == "t over seeds and episodes"


@pytest.mark.parametrize(("seeds", "warning"), [(1, "1 seed: "), (9, "9 seeds: "), (10, "")])
def test_few_seeds_print_a_warning(seeds: int, warning: str, capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [episodes(3.0, 5.0)] * seeds, {"hold": episodes(1.0, 2.0)})
    shown = capsys.readouterr().err
    assert shown.startswith(warning)
    assert ("train at least 10" in shown) == bool(warning)


@pytest.mark.parametrize(("count", "told"), [(19, True), (20, False)])
def test_few_episodes_print_a_warning(count: int, told: bool, capsys: pytest.CaptureFixture[str]) -> None:
    returns = [float(number % 3) for number in range(count)]
    print_comparison("ippo", [episodes(*returns)] * 10, {"hold": episodes(*returns[::-1])})
    assert ("play at least 20 before claiming" in capsys.readouterr().err) == told


def test_episodes_that_do_not_pair_give_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [episodes(3.0, 5.0, 4.0)], {"hold": episodes(1.0, 2.0)})
    shown = printed(capsys)
    assert [shown[name][1] for name in ("learner minus rule", "95% low", "95% high")] == ["", "", ""]


def test_a_narrow_terminal_has_whole_names_of_metrics_and_fewer_rules(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rules = {f"hold_for_{seconds}": [{**row, "trip_time_spread_min": 1.0} for row in episodes(seconds, 2.0)]
             for seconds in (10, 20, 30, 40)}  # fmt: skip
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    print_comparison("ippo", [], rules)
    shown = capsys.readouterr().out
    assert " trip_time_spread_min " in shown
    assert "columns omitted on this narrow terminal: rule hold_for_10" in shown


def test_lookahead_is_a_reference_and_not_the_best_rule() -> None:
    """The gap is 40, from 300 to 340: 310 closes a quarter and 290 loses as much. Student's t is 12.706
    for two episodes: gains of 39 and 41 have an interval of 40 +- 12.706."""
    rules = {"hold": [200.0, 400.0], "move": [200.0, 200.0], "lookahead": [239.0, 441.0]}
    [line] = gap_lines({"ippo": 310.0, "ia2c": 290.0}, rules)
    assert line.startswith("gap from hold, the best of the rules played, to lookahead, a reference that sim")
    assert line.endswith(": 40 (95% interval 27.29 to 52.71); of this gap, ippo closes 25%, ia2c closes -25%")
    [line] = gap_lines({}, rules)
    assert line.endswith(": 40 (95% interval 27.29 to 52.71)")
    [line] = gap_lines({"ippo": 4.0}, {"hold": [5.0, 5.0], "lookahead:hold:9": [3.0, 3.0]}, sign=-1)
    assert line.endswith(": 2 (95% interval 2 to 2); of this gap, ippo closes 50%")


@pytest.mark.parametrize(
    ("gains", "finding"),
    [
        # Student's t is 12.706 for two episodes, 4.303 for three; standard errors are 3, 3 and 1.
        ([3.1, -2.9], "not distinguishable from 0 (95% interval -38.02 to 38.22)"),
        ([13.0, 7.0], "not distinguishable from 0 (95% interval -28.12 to 48.12)"),
        ([-8.0, -10.0, -6.0], "none, lookahead is worse (95% interval -12.97 to -3.032)"),
        ([5.0], "not distinguishable from 0 over fewer than two episodes"),
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_gap_that_may_be_chance_has_no_shares(gains: list[float], finding: str, sign: int) -> None:
    hold = [float(300 + episode) for episode in range(len(gains))]
    rules = {
        "hold": hold,
        "lookahead": [value + sign * gain for value, gain in zip(hold, gains, strict=True)],
    }
    [line] = gap_lines({"ippo": 310.0}, rules, sign)
    assert line == f"gap from hold, the best of the rules played, to lookahead: {finding}"


def test_without_lookahead_or_another_rule_there_is_no_gap() -> None:
    assert gap_lines({"ippo": 310.0}, {"hold": [300.0]}) == gap_lines({}, {"lookahead": [3.0]}) == []


def test_the_share_of_the_gap_is_printed_if_episodes_pair(capsys: pytest.CaptureFixture[str]) -> None:
    rules = {"hold": episodes(1.0, 3.0), "lookahead": episodes(5.0, 7.0)}
    print_comparison("ippo", [episodes(3.0, 3.0), episodes(3.0, 3.0)], rules)
    assert ": 4 (95% interval 4 to 4); of this gap, ippo closes 25%" in capsys.readouterr().err
    print_comparison("ippo", [episodes(3.0, 3.0, 3.0), episodes(3.0, 3.0)], rules)
    assert "gap" not in capsys.readouterr().err
