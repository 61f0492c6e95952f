"""Statistics against hand-made cases."""

import subprocess
import sys

import numpy as np
import pytest
from covering import pairwise, quick_or_slow
from scipy import stats as scipy_stats

from headway.stats.curves import auc, final_reward
from headway.stats.intervals import difference_of_means, paired_difference, paired_difference_over_seeds
from headway.stats.samples import mean_std
from headway.stats.scores import interquartile_mean


def test_final_reward_is_the_mean_over_the_last_fifth_of_the_steps() -> None:
    steps = np.arange(0, 101, 10)
    assert final_reward(steps, steps) == 90.0  # points 80, 90, 100
    # A share of the steps, not of the points: this curve is sampled densely at its start.
    assert final_reward([0, 1, 2, 3, 4, 100], [9, 9, 9, 9, 9, 5]) == 5.0
    assert final_reward([3], [7]) == 7.0


def test_difference_of_means_is_welch_s() -> None:
    """Two samples with different variances, by the formulas written out."""
    a, b = [27.5, 21.0, 19.0, 23.6, 17.0], [27.1, 22.0, 20.8, 23.4, 23.4, 23.5, 25.8, 22.0]
    parts = [np.var(each, ddof=1) / len(each) for each in (a, b)]
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 4 + parts[1] ** 2 / 7)
    half = scipy_stats.t.ppf(0.975, freedom) * np.sqrt(sum(parts))
    found = difference_of_means(a, b)
    estimate = np.mean(a) - np.mean(b)
    assert found.estimate == pytest.approx(estimate)
    assert (found.low, found.high) == (pytest.approx(estimate - half), pytest.approx(estimate + half))
    assert not found.excludes_zero
    assert difference_of_means([9.0, 9.1, 8.9], [1.0, 1.2]).excludes_zero


def test_means_of_constant_samples_have_no_interval() -> None:
    found = difference_of_means([3.0, 3.0], [1.0, 1.0])
    assert found.estimate == 2.0
    assert np.isnan([found.low, found.high]).all()
    assert not found.excludes_zero
    with pytest.raises(ValueError, match="at least two seeds of each"):
        difference_of_means([1.0], [1.0, 2.0])
    with pytest.raises(ValueError, match="b must be finite"):
        difference_of_means([1.0, 2.0], [1.0, np.nan])


def test_auc_of_known_shapes() -> None:
    assert auc([0, 5, 10], [-5, 0, 5]) == 0.5
    assert auc([0, 1, 10], [0, 1, 1]) == pytest.approx((0.5 + 9) / 10)
    assert auc([5, 6, 15], [3, 3, 3]) == 0.5  # flat, by definition
    assert auc([0, 1, 10], [2, 2, 2], low=0, high=8) == 0.25


@pytest.mark.parametrize("values", [[3], [3, 3], [-5, 5], [5, -5]])
def test_the_own_range_area_of_two_points_is_nan(values: list[float]) -> None:
    """Otherwise it would always be 0.5."""
    assert np.isnan(auc([10, 20][: len(values)], values))
    assert np.isnan(auc([10, 20][: len(values)], values, low=0, high=8))


def test_auc_does_not_change_with_scale_or_shift() -> None:
    generator = np.random.default_rng(1)
    steps, values = np.cumsum(generator.integers(1, 9, 50)), generator.normal(size=50)
    assert auc(7 * steps + 3, 5 * values - 100) == pytest.approx(auc(steps, values))


@pytest.mark.parametrize(
    ("steps", "values", "bounds", "message"),
    [
        ([], [], {}, "at least one"),
        ([0, 1], [1], {}, "2 points"),
        ([0, 0], [1, 2], {}, "increase"),
        ([0, 1], [1, np.nan], {}, "finite"),
        ([0, 1], [1, 2], {"low": 0.0}, "both"),
        ([0, 1, 2], [1, 2, 3], {"low": 2.0, "high": 2.0}, "below"),
    ],
)
def test_impossible_curves_are_refused(
    steps: list[float], values: list[float], bounds: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        auc(steps, values, **bounds)


def test_mean_std_is_of_the_sample() -> None:
    result = mean_std([1, 2, 3, 4])
    assert (result.mean, result.count) == (2.5, 4)
    assert result.std == pytest.approx(np.sqrt(5 / 3))
    assert np.isnan(mean_std([3]).std)


def test_paired_difference_is_the_t_interval() -> None:
    generator = np.random.default_rng(2)
    days = generator.normal(0, 50, 10)
    a, b = days + generator.normal(1, 1, 10), days + generator.normal(0, 1, 10)
    result = paired_difference(a, b)
    expected = scipy_stats.ttest_rel(a, b).confidence_interval(0.95)
    assert (result.low, result.high) == pytest.approx((expected.low, expected.high))
    assert result.estimate == pytest.approx((a - b).mean())
    assert not paired_difference([1, 2, 3], [2, 2, 2]).excludes_zero
    assert paired_difference([1, 2, 3], [0, 1, 2.1]).excludes_zero


@pytest.mark.parametrize(
    ("effects", "seeds", "days"),
    quick_or_slow(
        {
            f"{effects}-{seeds}-{days}": (effects, seeds, days)
            for effects, seeds, days in pairwise([(1, 0), (1, 1), (1, 3), (0, 1)], [2, 3, 5, 10], [10, 200])
        },
        "(1, 0)-2-10",
        "(1, 3)-5-10",
    ),
)
def test_intervals_over_seeds_and_episodes_cover_the_truth(
    effects: tuple[float, float], seeds: int, days: int
) -> None:
    of_seed, of_day = effects
    generator = np.random.default_rng(3)
    covered = 0
    for _ in range(600):
        difference = 0.5 + of_seed * generator.normal(size=(seeds, 1)) + of_day * generator.normal(size=days)
        difference += generator.normal(size=(seeds, days))
        interval = paired_difference_over_seeds(difference, np.zeros((seeds, days)))
        covered += interval.low <= 0.5 <= interval.high
    assert covered / 600 >= 0.93  # two standard errors of 600 trials below 0.95
    if not of_day and days == 200:  # nothing is left but Student's t over seeds: no wider than that
        assert covered / 600 <= 0.97


def test_without_an_episode_effect_it_is_the_t_interval_over_seeds() -> None:
    learned = np.array([[3.0], [5.0], [10.0]]) + np.zeros((3, 4))
    result = paired_difference_over_seeds(learned, np.ones((3, 4)))
    expected = scipy_stats.ttest_1samp([2.0, 4.0, 9.0], 0).confidence_interval(0.95)
    assert (result.estimate, result.low, result.high) == pytest.approx((5, expected.low, expected.high))
    assert result.method == "t over seeds and episodes"
    over_days = paired_difference_over_seeds(learned.T, np.ones((4, 3)))
    assert (over_days.low, over_days.high) == pytest.approx((expected.low, expected.high))


def test_pairs_must_match() -> None:
    with pytest.raises(ValueError, match="same shape"):
        paired_difference([1, 2], [1, 2, 3])
    with pytest.raises(ValueError, match="two episodes"):
        paired_difference([1], [2])
    with pytest.raises(ValueError, match="two seeds and two episodes"):
        paired_difference_over_seeds([[1, 2]], [[1, 2]])
    with pytest.raises(ValueError, match="two seeds and two episodes"):
        paired_difference_over_seeds([[1], [2]], [[1], [2]])


@pytest.mark.parametrize("count", [1, 3, 4, 10, 37])
def test_interquartile_mean_is_the_trimmed_mean(count: int) -> None:
    scores = np.random.default_rng(count).normal(size=count)
    found = interquartile_mean([scores]).estimate
    assert found == pytest.approx(scipy_stats.trim_mean(scores, 0.25))


def test_stratified_bootstrap_draws_within_tasks() -> None:
    # If the runs of each task are equal, draws within tasks do not vary; draws across tasks would.
    result = interquartile_mean([[0, 0, 0], [10, 10]])
    assert (result.estimate, result.low, result.high) == (10 / 3, 10 / 3, 10 / 3)


def test_stratified_bootstrap_agrees_with_the_standard_error_of_a_trimmed_mean() -> None:
    scores = np.random.default_rng(4).normal(size=400)
    result = interquartile_mean([scores])
    error = scipy_stats.mstats.trimmed_stde(scores, limits=(0.25, 0.25))
    assert (result.high - result.low) / 2 == pytest.approx(1.96 * error, rel=0.05)
    assert interquartile_mean([scores]) == interquartile_mean([scores])


def test_importing_stats_is_cheap() -> None:
    code = "import sys, headway.stats; sys.exit(bool({'pandas', 'scipy', 'torch'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
