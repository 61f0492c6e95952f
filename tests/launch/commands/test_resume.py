"""`headway resume` on stores as sessions leave them."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from command_lines import output, refused
from small_runs import SMALL, end_as, stored_rows
from stored_runs import write_plan

from headway.contracts.errors import HeadwayError
from headway.store.energy_log import EnergyLog
from headway.store.run_folder import RunRecord
from headway_launch.commands.main import run
from headway_launch.console.progress_display import Progress
from headway_launch.runner.jobs import CellPlan
from headway_launch.runner.stored_run import StoredRun, jobs_to_resume

TINY = ("env=trivial", "algo=ippo", *SMALL, "env.args.agents=2", "env.args.steps=20")


@pytest.fixture(autouse=True)
def _two_cores(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway_launch.runner.runner.usable_cores", lambda: 2)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["serial", "process"])
def test_one_of_several_seeds_goes_on_alone(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Side by side each seed had one core, and alone it would have both."""
    assert run(["run", *TINY, f"backend={backend}", "seed=0,1"]) == 0
    first = stored_rows()[0]
    end_as(first.directory)
    shown: list[tuple[str, ...]] = []
    monkeypatch.setattr(Progress, "show", lambda progress: shown.append(progress._jobs[0].cells()))
    summary = json.loads(Path(first.directory, "summary.json").read_text())
    table = output("resume", first.run_id).out
    assert [row.status for row in stored_rows()] == ["FINISHED", "FINISHED"]
    assert [line.split("\t")[0] for line in table.splitlines()[1:4]] == ["0", "1", "mean"]
    again = json.loads(Path(first.directory, "summary.json").read_text())
    assert again["final_reward"] == summary["final_reward"]
    assert {cells[2] for cells in shown} == {"64 steps"}
    assert again["cpu_seconds"] > summary["cpu_seconds"] > 0


@pytest.mark.slow
def test_what_a_killed_session_used_is_still_counted() -> None:
    assert run(["run", *TINY, "backend=serial"]) == 0
    directory = Path(stored_rows()[0].directory)
    log = EnergyLog(directory)
    used = log.last()
    # Another session measured and died before it could write a summary.
    log.append({"time": 1.0, "cpu_seconds": float(used["cpu_seconds"]) + 1000.0, "kwh": 2.0, "kg_co2": 0.5})
    log.write()
    end_as(directory, "RUNNING")
    record = RunRecord.read(directory)
    replace(record, session=replace(record.session, pid=2**22 + 1)).write(directory)
    assert run(["resume", directory.name]) == 0
    summary = json.loads((directory / "summary.json").read_text())
    assert summary["cpu_seconds"] > float(used["cpu_seconds"]) + 1000.0
    assert (summary["kwh"], summary["kg_co2"]) == (2.0, 0.5)
    last = EnergyLog(directory).last()
    assert (summary["cpu_seconds"], summary["kwh"]) == (last["cpu_seconds"], last["kwh"])


def _stored(root: Path, seed: int, number: int, stack: tuple[int, ...] = (), **changes: object) -> StoredRun:
    mapping = {"env": {"id": "trivial"}, "algo": {"name": "ippo"}, "seed": [seed], **changes}
    directory = root / "default" / f"run-{number}-s{seed}"
    directory.mkdir(parents=True)
    record = {
        "run_id": directory.name, "study": "default", "environment": "trivial", "algorithm": "ippo",
        "seed": seed, "iterations": 1, "started": f"2026-01-01T00:00:{number:02d}.000+00:00",
        "session": {"host": "elsewhere", "pid": 1, "created": 0.0}, "status": "KILLED",
    }  # fmt: skip
    (directory / "run.json").write_text(json.dumps(record))
    (directory / "config.yaml").write_text(json.dumps(mapping))  # JSON is YAML
    write_plan(directory, stack or (seed,))
    return StoredRun.find(root, directory.name)


def test_two_runs_of_one_seed_go_on_one_after_the_other(tmp_path: Path) -> None:
    runs = [_stored(tmp_path, seed, number) for number, seed in enumerate((3, 4, 3))]
    batches = jobs_to_resume(runs)
    assert [[job.seeds for job in jobs] for jobs in batches] == [[(3,), (4,)], [(3,)]]
    assert batches[1][0].resumed == ("run-2-s3",)


def test_stacks_of_the_same_seeds_stay_as_they_were(tmp_path: Path) -> None:
    runs = [_stored(tmp_path, seed, number, (3, 4)) for number, seed in enumerate((3, 4, 3, 4))]
    [[first], [second]] = jobs_to_resume(runs)
    assert first.resumed == ("run-0-s3", "run-1-s4")
    assert second.resumed == ("run-2-s3", "run-3-s4")
    with pytest.raises(HeadwayError, match="name the runs of seed 4 too"):
        jobs_to_resume(runs[:1])


def test_runs_of_one_cell_keep_the_configuration_of_each(tmp_path: Path) -> None:
    runs = [_stored(tmp_path, seed, seed, evaluation={"episodes": (1, 7)[seed]}) for seed in (0, 1)]
    batches = jobs_to_resume(runs)
    assert [jobs[0].experiment.config.evaluation.episodes for jobs in batches] == [1, 7]


def test_a_finished_run_is_refused_before_anything_starts(tmp_path: Path) -> None:
    end_as(_stored(tmp_path / "runs", 0, 0).directory, "FINISHED")
    line = refused("resume", "run-0-s0")
    assert line == "headway: run run-0-s0 has finished: there is nothing to resume\n"


@pytest.mark.parametrize("words", [["run-0-s0"], ["--study", "default"]])
def test_a_dry_run_estimates_what_is_left(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end_as(_stored(tmp_path / "runs", 0, 0).directory)
    estimated: list[tuple[int, ...]] = []

    def note(cells: Sequence[CellPlan]) -> int:
        estimated.extend(job.seeds for cell in cells for job in cell.jobs)
        return 0

    monkeypatch.setattr("headway_launch.studies.dry_run.print_estimate", note)
    assert run(["resume", "--dry-run", *words]) == 0
    assert estimated == [(0,)]


def test_a_study_also_resumes_failed_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, status in enumerate(("KILLED", "FAILED", "FINISHED")):
        end_as(_stored(tmp_path / "runs", number, number).directory, status)
    resumed: list[str] = []

    def note(runs: list[StoredRun], known: object) -> list[object]:
        resumed.extend(run.record.run_id for run in runs)
        return []

    monkeypatch.setattr("headway_launch.runner.stored_run.jobs_to_resume", note)
    assert run(["resume", "--study", "default"]) == 0
    assert resumed == ["run-0-s0", "run-1-s1"]


def test_a_study_without_unfinished_runs_names_the_commands_for_its_results(tmp_path: Path) -> None:
    end_as(_stored(tmp_path / "runs", 0, 0).directory, "FINISHED")
    line = output("resume", "--study", "default").err.splitlines()[-1]
    assert line.endswith(
        "nothing to resume; for the results: headway compare default, headway report default"
    )


def test_results_include_finished_seeds_of_the_same_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = [_stored(tmp_path / "runs", seed, number) for number, seed in enumerate((2, 0, 1, 2, 3))]
    stored.append(_stored(tmp_path / "runs", 4, 5, evaluation={"episodes": 7}))
    for number, run_ in enumerate(stored):
        end_as(run_.directory, "KILLED" if number in (0, 2) else "FINISHED")
    (stored[4].directory / "config.yaml").write_text("")  # damaged
    resumed: list[CellPlan] = []

    def note(cells: Sequence[CellPlan], debug: bool, plan_kept: bool) -> tuple[int, list[Path]]:
        resumed.extend(cells)
        return 0, []

    monkeypatch.setattr("headway_launch.runner.runner.run_sessions", note)
    assert run(["resume", "run-2-s1"]) == 0
    [cell] = resumed
    assert cell.finished == (stored[1].directory, stored[3].directory)
    assert [job.seeds for job in cell.jobs] == [(1,)]
    assert cell.experiment.config.seed == (0, 1, 2)
