"""What an experiment came to: one row a seed, their mean and deviation, the rules on the same days."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from headway.config import ExperimentConfig
from headway.events import Row
from headway_launch.tables import Cell, print_table

if TYPE_CHECKING:
    from headway.energy.ledger import Energy
    from headway.store.session import Run
    from headway_launch.composing import Experiment
    from headway_launch.recording import JobRecording

_COLUMNS = ("seed", "status", "final reward", "AUC", "env steps", "steps/s", "CPU s", "kWh", "kg CO2eq")
_NOT_METRICS = ("episode_seed", "copy", "length", "return", "iteration", "env_steps", "mode", "final")


@dataclass(frozen=True)
class SeedResult:
    """One seed at its end; None where a figure is not known."""

    seed: int
    status: str
    run_id: str
    directory: str
    final_reward: float | None
    """Mean of the evaluation return over the last 20% of the curve's steps."""
    auc: float | None
    """Area under the evaluation curve, normalised by its own extremes."""
    env_steps: int
    steps_per_second: float | None
    cpu_seconds: float
    energy: "Energy"
    """Its equal share of its stack's."""
    energy_modes: Mapping[str, str]
    """How the power of each part is known."""

    @property
    def summary(self) -> dict[str, float | int | str | None]:
        """For the store."""
        return {
            "final_reward": self.final_reward,
            "auc": self.auc,
            "env_steps": self.env_steps,
            "steps_per_second": self.steps_per_second,
            "cpu_seconds": self.cpu_seconds,
            "kwh": self.energy.kwh,
            "kg_co2": self.energy.kg_co2,
            "cpu_kwh": self.energy.cpu_kwh,
            "gpu_kwh": self.energy.gpu_kwh,
            "ram_kwh": self.energy.ram_kwh,
            **self.energy_modes,
        }

    @property
    def cells(self) -> tuple[Cell, ...]:
        """A row of the table."""
        return (
            self.seed,
            self.status,
            self.final_reward,
            self.auc,
            self.env_steps,
            self.steps_per_second,
            self.cpu_seconds,
            self.energy.kwh,
            self.energy.kg_co2,
        )


def seed_result(
    run: "Run",
    recording: "JobRecording",
    mode: str,
    energy: "Energy",
    energy_modes: Mapping[str, str],
) -> SeedResult:
    """The figures of a run whose training has ended, from its log."""
    final, area = curve_figures(run, mode)
    return SeedResult(
        seed=run.record.seed,
        status=recording.status,
        run_id=run.run_id,
        directory=str(run.directory),
        final_reward=final,
        auc=area,
        env_steps=max(recording.env_steps, run.record.durable_env_steps),
        steps_per_second=recording.steps_per_second,
        cpu_seconds=recording.cpu_seconds / len(recording.runs),
        energy=energy,
        energy_modes=energy_modes,
    )


def curve_figures(run: "Run", mode: str) -> tuple[float | None, float | None]:
    """(final reward, AUC) of the evaluation curve in the log; None where it has no point yet."""
    from headway.stats import auc, final_reward
    from headway.store.log import read_rows

    metric = f"evaluation_{mode}/return"
    points = {
        int(row["env_steps"]): float(row[metric])
        for row in read_rows(run.directory, "curve")
        if metric in row
    }
    if not points:
        return None, None
    steps, values = list(points), list(points.values())
    return final_reward(steps, values), auc(steps, values)


def evaluated_rules(experiment: "Experiment", prepared: object) -> dict[str, list[Row]]:
    """Episodes of every rule that the experiment names, on its evaluation seeds."""
    from headway.rollout.episodes import evaluate_rule

    evaluation, rows = experiment.config.evaluation, {}
    for rule in evaluation.rules:
        if sys.stderr.isatty():
            print(f"evaluating the rule {rule} ...", end="\r", file=sys.stderr, flush=True)
        make_rule = experiment.env.rules[rule]
        episodes = max(evaluation.final_episodes, evaluation.episodes)
        rows[rule] = evaluate_rule(experiment.env.make, make_rule, prepared, evaluation.seed, episodes)
    return rows


def print_results(
    config: ExperimentConfig, results: Sequence[SeedResult], rules: Mapping[str, Sequence[Row]]
) -> None:
    """The table of seeds, with mean and sample standard deviation of the finished ones, and the comparison
    with the rules."""
    if not results:
        return
    rows = [result.cells for result in results]
    finished = [result.cells for result in results if result.status == "FINISHED"]
    if len(finished) > 1:
        rows += [_over_seeds("mean", finished), _over_seeds("std", finished)]
    print_table(_COLUMNS, rows, title=f"{config.algo.get('name')} on {config.env.id}")
    if rules:
        print()
        print_comparison(_final_episodes(config, results), rules)


def print_comparison(learned: Mapping[str, Sequence[Row]], rules: Mapping[str, Sequence[Row]]) -> None:
    """Mean return and metrics of policies and rules on the same days, and the paired difference in return
    to the first policy (mean and 95% interval over days)."""
    from headway.stats import paired_difference

    controllers = {**learned, **{f"rule {name}": rows for name, rows in rules.items()}}
    metrics = list(
        dict.fromkeys(name for rows in controllers.values() for name in rows[0] if name not in _NOT_METRICS)
    )
    first = next(iter(learned.values()), ())
    table: list[tuple[Cell, ...]] = []
    for name, rows in controllers.items():
        returns = [float(row["return"]) for row in rows]
        against: tuple[Cell, Cell, Cell] = (None, None, None)
        if rows is not first and len(first) == len(rows) > 1:
            difference = paired_difference([float(row["return"]) for row in first], returns)
            against = (difference.estimate, difference.low, difference.high)
        means = [sum(float(row[metric]) for row in rows) / len(rows) for metric in metrics]
        table.append((name, len(rows), sum(returns) / len(returns), *against, *means))
    better = f"{next(iter(learned), 'it')} better by"
    print_table(("controller", "days", "return", better, "from", "to", *metrics), table)


def _final_episodes(config: ExperimentConfig, results: Sequence[SeedResult]) -> dict[str, list[Row]]:
    """The last evaluation, in the first mode: each day's mean over the finished seeds, so that days pair."""
    from pathlib import Path

    from headway.store.log import read_rows

    mode, by_day = config.evaluation.modes[0], dict[int, list[Row]]()
    finished = [result for result in results if result.status == "FINISHED"]
    for result in finished:
        for row in read_rows(Path(result.directory), "evaluation"):
            if row["mode"] == mode and row["final"]:
                by_day.setdefault(int(row["episode_seed"]), []).append(row)
    if not by_day:
        return {}
    days = [_mean_row(by_day[day]) for day in sorted(by_day)]
    label = (
        f"{config.algo.get('name')}, mean of {len(finished)}"
        if len(finished) > 1
        else str(config.algo.get("name"))
    )
    return {label: days}


def _mean_row(rows: Sequence[Row]) -> Row:
    numbers = [name for name, value in rows[0].items() if not isinstance(value, str)]
    return {name: sum(float(row[name]) for row in rows) / len(rows) for name in numbers}


def _over_seeds(name: str, rows: Sequence[tuple[Cell, ...]]) -> tuple[Cell, ...]:
    from headway.stats import mean_std

    cells: list[Cell] = [name, None]
    for column in range(2, len(_COLUMNS)):
        values = [float(cell) for row in rows if isinstance(cell := row[column], int | float)]
        if len(values) < 2:
            cells.append(values[0] if values and name == "mean" else None)
            continue
        figures = mean_std(values)
        cells.append(figures.mean if name == "mean" else figures.std)
    return tuple(cells)
