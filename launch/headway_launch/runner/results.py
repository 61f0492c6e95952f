"""Results of an experiment: one row per seed, their mean and standard deviation."""

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from headway.config.experiment import EvaluationConfig, ExperimentConfig
from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.store.run_folder import RunRecord, Status, read_summary
from headway.wording import counted, environment_name
from headway_launch.console.output import print_line
from headway_launch.console.tables import Value, print_table, without_empty
from headway_launch.experiments.start_line import start_line

if TYPE_CHECKING:
    from headway.store.session import Run

AUC_HEADING, CO2_HEADING = "AUC (own range)", "kg CO2eq"
_FINAL, _MEAN_FINAL = "final reward", "mean final reward"
_USE = ("cpu_seconds", "kwh", "kg_co2", "cpu_kwh", "gpu_kwh", "ram_kwh")
_METRICS = {
    _FINAL: "final_reward",
    AUC_HEADING: "auc",
    "env steps": "env_steps",
    "steps/s": "steps_per_second",
    "CPU s": "cpu_seconds",
    "kWh": "kwh",
    CO2_HEADING: "kg_co2",
}
"""Columns of the table of seeds, and the metrics of a summary that they show."""
_COLUMNS = ("seed", "status", *_METRICS)
_CELL_COLUMNS = (
    "cell",
    "finished",
    _MEAN_FINAL,
    "std",
    AUC_HEADING,
    "CPU s",
    "kWh",
    CO2_HEADING,
)
_MAX_UNCHANGED = 3
"""Maximum number of seeds named in the notice that training has not changed their return."""
_OPTIONAL = ("steps/s", CO2_HEADING)
"""Columns left out first on a narrow terminal."""


@dataclass(frozen=True)
class SeedResult:
    """The stored results of one seed."""

    directory: Path
    record: RunRecord
    summary: Mapping[str, Any]
    """Metrics as `run_summary` returns them; None or missing: not known."""

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Return the results in a run's folder. Raises HeadwayError if its files cannot be read."""
        record = RunRecord.read(directory)
        return cls(directory, record, {"env_steps": record.durable_env_steps, **read_summary(directory)})

    @property
    def status(self) -> Status:
        """Status, with KILLED for a run whose session process ended without recording it."""
        return self.record.settled_status

    @property
    def row(self) -> tuple[Value, ...]:
        """The metrics as a row of the table."""
        return (self.record.seed, self.status, *map(self.summary.get, _METRICS.values()))


def run_summary(
    run: "Run", mode: str, used: Row, energy_modes: Mapping[str, str]
) -> dict[str, float | int | str | None]:
    """Return the summary of a run whose training has ended, from its log and its last energy sample.

    `final_reward` is the mean evaluation return over the last 20% of the curve's steps, `auc` the area under
    the evaluation curve, normalised by its own range. CPU seconds, energy and CO2 are over all sessions: the
    seed's equal share of the use of its stack. `energy_modes`: source of the power of each part.
    """
    final, area = curve_metrics(run, mode)
    return {
        "final_reward": final,
        "auc": area,
        "env_steps": run.record.durable_env_steps,
        "steps_per_second": _steps_per_second(run),
        **{name: float(used[name]) if name in used else None for name in _USE},
        **energy_modes,
    }


def curve_metrics(run: "Run", mode: str) -> tuple[float | None, float | None]:
    """Return (final reward, AUC) of the evaluation curve up to the last checkpoint.

    Each is None if the curve has no point yet (for the AUC: fewer than three), and both are if nothing was
    trained, since the evaluation before training is not a result. Points after the last checkpoint are
    ignored because they are dropped when the run is resumed.
    """
    if not run.record.durable_env_steps:
        return None, None
    from headway.stats.curves import auc, final_reward
    from headway.store.parquet_log import read_curve

    curve = read_curve(run.directory, f"evaluation_{mode}/return")
    points = {steps: value for steps, value in curve.items() if steps <= run.record.durable_env_steps}
    if not points:
        return None, None
    steps, values = list(points), list(points.values())
    area = auc(steps, values)
    return final_reward(steps, values), None if math.isnan(area) else area


def _steps_per_second(run: "Run") -> float | None:
    """Return the environment steps per second from the end of the first iteration to the last checkpoint."""
    from headway.store.parquet_log import read_curve

    times = read_curve(run.directory, "wall_s")
    steps = [each for each in times if 0 < each <= run.record.durable_env_steps]
    if len(steps) < 2:
        return None
    return (steps[-1] - steps[0]) / max(times[steps[-1]] - times[steps[0]], 1e-9)


def print_seeds(config: ExperimentConfig, results: Sequence[SeedResult]) -> None:
    """Print the table of seeds, with mean and sample standard deviation over the finished ones."""
    if not results:
        return
    rows = [result.row for result in results]
    finished = [result.row for result in results if result.status == "FINISHED"]
    if len(finished) > 1:
        rows += _summary_rows(finished)
    columns = _headings(_COLUMNS, _estimated(results), {config.evaluation.episodes})
    title = f"{config.algo.get('name')} on {environment_name(config.env.id)}"
    print_table(*without_empty(columns, rows, (CO2_HEADING,)), title, ("status",), _OPTIONAL)
    _print_notes(results)
    _print_unchanged(results, config.evaluation.modes)
    folders = [result.directory for result in results]
    metric = f"evaluation_{config.evaluation.modes[0]}/return"
    if line := start_line(str(config.algo["name"]), Path(config.store.root), folders, metric):
        print_line(line)


def print_cells(
    study: str, cells: Sequence[tuple[str, int, Sequence[SeedResult]]], episodes: Collection[int]
) -> None:
    """Print one row per cell: means over its finished seeds, and the resources used by all its seeds.

    `cells`: (label, number of planned seeds, results of the seeds that ended or were stopped). `episodes`:
    the distinct numbers of episodes per point of the evaluation curves.
    """
    rows: list[tuple[Value, ...]] = []
    for label, planned, results in cells:
        finished = [result for result in results if result.status == "FINISHED"]
        rewards, areas = _known(finished, "final_reward"), _known(finished, "auc")
        done = f"{len({result.record.seed for result in finished})} of {planned}"
        kg_co2 = _known(results, "kg_co2")
        used = (
            _sum(_known(results, "cpu_seconds")),
            _sum(_known(results, "kwh")),
            _sum(kg_co2) if len(kg_co2) == len(results) else None,
        )
        rows.append((label, done, *_mean_std(rewards), _mean_std(areas)[0], *used))
    estimated = any(_estimated(results) for _, _, results in cells)
    columns = _headings(_CELL_COLUMNS, estimated, episodes)
    shown = without_empty(columns, rows, (CO2_HEADING,))
    print_table(*shown, f"study {study}", ("finished",), (CO2_HEADING, AUC_HEADING))
    _print_notes([result for _, _, results in cells for result in results])


def _print_notes(results: Sequence[SeedResult]) -> None:
    """Print the definition of the final reward, and the reason why runs have no AUC."""
    from headway.stats.curves import FEWEST_POINTS, FINAL_SHARE

    rewarded = [result for result in results if result.summary.get("final_reward") is not None]
    if rewarded:
        steps = f"the last {FINAL_SHARE:.0%} of a run's steps"
        print_line(f"{_FINAL}: mean evaluation return over {steps}, on the episodes of the curve")
    if without := len(rewarded) - len(_known(rewarded, "auc")):
        print_line(
            f"no AUC for {counted(without, 'run')}: fewer than {FEWEST_POINTS} evaluations "
            "(one per evaluation.every steps, at most one per iteration)"
        )


def _print_unchanged(results: Sequence[SeedResult], modes: Sequence[str]) -> None:
    """Print which seeds had the same return in every evaluation, including the one before training."""
    from headway.store.parquet_log import read_curve

    unchanged = []
    for result in results:
        if result.status == "FINISHED":
            with suppress(HeadwayError):  # a damaged log hides no result
                curves = [read_curve(result.directory, f"evaluation_{mode}/return") for mode in modes]
                first, *others = (list(curve.values()) for curve in curves)
                if 0 in curves[0] and len(first) > 1 and len(set(first)) == 1:
                    unchanged.append((result.record.seed, first[0], len(first), others))
    for seed, value, count, others in unchanged[:_MAX_UNCHANGED]:
        changes = [
            f"; {mode} return from {values[0]:.4g} to {values[-1]:.4g}"
            for mode, values in zip(modes[1:], others, strict=True)
            if values
        ]
        print_line(
            f"seed {seed}: {modes[0]} return {value:.4g} in all {count} evaluations, also before training, "
            f"so its actions seem unchanged{''.join(changes)}; to learn more, raise env_steps or algo.lr"
        )
    if len(unchanged) > _MAX_UNCHANGED:
        print_line(f"and {len(unchanged) - _MAX_UNCHANGED} more seeds likewise")


def _headings(columns: Sequence[str], estimated: bool, episodes: Collection[int]) -> tuple[str, ...]:
    """Return the headings with remarks: energy estimated or not, and episodes per point of the curve.

    The last evaluation, which other tables use, may have more episodes than the points of the evaluation
    curve.
    """

    over = f"({counted(next(iter(episodes)), 'episode')})" if len(episodes) == 1 else "(episodes differ)"
    remarks = {_FINAL: over, _MEAN_FINAL: over, "kWh": "(estimated)" if estimated else ""}
    return tuple(f"{name} {remarks.get(name, '')}".rstrip() for name in columns)


def _mean_std(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Return mean and sample standard deviation; None where undefined.

    Both are undefined without values, the deviation also with one value.
    """
    from headway.stats.samples import mean_std

    if not values:
        return None, None
    result = mean_std(values)
    return result.mean, result.std if result.count > 1 else None


def _known(results: Sequence[SeedResult], name: str) -> list[float]:
    return [value for result in results if (value := result.summary.get(name)) is not None]


def _sum(values: Sequence[float]) -> float | None:
    return sum(values) if values else None


def _estimated(results: Sequence[SeedResult]) -> bool:
    return any(result.summary.get("energy.cpu", "").startswith("est") for result in results)


def last_evaluation(evaluation: EvaluationConfig, results: Sequence[SeedResult]) -> list[list[Row]]:
    """Return the last evaluation of each finished seed in the first mode, seeds x episodes.

    Episodes are ordered by episode seed. Raises HeadwayError if a seed lacks some, because its log is
    damaged.
    """
    from headway.store.parquet_log import read_rows

    mode, played = evaluation.modes[0], list[list[Row]]()
    for result in results:
        if result.status != "FINISHED":
            continue
        rows = read_rows(result.directory, "evaluation")
        last = [row for row in rows if row["mode"] == mode and row.get("final")]
        if len(last) != evaluation.last_episodes:
            raise HeadwayError(
                f"{result.directory}: {mode} episodes of the last evaluation are missing: a file "
                "evaluation-*.parquet is damaged or missing; train this seed again to compare it"
            )
        played.append(sorted(last, key=lambda row: int(row["episode_seed"])))
    return played


def _summary_rows(rows: Sequence[tuple[Value, ...]]) -> list[tuple[Value, ...]]:
    """Return the row of means and the row of standard deviations."""
    _, _, *columns = zip(*rows, strict=True)
    numbers = ([float(cell) for cell in cells if isinstance(cell, int | float)] for cells in columns)
    means, deviations = zip(*map(_mean_std, numbers), strict=True)
    return [("mean", None, *means), ("std", None, *deviations)]
