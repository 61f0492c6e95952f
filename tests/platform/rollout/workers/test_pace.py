"""The limit for an answer follows the time that earlier ones took."""

from math import inf

from headway.rollout.workers.pace import Pace


def test_there_is_no_limit_before_the_first_answer() -> None:
    assert Pace().limit_s == inf


def test_the_limit_is_ten_times_the_longest_answer_and_at_least_a_minute() -> None:
    pace = Pace()
    for seconds, limit in ((0.1, 60.0), (7.0, 70.0), (2.0, 70.0)):
        pace.add(seconds)
        assert pace.limit_s == limit


def test_a_given_limit_stays() -> None:
    pace = Pace(5.0)
    pace.add(100.0)
    assert pace.limit_s == 5.0
