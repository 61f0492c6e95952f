"""Comparisons of learners with rules and with each other: tables for a page or a paper, and all formats in
which commands print them."""

import csv
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from headway.stats.pairs import PairRow
from headway_launch.console.number_formats import MISSING, with_interval
from headway_launch.console.output import print_line
from headway_launch.console.tables import Value, print_table
from headway_launch.report.elements import Table
from headway_launch.report.latex_table import latex_table
from headway_launch.report.markdown_page import markdown_table
from headway_launch.runner.comparison import Comparison
from headway_launch.studies.learner_pairs import needed, p_texts, pairs_note

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


def comparison_table(comparison: Comparison, note: str = "") -> Table:
    """Return a comparison as a table with one row per controller and two columns per metric.

    `note`: end of its caption.
    """
    cells = comparison.cells
    learners = sum(not name.startswith("rule ") for name in comparison.controllers)
    differences = (
        f" Differences from the rule `{comparison.reference}`, paired by episode, with 95% intervals "
        "(Student's t). Intervals of several seeds cover the variation between seeds and between episodes, "
        "those of one seed or of a rule only that between episodes."
    )
    return Table(
        "comparison",
        f"{comparison.title}.{differences if comparison.reference else ''}{note}",
        comparison.headings(),
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


def _print_tables(found: Comparison, pairs: Sequence[PairRow], line: str) -> None:
    found.show()
    if pairs:
        table = pairs_table(pairs, "pairs", "")
        print_table(table.headings, table.rows, title="pairs of learners", numbers=table.headings[2:])
        print_line(pairs_note(pairs))


def _page_tables(found: Comparison, pairs: Sequence[PairRow], note: str = "") -> list[Table]:
    """Return the tables for a page or a paper; `note`: end of their captions."""
    tables = [comparison_table(found, note)]
    if pairs:
        caption = f"{found.title}. Differences between learners, {found.metrics[pairs[0].metric]}"
        table = pairs_table(pairs, "pairs", caption)
        tables.append(replace(table, caption=table.caption + note))
    return tables


COMPARISON_FORMATS: Mapping[str, Callable[[Comparison, Sequence[PairRow], str], None]] = {
    "table": _print_tables,
    "json": lambda found, pairs, _: print(json.dumps(records(found, pairs), indent=1)),
    "csv": lambda found, pairs, _: csv.writer(sys.stdout, lineterminator="\n").writerows(
        [RECORD_COLUMNS, *(record.values() for record in records(found, pairs))]
    ),
    "markdown": lambda found, pairs, line: print(
        "\n\n".join(map(markdown_table, _page_tables(found, pairs, f" Written by `{line}`.")))
    ),
    "latex": lambda found, pairs, line: print(
        "\n".join(latex_table(table, line) for table in _page_tables(found, pairs)), end=""
    ),
}
"""Printer for each value of --format: (comparison, pairs of learners, command line) -> None."""
