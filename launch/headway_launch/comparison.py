"""Trained policies beside the classical rules, on the same days."""

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from headway.events import LABELS, Row
from headway_launch.tables import Cell, print_table
from headway_launch.telling import tell

if TYPE_CHECKING:
    from headway.stats import Interval
    from headway_launch.composing import Experiment

_NOT_METRICS = LABELS | {"length", "return"}
SEEDS_FOR_A_CLAIM = 10
"""Training seeds from which a difference with an interval that excludes 0 is worth a claim."""
_COLUMNS = ("controller", "days", "return", "learner minus it", "95% from", "95% to")


def rule_episodes(
    experiment: "Experiment", prepared: object, rules: Sequence[str], root: int, episodes: int
) -> dict[str, list[Row]]:
    """Episodes of rules of the environment on the evaluation seeds that follow from `root`."""
    from headway.rollout.episodes import evaluate_rule

    if rules and sys.stderr.isatty():
        print(f"evaluating the rules: {', '.join(rules)}", file=sys.stderr, flush=True)
    make, known = experiment.env.make, experiment.env.rules
    return {rule: evaluate_rule(make, known[rule], prepared, root, episodes) for rule in rules}


def print_comparison(name: str, learned: Sequence[Sequence[Row]], rules: Mapping[str, Sequence[Row]]) -> None:
    """Mean return and metrics of `learned` (seeds x days) and of the rules (days each) on the same days, and
    the learner's return minus each rule's with its 95% interval: over days by Student's t for one seed,
    over seeds and days by the bootstrap for more.
    """
    label = name if len(learned) == 1 else f"{name}, {len(learned)} seeds"
    everything = [(label, [row for rows in learned for row in rows])] if learned else []
    everything += [(f"rule {rule}", list(rows)) for rule, rows in rules.items()]
    metrics = list(
        dict.fromkeys(name for _, rows in everything for name in rows[0] if name not in _NOT_METRICS)
    )
    table: list[tuple[Cell, ...]] = []
    for controller, rows in everything:
        against = _difference(learned, rows) if controller != label else None
        interval = (against.estimate, against.low, against.high) if against else (None, None, None)
        days = len(rows) // len(learned) if controller == label else len(rows)
        means = [_mean(rows, metric) for metric in metrics]
        table.append((controller, days, _mean(rows, "return"), *interval, *means))
    columns = (*_COLUMNS, *metrics)
    if sys.stdout.isatty():  # few controllers and many metrics: easier to read, and narrower, the other way
        rows_by_column = zip(columns[1:], *(cells[1:] for cells in table), strict=True)
        print_table(("", *(str(cells[0]).removeprefix("rule ") for cells in table)), list(rows_by_column))
    else:
        print_table(columns, table)
    if learned and rules and len(learned) < SEEDS_FOR_A_CLAIM:
        seeds = "1 seed" if len(learned) == 1 else f"{len(learned)} seeds"
        tell(
            f"{seeds}: the intervals cannot know how seeds differ and are too narrow; "
            f"train at least {SEEDS_FOR_A_CLAIM} before saying which is better"
        )


def _difference(learned: Sequence[Sequence[Row]], rule: Sequence[Row]) -> "Interval | None":
    """None where the days do not pair."""
    from headway.stats import paired_bootstrap, paired_difference

    days = [int(row["episode_seed"]) for row in rule]
    if len(days) < 2 or not learned:
        return None
    if any([int(row["episode_seed"]) for row in rows] != days for rows in learned):
        return None
    ours = [_returns(rows) for rows in learned]
    if len(ours) == 1:
        return paired_difference(ours[0], _returns(rule))
    return paired_bootstrap(ours, [_returns(rule)] * len(ours))


def _returns(rows: Sequence[Row]) -> list[float]:
    return [float(row["return"]) for row in rows]


def _mean(rows: Sequence[Row], column: str) -> float | None:
    values = [float(row[column]) for row in rows if column in row]
    return sum(values) / len(values) if values else None
