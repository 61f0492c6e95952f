import sys
from collections.abc import Sequence

import pytest

from headway.events import Row
from headway.stats.intervals import paired_difference, paired_difference_over_seeds
from headway_launch.runner.comparison import Comparison, gap_lines, print_findings


def episodes(*returns: float) -> list[Row]:
    return [{"episode_seed": seed, "return": value, "wait": value / 2} for seed, value in enumerate(returns)]


def compared(learned: Sequence[Sequence[Row]], **rules: list[Row]) -> Comparison:
    return Comparison.of("", {}, rules, {"ippo": learned} if learned else {})


def test_one_seed_is_paired_by_episode() -> None:
    found = compared([episodes(3.0, 5.0, 4.0)], hold=episodes(1.0, 2.0, 3.0))
    expected = paired_difference([3.0, 5.0, 4.0], [1.0, 2.0, 3.0])
    interval = (expected.estimate, expected.low, expected.high, "t over episodes")
    assert found.rows == [
        ("return", "ippo", 1, 4.0, *interval),
        ("return", "rule hold", None, 2.0, None, None, None, None),
        ("wait", "ippo", 1, 2.0, None, None, None, None),
        ("wait", "rule hold", None, 1.0, None, None, None, None),
    ]


def test_several_seeds_are_compared_over_seeds_and_episodes() -> None:
    found = compared([episodes(3.0, 5.0), episodes(2.0, 2.0)], hold=episodes(1.0, 2.0))
    expected = paired_difference_over_seeds([[3.0, 5.0], [2.0, 2.0]], [[1.0, 2.0], [1.0, 2.0]])
    interval = (expected.estimate, expected.low, expected.high, "t over seeds and episodes")
    assert found.rows[0] == ("return", "ippo", 2, 3.0, *interval)


@pytest.mark.parametrize(
    ("returns", "seeds", "answer"),
    [
        # Student's t is 12.706 for two episodes: differences of -1 and 1 have an interval of 0 +- 12.706.
        ([8.0, 14.0], 1, "ippo, 1 seed, does not differ significantly from {hold}: +0 [95%: -13, 13]"),
        ([19.0, 23.0], 2, "ippo, mean of 2 seeds, is 10 above {hold} [95%: 10, 10]"),
        ([19.0, 23.0], 10, "ippo, mean of 10 seeds, is 10 above {hold} [95%: 10, 10]"),
        ([19.0, 23.0] * 10, 10, "ippo, mean of 10 seeds, beats {hold}, by 10.0 [95%: 10.0, 10.0]"),
        ([-1.0, 3.0], 10, "ippo, mean of 10 seeds, is 10 below {hold} [95%: -10, -10]"),
        ([19.0], 2, "ippo, mean of 2 seeds, is 10 above {hold}"),
    ],
)
def test_the_answer_is_one_sentence(returns: list[float], seeds: int, answer: str) -> None:
    count = len(returns)
    rules = {"move": episodes(*[-5.0] * count), "hold": episodes(*([9.0, 13.0] * 10)[:count])}
    found = compared([episodes(*returns)] * seeds, **rules)
    assert found.answer == f"return: {answer.format(hold='the best rule, hold')}"
    assert [row[0] for row in found.cells] == ["ippo", "rule hold", "rule move"]
    minus = "minus hold" + " [95%]" * (count > 1)
    assert found.headings() == ["controller", "seeds", "return", minus, "wait"]
    alone = compared([episodes(*returns)] * seeds, hold=rules["hold"])
    assert alone.answer is not None  # with fewer digits: the other rule's interval is the narrowest
    assert alone.answer.replace(".0", "") == f"return: {answer.format(hold='the rule hold')}".replace(
        ".0", ""
    )
    assert compared([], **rules).answer is compared([episodes(*returns)]).answer is None


def test_the_interval_of_the_best_of_two_learners_is_corrected() -> None:
    """Student's t of two episodes is the Cauchy distribution, whose quantiles are tan(pi (p - 1/2)): 12.7 at
    0.975 and 25.5 at 0.9875."""
    rules, others = {"hold": episodes(0.0, 0.0)}, {"ia2c": [episodes(0.0, 1.0)]}
    alone = Comparison.of("", {}, rules, {"ippo": [episodes(19.0, 21.0)]}).answer
    assert alone == "return: ippo, 1 seed, is 20 above the rule hold [95%: 7, 33]"
    best = Comparison.of("", {}, rules, {"ippo": [episodes(19.0, 21.0)], **others}).answer
    assert best == (
        "return: ippo, 1 seed, the best of 2 learners, does not differ significantly from the rule hold: "
        "+20 [95%, corrected for choosing the best: -5, 45]"
    )


@pytest.mark.parametrize(
    ("seeds", "count", "lines"),
    [
        (1, 20, ["1 seed: the interval is over episodes of one policy"]),
        (9, 20, ["9 seeds: "]),
        (10, 20, []),
        (10, 19, ["19 episodes: the intervals assume"]),
        (1, 1, ["1 episode: no intervals, which need two"]),
    ],
)
def test_few_seeds_and_episodes_are_named(
    seeds: int, count: int, lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    returns = [float(number % 3) for number in range(count)]
    learned, rules = [episodes(*returns)] * seeds, {"hold": episodes(*returns[::-1])}
    print_findings(compared(learned, **rules), {"ippo": learned}, rules)
    _, *printed = capsys.readouterr().err.splitlines()
    assert len(printed) == len(lines)
    assert all(map(str.startswith, printed, lines))


def test_a_narrow_terminal_has_whole_names_of_rules_and_fewer_metrics(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    compared([episodes(3.0, 5.0)], headway_holding_90=episodes(1.0, 2.0)).show()
    shown = capsys.readouterr().out
    assert " rule headway_holding_90 " in shown
    assert "columns omitted on this narrow terminal: wait" in shown


def test_a_piped_table_has_one_row_per_controller(capsys: pytest.CaptureFixture[str]) -> None:
    """The interval is 2.5 +- 12.706 x 0.5, to two significant digits of its width."""
    compared([episodes(3.0, 5.0)], hold=episodes(1.0, 2.0)).show()
    assert [line.split("\t") for line in capsys.readouterr().out.splitlines()] == [
        ["controller", "seeds", "return", "return minus hold [95%]", "wait"],
        ["ippo", "1", "4", "+2 [-4, 9]", "2"],
        ["rule hold", "", "2", "", "0.7500"],
    ]


def test_numbers_in_a_pipe_have_no_separators_of_thousands(capsys: pytest.CaptureFixture[str]) -> None:
    """The interval is 2,400 +- 12.706 x 400, 10,165 wide: its two digits are thousands. A name keeps its
    comma."""
    rules = {"hold,100": episodes(1_000_000.0, 2_000_000.0)}
    compared([episodes(1_002_000.0, 2_002_800.0)], **rules).show()
    assert [line.split("\t") for line in capsys.readouterr().out.splitlines()[1:]] == [
        ["ippo", "1", "1502000", "+2000 [-3000, 7000]", "751200"],
        ["rule hold,100", "", "1500000", "", "750000"],
    ]


def test_the_first_metrics_of_all_episodes_are_shown() -> None:
    row = {"mode": "greedy", "length": 9, "return": 1.0, "a_min": 1.0, "b": 1.0, "c": 2.0, "d": 0.0, "e": 1.0}
    rules: dict[str, list[Row]] = {"hold": [row, row], "move": [row, {**row, "b": None}]}
    shown = {"return": "return", "a_min": "a, min", "c": "c", "d": "d"}
    assert Comparison.of("", {"a_min": "time, minutes"}, rules, {}).metrics == shown


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


def test_the_share_of_the_gap_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    rules = {"hold": episodes(1.0, 3.0), "lookahead": episodes(5.0, 7.0)}
    learned = [episodes(3.0, 3.0), episodes(3.0, 3.0)]
    found = compared(learned, **rules)
    assert found.reference == "hold"
    print_findings(found, {"ippo": learned}, rules)
    assert ": 4 (95% interval 4 to 4); of this gap, ippo closes 25%" in capsys.readouterr().err
