"""Results of an experiment: one row per seed, their mean and standard deviation."""

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from headway.config.experiment import ExperimentConfig
from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.store.run_folder import RunRecord, read_summary
from headway.wording import counted, environment_name
from headway_launch.console.output import print_line
from headway_launch.console.tables import Value, print_table, without_empty
from headway_launch.experiments.start_line import start_line
from headway_launch.runner.comparison import print_comparison

if TYPE_CHECKING:
    from headway.store.session import Run

_USE = ("cpu_seconds", "kwh", "kg_co2", "cpu_kwh", "gpu_kwh", "ram_kwh")
AUC_HEADING, CO2_HEADING = "AUC (own range)", "kg CO2eq"
_FINAL, _MEAN_FINAL = "final reward", "mean final reward"
_COLUMNS = (
    "seed",
    "status",
    _FINAL,
    AUC_HEADING,
    "env steps",
    "steps/s",
    "CPU s",
    "kWh",
    CO2_HEADING,
)
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
    """Final metrics of one seed; None for a metric that is not known."""

    seed: int
    status: str
    run_id: str
    directory: str
    final_reward: float | None
    """Mean of the evaluation return over the last 20% of the curve's steps."""
    auc: float | None
    """Area under the evaluation curve, normalised by the curve's own range; None if the curve has too few
    points."""
    env_steps: int
    """Environment steps up to the last checkpoint."""
    steps_per_second: float | None
    use: Mapping[str, float | None]
    """CPU seconds, energy and CO2 over all sessions: the seed's equal share of the use of its stack."""
    energy_modes: Mapping[str, str]
    """Source of the power of each part: for example measured or estimated."""

    @property
    def summary(self) -> dict[str, float | int | str | None]:
        """The metrics as stored in the run folder."""
        return {
            "final_reward": self.final_reward,
            "auc": self.auc,
            "env_steps": self.env_steps,
            "steps_per_second": self.steps_per_second,
            **self.use,
            **self.energy_modes,
        }

    @property
    def row(self) -> tuple[Value, ...]:
        """The metrics as a row of the table."""
        return (
            self.seed,
            self.status,
            self.final_reward,
            self.auc,
            self.env_steps,
            self.steps_per_second,
            self.use["cpu_seconds"],
            self.use["kwh"],
            self.use["kg_co2"],
        )


def seed_result(
    run: "Run",
    status: str,
    steps_per_second: float | None,
    mode: str,
    used: Row,
    energy_modes: Mapping[str, str],
) -> SeedResult:
    """Return the metrics of a run whose training has ended, from its log and its last energy sample."""
    final, area = curve_metrics(run, mode)
    return SeedResult(
        seed=run.record.seed,
        status=status,
        run_id=run.run_id,
        directory=str(run.directory),
        final_reward=final,
        auc=area,
        env_steps=run.record.durable_env_steps,
        steps_per_second=steps_per_second,
        use={name: float(used[name]) if name in used else None for name in _USE},
        energy_modes=energy_modes,
    )


def stored_result(directory: Path) -> SeedResult:
    """Return the metrics of a run that ended in an earlier session, as stored by that session."""
    record, summary = RunRecord.read(directory), read_summary(directory)

    def metric(name: str) -> float | None:
        value = summary.get(name)
        return None if value is None else float(value)

    return SeedResult(
        seed=record.seed,
        status=record.settled_status,
        run_id=record.run_id,
        directory=str(directory),
        final_reward=metric("final_reward"),
        auc=metric("auc"),
        env_steps=record.durable_env_steps,
        steps_per_second=metric("steps_per_second"),
        use={name: metric(name) for name in _USE},
        energy_modes={name: str(value) for name, value in summary.items() if name.startswith("energy.")},
    )


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


def print_results(
    config: ExperimentConfig, results: Sequence[SeedResult], rules: Mapping[str, Sequence[Row]]
) -> None:
    """Print the table of seeds and the comparison with the rules.

    The table ends with mean and sample standard deviation over the finished seeds.
    """
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
    if rules:
        print()
        print_comparison(
            str(config.algo["name"]), _final_episodes(config.evaluation.modes[0], results), rules
        )
    folders = [Path(result.directory) for result in results]
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
        rewards = [result.final_reward for result in finished if result.final_reward is not None]
        areas = [result.auc for result in finished if result.auc is not None]
        done = f"{len({result.seed for result in finished})} of {planned}"
        co2 = [result.use.get("kg_co2") for result in results]
        kg_co2 = None if None in co2 else _sum(results, "kg_co2")
        used = (_sum(results, "cpu_seconds"), _sum(results, "kwh"), kg_co2)
        rows.append((label, done, *_mean_std(rewards), _mean_std(areas)[0], *used))
    estimated = any(_estimated(results) for _, _, results in cells)
    columns = _headings(_CELL_COLUMNS, estimated, episodes)
    shown = without_empty(columns, rows, (CO2_HEADING,))
    print_table(*shown, f"study {study}", ("finished",), (CO2_HEADING, AUC_HEADING))
    _print_notes([result for _, _, results in cells for result in results])


def _print_notes(results: Sequence[SeedResult]) -> None:
    """Print the definition of the final reward, and the reason why runs have no AUC."""
    from headway.stats.curves import FEWEST_POINTS, FINAL_SHARE

    if any(result.final_reward is not None for result in results):
        print_line(f"{_FINAL}: mean evaluation return over the last {FINAL_SHARE:.0%} of a run's steps")
    without = sum(result.final_reward is not None and result.auc is None for result in results)
    if without:
        print_line(
            f"no AUC for {counted(without, 'run')}: fewer than {FEWEST_POINTS} evaluations "
            "(evaluation.every sets the interval)"
        )


def _print_unchanged(results: Sequence[SeedResult], modes: Sequence[str]) -> None:
    """Print which seeds had the same return in every evaluation, including the one before training."""
    from headway.store.parquet_log import read_curve

    unchanged = []
    for result in results:
        if result.status == "FINISHED":
            with suppress(HeadwayError):  # a damaged log hides no result
                curves = [read_curve(Path(result.directory), f"evaluation_{mode}/return") for mode in modes]
                first, *others = (list(curve.values()) for curve in curves)
                if 0 in curves[0] and len(first) > 1 and len(set(first)) == 1:
                    unchanged.append((result.seed, first[0], others))
    for seed, value, others in unchanged[:_MAX_UNCHANGED]:
        changes = [
            f"; {mode} return from {values[0]:.4g} to {values[-1]:.4g}"
            for mode, values in zip(modes[1:], others, strict=True)
            if values
        ]
        print_line(
            f"seed {seed}: the {modes[0]} return was {value:.4g} in every evaluation, also before training"
            + "".join(changes)
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


def _sum(results: Sequence[SeedResult], name: str) -> float | None:
    known = [value for result in results if (value := result.use.get(name)) is not None]
    return sum(known) if known else None


def _estimated(results: Sequence[SeedResult]) -> bool:
    return any(result.energy_modes.get("energy.cpu", "").startswith("est") for result in results)


def _final_episodes(mode: str, results: Sequence[SeedResult]) -> list[list[Row]]:
    """Return the last evaluation of each finished seed in a mode, seeds x episodes.

    Episodes are ordered by episode seed. Raises HeadwayError if a seed has none, because its log is damaged.
    """
    from headway.store.parquet_log import read_rows

    played: list[list[Row]] = []
    for result in results:
        if result.status != "FINISHED":
            continue
        rows = read_rows(Path(result.directory), "evaluation")
        last = [row for row in rows if row["mode"] == mode and row.get("final")]
        if not last:
            raise HeadwayError(
                f"{result.directory}: there are no {mode} episodes of the last evaluation: a file "
                "evaluation-*.parquet is damaged or missing; train this seed again to compare it"
            )
        played.append(sorted(last, key=lambda row: int(row["episode_seed"])))
    return played


def _summary_rows(rows: Sequence[tuple[Value, ...]]) -> list[tuple[Value, ...]]:
    """Return the row of means and the row of standard deviations."""
    statistics = [
        _mean_std([float(cell) for row in rows if isinstance(cell := row[column], int | float)])
        for column in range(2, len(_COLUMNS))
    ]
    return [
        ("mean", None, *(mean for mean, _ in statistics)),
        ("std", None, *(deviation for _, deviation in statistics)),
    ]
