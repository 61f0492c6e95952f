"""Limits on waiting follow how long earlier waits took."""

from math import inf

from headway.timeouts import AdaptiveTimeout


def test_the_limit_is_ten_times_the_longest_wait_and_at_least_a_minute() -> None:
    timeout = AdaptiveTimeout()
    assert timeout.limit_s == inf  # before the first wait
    for seconds, limit in ((0.1, 60.0), (7.0, 70.0), (2.0, 70.0)):
        timeout.add(seconds)
        assert timeout.limit_s == limit


def test_a_given_limit_stays() -> None:
    timeout = AdaptiveTimeout(5.0)
    timeout.add(100.0)
    assert timeout.limit_s == 5.0
