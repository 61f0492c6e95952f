"""Pairs of learners in words."""

import math
from collections.abc import Sequence

from headway.stats.pairs import MOST_SEEDS, POWER, PairRow
from headway.stats.samples import CONFIDENCE


def p_texts(pair: PairRow) -> tuple[str, str]:
    """Return the p-value and the corrected one."""
    return p_text(pair.difference.p_value), p_text(pair.corrected_p)


def needed(pair: PairRow) -> int | str | None:
    """Return the number of seeds needed; None if it is unknown."""
    if math.isnan(pair.seeds_needed):
        return None
    return f">{MOST_SEEDS:,}" if math.isinf(pair.seeds_needed) else int(pair.seeds_needed)


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
