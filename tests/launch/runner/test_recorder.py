"""Results of a killed training process: only steps up to its last checkpoint count, reported or not."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from headway.config.experiment import StoreConfig
from headway.energy.ledger import Energy
from headway.events import Event, Failed, Finished, IterationFinished, Started, Usage
from headway.store.checkpoint import save_checkpoint
from headway.store.energy_log import read_energy
from headway.store.index import RunIndex
from headway.store.parquet_log import RunLog
from headway.store.run_folder import CHECKPOINTS, RunRecord
from headway.store.session import Cell, Run, SessionStore
from headway_launch.runner.recorder import JobRecorder
from headway_launch.runner.results import SeedResult, print_cells, run_summary

STEPS = 100


@pytest.fixture
def runs(tmp_path: Path) -> Sequence[Run]:
    """Two seeds of one stack."""
    cell = Cell(SessionStore(StoreConfig(root=str(tmp_path))), "study", "bus", "ippo", {})
    return [cell.begin_run(seed, "", {}, iterations=10) for seed in (0, 1)]


def train(recording: JobRecorder, iterations: int) -> None:
    """Log and report iterations, each with an evaluation whose return is the iteration's number."""
    for iteration in range(1, iterations + 1):
        row = {"iteration": iteration, "env_steps": STEPS * iteration, "wall_s": 1.0 * iteration}
        evaluated = {**row, "evaluation_greedy/return": float(iteration)}
        for run in recording.runs:
            log = RunLog(run.directory)
            log.append("curve", [evaluated])
            log.commit(iteration)
        recording.take(IterationFinished(iteration, STEPS * iteration, Usage(), 1.0 * iteration, 0.5, 0.5))


def result_of(run: Run) -> SeedResult:
    run.finish("KILLED", run_summary(run, "greedy", {}, {}))
    return SeedResult.read(run.directory)


@pytest.mark.parametrize("last", [Finished(8, stopped=True), Failed("it broke", "")])
def test_an_unreported_checkpoint_counts_and_nothing_after_it(runs: Sequence[Run], last: Event) -> None:
    recording = JobRecorder(runs)
    train(recording, 8)
    save_checkpoint(runs[1].directory / CHECKPOINTS, 5, {})  # killed before the event
    recording.take(last)
    for run in runs:
        summary = result_of(run).summary
        assert summary["env_steps"] == 5 * STEPS
        assert summary["final_reward"] == 5.0  # last 20% of five iterations; of eight it would be 7.5
    for row in RunIndex(runs[0].directory.parents[1]).rows():
        assert (row.iterations, row.env_steps, row.final_reward) == (5, 5 * STEPS, 5.0)


def test_energy_samples_have_the_wall_time_also_where_energy_is_unknown(runs: Sequence[Run]) -> None:
    """The time of earlier sessions is included once, and every seed of a stack takes all of it."""
    for run in runs:
        run.record = replace(run.record, duration_s=100.0)
    recording = JobRecorder(runs, before=({"time": 1.0, "duration_s": 100.0, "cpu_seconds": 7.0},) * 2)
    for moment in (2.0, 3.0):
        time.sleep(0.01)
        recording.keep_energy(moment, Energy(None, None, None, None))
    for run in runs:
        run.finish("FINISHED", {})
        samples = read_energy(run.directory)
        first, last = samples["duration_s"]
        assert 100.01 <= first < last <= run.record.duration_s < 160.0
        assert list(samples["cpu_seconds"]) == [7.0, 7.0]


@pytest.mark.parametrize(
    ("earlier", "kwh", "total"),
    [
        ({"cpu_seconds": 90.0, "kwh": 0.9}, 0.2, 0.9 + 0.1),
        ({"cpu_seconds": 90.0}, 0.2, None),
        ({"cpu_seconds": 0.05}, 0.2, 0.1),
        ({"cpu_seconds": 90.0, "kwh": 0.9}, None, None),
        ({"cpu_seconds": 9000.0, "kwh": 90.0}, None, 90.0),
    ],
)
def test_a_total_is_unknown_if_a_session_did_not_measure_its_energy(
    runs: Sequence[Run], earlier: dict[str, float], kwh: float | None, total: float | None
) -> None:
    """Unless that session is too short to matter. This session: 10 CPU seconds per seed."""
    recording = JobRecorder(runs, before=(earlier,) * 2)
    recording.take(IterationFinished(1, STEPS, Usage(cpu_seconds=20.0), 1.0, 0.5, 0.5))
    for sample in recording.keep_energy(1.0, Energy(kwh, None, None, None)):
        assert sample.get("kwh") == (None if total is None else pytest.approx(total))
        assert sample["cpu_seconds"] == earlier["cpu_seconds"] + 10.0


@pytest.mark.parametrize(("evaluations", "area"), [(2, None), (3, 0.5), (4, 0.5)])
def test_a_curve_of_two_points_has_no_area(
    runs: Sequence[Run], evaluations: int, area: float | None, capsys: pytest.CaptureFixture[str]
) -> None:
    """Normalised by its own range it would always be 0.5, as for any straight line."""
    recording = JobRecorder(runs)
    train(recording, evaluations)
    save_checkpoint(runs[0].directory / CHECKPOINTS, evaluations, {})
    recording.take(Finished(evaluations, stopped=False))
    result = result_of(runs[0])
    assert result.summary["auc"] == (None if area is None else pytest.approx(area))
    assert result.summary["final_reward"] is not None
    print_cells("study", [("ippo", 1, [result])], {2})
    definition = (
        "final reward: mean evaluation return over the last 20% of a run's steps, on the episodes of the "
        "curve\n"
    )
    line = (
        "no AUC for 1 run: fewer than 3 evaluations (one per evaluation.every steps, at most one per "
        "iteration)\n"
    )
    assert capsys.readouterr().err == definition + (line if area is None else "")


@pytest.mark.parametrize("iterations", [0, 8])
def test_without_a_checkpoint_there_is_no_result(runs: Sequence[Run], iterations: int) -> None:
    """The evaluation before training is not a result."""
    log = RunLog(runs[0].directory)
    log.append("curve", [{"iteration": 0, "env_steps": 0, "wall_s": 0.0, "evaluation_greedy/return": 7.0}])
    log.commit(0)
    recording = JobRecorder(runs)
    train(recording, iterations)
    recording.take(Finished(iterations, stopped=True))
    summary = result_of(runs[0]).summary
    assert [summary[name] for name in ("env_steps", "final_reward", "auc")] == [0, None, None]


def test_runs_are_tagged_with_the_iterations_at_which_episodes_restarted(runs: Sequence[Run]) -> None:
    JobRecorder(runs).take(Started(0, ()))
    assert "episodes_restarted" not in runs[0].record.tags
    for iteration in (3, 7):
        JobRecorder(runs).take(Started(iteration, (), episodes_restarted=True))
    for run in runs:
        assert RunRecord.read(run.directory).tags["episodes_restarted"] == "3, 7"
