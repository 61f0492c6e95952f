"""Notices before training: its extent, and settings that a user may not have meant."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from headway.config.experiment import NO_PRESET, ExperimentConfig
from headway.wording import counted
from headway_launch.console.output import print_notice
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.experiment_file import split_experiment_file

_INTERVALS = 6
"""Evaluations after the first that a suggested `evaluation.every` leaves, at least."""


def print_notices(overrides: Sequence[str], experiments: Sequence[Experiment]) -> None:
    """Print the notices about the `experiments` that `overrides` describe."""
    file, words = split_experiment_file(overrides)
    lines = []
    if not file and not any(word.lstrip("+").startswith(("algo=", "experiment=")) for word in words):
        preset = experiments[0].config.preset
        chosen = "" if preset == NO_PRESET else f", with preset={preset}"
        lines.append(f"no algo is named: algo={experiments[0].algo_name}{chosen} (`headway list algos`)")
    lines += [line for each in experiments for line in _about(each.config, len(each.rules))]
    for line in lines:
        print_notice(line)


def _about(config: ExperimentConfig, rules: int) -> Iterator[str]:
    evaluation, steps = config.evaluation, config.env_steps
    evaluations = 1 + config.evaluations_until(config.iterations)
    yield _extent(config, evaluations, rules)
    if evaluation.every >= steps and evaluations == 2 and config.iterations > 1:
        every = steps // _INTERVALS
        every -= every % 10 ** (len(str(every)) - 1)  # one significant digit
        yield (
            f"evaluation.every={evaluation.every:_} is not below env_steps={steps:_}: the curve has "
            f"two points, before and after training; set evaluation.every={max(every, 1):_}"
        )
    if (
        evaluation.final_episodes < evaluation.episodes
        and evaluation.final_episodes != type(evaluation).final_episodes
    ):
        yield (
            f"evaluation.final_episodes={evaluation.final_episodes} becomes {evaluation.episodes}, since the "
            "last evaluation includes the episodes of all others; lower evaluation.episodes too for fewer"
        )


def _extent(config: ExperimentConfig, evaluations: int, rules: int) -> str:
    """Return the steps, iterations and evaluations of a run, and the folders of its environment."""
    steps, iterations = config.iterations * config.iteration_steps, config.iterations
    last = ""
    if rules:
        last = f", the last with {counted(rules, 'rule')}, on {config.evaluation.last_episodes} episodes each"
    rounded = "" if steps == config.env_steps else f" (env_steps={config.env_steps:_} rounded up)"
    folders = [
        f"; env.args.{key}={value}"
        for key, value in config.env.args.items()
        if isinstance(value, str) and _is_folder(value)
    ]
    return (
        f"{steps:,} steps per run{rounded}, in {counted(iterations, 'iteration')} of "
        f"{config.iteration_steps:,} (rollout.copies x rollout.steps), {evaluations:,} evaluations"
        + "".join((last, *folders))
    )


def _is_folder(value: str) -> bool:
    try:
        return bool(value) and Path(value).is_dir()
    except OSError:  # no path, such as a name that is too long
        return False
