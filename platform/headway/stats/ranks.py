"""Ranks of controllers over several tasks, as in critical-difference diagrams.

Sources: Demsar 2006, "Statistical Comparisons of Classifiers over Multiple Data Sets", JMLR 7; Benavoli et
al. 2016, "Should We Really Use Post-Hoc Tests Based on Mean-Ranks?", JMLR 17, for Wilcoxon's test of each
pair instead of Nemenyi's: whether two controllers differ then does not depend on the others.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.stats.samples import as_sample

_PERMUTATIONS, _SEED = 9_999, 0


@dataclass(frozen=True, slots=True)
class Friedman:
    """Friedman's test of the hypothesis that the ranks within each task are in random order."""

    statistic: float
    """Friedman's chi-squared (without a correction for ties)."""
    p_value: float


def ranks(scores: ArrayLike) -> NDArray[np.float64]:
    """Return the rank of each controller on each task, both (tasks, controllers); 1 is the highest score.

    Equal scores share the mean of their ranks.
    """
    table = as_sample(scores, "scores", axes=2)
    above = (table[:, None, :] > table[:, :, None]).sum(axis=2)
    equal = (table[:, None, :] == table[:, :, None]).sum(axis=2)
    found: NDArray[np.float64] = above + (equal + 1) / 2
    return found


def friedman(scores: ArrayLike) -> Friedman:
    """Return Friedman's test of scores (tasks, controllers).

    Its p-value is by permutation of the ranks within each task, which is valid for few tasks too, unlike the
    distributions of chi-squared and F. Raises ValueError for fewer than two tasks or controllers.
    """
    table = ranks(scores)
    tasks, controllers = table.shape
    if min(tasks, controllers) < 2:
        raise ValueError("Friedman's test needs at least two tasks and two controllers")

    def statistic(placed: NDArray[np.float64]) -> NDArray[np.float64]:
        """(..., tasks, controllers) -> (...)."""
        deviations = placed.mean(axis=-2) - (controllers + 1) / 2
        found: NDArray[np.float64] = (
            12 * tasks / (controllers * (controllers + 1)) * (deviations**2).sum(axis=-1)
        )
        return found

    generator = np.random.default_rng(_SEED)
    drawn = generator.permuted(np.broadcast_to(table, (_PERMUTATIONS, *table.shape)), axis=-1)
    observed = statistic(table)
    as_large = int((statistic(drawn) >= observed - 1e-9).sum())
    return Friedman(float(observed), (1 + as_large) / (1 + _PERMUTATIONS))


def signed_rank_p_value(differences: ArrayLike) -> float:
    """Return the two-sided p-value of Wilcoxon's signed-rank test of differences (tasks,).

    Zeros are left out, and equal magnitudes share the mean of their ranks. The p-value is exact: the share of
    all choices of signs whose sum of signed ranks is as far from 0.
    """
    values = as_sample(differences, "differences")
    values = values[values != 0]
    # Twice the ranks, which are whole numbers also for ties; 1 is the smallest magnitude.
    doubled = np.rint(2 * ranks(-np.abs(values)[None])[0]).astype(int) if len(values) else np.zeros(0, int)
    observed, total = abs(int((np.sign(values) * doubled).sum())), int(doubled.sum())
    chances = np.zeros(total + 1)  # of each sum of the doubled ranks with a positive sign
    chances[0] = 1.0
    for rank in doubled:
        chances[rank:] = (chances[rank:] + chances[: total + 1 - rank]) / 2
        chances[:rank] /= 2
    return min(float(chances[np.abs(2 * np.arange(total + 1) - total) >= observed].sum()), 1.0)


def groups(count: int, differ: Callable[[int, int], bool]) -> list[tuple[int, int]]:
    """Return the largest ranges (first, last) of 0 .. `count` - 1 of which no two differ: the bars of a
    critical-difference diagram whose controllers are numbered by their mean rank."""
    found: list[tuple[int, int]] = []
    for first in range(count):
        last = first
        while last + 1 < count and not any(differ(each, last + 1) for each in range(first, last + 1)):
            last += 1
        if last > first and (not found or last > found[-1][1]):
            found.append((first, last))
    return found
