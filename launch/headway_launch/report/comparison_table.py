"""Comparisons of learners with rules and with each other, and their tables for a page or a paper."""

from collections.abc import Sequence

from headway.stats.pairs import PairRow
from headway_launch.console.number_formats import MISSING, with_interval
from headway_launch.console.tables import Value
from headway_launch.report.elements import Table
from headway_launch.runner.comparison import Comparison
from headway_launch.studies.learner_pairs import needed, p_texts, pairs_note

PAIR_COLUMNS = (
    *("metric", "learner", "minus learner", "difference", "95% low", "95% high"),
    *("p", "p (Holm)", "seeds needed"),
)
RECORD_COLUMNS = (
    *("metric", "controller", "seeds", "mean", "reference", "difference", "95% low", "95% high", "interval"),
    *("p", "p (Holm)", "seeds needed"),
)


def records(found: Comparison, pairs: Sequence[PairRow] = ()) -> list[dict[str, Value]]:
    """Return each difference from the reference, then of each pair of learners, with all digits."""
    means = {(row.metric, row.controller): row for row in found.rows}
    listed: list[dict[str, Value]] = []
    for row in found.rows:
        reference = None if row.difference is None else f"rule {found.reference}"
        values = (*row[:4], reference, *row[4:], None, None, None)
        listed.append(dict(zip(RECORD_COLUMNS, values, strict=True)))
    for pair in pairs:
        interval = pair.difference.interval
        compared = (
            *means[pair.metric, pair.a][:4],
            *(pair.b, interval.estimate, interval.low, interval.high, interval.method),
            *(pair.difference.p_value, pair.corrected_p, needed(pair)),
        )
        listed.append(dict(zip(RECORD_COLUMNS, compared, strict=True)))
    return listed


def pair_values(pair: PairRow) -> tuple[Value, ...]:
    """Return the values of `PAIR_COLUMNS`."""
    found = pair.difference.interval
    return (*pair[:3], found.estimate, found.low, found.high, *p_texts(pair), needed(pair))


def comparison_table(comparison: Comparison, note: str = "") -> Table:
    """Return a comparison as a table with one row per controller and two columns per metric.

    `note`: end of its caption.
    """
    cells = comparison.cells
    learners = sum(not name.startswith("rule ") for name in comparison.controllers)
    return Table(
        "comparison",
        f"{comparison.title}. Differences from the rule `{comparison.reference}`, paired by episode, with "
        "95% intervals (Student's t). Intervals of several seeds cover the variation between seeds and "
        "between episodes, those of one seed or of a rule only that between episodes." + note,
        comparison.headings,
        cells,
        emphasised=frozenset(range(learners, len(cells))),
    )


def pairs_table(pairs: Sequence[PairRow], name: str, caption: str) -> Table:
    """Return pairs of learners as a table with one row per pair; `caption` is continued by `pairs_note`."""
    import pandas as pd

    cells, exact = [], []
    for pair in pairs:
        found = pair.difference.interval
        shown = with_interval(found.estimate, found.low, found.high, sign="+")
        seeds = needed(pair)
        cells.append([pair.a, pair.b, shown, *p_texts(pair), MISSING if seeds is None else str(seeds)])
        exact.append(
            {
                "controller": pair.a,
                "minus": pair.b,
                "difference": found.estimate,
                "low": found.low,
                "high": found.high,
                "interval": found.method,
                "p": pair.difference.p_value,
                "p_holm": pair.corrected_p,
                "seeds_needed": pair.seeds_needed,
            }
        )
    headings = ["controller", "minus", "difference [95%]", "p", "p (Holm)", "seeds needed"]
    caption = f"{caption}. {pairs_note(pairs)}."
    return Table(name, caption, headings, cells, pd.DataFrame(exact), words=frozenset({0, 1}))
