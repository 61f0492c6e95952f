import pytest

from headway.events import Row
from headway.stats import paired_difference, paired_difference_over_seeds
from headway_launch.runner.comparison import print_comparison


def days(*returns: float) -> list[Row]:
    return [{"episode_seed": day, "return": value, "wait": value / 2} for day, value in enumerate(returns)]


def printed(capsys: pytest.CaptureFixture[str]) -> list[list[str]]:
    return [line.split("\t") for line in capsys.readouterr().out.splitlines()]


def test_one_seed_is_compared_day_by_day(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [days(3.0, 5.0, 4.0)], {"hold": days(1.0, 2.0, 3.0)})
    header, learner, rule = printed(capsys)
    expected = paired_difference([3.0, 5.0, 4.0], [1.0, 2.0, 3.0])
    assert header[-2:] == ["interval", "wait"]
    assert learner[:4] == ["ippo", "3", "4", ""]
    figures = [2.0, expected.estimate, expected.low, expected.high]
    assert [float(cell) for cell in rule[2:6]] == pytest.approx(figures, rel=1e-5)
    assert rule[6:] == ["t over episodes", "1"]


def test_several_seeds_are_compared_over_seeds_and_days(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [days(3.0, 5.0), days(2.0, 2.0)], {"hold": days(1.0, 2.0)})
    _, learner, rule = printed(capsys)
    expected = paired_difference_over_seeds([[3.0, 5.0], [2.0, 2.0]], [[1.0, 2.0], [1.0, 2.0]])
    assert learner[:3] == ["ippo, 2 seeds", "2", "3"]
    figures = [expected.estimate, expected.low, expected.high]
    assert [float(cell) for cell in rule[3:6]] == pytest.approx(figures, rel=1e-5)
    assert rule[6] == "t over seeds and episodes"


@pytest.mark.parametrize(("seeds", "told"), [(1, "1 seed: "), (9, "9 seeds: "), (10, "")])
def test_few_seeds_are_told_what_they_cannot_say(
    seeds: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    print_comparison("ippo", [days(3.0, 5.0)] * seeds, {"hold": days(1.0, 2.0)})
    said = capsys.readouterr().err
    assert said.startswith(told)
    assert ("train at least 10" in said) == bool(told)


def test_days_that_do_not_pair_give_no_interval(capsys: pytest.CaptureFixture[str]) -> None:
    print_comparison("ippo", [days(3.0, 5.0, 4.0)], {"hold": days(1.0, 2.0)})
    assert printed(capsys)[2][3:6] == ["", "", ""]
