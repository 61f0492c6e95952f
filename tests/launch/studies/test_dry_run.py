"""A dry run lists the runs and estimates their cost."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from command_lines import output
from stored_runs import keep_run

from headway.energy.ledger import Energy, JobUsage
from headway.energy.meter import EnergyMeter
from headway.events import EvaluationFinished, IterationFinished, Started, Usage
from headway.store.run_folder import Process
from headway.training.loop import TrainingJob
from headway_launch.experiments.compose import compose
from headway_launch.experiments.sweep import compose_sweep
from headway_launch.runner.calibration import Pace
from headway_launch.runner.cores import CoreShares
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.training_process import TrainingProcess

PACE = Pace(
    0.0, start_s=3.0, evaluation_s=2.0, cpu_start_s=4.0, marks=[(0.5, 1.0)] * 7,
    kwh=1e-6, kg_co2=1e-7,
)  # fmt: skip


def test_the_cost_of_a_job_is_start_iterations_and_evaluations() -> None:
    config = compose(
        ["env=trivial", "rollout.copies=4", "rollout.steps=25", "env_steps=1000", "evaluation.every=300"]
    ).config
    config = replace(config, evaluation=replace(config.evaluation, episodes=10, final_episodes=30))
    # Ten iterations of 100 steps; evaluations before them (whose CPU seconds are the start's), at 300, 600
    # and 900, and the last of three times the episodes.
    whole = PACE.estimate(config, 0)
    assert whole.seconds == pytest.approx(3.0 + 10 * 0.5 + (1 + 3 + 3) * 2.0)
    assert whole.cpu_s == pytest.approx(4.0 + 10 * 1.0 + (3 + 3) * 2.0 * 2.0)
    assert whole.kwh == pytest.approx(whole.cpu_s * 1e-6)
    rest = PACE.estimate(config, 7)
    assert rest.seconds == pytest.approx(3.0 + 3 * 0.5 + (1 + 3) * 2.0)
    assert replace(PACE, kwh=None).estimate(config, 0).kwh is None


@pytest.mark.slow
def test_a_dry_run_lists_estimates_and_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    finished: list[JobUsage] = []
    started: list[TrainingProcess] = []
    finish, start = EnergyMeter.finish, TrainingProcess.__init__

    def watched(meter: EnergyMeter, name: str, others: dict[str, JobUsage], usage: JobUsage) -> Energy:
        finished.append(usage)
        return finish(meter, name, others, usage)

    def counted(process: TrainingProcess, job: TrainingJob) -> None:
        started.append(process)
        start(process, job)

    monkeypatch.setattr(EnergyMeter, "finish", watched)
    monkeypatch.setattr(TrainingProcess, "__init__", counted)
    monkeypatch.setattr("headway_launch.runner.calibration.uses_gpu", lambda job: True)
    algorithms = ("ippo", "ia2c", "mappo")
    sweep = (
        "sweep", "env=trivial", f"algo={','.join(algorithms)}", "seed=0..2", "rollout.steps=128",
        "env_steps=1e6", "backend=serial", "backend.parallel=2", "energy=off", "evaluation.episodes=1",
        f"store.root={tmp_path / 'runs'}",
    )  # fmt: skip
    shown = output(*sweep, "--dry-run")
    listed, estimated = shown.out.split("\n\n")[:2]
    header, *rows = [line.split("\t") for line in listed.splitlines()]
    assert header == ["cell", "iteration", "seeds", "runs", "action"]
    assert rows == [[algo, "8 x 128 steps", "0..2", "3", "train"] for algo in algorithms]
    header, *rows = [line.split("\t") for line in estimated.splitlines()]
    assert header == ["cell", "jobs", "s per job", "total CPU s", "total kWh"]
    assert [row[:2] for row in rows] == [[algo, "3"] for algo in algorithms]
    assert all(float(row[2]) > 1 and float(row[3]) > 3 and row[4:] == [""] for row in rows)
    measured = "for the estimate: start, an evaluation of 1 episode, up to 7 iterations of 8 x 128 steps"
    for algo in algorithms:
        assert shown.err.splitlines().count(f"measuring {algo} {measured}") == 1
    assert "9 jobs" in shown.out
    assert "trains a stack" not in shown.out
    assert "measured on this machine; on a cluster" not in shown.out
    assert "energy not measured" in shown.out
    assert "Energy" not in shown.out
    assert "measured with 2 trainings in parallel: 3 cells. This assumes" in shown.out
    assert not (tmp_path / "runs").exists()
    assert len(finished) == 4
    assert all(usage.uses_gpu for usage in finished)
    assert len(started) == len(algorithms) + 1  # two at a time, the first cell again


@pytest.fixture
def _measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every cell has been measured, with the same result."""

    def measured(cells: Sequence[CellPlan], shares: CoreShares) -> tuple[dict[int, Pace], str]:
        return {id(cell): PACE for cell in cells}, "CPU estimated"

    monkeypatch.setattr("headway_launch.studies.dry_run.calibrate", measured)


@pytest.mark.usefixtures("_measured")
def test_run_has_a_dry_run(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    words = ("run", "env=trivial", "algo=ippo", "env_steps=2048", "energy=off", f"store.root={root}")
    shown = output(*words, "--dry-run").out
    assert shown.startswith("cell\titeration\tseeds\truns\taction\n")
    assert "\ttrain\n" in shown
    assert "Estimated from an evaluation and at least 6 iterations" in shown
    assert not root.exists()


@pytest.mark.usefixtures("_measured")
def test_the_dry_run_of_a_search_tells_its_budget_and_cost(tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason='Optuna is not installed: pip install "headway[search]"')
    root = tmp_path / "runs"
    told = output("search", "toy_tracking", "energy=off", f"store.root={root}", "--dry-run").out
    _, ippo, mappo, _, total, *_ = told.splitlines()
    steps = 8 * 2_048 + 4 * 2_048 + 2 * 4_096
    assert ippo.split("\t")[:6] == ["ippo", "8", "0", "1", "8 to 2,048, 4 to 4,096, 2 to 8,192", str(steps)]
    assert mappo.split("\t")[:6] == ["mappo", *ippo.split("\t")[1:6]]
    # One job per candidate and rung; each starts a process.
    assert total.startswith("28 jobs, ")
    assert not root.exists()


@pytest.mark.usefixtures("_measured")
def test_the_estimate_explains_stacks_and_the_place_of_measurement(tmp_path: Path) -> None:
    words = [
        "sweep", "env=trivial", "algo=ippo", "seed=0..4", "rollout.steps=16", "env_steps=1e6", "energy=off",
        "backend=ray", "backend.workers=1", "backend.parallel=1", "backend.stack=3", "evaluation.episodes=1",
        f"store.root={tmp_path / 'runs'}",
    ]  # fmt: skip
    shown = output(*words, "--dry-run").out
    assert "5 runs in 2 jobs: a job trains up to 3 seeds at once (backend.stack)" in shown
    assert "It was measured on this machine; on a cluster" in shown


def test_a_cell_with_finished_runs_costs_their_mean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["sweep", "env=trivial", "algo=ippo", "study=toys", "env_steps=2048", "energy=off",
             "backend=serial", "backend.parallel=1", f"store.root={tmp_path}"]  # fmt: skip
    [experiment] = compose_sweep(words[1:])
    for seed, (cpu, kwh) in enumerate(((4.0, 0.1), (6.0, 0.3))):
        keep_run(tmp_path, experiment, seed, "FINISHED", session=Process.current(), cpu_seconds=cpu, kwh=kwh)
    monkeypatch.setattr("headway_launch.studies.dry_run.calibrate", None)
    shown = output(*words, "seed=0..4", "--dry-run").out
    assert "ippo\t3\t15\t15\t0.6\n" in shown  # three new seeds of 15 s, 5 CPU s and 0.2 kWh
    assert "3 jobs, 1 in parallel: about 0:00:45, 15 CPU s, 0.6 kWh" in shown
    assert "Estimated as the mean of finished runs on this machine: 1 cell." in shown
    assert "Estimated from" not in shown


@pytest.mark.usefixtures("_measured")
def test_known_and_measured_cells_are_told_apart_and_energy_is_summed_only_if_all_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["sweep", "env=trivial", "study=toys", "env_steps=2048", "backend.parallel=1",
             f"store.root={tmp_path}"]  # fmt: skip
    [experiment] = compose_sweep([*words[1:], "algo=ippo", "energy=off", "backend=serial"])
    keep_run(tmp_path, experiment, 0, "FINISHED", session=Process.current(), cpu_seconds=4.0, kwh=0.1)
    both = [*words, "algo=ippo,ia2c", "seed=0,1", "--dry-run"]
    shown = output(*both, "energy=codecarbon", "backend=ray").out
    assert "Estimated as the mean of finished runs on this machine: 1 cell." in shown
    assert "6 iterations, measured with 1 training in parallel: 1 cell." in shown
    assert "on a cluster with other processors" in shown
    assert "Measured energy: CodeCarbon's value" in shown
    paced = "headway_launch.studies.dry_run.calibrate"
    without = replace(PACE, kwh=None, kg_co2=None)
    monkeypatch.setattr(paced, lambda cells, shares: ({id(cell): without for cell in cells}, ""))
    shown = output(*both, "energy=off", "backend=serial").out
    assert "ippo\t1\t10\t4\t0.1\n" in shown
    assert "CPU s, energy known for 1 job only\n" in shown
    assert "CodeCarbon" not in shown


@pytest.mark.usefixtures("_measured")
def test_only_a_cells_own_runs_give_its_estimate(tmp_path: Path) -> None:
    """A short run of the same settings says little of a long one, which hardly consists of its start."""
    words = ["sweep", "env=trivial", "algo=ippo", "study=toys", "seed=0,1", "energy=off", "backend=serial",
             f"store.root={tmp_path}"]  # fmt: skip
    [experiment] = compose_sweep([*words[1:], "env_steps=2048"])
    keep_run(tmp_path, experiment, 0, "FINISHED", session=Process.current(), cpu_seconds=4.0)
    shown = output(*words, "env_steps=204_800", "--dry-run").out
    assert "Estimated as the mean" not in shown
    assert "Estimated from an evaluation" in shown


def test_finished_runs_of_whole_stacks_give_the_cost_of_a_smaller_last_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["sweep", "env=trivial", "algo=ippo", "study=toys", "env_steps=2048", "energy=off",
             "backend=serial", "backend.parallel=1", "backend.stack=3", f"store.root={tmp_path}"]  # fmt: skip
    [experiment] = compose_sweep(words[1:])
    for seed in (0, 1, 2):
        kept = {"stack": (0, 1, 2), "session": Process.current(), "cpu_seconds": 5.0}
        keep_run(tmp_path, experiment, seed, "FINISHED", **kept)
    monkeypatch.setattr("headway_launch.studies.dry_run.calibrate", None)
    shown = output(*words, "seed=0..7", "--dry-run").out
    assert "ippo\t2\t20\t25\t\n" in shown  # five seeds in jobs of 3 and 2
    assert "ippo\t1\t20\t10\t\n" in output(*words, "seed=0..4", "--dry-run").out


def test_iterations_are_measured_without_the_evaluations_between_them() -> None:
    pace = Pace(time.monotonic())
    spent = 5.0
    pace.take(Started(0, (), False))
    pace.take(EvaluationFinished(0, 0, "greedy", Usage(spent, 0), 0.0))
    for iteration in (1, 2, 3):
        spent += 1.0
        pace.take(IterationFinished(iteration, 100 * iteration, Usage(spent, 0), spent, 0.75, 0.25))
        spent += 2.0
        pace.take(EvaluationFinished(iteration, 100 * iteration, "greedy", Usage(spent, 0), 0.0))
    assert (pace.iteration_s, pace.cpu_iteration_s, pace.cpu_start_s, len(pace.counted)) == (1.0, 1.0, 5.0, 2)
