"""Comparison of trained policies with the classical rules on the same evaluation episodes."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway.events import LABELS, Row
from headway.registry import rule_entry
from headway.rollout.lookahead import is_lookahead
from headway_launch.console.output import print_line, prints_to_stderr
from headway_launch.console.tables import Value, print_table

if TYPE_CHECKING:
    from headway.rollout.episodes import OnStep
    from headway.stats.samples import Interval
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.compose import Experiment, PreparedEnv

_NOT_METRICS = LABELS | {"length", "return"}
SEEDS_FOR_A_CLAIM = 10
"""Minimum number of training seeds from which an interval over seeds that excludes 0 supports a claim."""
EPISODES_FOR_A_CLAIM = 20
"""Minimum number of episodes from which an interval over episodes that excludes 0 supports a claim."""
_COLUMNS = ("controller", "episodes", "return", "learner minus rule", "95% low", "95% high", "interval")


def rules_to_play(environment: "PreparedEnv", names: str | None, option: str = "--rules") -> tuple[str, ...]:
    """Return the rules to play: the distinct ones in `names` (`a,b`) or, by default, all that can be played
    except `lookahead`.

    Prints which rules are left out because wrappers hide their inputs. Raises HeadwayError, naming `option`,
    for an unknown rule or a listed rule that cannot play.
    """
    known = environment.entry.rules
    if names is not None:
        wanted = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
        for name in wanted:
            if problem := _refusal(environment, name):
                raise HeadwayError(f"{option}: {problem}")
        return wanted
    problems = {name: problem for name in known if (problem := _refusal(environment, name))}
    if problems:
        others = f" (likewise {', '.join(list(problems)[1:])})" if len(problems) > 1 else ""
        print_line(f"headway: left out: {next(iter(problems.values()))}{others}")
    return tuple(name for name in known if name not in problems)


def _refusal(environment: "PreparedEnv", rule: str) -> str | None:
    """Return why a rule is unknown or cannot play an environment; None if it can."""
    try:
        rule_entry(environment.entry, rule).make(environment.prepared)
    except HeadwayError as error:
        return str(error)
    return None


@prints_to_stderr()
def rule_episodes(
    experiment: "Experiment",
    prepared: object,
    rules: Sequence[str],
    root: int,
    episodes: int,
    progress: "CountedProgress",
) -> dict[str, list[Row]]:
    """Return the episodes of each rule, one row per episode, on the evaluation seeds derived from `root`."""
    from headway.rollout.episodes import evaluate_rule

    env = experiment.env
    return {
        rule: evaluate_rule(
            env.make, rule_entry(env, rule).make, prepared, root, episodes, counting(progress, f"rule {rule}")
        )
        for rule in rules
    }


def counting(progress: "CountedProgress", name: str) -> "OnStep":
    """Return a callback that adds the finished episodes of the controller `name` to the counter."""
    return lambda step, ended: progress.add(ended, f"{name}, step {step:,}")


def print_comparison(name: str, learned: Sequence[Sequence[Row]], rules: Mapping[str, Sequence[Row]]) -> None:
    """Print mean returns and metrics of a learner and of rules, and the differences of their returns.

    `learned`: seeds x episodes; `rules`: episodes of each rule. Differences are the learner's return minus
    each rule's, with the 95% interval of `difference`.
    """
    label = name if len(learned) == 1 else f"{name}, {len(learned)} seeds"
    controllers = [(label, [row for rows in learned for row in rows])] if learned else []
    controllers += [(f"rule {rule}", list(rows)) for rule, rows in rules.items()]
    metrics = list(
        dict.fromkeys(name for _, rows in controllers for name in rows[0] if name not in _NOT_METRICS)
    )
    table: list[tuple[Value, ...]] = []
    methods: set[str] = set()
    for controller, rows in controllers:
        against = _return_difference(learned, rows) if controller != label else None
        interval = (against.estimate, against.low, against.high, against.method) if against else (None,) * 4
        methods |= {against.method} if against else set()
        episodes = len(rows) // len(learned) if controller == label else len(rows)
        means = [_mean(rows, metric) for metric in metrics]
        table.append((controller, episodes, _mean(rows, "return"), *interval, *means))
    _print_by_column((*_COLUMNS, *metrics), table, methods)
    if len({tuple(_episode_seeds(rows)) for rows in (*learned, *rules.values())}) == 1:
        of_learner = {name: fmean(fmean(_returns(rows)) for rows in learned)} if learned else {}
        for line in gap_lines(of_learner, {rule: _returns(rows) for rule, rows in rules.items()}):
            print_line(line)
    if learned and rules and len(learned) < SEEDS_FOR_A_CLAIM:
        print_line(few_seeds(len(learned)))
    if methods and (episodes := len(learned[0])) < EPISODES_FOR_A_CLAIM:
        print_line(few_episodes(episodes))


def difference(learned: Sequence[Sequence[float]], rule: Sequence[float]) -> "Interval":
    """Return the paired difference of a metric between a learner (seeds x episodes) and a rule (episodes).

    The 95% interval is Student's t over episodes for one seed, over seeds and episodes for more. Raises
    ValueError for fewer than two episodes.
    """
    from headway.stats.intervals import paired_difference, paired_difference_over_seeds

    if len(learned) == 1:
        return paired_difference(learned[0], rule)
    return paired_difference_over_seeds(learned, [rule] * len(learned))


def gap_lines(learned: Mapping[str, float], rules: Mapping[str, Sequence[float]], sign: int = 1) -> list[str]:
    """Return a sentence for each `lookahead` among the rules on its lead over the best other rule.

    It states which share of that lead each learner reaches, if the paired 95% interval of the lead over
    episodes is above 0. `learned`: mean of each learner; `rules`: values of each rule, of the same episodes
    in the same order. `sign` is -1 if lower is better.
    """
    others = [rule for rule in rules if not is_lookahead(rule)]
    if not others:
        return []
    best = max(others, key=lambda rule: sign * fmean(rules[rule]))
    means = {name: sign * (value - fmean(rules[best])) for name, value in learned.items()}
    gained = {
        reference: [sign * (value - of_best) for value, of_best in zip(values, rules[best], strict=True)]
        for reference, values in rules.items()
        if is_lookahead(reference)
    }
    return [_gap_line(best, reference, values, means) for reference, values in gained.items()]


def _gap_line(best: str, reference: str, gains: Sequence[float], learned: Mapping[str, float]) -> str:
    """Return the sentence on one `lookahead`; `gains` (episodes,) and `learned` are differences from the rule
    `best`."""
    between = f"gap from {best}, the best of the rules played, to {reference}"
    if len(gains) < 2:
        return f"{between}: not distinguishable from 0 over fewer than two episodes"
    gap = difference([gains], [0.0] * len(gains))
    interval = f"95% interval {gap.low:.4g} to {gap.high:.4g}"
    if gap.low <= 0:
        finding = "not distinguishable from 0" if gap.high >= 0 else f"none, {reference} is worse"
        return f"{between}: {finding} ({interval})"
    shares = ", ".join(f"{name} closes {value / gap.estimate:.0%}" for name, value in learned.items())
    note = "a reference that simulates the environment"
    return f"{between}, {note}: {gap.estimate:.4g} ({interval}){'; of this gap, ' if shares else ''}{shares}"


def few_seeds(seeds: int) -> str:
    """Return a warning about a comparison over few training seeds."""
    if seeds == 1:
        limit = "1 seed: the interval is over episodes of one policy and ignores the variation between seeds"
    else:
        limit = f"{seeds} seeds: the interval assumes a normal distribution and may miss rare failures"
    return f"{limit}; train at least {SEEDS_FOR_A_CLAIM} before claiming that one is better"


def few_episodes(episodes: int) -> str:
    """Return a warning about a comparison over few episodes."""
    return (
        f"{episodes} episodes: the intervals assume a normal distribution and may miss rare episodes; "
        f"play at least {EPISODES_FOR_A_CLAIM} before claiming that one is better"
    )


def _print_by_column(
    columns: Sequence[str], table: Sequence[Sequence[Value]], methods: Iterable[str]
) -> None:
    """Print the table with one column per controller, which is narrower for few controllers and many metrics.

    On a narrow terminal the columns of the rules with the lowest return are left out first; there the title
    has the kind of interval, of which there is a row elsewhere.
    """
    rows = [
        (name, *(row[place] for row in table))
        for place, name in enumerate(columns)
        if place and not (name == "interval" and sys.stdout.isatty())
    ]
    names = [str(row[0]) for row in table]
    rules = sorted((row for row in table if str(row[0]).startswith("rule ")), key=lambda row: row[2] or 0)
    spare = [str(row[0]) for row in rules[:-1]]
    title = f"95% intervals: {', '.join(methods)}" if methods else ""
    print_table(("metric", *names), rows, title, whole=("metric",), spare=spare)


def _return_difference(learned: Sequence[Sequence[Row]], rule: Sequence[Row]) -> "Interval | None":
    """Return the difference of the returns; None if the episodes do not pair by seed."""
    seeds = _episode_seeds(rule)
    if len(seeds) < 2 or not learned:
        return None
    if any(_episode_seeds(rows) != seeds for rows in learned):
        return None
    return difference([_returns(rows) for rows in learned], _returns(rule))


def _episode_seeds(rows: Sequence[Row]) -> list[int]:
    return [int(row["episode_seed"]) for row in rows]


def _returns(rows: Sequence[Row]) -> list[float]:
    return [float(row["return"]) for row in rows]


def _mean(rows: Sequence[Row], column: str) -> float | None:
    values = [float(row[column]) for row in rows if column in row]
    return sum(values) / len(values) if values else None
