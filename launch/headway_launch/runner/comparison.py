"""Trained policies beside the classical rules, on the same days."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway.events import LABELS, Row
from headway_launch.console.output import print_line
from headway_launch.console.tables import Cell, print_table

if TYPE_CHECKING:
    from headway.rollout.episodes import OnStep
    from headway.stats import Interval
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.compose import Experiment, PreparedEnv

_NOT_METRICS = LABELS | {"length", "return"}
SEEDS_FOR_A_CLAIM = 10
"""Training seeds from which a difference with an interval over them that excludes 0 is worth a claim."""
DAYS_FOR_A_CLAIM = 20
"""Days from which a difference with an interval over days that excludes 0 is worth a claim."""
_COLUMNS = ("controller", "days", "return", "learner minus it", "95% from", "95% to", "interval")


def rules_to_play(environment: "PreparedEnv", names: str | None, option: str = "--rules") -> tuple[str, ...]:
    """Rules of an environment by name, each once: those that `option` gives, `a,b`, or else all that can play
    it. Those that cannot, because wrappers hide what they look at, are told in a line.

    Raises HeadwayError for a name that is no rule, and for a rule that is named and cannot play.
    """
    known = environment.entry.rules
    if names is not None:
        wanted = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
        for name in wanted:
            if name not in known:
                raise HeadwayError(f"{option}: {name!r} is no rule here; {suggestion(name, known)}")
            if problem := _why_not(environment, name):
                raise HeadwayError(f"{option}: {problem}")
        return wanted
    problems = {name: problem for name in known if (problem := _why_not(environment, name))}
    if problems:
        others = f" (and so {', '.join(list(problems)[1:])})" if len(problems) > 1 else ""
        print_line(f"headway: left out: {next(iter(problems.values()))}{others}")
    return tuple(name for name in known if name not in problems)


def _why_not(environment: "PreparedEnv", rule: str) -> str | None:
    try:
        environment.entry.rules[rule].make(environment.prepared)
    except HeadwayError as error:
        return str(error)
    return None


def rule_episodes(
    experiment: "Experiment",
    prepared: object,
    rules: Sequence[str],
    root: int,
    episodes: int,
    counted: "CountedProgress",
) -> dict[str, list[Row]]:
    """Episodes of rules of the environment on the evaluation seeds that follow from `root`, counted."""
    from headway.rollout.episodes import evaluate_rule

    make, known = experiment.env.make, experiment.env.rules
    return {
        rule: evaluate_rule(
            make, known[rule].make, prepared, root, episodes, counting(counted, f"rule {rule}")
        )
        for rule in rules
    }


def counting(counted: "CountedProgress", name: str) -> "OnStep":
    """Adds the episodes that end, of the controller named, to those that are counted."""
    return lambda step, ended: counted.add(ended, f"{name}, step {step:,}")


def print_comparison(name: str, learned: Sequence[Sequence[Row]], rules: Mapping[str, Sequence[Row]]) -> None:
    """Mean return and metrics of `learned` (seeds x days) and of the rules (days each) on the same days, and
    the learner's return minus each rule's with the 95% interval of `difference`.
    """
    label = name if len(learned) == 1 else f"{name}, {len(learned)} seeds"
    everything = [(label, [row for rows in learned for row in rows])] if learned else []
    everything += [(f"rule {rule}", list(rows)) for rule, rows in rules.items()]
    metrics = list(
        dict.fromkeys(name for _, rows in everything for name in rows[0] if name not in _NOT_METRICS)
    )
    table: list[tuple[Cell, ...]] = []
    methods: set[str] = set()
    for controller, rows in everything:
        against = _of_returns(learned, rows) if controller != label else None
        interval = (against.estimate, against.low, against.high, against.method) if against else (None,) * 4
        methods |= {against.method} if against else set()
        days = len(rows) // len(learned) if controller == label else len(rows)
        means = [_mean(rows, metric) for metric in metrics]
        table.append((controller, days, _mean(rows, "return"), *interval, *means))
    columns = (*_COLUMNS, *metrics)
    if sys.stdout.isatty():
        _print_upright(columns, table, methods)
    else:
        print_table(columns, table)
    if learned and rules and len(learned) < SEEDS_FOR_A_CLAIM:
        print_line(few_seeds(len(learned)))


def difference(learned: Sequence[Sequence[float]], rule: Sequence[float]) -> "Interval":
    """A figure of a learner (seeds x days) minus a rule's (days) on the same days, with its 95% interval: by
    Student's t over days for one seed, over seeds and days for more. Raises ValueError below two days."""
    from headway.stats import paired_difference, paired_difference_over_seeds

    if len(learned) == 1:
        return paired_difference(learned[0], rule)
    return paired_difference_over_seeds(learned, [rule] * len(learned))


def few_seeds(seeds: int) -> str:
    """What so few training seeds cannot tell."""
    if seeds == 1:
        known = "1 seed: the interval is over days for this one policy; how seeds differ cannot be known"
    else:
        known = f"{seeds} seeds: the interval takes them to differ by a normal law and may miss rare failures"
    return f"{known}; train at least {SEEDS_FOR_A_CLAIM} before saying which is better"


def few_days(days: int) -> str:
    """What so few days cannot tell."""
    return (
        f"{days} days: the intervals take days to differ by a normal law and may miss rare ones; "
        f"play at least {DAYS_FOR_A_CLAIM} before saying which is better"
    )


def _print_upright(columns: Sequence[str], table: Sequence[Sequence[Cell]], methods: Iterable[str]) -> None:
    """A column a controller: with few of them and many metrics easier to read, and narrower. On a narrow
    terminal the worst rules go first."""
    method = columns.index("interval")
    rows = [
        (name, *(row[place] for row in table))
        for place, name in enumerate(columns)
        if place not in (0, method)
    ]
    names = [str(row[0]).removeprefix("rule ") for row in table]
    rules = sorted((row for row in table if str(row[0]).startswith("rule ")), key=lambda row: row[2] or 0)
    spare = [str(row[0]).removeprefix("rule ") for row in rules[:-1]]
    title = f"95% intervals: {', '.join(methods)}" if methods else ""
    print_table(("", *names), rows, title, spare=spare)


def _of_returns(learned: Sequence[Sequence[Row]], rule: Sequence[Row]) -> "Interval | None":
    """None where the days do not pair."""
    days = [int(row["episode_seed"]) for row in rule]
    if len(days) < 2 or not learned:
        return None
    if any([int(row["episode_seed"]) for row in rows] != days for rows in learned):
        return None
    return difference([_returns(rows) for rows in learned], _returns(rule))


def _returns(rows: Sequence[Row]) -> list[float]:
    return [float(row["return"]) for row in rows]


def _mean(rows: Sequence[Row], column: str) -> float | None:
    values = [float(row[column]) for row in rows if column in row]
    return sum(values) / len(values) if values else None
