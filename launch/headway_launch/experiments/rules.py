"""The rules of an experiment's environment: those that can play it, and the episodes that they play."""

from collections.abc import Sequence
from contextlib import closing
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway.contracts.random_rule import RANDOM
from headway.events import Row
from headway.registry import rule_entry
from headway_launch.console.output import print_line, prints_to_stderr

if TYPE_CHECKING:
    from headway.rollout.episodes import OnStep
    from headway_launch.console.progress_display import CountedProgress
    from headway_launch.experiments.experiment import Experiment, PreparedEnv

_CHECKED_STEPS = 5
"""Steps of each rule before training, in which its actions are checked."""


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
def require_valid_actions(experiment: "Experiment", prepared: object) -> None:
    """Play a few steps of each rule to evaluate. Raises HeadwayError for an invalid action.

    Environments with a limit of copies per process are not played: simulators take seconds to start.
    """
    from headway.rollout.episodes import evaluation_seeds

    entry = experiment.env
    names = [name for name in experiment.rules if name in entry.rules and entry.rules[name] is not RANDOM]
    if not names:
        return
    with closing(entry.make(prepared, 1)) as env:
        if env.spec.max_copies_per_process is not None:
            return
        for name in names:
            rule = rule_entry(entry, name).make(prepared)
            observed = env.reset(evaluation_seeds(experiment.config.evaluation.seed, 0, 1))
            for _ in range(_CHECKED_STEPS):
                _, observed = env.step(rule.act(env, observed))


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
