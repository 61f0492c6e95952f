"""Description, for reports, of what a cell's runs started from and of their stages."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import fmean
from typing import Any

from headway.config.experiment import last_iterations, steps_per_iteration
from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.store.parquet_log import read_rows
from headway.store.run_configuration import read_configuration
from headway.store.run_folder import RunRecord, find_run, read_rules, read_summary
from headway.wording import counted
from headway_launch.experiments.parameters import flat


@dataclass(frozen=True)
class RuleStart:
    """The rule from which a cell's runs started."""

    rule: str
    env_steps: int
    """Steps of each run in which it acted."""
    imitated: float | None
    """Mean of a metric over the policies that imitated it, at the end of these steps; None if unknown."""
    played: float | None
    """The rule's mean on the same episodes; None if it was not run."""


def start_line(
    name: str, root: Path, directories: Sequence[Path], metric: str, with_rule: bool = True
) -> str | None:
    """Return a sentence on what a cell's runs started from and on their stages; None without either.

    `name` is the cell's name, `root` the store and `directories` the runs' folders. If policies imitated a
    rule, the sentence gives their `metric`, such as `evaluation_greedy/return`, and the rule's; it omits the
    rule unless `with_rule`.
    """
    config = read_configuration(directories[0])
    start, parts = config.get("start") or {}, []
    if with_rule and (found := rule_start(root, directories, metric)):
        parts.append(_from_rule(found, int(config["evaluation"]["episodes"]), metric))
    elif start.get("run"):
        parts.append(_from_run(root, start["run"]))
    anchors = [f"start.{key}={start[key]}" for key in ("kl_coeff", "critic_iterations") if start.get(key)]
    if anchors:
        parts.append(f"was kept near that start by {' and '.join(anchors)}")
    if stages := config.get("stages"):
        iteration_steps = steps_per_iteration(config)
        ends = last_iterations([stage["env_steps"] for stage in stages], iteration_steps)
        steps = [(end - begin) * iteration_steps for begin, end in pairwise((0, *ends))]
        parts.append(f"was trained in stages: {', then '.join(map(_stage, stages, steps))}")
    return f"{name} {'; it '.join(parts)}" if parts else None


def _stage(stage: Mapping[str, Any], steps: int) -> str:
    settings = [f"{key}={value}" for key, value in flat(stage["training_args"])]
    return f"{steps:,} steps{' with ' if settings else ''}{' and '.join(settings)}"


def rule_start(root: Path, directories: Sequence[Path], metric: str) -> RuleStart | None:
    """Return the rule from which a cell's runs started, if any; arguments as those of `start_line`."""
    config = read_configuration(directories[0])
    rule = (config.get("start") or {}).get("rule")
    if not rule:
        return None
    iteration_steps = steps_per_iteration(config)
    iterations = -(-config["start"]["env_steps"] // iteration_steps)
    imitated = [
        float(row[metric])
        for directory in directories
        for row in read_rows(directory, "curve")
        if row["iteration"] == iterations and row.get(metric) is not None
    ]
    column = metric.partition("/")[2]
    record = RunRecord.read(directories[0])
    played: Mapping[str, list[Row]] = {}
    with suppress(HeadwayError):  # damaged
        played = read_rules(root, record.study, record.cell)
    episodes = played.get(rule, [])[: int(config["evaluation"]["episodes"])]
    values = [float(episode[column]) for episode in episodes if column in episode]
    return RuleStart(
        rule,
        iterations * iteration_steps,
        fmean(imitated) if imitated else None,
        fmean(values) if values else None,
    )


def _from_rule(found: RuleStart, episodes: int, metric: str) -> str:
    line = f"started from rule {found.rule}, which acted in the first {found.env_steps:,} steps of each run"
    if found.imitated is None:
        return line
    measured = metric.removeprefix("evaluation_").replace("/", " ")
    line = (
        f"{line}; the policies that imitated it then had a mean {measured} of {found.imitated:.4g} on the "
        f"curve's {counted(episodes, 'episode')}"
    )
    return line if found.played is None else f"{line}, and the rule {found.played:.4g}"


def _from_run(root: Path, parent: str) -> str:
    line = f"started from run {parent}"
    try:
        folder = find_run(root, parent)
        record, summary = RunRecord.read(folder), read_summary(folder)
    except HeadwayError:
        return f"{line}, which is no longer in the store"
    units = {"env_steps": "steps", "cpu_seconds": "CPU s", "kwh": "kWh"}
    used = {unit: summary[key] for key, unit in units.items() if summary.get(key)}
    costs = [
        f"{use:,} {unit}" if isinstance(use, int) else f"{use:,.4g} {unit}" for unit, use in used.items()
    ]
    cost = f", whose {', '.join(costs)} are not in these results" if costs else ""
    shared = "; all its seeds share that start, so the intervals do not include its variation"
    return f"{line} ({record.algorithm} on {record.environment}){cost}{shared}"
