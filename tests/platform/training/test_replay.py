"""Learners with replay: one seed gives one curve, whatever the backend, interruptions and failures; and the
files of their replay data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from covering import pairwise
from rehearsal import TOYS, FaultConfig, FaultyVisitors
from runs import Log, job_of, logs_of, trained, with_algorithm

from headway.contracts import HeadwayError
from headway.events import Event, Notice, Started
from headway.store.checkpoint import load_latest
from headway.training.loop import TrainingJob
from headway_algos.registry import ENTRIES
from headway_algos.replay_config import NetworkConfig

TASKS = {"madqn": "visitors", "ddpg": "tracking"}
every_algorithm = pytest.mark.parametrize("algorithm", TASKS)


def _job(algorithm: str, folder: Path, **choices: Any) -> TrainingJob:  # noqa: ANN401 - those of `job_of`
    entry = ENTRIES[algorithm]
    config = entry.config(
        model=NetworkConfig((8,)), capacity=150, learning_starts=20, batch_size=8, updates=5, target_every=3
    )
    job = job_of(folder, **{"env": TOYS[TASKS[algorithm]], **choices})
    return with_algorithm(job, entry, config)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Log]:
    """Six iterations of seed 5 of each algorithm, undisturbed, on the serial backend."""
    logs = {}
    for algorithm in TASKS:
        trained(job := _job(algorithm, tmp_path_factory.mktemp(algorithm)))
        logs[algorithm] = logs_of(job)[0]
    return logs


def _files(folder: Path, seed: int = 5) -> list[str]:
    return sorted(path.name for path in (folder / str(seed) / "checkpoints").iterdir())


def _notices(events: list[Event]) -> list[str]:
    return [event.line for event in events if isinstance(event, Notice)]


@every_algorithm
def test_there_is_something_to_compare(whole: dict[str, Log], algorithm: str) -> None:
    losses = [row["critic/loss"] for row in whole[algorithm]["curve"][1:]]
    assert len(set(losses)) == 6
    explored = [float.fromhex(row["policy/exploration"]) for row in whole[algorithm]["curve"][1:]]
    assert explored[0] > explored[3] > explored[5]


@pytest.mark.parametrize(("algorithm", "backend", "stop"), pairwise(TASKS, ["serial", "process"], [1, 3]))
def test_resumed_equals_never_stopped(
    whole: dict[str, Log], tmp_path: Path, algorithm: str, backend: str, stop: int
) -> None:
    """Including the replay buffer, open decisions and the state of correlated noise."""
    job = _job(algorithm, tmp_path, backend=backend)
    trained(job, stop_after=stop)
    assert f"experience-{stop:06d}.pt" in _files(tmp_path)
    assert _notices(trained(replace(job, resume=True))) == []
    assert logs_of(job) == [whole[algorithm]]


def test_a_worker_killed_in_mid_iteration_changes_nothing(whole: dict[str, Log], tmp_path: Path) -> None:
    faulty = FaultyVisitors, FaultConfig("kill", str(tmp_path), at=41, copies=2)
    events = trained(job := _job("madqn", tmp_path, env=faulty, backend="process"))
    assert ["replaced" in line for line in _notices(events)] == [True]
    assert logs_of(job) == [whole["madqn"]]


@every_algorithm
def test_two_replay_buffers_are_kept_and_removed_at_the_end(tmp_path: Path, algorithm: str) -> None:
    job = _job(algorithm, tmp_path, seeds=(5, 6))
    trained(job, stop_after=5)
    kept = ["checkpoint-000004.pt", "checkpoint-000005.pt"]
    assert _files(tmp_path, 5) == [*kept, "experience-000004.pt", "experience-000005.pt"]
    assert _files(tmp_path, 6) == kept  # one file for the stack
    checkpoints = tmp_path / "5" / "checkpoints"
    assert "replay" not in load_latest(checkpoints)[1]
    trained(replace(job, resume=True))
    assert _files(tmp_path, 5) == _files(tmp_path, 6) == ["checkpoint-000005.pt", "checkpoint-000006.pt"]


def test_the_replay_buffer_is_removed_even_if_the_session_died_just_after_the_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = _job("madqn", tmp_path)
    with monkeypatch.context() as dying:
        dying.setattr("headway.training.loop.remove_replay", _die)
        with pytest.raises(KeyboardInterrupt):
            trained(job)
    left = ["checkpoint-000004.pt", "checkpoint-000006.pt"]
    assert _files(tmp_path) == [*left, "experience-000004.pt"]
    trained(replace(job, resume=True))
    assert _files(tmp_path) == left


def _die(directory: Path, gate: Path | None) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("harm", ["cut", "removed"])
def test_a_broken_buffer_falls_back_one_checkpoint(whole: dict[str, Log], tmp_path: Path, harm: str) -> None:
    job = _job("madqn", tmp_path)
    trained(job, stop_after=4)
    newest = tmp_path / "5" / "checkpoints" / "experience-000004.pt"
    if harm == "cut":
        newest.write_bytes(newest.read_bytes()[:-100])
    else:
        newest.unlink()
    events = trained(replace(job, resume=True))
    assert "its replay data experience-000004.pt are " in _notices(events)[0]
    started = [event for event in events if isinstance(event, Started)]
    assert started[0].iteration == 2
    assert logs_of(job) == [whole["madqn"]]


def test_a_run_whose_replay_buffer_is_missing_prints_one_line(tmp_path: Path) -> None:
    job = _job("madqn", tmp_path)
    trained(job, stop_after=4)
    for path in (tmp_path / "5" / "checkpoints").glob("experience-*.pt"):
        path.unlink()
    with pytest.raises(HeadwayError, match=r"start a new run .*its replay data .* are missing") as caught:
        trained(replace(job, resume=True))
    assert "\n" not in str(caught.value)
