"""`headway compare`: compare the cells of studies and the classical rules on the same episodes."""

import argparse
import csv
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from headway.config.schema import suggestion
from headway.contracts.errors import HeadwayError
from headway.rollout.lookahead import is_lookahead
from headway.wording import readable_metric
from headway_launch.commands.arguments import (
    OTHER_EVALUATION_SEED,
    add_best_argument,
    add_config_dir_argument,
    add_store_argument,
    add_where_argument,
    named_studies,
    typed_line,
    without_folders,
)
from headway_launch.console.tables import print_table
from headway_launch.report.comparison_table import (
    PAIR_COLUMNS,
    RECORD_COLUMNS,
    Comparison,
    ComparisonRow,
    comparison_table,
    pair_rows,
    pairs_note,
    pairs_table,
)
from headway_launch.report.elements import Table
from headway_launch.report.latex_table import latex_table
from headway_launch.report.markdown_page import markdown_table

if TYPE_CHECKING:
    from headway.events import Row
    from headway_launch.experiments.compose import Experiment
    from headway_launch.runner.stored_run import StoredRun

_MAX_DIFFERENCES = 3
"""Maximum number of differences between environments that an error lists."""

EXAMPLES = """\
examples:
  headway compare bus --episodes 200
  headway compare bus --episodes 200 --against always_move --metrics return,mean_wait_min,headway_cv
  headway compare bus --format markdown            a table for a page; latex: for a paper
  headway compare bus --best
  headway compare bus --best --keep                store these episodes, for the report's absolute metric
  headway compare bus bus_longer old/runs:bus      learners of several studies, also of other stores
  headway compare bus --rules always_move,headway_holding_0.9 --where preset=bus_tuned
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
The tables round the numbers of a metric to two significant digits of its narrowest interval; so do markdown
and latex (for the package booktabs), which have one row per controller or pair; csv and json have all digits
and one row per difference. `headway list metrics ENVIRONMENT` describes the metrics.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study or environment, the episodes and the reference."""
    parser.add_argument(
        "study",
        metavar="STUDY|KEY=VALUE",
        nargs="+",
        help="studies, as in `headway runs`, or STORE:STUDY for one of another store; or, for rules alone, "
        "env=, env.KEY= or experiment=",
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
    parser.add_argument("--format", choices=_FORMATS, default="table", help="output format (default: table)")
    add_where_argument(parser)
    add_config_dir_argument(parser)
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Evaluate and print the table."""
    from headway_launch.console.output import print_line
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.start_line import start_line
    from headway_launch.runner.checkpointed_policy import policy_episodes, stored_policy
    from headway_launch.runner.comparison import (
        EPISODES_FOR_A_CLAIM,
        SEEDS_FOR_A_CLAIM,
        counting,
        few_episodes,
        few_seeds,
        gap_lines,
        rule_episodes,
        rules_to_play,
    )
    from headway_launch.runner.warm_up import compile_kernels

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
        _require_other_episodes(arguments.seed, cells)
    found = experiment.prepare_environment()
    names = rules_to_play(found, arguments.rules)
    if not names:
        raise HeadwayError("--rules is empty; give at least one, such as --rules random")
    if arguments.against is not None and arguments.against not in names:
        names = (*rules_to_play(found, arguments.against, "--against"), *names)
    metrics = _metrics(arguments.metrics, ("length", "return", *found.spec.metrics))
    compile_kernels(experiment.env)
    policies = {
        label: [stored_policy(run, found, arguments.best) for run in members]
        for label, members in cells.items()
    }
    root, episodes, greedy = arguments.seed, arguments.episodes, arguments.mode == "greedy"
    players = len(names) + sum(map(len, policies.values()))
    with CountedProgress("episodes played", players * episodes) as progress:
        rules = rule_episodes(experiment, found.prepared, names, root, episodes, progress)
        reference = arguments.against or _best(rules)
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
            _keep(members, iterations, played[label], rules, root, arguments.mode)
    mode = f", {arguments.mode}" if cells else ""
    by_return = sorted(rules, key=lambda rule: -_mean(rules[rule], "return"))
    comparison = Comparison(
        f"{subject.name}: {episodes} episodes of {found.spec.name}{mode}",
        reference,
        {metric: readable_metric(metric, found.entry.metrics.get(metric, "")) for metric in metrics},
        [*played, *(f"rule {rule}" for rule in by_return)],
        _rows(metrics, rules, played, reference),
        pair_rows(
            metrics[0],
            {label: [_values(of_seed, metrics[0]) for of_seed in played[label]] for label in played},
            subject.pairs(which),
        ),
    )
    _FORMATS[arguments.format](comparison, typed_line(arguments))
    for label, members in cells.items():
        folders = [run.directory for run in members]
        return_metric = f"evaluation_{arguments.mode}/return"
        if line := start_line(label, members[0].store, folders, return_metric):
            print_line(line)
    returns = {label: fmean(_mean(of_seed, "return") for of_seed in played[label]) for label in played}
    for line in gap_lines(returns, {rule: _values(rows, "return") for rule, rows in rules.items()}):
        print_line(line)
    fewest = min(map(len, cells.values()), default=SEEDS_FOR_A_CLAIM)
    if fewest < SEEDS_FOR_A_CLAIM:
        print_line(few_seeds(fewest))
    if episodes < EPISODES_FOR_A_CLAIM and len(rules) + len(played) > 1:
        print_line(few_episodes(episodes))
    return 0


@dataclass(frozen=True)
class _Subject:
    """Learners to compare, and their environment."""

    name: str
    experiment: "Experiment"
    studies: Sequence[Mapping[str, list["StoredRun"]]]
    """Per study, the runs of each learner by label; empty if only rules are compared."""

    @property
    def cells(self) -> Mapping[str, list["StoredRun"]]:
        """Runs of each learner by label."""
        return {label: members for study in self.studies for label, members in study.items()}

    def pairs(self, suffix: str) -> list[tuple[str, str]]:
        """Return the labels, with a suffix, of the pairs to compare: of different studies, if several."""
        several = combinations(self.studies, 2)
        found = [(a, b) for one, other in several for a in one for b in other] or combinations(self.cells, 2)
        return [(f"{a}{suffix}", f"{b}{suffix}") for a, b in found]


def _subject(arguments: argparse.Namespace) -> _Subject:
    from headway_launch.experiments.compose import compose
    from headway_launch.experiments.options import options
    from headway_launch.experiments.override_words import require_each_key_once

    words: list[str] = arguments.study
    if "=" in words[0]:
        require_each_key_once(words)
        _require_for_rules(words)
        if arguments.best:
            raise HeadwayError("--best has no effect if rules are compared alone; omit it, or name a study")
        return _Subject(" ".join(map(without_folders, words)), compose(words), ())
    if override := next((word for word in words if "=" in word), None):
        raise HeadwayError(
            f"{override!r}: a study is compared with its own configuration; omit this, "
            f"or omit {words[0]!r} to compare rules alone"
        )
    try:
        named = named_studies(words, arguments.store)
        found = [_cells(root, study, arguments.where) for root, study in named.values()]
    except HeadwayError as error:
        known = options()
        for group in ("env", "experiment"):
            if words[0] in known[group]:
                hint = f"for rules alone: headway compare {group}={words[0]}"
                raise HeadwayError(f"{error}; {hint}") from error
        raise
    if len(found) > 1:
        found = [
            {f"{label} ({name})": members for label, members in cells.items()}
            for name, cells in zip(named, found, strict=True)
        ]
    subject = _Subject(" and ".join(named), next(iter(found[0].values()))[0].experiment, found)
    _require_one_environment(subject)
    return subject


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


def _cells(root: Path, study: str, where: Sequence[str]) -> Mapping[str, list["StoredRun"]]:
    """Return the finished runs of a study for which `where` holds, by label.

    Raises HeadwayError if there are none.
    """
    from headway.store.cell_names import labelled_cells
    from headway_launch.runner.stored_run import StoredRun
    from headway_launch.studies.runs import finished_runs

    runs = finished_runs(root, study, where)
    return {
        label: [StoredRun.read(root, Path(row.directory)) for row in members]
        for label, members in labelled_cells(runs.rows, runs.beside).items()
    }


def _require_one_environment(subject: _Subject) -> None:
    """Raise HeadwayError if the evaluation environments of the learners differ."""
    environments = [members[0].experiment.evaluated_env for members in subject.cells.values()]
    if differing := _differing(environments):
        more = "; ..." if len(differing) > _MAX_DIFFERENCES else ""
        shown = "; ".join(f"{key} ({values})" for key, values in list(differing.items())[:_MAX_DIFFERENCES])
        have = "study {} holds" if len(subject.studies) == 1 else "studies {} hold"
        raise HeadwayError(
            f"{have.format(subject.name)} several environments, which differ in {shown}{more}: choose one, "
            f"such as --where '{next(iter(differing))}=...'; `headway report` compares over environments"
        )


def _differing(environments: Sequence[Mapping[str, object]]) -> dict[str, str]:
    """Return the values of each key in which evaluation environments differ."""
    from headway_launch.experiments.parameters import flat

    settings = [dict(flat({"env": environment})) for environment in environments]
    keys = dict.fromkeys(key for each in settings for key in each)
    values = {key: list(dict.fromkeys(str(each.get(key)) for each in settings)) for key in keys}
    return {key: ", ".join(found) for key, found in values.items() if len(found) > 1}


def _metrics(names: str, known: Sequence[str]) -> tuple[str, ...]:
    wanted = tuple(name.strip() for name in names.split(",") if name.strip())
    for name in wanted:
        if name not in known:
            raise HeadwayError(f"--metrics: unknown metric {name!r}; {suggestion(name, known)}")
    if not wanted:
        raise HeadwayError("--metrics is empty; give at least one, such as --metrics return")
    return wanted


def _best(rules: Mapping[str, Sequence["Row"]]) -> str:
    """Return the rule with the highest mean return; `lookahead` only if there is no other."""
    return max(rules, key=lambda rule: (not is_lookahead(rule), _mean(rules[rule], "return")))


def _values(episodes: Sequence["Row"], metric: str) -> list[float]:
    return [float(row[metric]) for row in episodes]


def _mean(episodes: Sequence["Row"], metric: str) -> float:
    return fmean(_values(episodes, metric))


def _rows(
    metrics: Sequence[str],
    rules: Mapping[str, Sequence["Row"]],
    learned: Mapping[str, Sequence[Sequence["Row"]]],
    reference: str,
) -> list[ComparisonRow]:
    """Return the rows of a comparison. `rules`: episodes of each; `learned`: seeds x episodes of each."""
    from headway_launch.runner.comparison import difference

    controllers = {**{f"rule {rule}": [episodes] for rule, episodes in rules.items()}, **learned}
    rows = []
    for metric in metrics:
        of_reference = _values(rules[reference], metric)
        for name, by_seed in controllers.items():
            values = [_values(of_seed, metric) for of_seed in by_seed]
            row = ComparisonRow(
                metric, name, len(values) if name in learned else None, fmean(map(fmean, values))
            )
            if name != f"rule {reference}":
                found = difference(values, of_reference)
                row = row._replace(
                    difference=found.estimate, low=found.low, high=found.high, interval=found.method
                )
            rows.append(row)
    return rows


def _require_other_episodes(root: int, cells: Mapping[str, Sequence["StoredRun"]]) -> None:
    """Raise HeadwayError if episodes of this root selected the best policies of a learner."""
    for label, members in cells.items():
        if members[0].experiment.config.evaluation.seed == root:
            raise HeadwayError(
                f"--keep: the episodes of --seed {root} selected the policies of {label}, on which their "
                "return is too high; give another --seed"
            )


def _keep(
    members: Sequence["StoredRun"],
    iterations: Sequence[int],
    played: Sequence[Sequence["Row"]],
    rules: Mapping[str, Sequence["Row"]],
    root: int,
    mode: str,
) -> None:
    """Store the episodes of a learner's best policies and of the rules beside its runs."""
    from headway.store.atomic_files import write_json
    from headway.store.run_folder import best_file
    from headway_launch.console.output_files import write_error

    record = members[0].record
    path = best_file(members[0].store, record.study, record.cell)
    runs = {
        run.record.run_id: {"iteration": iteration, "episodes": list(episodes)}
        for run, iteration, episodes in zip(members, iterations, played, strict=True)
    }
    try:
        write_json(path, {"seed": root, "mode": mode, "rules": dict(rules), "runs": runs})
    except OSError as error:
        raise write_error("--keep", path, error) from error


def _print_tables(found: Comparison, line: str) -> None:
    from headway_launch.console.output import print_line

    print_table(found.columns, found.rounded(), title=found.title)
    if found.pairs:
        print_table(PAIR_COLUMNS, found.rounded_pairs(), title="pairs of learners")
        print_line(pairs_note(found.pairs))


def _page_tables(found: Comparison, note: str = "") -> list[Table]:
    """Return the tables for a page or a paper; `note`: end of their captions."""
    tables = [comparison_table(found, note)]
    if found.pairs:
        caption = f"{found.title}. Differences between learners, {found.metrics[found.pairs[0].metric]}"
        pairs = pairs_table(found.pairs, "pairs", caption)
        tables.append(replace(pairs, caption=pairs.caption + note))
    return tables


_FORMATS: Mapping[str, Callable[[Comparison, str], None]] = {
    "table": _print_tables,
    "json": lambda found, _: print(json.dumps(found.records(), indent=1)),
    "csv": lambda found, _: csv.writer(sys.stdout, lineterminator="\n").writerows(
        [RECORD_COLUMNS, *(record.values() for record in found.records())]
    ),
    "markdown": lambda found, line: print(
        "\n\n".join(map(markdown_table, _page_tables(found, f" Written by `{line}`.")))
    ),
    "latex": lambda found, line: print(
        "\n".join(latex_table(table, line) for table in _page_tables(found)), end=""
    ),
}
"""Printers by the value of --format, of a comparison made by a command line."""
