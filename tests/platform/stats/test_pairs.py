"""Differences between learners: intervals against definitions and draws, Holm against closed testing, seeds
needed against published tables and draws."""

from collections.abc import Iterator
from itertools import chain, combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from headway.stats.intervals import paired_difference, paired_difference_over_seeds
from headway.stats.pairs import LearnerDifference, holm
from headway.stats.samples import Interval

Values = NDArray[np.float64]


def drawn(
    seeds: int, episodes: int, difference: float, deviations: tuple[float, float, float, float], number: int
) -> Iterator[LearnerDifference]:
    """Differences of two learners with normal effects: of the seeds of each, of episodes on their difference,
    and of each single value. All episodes differ in difficulty, which both learners share."""
    of_a, of_b, of_episodes, rest = deviations
    generator = np.random.default_rng(11)

    def values(mean: float, of_seeds: float, shared: Values) -> Values:
        own = generator.normal(0, of_seeds, (seeds, 1)) + generator.normal(0, rest, (seeds, episodes))
        return mean + own + shared + generator.normal(0, of_episodes / np.sqrt(2), episodes)

    for _ in range(number):
        shared = generator.normal(0, 5, episodes)
        yield LearnerDifference.of(values(difference, of_a, shared), values(0, of_b, shared))


def ends(interval: Interval) -> tuple[float, float, float]:
    return interval.low, interval.estimate, interval.high


def test_the_interval_sums_the_squares_of_three() -> None:
    generator = np.random.default_rng(1)
    a, b = generator.normal(3, 1, (4, 6)), generator.normal(0, 2, (3, 6))
    half = [
        stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
        for values in (a.mean(axis=1), b.mean(axis=1), a.mean(axis=0) - b.mean(axis=0))
    ]
    found = LearnerDifference.of(a, b).interval
    assert found.estimate == pytest.approx(a.mean() - b.mean())
    assert found.high - found.estimate == pytest.approx(np.sqrt(np.square(half).sum()))
    assert found.estimate - found.low == pytest.approx(np.sqrt(np.square(half).sum()))
    assert found.method == "t over seeds and episodes"


def test_seeds_without_variation_leave_the_interval_of_a_learner_and_a_rule() -> None:
    a, rule = np.random.default_rng(2).normal(1, 1, (5, 7)), np.arange(7.0)
    found = LearnerDifference.of(a, [rule, rule]).interval
    assert ends(found) == pytest.approx(ends(paired_difference_over_seeds(a, [rule] * 5)))


def test_a_single_seed_leaves_the_paired_t_over_episodes() -> None:
    a, b = np.random.default_rng(3).normal(0, 1, (2, 12))
    found = LearnerDifference.of([a], [b])
    assert ends(found.interval) == pytest.approx(ends(paired_difference(a, b)))
    assert found.p_value == pytest.approx(stats.ttest_rel(a, b).pvalue)
    assert np.isnan(found.seeds_needed())
    assert LearnerDifference.of([a], [b, b + 1]).interval.method == "t over episodes"


def test_p_is_where_the_interval_begins_to_exclude_zero() -> None:
    generator = np.random.default_rng(4)
    found = LearnerDifference.of(generator.normal(1, 1, (4, 9)), generator.normal(0, 1, (6, 9)))
    parts = ((found.seed_variances[0], 4), (found.seed_variances[1], 6), (found.episode_variance, 9))
    half = sum(stats.t.ppf(1 - found.p_value / 2, n - 1) ** 2 * value / n for value, n in parts)
    assert np.sqrt(half) == pytest.approx(abs(found.estimate))


def test_equal_learners_have_p_1_and_constant_ones_that_differ_0() -> None:
    assert LearnerDifference.of(np.ones((2, 3)), np.ones((2, 3))).p_value == 1.0
    assert LearnerDifference.of(np.ones((2, 3)), np.zeros((2, 3))).p_value == 0.0
    assert LearnerDifference.of(np.ones((2, 3)), np.zeros((2, 3))).seeds_needed() == 2


@pytest.mark.parametrize(
    ("seeds", "episodes", "deviations"),
    [
        (5, 10, (1.0, 1.0, 0.0, 1.0)),
        (5, 10, (1.0, 3.0, 1.0, 1.0)),
        (10, 20, (1.0, 1.0, 2.0, 1.0)),
        (3, 50, (1.0, 0.0, 0.5, 3.0)),
    ],
)
def test_at_most_one_interval_in_twenty_misses_the_true_difference(
    seeds: int, episodes: int, deviations: tuple[float, float, float, float]
) -> None:
    missed = [found.interval.excludes_zero for found in drawn(seeds, episodes, 0.0, deviations, 1_000)]
    assert np.mean(missed) <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / 1_000)


@pytest.mark.parametrize(("effect", "published"), [(0.2, 393), (0.5, 64), (0.8, 26)])
def test_seeds_needed_are_cohens(effect: float, published: int) -> None:
    """Cohen 1992, "A Power Primer", table 2: sizes of two groups for a power of 80% at 5%. The pooled t that
    he assumes has 2 n - 2 degrees of freedom, each group's has n - 1, which takes one or two seeds more."""
    found = LearnerDifference(effect, (9, 9), 10**6, (1.0, 1.0), 0.0, (0.0, 0.0))
    assert published <= found.seeds_needed() <= published + 2


@pytest.mark.parametrize(
    ("episodes", "difference", "deviations"),
    [
        (20, 1.0, (1.0, 1.0, 0.5, 1.0)),
        (20, 1.5, (1.0, 2.0, 1.0, 1.0)),
        (50, 0.5, (0.5, 0.5, 0.2, 2.0)),
        (10, 2.0, (1.0, 1.0, 1.5, 1.0)),
    ],
)
def test_as_many_experiments_show_the_difference_as_the_power_says(
    episodes: int, difference: float, deviations: tuple[float, float, float, float]
) -> None:
    of_a, of_b, of_episodes, rest = deviations
    true = LearnerDifference(
        difference,
        (7, 7),
        episodes,
        (of_a**2 + rest**2 / episodes, of_b**2 + rest**2 / episodes),
        of_episodes**2 + 2 * rest**2 / 7,
        (rest**2, rest**2),
    )
    needed = int(true.seeds_needed())
    assert true.power(needed - 1) < 0.8 <= true.power(needed)
    shown = [found.interval.excludes_zero for found in drawn(needed, episodes, difference, deviations, 1_000)]
    assert np.mean(shown) == pytest.approx(true.power(needed), abs=0.03)


def test_no_number_of_seeds_makes_up_for_few_episodes() -> None:
    found = LearnerDifference(0.5, (5, 5), 4, (1.0, 1.0), 4.0, (0.1, 0.1))
    assert np.isinf(found.seeds_needed())
    assert np.isinf(LearnerDifference(0.0, (5, 5), 4, (1.0, 1.0), 4.0, (0.1, 0.1)).seeds_needed())


def test_more_tests_need_more_seeds() -> None:
    found = LearnerDifference(1.0, (5, 5), 50, (1.0, 1.0), 1.0, (0.5, 0.5))
    assert found.seeds_needed(0.05) < found.seeds_needed(0.05 / 36)


def test_holm_is_the_closed_test_of_bonferroni() -> None:
    """An adjusted p is the largest Bonferroni p of all intersections of hypotheses that hold this one."""
    p_values = [0.01, 0.04, 0.03, 0.005, 0.5, 0.03]
    places = range(len(p_values))
    subsets = list(chain.from_iterable(combinations(places, size) for size in range(1, len(places) + 1)))
    expected = [
        max(min(1.0, len(each) * min(p_values[i] for i in each)) for each in subsets if place in each)
        for place in places
    ]
    assert holm(p_values).tolist() == pytest.approx(expected)
    assert holm([0.03]).tolist() == [0.03]
    assert holm([]).tolist() == []


def test_learners_need_the_same_episodes() -> None:
    with pytest.raises(ValueError, match="the same episodes, at least two"):
        LearnerDifference.of(np.zeros((2, 3)), np.zeros((2, 4)))
    with pytest.raises(ValueError, match="the same episodes, at least two"):
        LearnerDifference.of(np.zeros((2, 1)), np.zeros((2, 1)))
    with pytest.raises(ValueError, match="finite"):
        LearnerDifference.of([[1.0, np.nan]], [[1.0, 2.0]])
