"""`headway compare`: compare the cells of studies and the classical rules on the same episodes."""

import argparse
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway.stats.comparison import metric_values
from headway.stats.pairs import pair_rows
from headway_launch.commands.arguments import (
    OTHER_EVALUATION_SEED,
    add_best_argument,
    add_config_dir_argument,
    add_format_argument,
    add_store_argument,
    add_where_argument,
    named_studies,
    typed_line,
    without_folders,
)
from headway_launch.report.comparison_table import COMPARISON_FORMATS
from headway_launch.runner.comparison import Comparison

if TYPE_CHECKING:
    from headway.events import Row
    from headway_launch.studies.compared_learners import ComparedLearners

EXAMPLES = """\
examples:
  headway compare bus --episodes 200
  headway compare bus --episodes 200 --against always_move --metrics return,mean_wait_min,headway_cv
  headway compare bus --format markdown            a table for a page; latex: for a paper
  headway compare bus --best
  headway compare bus --best --keep                store these episodes, for the report's absolute metric
  headway compare bus bus_longer old/runs:bus      learners of several studies, also of other stores
  headway compare bus --rules always_move,headway_holding_0.9 --where preset=bus_tuned
  headway compare bus env.args.disruptions.surge=3         learners and rules on a changed environment
  headway compare env=bus env.args.scenario=corridor --episodes 20        rules alone, without training
  headway compare experiment=intersection_study --against human --metrics outflow_vph,collisions

The newest policy of every finished seed and every rule are evaluated on the same episodes; with --best, each
seed's policy is the one with the highest mean return in the evaluations during its training, whose episodes
are others (unless --seed is evaluation.seed). Differences are
controller minus reference, paired by episode, with 95% intervals by Student's t: over episodes for a rule or
a cell with one seed, over training seeds and episodes for a cell with several. The default reference is the
rule with the highest mean return. Pairs of learners, of different studies if several are named, are compared
by the first metric: paired by episode but not by seed, with an interval and a p-value over the seeds of both
and the episodes. p (Holm) is corrected for the number of pairs; --where selects fewer.
Tables, also in markdown and latex (for the package booktabs), have one row per controller, rounded to two
significant digits of a metric's narrowest interval, and one per pair. csv and json have all digits and one
row per difference. `headway list metrics ENVIRONMENT` describes the metrics.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study or environment, the episodes and the reference."""
    parser.add_argument(
        "study",
        metavar="STUDY|KEY=VALUE",
        nargs="+",
        help="studies, as in `headway runs`, or STORE:STUDY for one of another store, and env.args.KEY=VALUE "
        "to change their environment; or, for rules alone, env=, env.KEY= or experiment=",
    )
    parser.add_argument("--episodes", type=int, default=100, help="evaluation episodes (default: 100)")
    parser.add_argument(
        "--seed",
        type=int,
        default=OTHER_EVALUATION_SEED,
        help=f"root of the episode seeds (default: {OTHER_EVALUATION_SEED})",
    )
    parser.add_argument("--mode", choices=("greedy", "sampled"), default="greedy", help="how policies act")
    add_best_argument(parser)
    parser.add_argument(
        "--keep",
        action="store_true",
        help="with --best: store the episodes, for the absolute metric of `headway report`",
    )
    parser.add_argument("--rules", help="rules to evaluate, comma-separated (default: all that can run)")
    parser.add_argument("--against", help="reference rule (default: the best one)")
    parser.add_argument(
        "--metrics", default="return", help="metrics to compare, comma-separated (default: return)"
    )
    add_format_argument(parser, COMPARISON_FORMATS)
    add_where_argument(parser)
    add_config_dir_argument(parser)
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Evaluate and print the table."""
    from headway_launch.console.output import print_line
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.rules import counting, rule_episodes, rules_to_play
    from headway_launch.experiments.start_line import start_line
    from headway_launch.runner.checkpointed_policy import policy_episodes, stored_policy
    from headway_launch.runner.comparison import print_env_changes, print_findings
    from headway_launch.runner.warm_up import compile_kernels
    from headway_launch.studies.kept_episodes import keep_episodes, require_other_episodes

    if arguments.episodes < 2:
        raise HeadwayError(
            f"--episodes {arguments.episodes}: must be at least 2, because an interval needs two episodes"
        )
    if arguments.seed < 0:
        raise HeadwayError(f"--seed {arguments.seed}: must not be negative")
    if arguments.keep and not arguments.best:
        raise HeadwayError("--keep stores the episodes of the best policies; add --best, or omit it")
    if arguments.keep and arguments.archive is not None:
        raise HeadwayError("--keep has no effect on an archive, which is only read; name its store")
    subject = _subject(arguments)
    which = ", best policies" if arguments.best else ""
    experiment, cells = subject.experiment, {f"{label}{which}": runs for label, runs in subject.cells.items()}
    if arguments.keep:
        require_other_episodes(arguments.seed, cells)
    found = experiment.prepare_environment()
    names = rules_to_play(found, arguments.rules)
    if not names:
        raise HeadwayError("--rules is empty; give at least one, such as --rules random")
    against = arguments.against
    if against is not None:
        references = rules_to_play(found, against, "--against")
        if len(references) != 1:
            raise HeadwayError(f"--against {against!r}: give one rule, such as --against random")
        [against] = references
        names = tuple(dict.fromkeys((against, *names)))
    metrics = _metrics(arguments.metrics, ("length", "return", *found.spec.metrics))
    compile_kernels(experiment.env)
    policies = {
        label: [stored_policy(run, found, arguments.best, subject.changed) for run in members]
        for label, members in cells.items()
    }
    print_env_changes(subject.changes)
    root, episodes, greedy = arguments.seed, arguments.episodes, arguments.mode == "greedy"
    players = len(names) + sum(map(len, policies.values()))
    with CountedProgress("episodes played", players * episodes) as progress:
        rules = rule_episodes(experiment, found.prepared, names, root, episodes, progress)
        played = {
            label: [
                policy_episodes(policy, root, episodes, greedy, counting(progress, label))
                for policy in of_cell
            ]
            for label, of_cell in policies.items()
        }
    if arguments.keep:
        for label, members in cells.items():
            iterations = [policy.iteration for policy in policies[label]]
            keep_episodes(members, iterations, played[label], rules, root, arguments.mode)
    _require_values(metrics, {f"rule {rule}": [rows] for rule, rows in rules.items()} | played)
    mode = f", {arguments.mode}" if cells else ""
    comparison = Comparison.of(
        f"{without_folders(subject.name)}: {episodes} episodes of {found.spec.name}{mode}",
        found.entry.metrics,
        rules,
        played,
        metrics,
        against,
    )
    pairs = pair_rows(
        metrics[0],
        {label: [metric_values(of_seed, metrics[0]) for of_seed in played[label]] for label in played},
        subject.pairs(which),
    )
    COMPARISON_FORMATS[arguments.format](comparison, pairs, typed_line(arguments))
    for label, members in cells.items():
        folders = [run.directory for run in members]
        if line := start_line(label, members[0].store, folders, f"evaluation_{arguments.mode}/return"):
            print_line(line)
    print_findings(comparison, played, rules)
    return 0


def _subject(arguments: argparse.Namespace) -> "ComparedLearners":
    from headway_launch.experiments.compose import compose
    from headway_launch.experiments.options import options
    from headway_launch.experiments.override_words import require_each_key_once
    from headway_launch.studies.compared_learners import ComparedLearners

    words: list[str] = arguments.study
    studies = [word for word in words if "=" not in word]
    changed = [word for word in words if "=" in word]
    if not studies:
        require_each_key_once(words)
        _require_for_rules(words)
        for option in ("best", "where"):
            if getattr(arguments, option):
                line = f"--{option} has no effect if rules are compared alone; omit it, or name a study"
                raise HeadwayError(line)
        return ComparedLearners(" ".join(words), compose(words))
    if changed and arguments.keep:
        raise HeadwayError(f"--keep stores episodes of the studies' own environment; omit {changed[0]}")
    try:
        learners = ComparedLearners.of(named_studies(studies, arguments.store), arguments.where)
    except HeadwayError as error:
        known = options()
        for group in ("env", "experiment"):
            if studies[0] in known[group]:
                hint = f"for rules alone: headway compare {group}={studies[0]}"
                raise HeadwayError(f"{error}; {hint}") from error
        raise
    learners.require_one_environment()
    return learners.with_env_args(changed)


def _require_for_rules(words: Sequence[str]) -> None:
    """Raise HeadwayError for overrides that have no effect on rules, or that do not name an environment."""
    keys = [word.partition("=")[0].lstrip("+~") for word in words]
    for word, key in zip(words, keys, strict=True):
        if key.split(".")[0] not in ("env", "experiment") or key.startswith("env.training_args"):
            raise HeadwayError(
                f"{word!r} has no effect if rules are compared alone; give env=, env.KEY= or experiment=, "
                "and options such as --episodes, --rules and --seed"
            )
    if not {"env", "experiment"} & set(keys):
        raise HeadwayError("no environment given; add env=ENV or experiment=EXPERIMENT")


def _require_values(metrics: Sequence[str], played: Mapping[str, Sequence[Sequence["Row"]]]) -> None:
    """Raise HeadwayError if a metric has no value in an episode of a controller, seeds x episodes of each."""
    for metric in metrics:
        for name, by_seed in played.items():
            values = [value for rows in by_seed for value in metric_values(rows, metric)]
            if missing := sum(not isfinite(value) for value in values):
                raise HeadwayError(
                    f"--metrics: {metric} has no value in {missing} of {len(values)} episodes of {name}; "
                    "choose a metric that every episode has"
                )


def _metrics(names: str, known: Sequence[str]) -> tuple[str, ...]:
    wanted = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
    for name in wanted:
        if name not in known:
            raise HeadwayError(f"--metrics: unknown metric {name!r}; {suggestion(name, known)}")
    if not wanted:
        raise HeadwayError("--metrics is empty; give at least one, such as --metrics return")
    return wanted
