"""`headway evaluate`: a trained policy beside the classical rules, on the same days."""

import argparse

from headway.contracts.errors import HeadwayError
from headway_launch.commands.runs import add_store_argument, existing_store

EXAMPLES = """\
examples:
  headway evaluate s0-20260101-1200                any part of the name that only one run has
  headway evaluate RUN --episodes 100 --seed 5     other days
  headway evaluate RUN --mode sampled --rules always_move,headway_holding_0.9

The differences are those of the return, policy minus rule, day by day, with 95% intervals over the days.
What the other figures mean: `headway list metrics ENVIRONMENT`.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The run and the days."""
    parser.add_argument("run", metavar="RUN", help="identity as `headway runs` shows it")
    parser.add_argument("--episodes", type=int, help="days (default: those of the run's last evaluation)")
    parser.add_argument("--mode", choices=("greedy", "sampled"), default="greedy")
    parser.add_argument(
        "--seed", type=int, help="root of the days' seeds (default: the run's evaluation.seed)"
    )
    parser.add_argument("--rules", help="rules to play beside it, with commas (default: all that can)")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Play and print the table."""
    from headway_launch.console.threads import limit_threads

    limit_threads()
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.runner.checkpointed_policy import newest_policy, policy_episodes
    from headway_launch.runner.comparison import counting, print_comparison, rule_episodes, rules_to_play
    from headway_launch.runner.stored_run import StoredRun
    from headway_launch.runner.warm_up import compile_kernels

    run = StoredRun.find(existing_store(arguments.store), arguments.run)
    experiment = run.experiment
    evaluation = experiment.config.evaluation
    episodes = evaluation.last_episodes if arguments.episodes is None else arguments.episodes
    root = evaluation.seed if arguments.seed is None else arguments.seed
    if episodes < 1 or root < 0:
        raise HeadwayError("--episodes must be at least 1 and --seed at least 0")
    found = experiment.prepare()
    rules = rules_to_play(found, arguments.rules)
    compile_kernels(experiment.env)
    policy = newest_policy(run, found)
    name = f"{experiment.algo_name} {arguments.mode}"
    with CountedProgress("episodes played", (1 + len(rules)) * episodes) as counted:
        greedy, told = arguments.mode == "greedy", counting(counted, name)
        learned = policy_episodes(policy, root, episodes, greedy, told)
        played = rule_episodes(experiment, found.prepared, rules, root, episodes, counted)
    print_comparison(name, [learned], played)
    return 0
