"""`headway resume` on stores as sessions leave them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from headway.config.experiment import StoreConfig
from headway.contracts.errors import HeadwayError
from headway.store.energy_log import EnergyLog
from headway.store.index import RunIndex, RunRow
from headway.store.run_folder import RunRecord
from headway_launch.commands.main import run
from headway_launch.console.progress_display import Progress
from headway_launch.runner.stored_run import StoredRun, jobs_to_resume

TINY = (
    "env=trivial",
    "algo=ippo",
    "energy=off",
    "env.args.agents=2",
    "env.args.steps=20",
    "rollout.copies=4",
    "rollout.block=2",
    "rollout.steps=16",
    "env_steps=64",
    "evaluation.episodes=1",
    "evaluation.final_episodes=2",
)


@pytest.fixture(autouse=True)
def _a_folder_and_two_cores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("headway_launch.runner.runner.usable_cores", lambda: 2)


def _runs() -> list[RunRow]:
    return RunIndex(Path(StoreConfig().root)).rows()


def _end_as_killed(directory: str, status: str = "KILLED") -> None:
    """As if the session had died after the last checkpoint."""
    path = Path(directory, "run.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"status": status}))


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["serial", "process"])
def test_one_of_several_seeds_goes_on_alone(
    backend: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Side by side each seed had one core, and alone it would have both."""
    assert run(["run", *TINY, f"backend={backend}", "seed=0,1"]) == 0
    first = _runs()[0]
    _end_as_killed(first.directory)
    shown: list[tuple[str, ...]] = []
    monkeypatch.setattr(Progress, "show", lambda progress: shown.append(progress._jobs[0].cells()))
    summary = json.loads(Path(first.directory, "summary.json").read_text())
    capsys.readouterr()
    assert run(["resume", first.run_id]) == 0, capsys.readouterr().err
    assert [row.status for row in _runs()] == ["FINISHED", "FINISHED"]
    again = json.loads(Path(first.directory, "summary.json").read_text())
    assert again["final_reward"] == summary["final_reward"]
    assert {cells[2] for cells in shown} == {"64 steps"}
    assert again["cpu_seconds"] > summary["cpu_seconds"] > 0


@pytest.mark.slow
def test_what_a_killed_session_used_is_still_counted() -> None:
    assert run(["run", *TINY, "backend=serial"]) == 0
    directory = Path(_runs()[0].directory)
    log = EnergyLog(directory)
    used = log.last()
    # Another session measured and died before it could write a summary.
    log.append({"time": 1.0, "cpu_seconds": float(used["cpu_seconds"]) + 1000.0, "kwh": 2.0, "kg_co2": 0.5})
    log.write()
    _end_as_killed(str(directory), "RUNNING")
    record = RunRecord.read(directory)
    replace(record, session=replace(record.session, pid=2**22 + 1)).write(directory)
    assert run(["resume", directory.name]) == 0
    summary = json.loads((directory / "summary.json").read_text())
    assert summary["cpu_seconds"] > float(used["cpu_seconds"]) + 1000.0
    assert (summary["kwh"], summary["kg_co2"]) == (2.0, 0.5)
    last = EnergyLog(directory).last()
    assert {name: summary[name] for name in ("cpu_seconds", "kwh")} == {
        name: last[name] for name in ("cpu_seconds", "kwh")
    }


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
    (directory / "plan.json").write_text(json.dumps({"stack": list(stack or (seed,)), "workers": 1}))
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
    runs = [
        _stored(tmp_path, seed, seed, evaluation={"episodes": episodes})
        for seed, episodes in enumerate((1, 7))
    ]
    batches = jobs_to_resume(runs)
    assert [jobs[0].experiment.config.evaluation.episodes for jobs in batches] == [1, 7]


def test_a_finished_run_is_refused_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _end_as_killed(str(_stored(tmp_path / "runs", 0, 0).directory), "FINISHED")
    assert run(["resume", "run-0-s0"]) == 2
    told = capsys.readouterr()
    assert told.err == "headway: run run-0-s0 has finished: there is nothing to resume\n"
    assert told.out == ""


def test_a_study_goes_on_with_what_failed_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, status in enumerate(("KILLED", "FAILED", "FINISHED")):
        _end_as_killed(str(_stored(tmp_path / "runs", number, number).directory), status)
    resumed: list[str] = []

    def note(runs: list[StoredRun], known: object) -> list[object]:
        resumed.extend(run.record.run_id for run in runs)
        return []

    monkeypatch.setattr("headway_launch.runner.stored_run.jobs_to_resume", note)
    assert run(["resume", "--study", "default"]) == 0
    assert resumed == ["run-0-s0", "run-1-s1"]
