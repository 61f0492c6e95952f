"""Pairs of learners on the same episodes, tested as one family of hypotheses."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from headway.stats.pairs import MOST_SEEDS, POWER, LearnerDifference, holm
from headway.stats.samples import CONFIDENCE


class PairRow(NamedTuple):
    """One metric of two learners on the same episodes."""

    metric: str
    a: str
    b: str
    difference: LearnerDifference
    """a minus b."""
    corrected_p: float
    """Its p-value, corrected by Holm for the number of pairs."""
    seeds_needed: float
    """See `LearnerDifference.seeds_needed`, with the significance of one of as many tests as pairs."""

    @property
    def p_texts(self) -> tuple[str, str]:
        """The p-value and the corrected one."""
        return p_text(self.difference.p_value), p_text(self.corrected_p)

    @property
    def needed(self) -> int | str | None:
        """The number of seeds needed; None if it is unknown."""
        if math.isnan(self.seeds_needed):
            return None
        return f">{MOST_SEEDS:,}" if math.isinf(self.seeds_needed) else int(self.seeds_needed)


def pair_rows(
    metric: str,
    learners: Mapping[str, Sequence[Sequence[float]]],
    pairs: Iterable[tuple[str, str]],
) -> list[PairRow]:
    """Compare pairs of `learners`, each with its values of a metric (seeds x episodes); the pairs are one
    family of hypotheses."""
    found = {(a, b): LearnerDifference.of(learners[a], learners[b]) for a, b in pairs}
    corrected = holm([each.p_value for each in found.values()])
    significance = (1 - CONFIDENCE) / max(len(found), 1)
    return [
        PairRow(metric, *pair, each, float(p_value), each.seeds_needed(significance))
        for (pair, each), p_value in zip(found.items(), corrected, strict=True)
    ]


def p_text(value: float) -> str:
    """Return a p-value with three decimals."""
    return "<0.001" if value < 0.001 else f"{value:.3f}"


def pairs_note(pairs: Sequence[PairRow]) -> str:
    """Explain the columns of a table of pairs, which played the same episodes."""
    family = f"corrected by Holm for {len(pairs)} pairs" if len(pairs) > 1 else "of a single pair"
    episodes = pairs[0].difference.episodes
    return (
        f"p (Holm): {family}. Seeds needed: seeds per learner with which a corrected p below "
        f"{1 - CONFIDENCE:.0%} has a probability of {POWER:.0%} with {episodes} episodes, if the true "
        "difference and variances are the observed ones"
    )
