import pytest

from headway.events import Row
from headway.stats import paired_bootstrap, paired_difference
from headway_launch.comparison import print_comparison


def days(*returns: float) -> list[Row]:
    return [{"episode_seed": day, "return": value, "wait": value / 2} for day, value in enumerate(returns)]


def printed(capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    return [line.split("\t") for line in capsys.readouterr().out.splitlines()]


def test_one_seed_is_compared_day_by_day(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [days(3.0, 5.0, 4.0)], {"hold": days(1.0, 2.0, 3.0)})
    header, learner, rule = printed(capsys)
    expected = paired_difference([3.0, 5.0, 4.0], [1.0, 2.0, 3.0])
    assert header[-1] == "wait"
    assert learner[:4] == ["ippo", "3", "4.0", ""]
    assert [float(cell) for cell in rule[2:]] == [2.0, expected.estimate, expected.low, expected.high, 1.0]


def test_several_seeds_are_compared_over_seeds_and_days(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [days(3.0, 5.0), days(2.0, 2.0)], {"hold": days(1.0, 2.0)})
    _, learner, rule = printed(capsys)
    expected = paired_bootstrap([[3.0, 5.0], [2.0, 2.0]], [[1.0, 2.0], [1.0, 2.0]])
    assert learner[:3] == ["ippo, 2 seeds", "2", "3.0"]
    assert [float(cell) for cell in rule[3:6]] == [expected.estimate, expected.low, expected.high]


def test_days_that_do_not_pair_give_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [days(3.0, 5.0, 4.0)], {"hold": days(1.0, 2.0)})
    assert printed(capsys)[2][3:6] == ["", "", ""]
