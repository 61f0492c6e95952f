"""A worker pool counts failures of workers and losses of their machines separately."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest

from headway.events import Usage
from headway.rollout.episodes import EvaluationRequest
from headway.rollout.workers.worker import Begin, Collect, Command, Done, Evaluate
from headway.rollout.workers.worker_pool import WorkerFailedError, WorkerPool

DONE = Done([], [], None, Usage())
EVALUATION = Evaluate(EvaluationRequest(1, 0, 1, True), 0, 1)
LOST, DEATH = "its machine cannot be reached", "killed by signal 9"


class _Scripted:
    """A launcher that is also its own connections: every answer is the next one of a list."""

    process_id = None
    waitable = None
    trajectory: Any = None
    lost_with_machine = False

    def __init__(self, answers: Iterator[Done | str]) -> None:
        self._answers = answers

    def start(self, shard: int) -> "_Scripted":
        return _Scripted(self._answers)

    def wait(self, waitables: Sequence[Any], timeout_s: float | None) -> list[Any]:
        return list(waitables)

    def dismiss(self, links: Sequence[Any]) -> None:
        pass

    def publish(self, parameters: object) -> None:
        pass

    def await_start(self) -> None:
        pass

    def send(self, command: Command) -> None:
        pass

    def receive(self) -> Done | str:
        answer = next(self._answers)
        self.lost_with_machine = answer == LOST
        return answer

    def kill(self) -> None:
        pass


def _answered(*answers: Done | str, commands: Sequence[Command] = (Begin("episodes"),)) -> list[str]:
    """The notices of a pool of one worker that gives these answers to the commands."""
    notices: list[str] = []
    pool = WorkerPool(_Scripted(iter(answers)), 1, notices.append)
    for command in commands:
        pool.send(0, command)
        pool.answer(0)
    return notices


@pytest.mark.parametrize(
    "answers",
    [(LOST, DEATH, DONE), (DEATH, LOST, DONE), (LOST, LOST, LOST, DONE), (LOST, DEATH, LOST, LOST, DONE)],
)
def test_a_lost_machine_is_no_failure_of_the_worker(answers: tuple[Done | str, ...]) -> None:
    lines = [f"worker 0 failed ({answer}); replaced, its episodes start again" for answer in answers[:-1]]
    assert _answered(*answers) == lines


@pytest.mark.parametrize("answers", [(DEATH, DEATH), (DEATH, LOST, DEATH), (LOST, DEATH, LOST, DEATH)])
def test_a_second_failure_in_a_row_ends_the_run(answers: tuple[Done | str, ...]) -> None:
    with pytest.raises(WorkerFailedError, match=r"^worker 0 failed twice \(killed by signal 9\)$"):
        _answered(*answers)


def test_too_many_lost_machines_in_a_row_end_the_run() -> None:
    with pytest.raises(WorkerFailedError, match=rf"^worker 0 lost its machine 4 times in a row \({LOST}\)$"):
        _answered(LOST, LOST, LOST, LOST)


def test_an_executed_command_resets_the_counts() -> None:
    answers = (DEATH, LOST, LOST, LOST, DONE, DEATH, LOST, LOST, LOST, DONE, DONE)
    assert len(_answered(*answers, commands=(Begin("episodes"), Collect(1)))) == 8


def test_a_limit_follows_the_time_that_workers_needed_not_when_their_answers_were_received() -> None:
    """While worker 0 was waited for, worker 1 had long answered."""
    pool = WorkerPool(_Scripted(iter([replace(DONE, seconds=3.0), replace(DONE, seconds=8.0)])), 2, print)
    for worker in pool.workers:
        worker.sent_at = time.monotonic() - 1000
    pool.all([Collect(1)] * 2)
    assert pool.timeouts[Collect].limit_s == 80.0


def test_a_worker_has_more_time_until_it_has_made_its_environments() -> None:
    """An evaluator makes them at its first command, others when they begin or restore episodes."""
    pool = WorkerPool(_Scripted(iter([DONE])), 1, print, timeout_s=2.0)
    [worker] = pool.workers
    for failures, limit in ((0, 60.0), (1, 4.0)):
        worker.pending, worker.failures = [EVALUATION], failures
        assert pool._limit_s(worker) == limit
    worker.failures = 0
    pool.all([EVALUATION])
    pool.send(0, EVALUATION)
    assert pool._limit_s(worker) == 2.0
    for command in (Begin("episodes"), EVALUATION):
        derived = WorkerPool(_Scripted(iter(())), 1, print)
        derived.send(0, command)
        assert derived._limit_s(derived.workers[0]) == 900.0


def test_a_worker_that_makes_its_environments_is_told_to_be_late_before_its_limit() -> None:
    told: list[str] = []
    pool = WorkerPool(_Scripted(iter(())), 1, told.append, "the town")
    [worker] = pool.workers
    worker.send(Begin("episodes"))
    assert 59 < pool._notice_in_s(0) <= 60
    worker.sent_at -= 100
    assert not pool._is_overdue(0)
    assert told == ["worker 0 has not answered for 100 s while starting episodes of the town; it may hang"]
    assert 799 < pool._notice_in_s(0) <= 800
    worker.sent_at -= 800
    assert pool._is_overdue(0)
    assert len(told) == 1
    worker.send(EVALUATION)
    worker.sent_at -= 100
    assert not pool._is_overdue(0)
    assert told[1].endswith("while evaluating on the town; it may hang, or an episode does not end")


def test_of_no_workers_none_has_answered() -> None:
    pool = WorkerPool(_Scripted(iter(())), 2, print)
    assert pool.answered([], 0) == []
