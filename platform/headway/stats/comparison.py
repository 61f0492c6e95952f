"""Comparison of learners with rules on the same episodes: means, and differences from a reference rule."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

from headway.contracts.entries import is_lookahead
from headway.events import LABELS, Row
from headway.stats.samples import CONFIDENCE, Interval

RULE = "rule "
"""Prefix of a rule's name among those of controllers."""
_FIRST_METRICS = 3
"""Metrics beside the return, unless they are chosen."""
SEEDS_FOR_A_CLAIM = 10
"""Minimum number of training seeds from which an interval over seeds that excludes 0 supports a claim."""
EPISODES_FOR_A_CLAIM = 20
"""Minimum number of episodes from which an interval over episodes that excludes 0 supports a claim."""


class ComparisonRow(NamedTuple):
    """One metric of one controller. None: a rule has no seeds, the reference no difference from itself."""

    metric: str
    controller: str
    seeds: int | None
    mean: float
    difference: float | None = None
    """Controller minus reference; None also for metrics that are not compared."""
    low: float | None = None
    high: float | None = None
    interval: str | None = None
    """Kind of the interval of the difference, from `low` to `high`; None: only one episode was played."""


def comparison_rows(
    rules: Mapping[str, Sequence[Row]],
    learned: Mapping[str, Sequence[Sequence[Row]]],
    names: Sequence[str],
    reference: str | None,
    confidence: float = CONFIDENCE,
) -> list[ComparisonRow]:
    """Return one row per metric and controller: per metric, learners, then rules by their mean return.

    `rules`: episodes of each; `learned`: seeds x episodes of each; `names`: metrics to compare. Without
    `names` the return is compared, beside which stand the means of the first metrics that all episodes have.
    """
    controllers = {**learned, **{f"{RULE}{rule}": [rules[rule]] for rule in _by_return(rules)}}
    with_difference = names or ("return",)
    rows = []
    for metric in names or _first_metrics(controllers.values()):
        for name, by_seed in controllers.items():
            values = [metric_values(of_seed, metric) for of_seed in by_seed]
            seeds = len(values) if name in learned else None
            row = ComparisonRow(metric, name, seeds, fmean(map(fmean, values)))
            if reference is not None and metric in with_difference and name != f"{RULE}{reference}":
                of_reference = metric_values(rules[reference], metric)
                if len(of_reference) > 1:
                    found = difference(values, of_reference, confidence)
                    row = ComparisonRow(*row[:4], found.estimate, found.low, found.high, found.method)
                else:
                    row = row._replace(difference=row.mean - of_reference[0])
            rows.append(row)
    return rows


def best_learner(
    rules: Mapping[str, Sequence[Row]], learned: Mapping[str, Sequence[Sequence[Row]]], reference: str
) -> ComparisonRow:
    """Return the row of the learner with the highest mean return, compared with the rule `reference`.

    Its interval is corrected for choosing the best of n learners: it has the confidence 1 - 5% / n
    (Bonferroni), with which all n contain their true differences with a probability of at least 95%.
    """
    name = max(learned, key=lambda learner: mean_return(learned[learner]))
    confidence = 1 - (1 - CONFIDENCE) / len(learned)
    (row,) = comparison_rows(
        {reference: rules[reference]}, {name: learned[name]}, ("return",), reference, confidence
    )[:1]
    return row


def best_rule(rules: Mapping[str, Sequence[Row]]) -> str | None:
    """Return the rule with the highest mean return; `lookahead` only if there is no other, None if there is
    none."""
    return min(_by_return(rules), key=is_lookahead, default=None)


def _by_return(rules: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return the names of rules by their mean return, highest first."""
    return sorted(rules, key=lambda rule: -fmean(metric_values(rules[rule], "return")))


def metric_values(episodes: Sequence[Row], metric: str) -> list[float]:
    """Return a metric of each episode."""
    return [float(row[metric]) for row in episodes]


def mean_return(learned: Sequence[Sequence[Row]]) -> float:
    """Return the mean return of a learner, seeds x episodes."""
    return fmean(fmean(metric_values(rows, "return")) for rows in learned)


def _first_metrics(played: Iterable[Sequence[Sequence[Row]]]) -> list[str]:
    """Return the return and the first metrics that all episodes have."""
    first, *others = (row for by_seed in played for rows in by_seed for row in rows)
    names = [name for name in first if name not in LABELS | {"length", "return"}]
    everywhere = [name for name in names if all(row.get(name) is not None for row in (first, *others))]
    return ["return", *everywhere[:_FIRST_METRICS]]


def difference(
    learned: Sequence[Sequence[float]], rule: Sequence[float], confidence: float = CONFIDENCE
) -> Interval:
    """Return the paired difference of a metric between a learner (seeds x episodes) and a rule (episodes).

    The interval is Student's t over episodes for one seed, over seeds and episodes for more. Raises
    ValueError for fewer than two episodes.
    """
    from headway.stats.intervals import paired_difference, paired_difference_over_seeds

    if len(learned) == 1:
        return paired_difference(learned[0], rule, confidence)
    return paired_difference_over_seeds(learned, [rule] * len(learned), confidence)


@dataclass(frozen=True)
class Gap:
    """What `lookahead` gains over the best other rule."""

    best: str
    """The best of the rules without `lookahead`."""
    reference: str
    """The `lookahead`."""
    lead: Interval | None
    """Gain of `reference` over `best`, paired by episode; None: fewer than two episodes."""
    shares: Mapping[str, float]
    """Part of the lead that each learner reaches, by name; empty unless the lead's interval is above 0."""


def gaps(learned: Mapping[str, float], rules: Mapping[str, Sequence[float]], sign: int = 1) -> list[Gap]:
    """Return the gap of each `lookahead` among the rules; none without another rule.

    `learned`: mean of each learner; `rules`: values of each rule, of the same episodes in the same order.
    `sign` is -1 if lower is better.
    """
    others = [rule for rule in rules if not is_lookahead(rule)]
    if not others:
        return []
    best = max(others, key=lambda rule: sign * fmean(rules[rule]))
    found = []
    for reference in filter(is_lookahead, rules):
        gains = [sign * (a - b) for a, b in zip(rules[reference], rules[best], strict=True)]
        lead = difference([gains], [0.0] * len(gains)) if len(gains) > 1 else None
        shares = {}
        if lead is not None and lead.low > 0:
            base = fmean(rules[best])
            shares = {name: sign * (value - base) / lead.estimate for name, value in learned.items()}
        found.append(Gap(best, reference, lead, shares))
    return found
