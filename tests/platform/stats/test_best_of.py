"""The expected best of n candidates, held to the enumeration of all samples of n."""

from itertools import product

import numpy as np
import pytest

from headway.stats.best_of import expected_best


@pytest.mark.parametrize(
    "scores",
    [[0.3], [1.0, 2.0], [3.0, -1.0, 0.5, 7.0], [2.0, 2.0, 5.0, 2.0], [4.0] * 3, [1e6 + 1, 1e6, 1e6 + 2]],
)
@pytest.mark.parametrize("lower_is_better", [False, True])
def test_it_is_the_mean_over_all_samples(scores: list[float], lower_is_better: bool) -> None:
    found = expected_best(scores, lower_is_better)
    assert found.mean.shape == found.std.shape == (len(scores),)
    for n in range(1, len(scores) + 1):
        best = [(min if lower_is_better else max)(sample) for sample in product(scores, repeat=n)]
        assert found.mean[n - 1] == pytest.approx(np.mean(best), rel=1e-12)
        assert found.std[n - 1] == pytest.approx(np.std(best), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("scores", [[], [1.0, float("nan")], [[1.0, 2.0]]])
def test_scores_that_are_none_are_refused(scores: list[float]) -> None:
    with pytest.raises(ValueError, match="scores must be"):
        expected_best(scores)
