"""`headway evaluate`: evaluate a trained policy and the classical rules on the same episodes."""

import argparse

from headway.contracts.errors import HeadwayError
from headway.wording import counted
from headway_launch.commands.arguments import (
    OTHER_EVALUATION_SEED,
    add_best_argument,
    add_format_argument,
    add_store_argument,
    existing_store,
    typed_line,
)
from headway_launch.report.comparison_table import COMPARISON_FORMATS

EXAMPLES = """\
examples:
  headway evaluate s0-20260101-1200                any unique part of a run's name
  headway evaluate RUN --episodes 100 --seed 5     other episodes
  headway evaluate RUN env.args.scenario=corridor  the same policy elsewhere (zero-shot transfer)
  headway evaluate RUN --best                      the best policy of the training instead of the newest
  headway evaluate RUN --format json               all digits; also csv, and markdown or latex for a page
  headway evaluate RUN --mode sampled --rules always_move,headway_holding_0.9

env.args.KEY=VALUE changes the environment for the policy and the rules alike; observations and actions must
keep their shapes. Differences are of the return, controller minus best rule, paired by episode, with 95%
intervals over episodes. The other columns are the environment's first metrics (`headway list metrics
ENVIRONMENT`); `headway compare STUDY --metrics NAME,NAME` shows any. The formats are those of `compare`: csv
and json have all digits.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the run and the episodes."""
    parser.add_argument("run", metavar="RUN", help="name of the run, as in `headway runs`")
    parser.add_argument(
        "overrides",
        metavar="env.args.KEY=VALUE",
        nargs="*",
        default=[],
        help="arguments of another environment to evaluate on",
    )
    parser.add_argument(
        "--episodes", type=int, help="evaluation episodes (default: as in the run's last evaluation)"
    )
    parser.add_argument("--mode", choices=("greedy", "sampled"), default="greedy", help="how the policy acts")
    parser.add_argument(
        "--seed",
        type=int,
        help="root of the episode seeds (default: the run's evaluation.seed; with --best "
        f"{OTHER_EVALUATION_SEED})",
    )
    add_best_argument(parser)
    parser.add_argument("--rules", help="rules to evaluate, comma-separated (default: all that can run)")
    add_format_argument(parser, COMPARISON_FORMATS)
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Evaluate and print the table."""
    from headway_launch.console.output import print_line
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.rules import counting, rule_episodes, rules_to_play
    from headway_launch.runner.checkpointed_policy import policy_episodes, stored_policy
    from headway_launch.runner.comparison import Comparison, print_env_changes, print_findings
    from headway_launch.runner.stored_run import StoredRun
    from headway_launch.runner.warm_up import compile_kernels

    run = StoredRun.find(existing_store(arguments.store), arguments.run)
    experiment, changes = run.with_env_args(arguments.overrides)
    evaluation = experiment.config.evaluation
    episodes = evaluation.last_episodes if arguments.episodes is None else arguments.episodes
    # The best policy was chosen by the episodes of evaluation.seed: on these its return is too high.
    usual = OTHER_EVALUATION_SEED if arguments.best else evaluation.seed
    root = usual if arguments.seed is None else arguments.seed
    if episodes < 1 or root < 0:
        raise HeadwayError("--episodes must be at least 1 and --seed at least 0")
    found = experiment.prepare()
    rules = rules_to_play(found, arguments.rules)
    compile_kernels(experiment.env)
    policy = stored_policy(run, found, arguments.best, arguments.overrides)
    print_env_changes(changes)
    name = experiment.algo_name
    if arguments.best:
        name = f"{name}, best policy (iteration {policy.iteration})"
        if arguments.seed is None:
            print_line(
                f"headway: these episodes are not the {evaluation.episodes} that selected this policy; to "
                f"evaluate the newest policy on them: --seed {root} without --best"
            )
    with CountedProgress("episodes played", (1 + len(rules)) * episodes) as progress:
        greedy, count = arguments.mode == "greedy", counting(progress, name)
        learned = policy_episodes(policy, root, episodes, greedy, count)
        played = rule_episodes(experiment, found.prepared, rules, root, episodes, progress)
    title = f"{run.record.run_id}: {counted(episodes, 'episode')} of {found.spec.name}, {arguments.mode}"
    comparison = Comparison.of(title, found.entry.metrics, played, {name: [learned]})
    COMPARISON_FORMATS[arguments.format](comparison, (), typed_line(arguments))
    print_findings(comparison, {name: [learned]}, played)
    return 0
