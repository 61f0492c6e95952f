"""One seed gives one curve, whatever the backend, the other seeds, interruptions and failures."""

import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from covering import quick_or_slow
from rehearsal import TOYS, Fault, FaultConfig, FaultyVisitors
from runs import Backend, Log, job_of, log_of, logs_of, train_quietly, trained

from headway.contracts import HeadwayError, child_seeds
from headway.events import (
    CheckpointSaved,
    EvaluationFinished,
    Event,
    Finished,
    IterationFinished,
    Notice,
    Started,
)
from headway.rollout.episodes import evaluation_seeds
from headway.rollout.workers.worker_pool import WorkerFailedError
from headway.store.checkpoint import latest_iteration, write_checkpoint
from headway.store.fencing import open_gate
from headway.store.parquet_log import RunLog, read_rows
from headway.training import loop
from headway.training.loop import TrainingJob, train


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Six iterations of seed 5 on visitors, undisturbed, on the serial backend."""
    job = job_of(tmp_path_factory.mktemp("whole"))
    trained(job)
    return logs_of(job)[0]


@pytest.fixture(scope="module")
def whole_stack(tmp_path_factory: pytest.TempPathFactory) -> list[Log]:
    """Six iterations of seeds 5 and 6 together, undisturbed."""
    job = job_of(tmp_path_factory.mktemp("whole_stack"), seeds=(5, 6))
    trained(job)
    return logs_of(job)


def _faulty(folder: Path, fault: Fault = "kill", **choices: Any) -> tuple[type[FaultyVisitors], FaultConfig]:  # noqa: ANN401 - FaultConfig's
    return FaultyVisitors, FaultConfig(fault, str(folder), **{"at": 41, "copies": 2, **choices})


def _of(kind: type[Event], events: list[Event]) -> list[Any]:
    return [event for event in events if isinstance(event, kind)]


def _end(events: list[Event]) -> tuple[int, bool]:
    assert isinstance(events[-1], Finished)
    kept = any(isinstance(event, CheckpointSaved) for event in events)
    assert (events[-1].store_s > 0) == kept  # checkpoints take time
    return events[-1].iteration, events[-1].stopped


def test_the_log_holds_every_iteration_evaluation_and_episode(whole: Log) -> None:
    assert [row["iteration"] for row in whole["curve"]] == list("0123456")
    assert [row["env_steps"] for row in whole["curve"]] == [str(64 * i) for i in range(7)]
    for row in whole["curve"]:
        evaluated = int(row["iteration"]) % 2 == 0
        assert ("evaluation_greedy/return" in row) == evaluated
        assert ("evaluation_sampled/regret" in row) == evaluated
        assert ("policy/entropy" in row) == (row["iteration"] != "0")
    modes = [(row["iteration"], row["mode"], row["episode_seed"]) for row in whole["evaluation"]]
    last = [("6", repr(mode), str(i)) for mode in ("greedy", "sampled") for i in range(3)]
    assert modes[-6:] == last
    assert len(modes) == 3 * 2 * 2 + 6
    assert {row["copy"] for row in whole["episodes"]} == set("0123")


@pytest.mark.parametrize(
    ("every", "evaluated"), [(100, [0, 128, 256, 320, 384]), (128, [0, 128, 256, 384]), (1000, [0, 384])]
)
def test_evaluations_come_as_a_multiple_is_reached(tmp_path: Path, every: int, evaluated: list[int]) -> None:
    job = job_of(tmp_path)
    evaluation = replace(job.config.evaluation, every=every, modes=("greedy",))
    events = trained(replace(job, config=replace(job.config, evaluation=evaluation)))
    assert [event.env_steps for event in _of(EvaluationFinished, events)] == evaluated


def test_the_last_point_of_a_curve_is_the_mean_of_the_same_episodes_as_the_others(tmp_path: Path) -> None:
    events = trained(job := job_of(tmp_path, iterations=2))
    last = _of(EvaluationFinished, events)[-1]
    played = read_rows(Path(job.directories[0]), "evaluation")[-3:]
    assert [(row["mode"], row["final"], row["episode_seed"]) for row in played] == [
        ("sampled", 1, day) for day in range(3)
    ]
    expected = np.mean([row["return"] for row in played[:2]])
    assert last.mean_return == expected
    assert read_rows(Path(job.directories[0]), "curve")[-1]["evaluation_sampled/return"] == expected


def test_events_come_in_order(tmp_path: Path) -> None:
    events = trained(job_of(tmp_path, backend="process"))
    assert isinstance(events[0], Started)
    assert len(events[0].process_ids) == 3
    assert not events[0].episodes_restarted
    assert _end(events) == (6, False)
    assert [e.iteration for e in _of(IterationFinished, events)] == [1, 2, 3, 4, 5, 6]
    assert [e.iteration for e in _of(CheckpointSaved, events)] == [2, 4, 6]
    assert [e.iteration for e in _of(EvaluationFinished, events)[::2]] == [0, 2, 4, 6]
    reports = [e for e in events if isinstance(e, IterationFinished | EvaluationFinished | Finished)]
    cpu = [e.usage.cpu_seconds for e in reports if e.usage]
    assert len(cpu) == len(reports)
    assert cpu == sorted(cpu)
    assert cpu[0] > 0


def test_the_last_event_includes_the_usage_of_the_last_evaluation_and_checkpoint(tmp_path: Path) -> None:
    events = trained(job_of(tmp_path, iterations=1))
    before, after = (event.usage.cpu_seconds for event in (_of(IterationFinished, events)[0], events[-1]))  # type: ignore[union-attr]
    assert after - before > 0.002


def test_other_seeds_in_the_same_stack_change_nothing(whole: Log, tmp_path: Path) -> None:
    job = job_of(tmp_path, seeds=(4, 5, 6), backend="process")
    trained(job)
    logs = logs_of(job)
    assert logs[1] == whole
    assert logs[0]["curve"] != whole["curve"] != logs[2]["curve"]


@pytest.mark.parametrize("toy", ["visitors", "tracking"])
def test_other_blocks_agree_in_the_first_updates(toy: str, tmp_path: Path) -> None:
    def curve(name: str, block: int) -> list[dict[str, float]]:
        job = job_of(tmp_path / name, TOYS[toy], (6,), block=block, iterations=3, precision="float64")
        trained(job)
        rows = read_rows(tmp_path / name / "6", "curve")
        return [{name: float(value) for name, value in row.items()} for row in rows]

    alone = curve("alone", 2)
    for other in (curve("small", 1), curve("large", 4)):
        for row, expected in zip(other, alone, strict=True):
            assert row.keys() == expected.keys()
            for name in row.keys() - {"wall_s", "time/collect_s", "time/learn_s"}:
                np.testing.assert_allclose(row[name], expected[name], rtol=1e-8, atol=1e-10, err_msg=name)


def test_evaluation_seeds_are_the_same_for_all_runs_and_apart_from_training() -> None:
    evaluation = set(evaluation_seeds(1_000_003, 0, 500).tolist())
    assert evaluation_seeds(1_000_003, 10, 5).tolist() == evaluation_seeds(1_000_003, 0, 15)[10:].tolist()
    assert len(evaluation) == 500
    for seed in (0, 1, 1_000_003):  # even if a training seed is the evaluation's root
        assert evaluation.isdisjoint(child_seeds(seed, "env", 0, 500).tolist())


def test_a_worker_lost_in_mid_iteration_does_not_change_the_curve(whole: Log, tmp_path: Path) -> None:
    events = trained(job := job_of(tmp_path, _faulty(tmp_path), backend="process"))
    assert [len(_of(Notice, events)), "replaced" in _of(Notice, events)[0].line] == [1, True]
    assert logs_of(job) == [whole]


def test_a_run_that_cannot_continue_raises_and_leaves_no_worker(tmp_path: Path) -> None:
    events: list[Event] = []
    job = job_of(tmp_path, _faulty(tmp_path, "raise", times=9), backend="process")
    with pytest.raises(WorkerFailedError, match="the bridge is out"):
        train(job, events.append, lambda: False)
    assert not any(psutil.pid_exists(process_id) for process_id in _of(Started, events)[0].process_ids[1:])


@pytest.mark.parametrize(("backend", "stop"), [("serial", 1), ("serial", 4), ("process", 3)])
def test_resumed_equals_never_stopped(whole: Log, tmp_path: Path, backend: Backend, stop: int) -> None:
    job = job_of(tmp_path, backend=backend)
    events = trained(job, stop_after=stop)
    assert events[-2] == CheckpointSaved(stop)
    assert _end(events) == (stop, True)
    events = trained(replace(job, resume=True))
    assert _of(Started, events)[0].iteration == stop
    assert logs_of(job) == [whole]
    assert _end(trained(replace(job, resume=True))) == (6, False)  # nothing is left to do
    assert logs_of(job) == [whole]


def test_stopped_before_the_first_iteration_and_resumed(whole: Log, tmp_path: Path) -> None:
    job = job_of(tmp_path)
    assert _end(trained(job, stop_after=0)) == (0, True)
    trained(replace(job, resume=True), stop_after=0)
    trained(replace(job, resume=True))
    assert logs_of(job) == [whole]


def test_a_checkpoint_cut_in_half_falls_back_to_the_one_before(whole: Log, tmp_path: Path) -> None:
    job = job_of(tmp_path)
    trained(job, stop_after=4)
    newest = tmp_path / "5" / "checkpoints" / "checkpoint-000004.pt"
    newest.write_bytes(newest.read_bytes()[: newest.stat().st_size // 2])
    events = trained(replace(job, resume=True))
    assert "checkpoint-000004.pt is broken" in _of(Notice, events)[0].line
    assert _of(Started, events)[0].iteration == 2
    assert logs_of(job) == [whole]


def test_a_broken_checkpoint_is_removed_once_training_goes_on_before_it(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    trained(job, stop_after=4)
    folder = tmp_path / "5" / "checkpoints"
    (folder / "checkpoint-000004.pt").write_bytes(b"half")
    trained(replace(job, resume=True), stop_after=1)
    assert sorted(path.name for path in folder.iterdir()) == ["checkpoint-000002.pt", "checkpoint-000003.pt"]


def _train_in_a_process(job: TrainingJob) -> int | None:
    process = multiprocessing.get_context("forkserver").Process(target=train_quietly, args=(job,))
    process.start()
    process.join(300)
    return process.exitcode


def test_a_killed_training_process_resumes_to_the_same_curve(whole: Log, tmp_path: Path) -> None:
    # On the serial backend the fault kills the training process itself, in iteration 4.
    job = job_of(tmp_path, _faulty(tmp_path, at=3 * 16 + 9, copies=4))
    assert _train_in_a_process(job) == -9
    events = trained(replace(job, resume=True))
    assert _of(Started, events)[0].iteration == 2
    assert logs_of(job) == [whole]


@pytest.mark.parametrize("writes", quick_or_slow({str(n): (n,) for n in (4, 5, 6, 7, 8)}, "4", "8"))
def test_a_stack_killed_between_two_writes_loses_nothing(
    whole_stack: list[Log], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    """At iterations 2 and 4 each of the two seeds writes a log and a checkpoint."""
    written = 0

    def count() -> None:
        nonlocal written
        written += 1
        if written > writes:
            raise KeyboardInterrupt

    def save(directory: Path, iteration: int, content: bytes, gate: Path | None) -> Path:
        count()
        return write_checkpoint(directory, iteration, content, gate)

    class CountedLog(RunLog):
        def commit(self, iteration: int) -> None:
            count()
            super().commit(iteration)

    job = job_of(tmp_path, seeds=(5, 6))
    with monkeypatch.context() as patch:
        patch.setattr(loop, "write_checkpoint", save)
        patch.setattr(loop, "RunLog", CountedLog)
        with pytest.raises(KeyboardInterrupt):
            trained(job)
    trained(replace(job, resume=True))
    assert logs_of(job) == whole_stack


def test_rows_of_a_session_that_died_before_its_first_checkpoint_are_not_doubled(
    whole: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(directory: Path, iteration: int, content: bytes, gate: Path | None) -> Path:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(loop, "write_checkpoint", die)
        with pytest.raises(KeyboardInterrupt):
            trained(job_of(tmp_path))
    assert log_of(tmp_path / "5")["curve"]
    trained(job := job_of(tmp_path))
    assert logs_of(job) == [whole]


@pytest.mark.parametrize("asked", quick_or_slow({str(n): (n,) for n in (0, 1, 3, 4, 5)}, "0", "3"))
def test_a_process_that_was_taken_over_can_change_nothing(whole: Log, tmp_path: Path, asked: int) -> None:
    """A machine cut off and given up for lost continues after its replacement has ended."""
    (tmp_path / "5").mkdir()
    job = job_of(tmp_path)

    def gated(resume: bool) -> TrainingJob:
        return replace(job, gates=(str(open_gate(tmp_path / "5")),), resume=resume)

    questions = 0

    def take_over() -> bool:
        nonlocal questions
        if questions == asked:
            trained(gated(resume=asked > 1))
        questions += 1
        return False

    with pytest.raises(HeadwayError, match="another training process has taken over"):
        train(gated(resume=False), lambda event: None, take_over)
    assert asked < questions <= asked + 3
    assert logs_of(job) == [whole]
    assert latest_iteration(job.checkpoints[0]) == 6


def test_a_stack_resumes_from_the_newest_intact_checkpoint(whole_stack: list[Log], tmp_path: Path) -> None:
    job = job_of(tmp_path, seeds=(5, 6))
    trained(job, stop_after=4)
    newest, same = (folder / "checkpoint-000004.pt" for folder in job.checkpoints)
    assert newest.read_bytes() == same.read_bytes()
    newest.write_bytes(newest.read_bytes()[:-1])
    events = trained(replace(job, resume=True))
    assert _of(Started, events)[0].iteration == 4
    assert logs_of(job) == whole_stack


def test_without_snapshots_a_resumed_run_says_so_and_sees_new_episodes(tmp_path: Path) -> None:
    job = job_of(tmp_path, _faulty(tmp_path, times=0, snapshots=False))
    trained(job, stop_after=2)
    events = trained(replace(job, resume=True), stop_after=2)
    assert "episodes restart after" in _of(Notice, events)[0].line
    assert _of(Started, events)[0].episodes_restarted
    trained(replace(job, resume=True))
    first = [
        [row for row in log_of(tmp_path / "5")["episodes"] if row["iteration"] in iterations]
        for iterations in ("12", "34", "56")
    ]
    keys = [{(row["length"], row["return"]) for row in rows} for rows in first]
    assert not keys[0] & keys[1]
    assert not keys[1] & keys[2]
