"""Sessions in separate processes: finished, stopped, resumed, killed, failing."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import psutil
import pytest
from command_lines import failed, output, refused
from small_runs import SMALL, stored_rows
from stored_runs import keep_run

from headway.contracts.errors import HeadwayError
from headway.events import Event, IterationFinished
from headway.store.checkpoint import latest_iteration
from headway.store.run_folder import CHECKPOINTS
from headway_launch.experiments.compose import compose
from headway_launch.runner.cell import SessionCell
from headway_launch.runner.jobs import CellPlan, plan_jobs
from headway_launch.runner.recorder import JobRecorder
from headway_launch.runner.runner import Runner, store_share
from headway_launch.runner.scheduler import StopRequests
from headway_launch.runner.training_process import TrainingProcess

TINY = (
    "env=trivial", "algo=ippo", *SMALL, "env.args.agents=2", "env.args.steps=20", "rollout.steps=32",
    "evaluation.every=1000000",
)  # fmt: skip
ENV_FILE = """
from headway_envs.toy.trivial_parallel import TrivialParallel
from headway_envs.toy.trivial import TrivialConfig


def parallel_env(agents: int = 2, steps: int = 20):
    return TrivialParallel(TrivialConfig(agents=agents, steps=steps))
"""
LONG = ("env_steps=1e8",)
PATIENCE_S = 180.0
BEGUN = "(training| left)"
"""Pattern of a progress line once training has begun: `training`, or the time left if it is known."""


@dataclass(frozen=True)
class Running:
    """A `headway` process, whose stderr is a file."""

    process: "subprocess.Popen[str]"
    told: Path

    def wait_for(self, holds: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < deadline, f"nothing happened; stderr so far: {self.told.read_text()}"
            time.sleep(0.05)

    def has_said(self, pattern: str) -> bool:
        return re.search(pattern, self.told.read_text()) is not None

    def table(self) -> list[dict[str, str]]:
        """Return the table of seeds, once the process has ended."""
        assert self.process.stdout is not None
        header, *rows = [line.split("\t") for line in self.process.stdout.read().splitlines()]
        return [dict(zip(header, row, strict=True)) for row in rows]

    def training(self) -> list[psutil.Process]:
        """Return its training processes and their workers."""
        processes = psutil.Process(self.process.pid).children(recursive=True)
        return [child for child in processes if "resource_tracker" not in " ".join(child.cmdline())]


@contextmanager
def headway(*arguments: str, folder: Path) -> Iterator[Running]:
    command, told = [sys.executable, "-m", "headway_launch", *arguments], folder / "told.txt"
    with told.open("w") as stderr:
        process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=stderr, text=True, start_new_session=True
        )
    try:
        yield Running(process, told)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_a_run_ends_with_a_table_and_is_in_the_store(empty_folder: Path) -> None:
    words = ("backend=serial", "seed=3,4", "env_steps=256", "evaluation.rules=[optimal]")
    shown = output("run", *TINY, *words)
    table = [line.split("\t") for line in shown.out.splitlines()]
    assert table[0][:4] == ["seed", "status", "final reward (1 episode)", "AUC (own range)"]
    assert [row[:2] for row in table[1:3]] == [["3", "FINISHED"], ["4", "FINISHED"]]
    assert [row[0] for row in table[3:5]] == ["mean", "std"]
    of_rule = dict(zip(table[6], table[8], strict=True))
    assert (of_rule["controller"], of_rule["return"]) == ("rule optimal", "20")
    assert "final policies and rules on the curve's 1 episode and 1 other\n" in shown.err
    assert "\nreturn: ippo, mean of 2 seeds, " in shown.err
    assert "headway browse" in shown.err
    assert "of the training processes'" not in shown.err  # too short for a store share
    assert [(row.seed, row.status, row.env_steps) for row in stored_rows(empty_folder)] == [
        (3, "FINISHED", 256),
        (4, "FINISHED", 256),
    ]


def test_the_share_of_the_store_is_stated_for_long_trainings() -> None:
    short, long = (JobRecorder([], trained_s=seconds, store_s=1.0) for seconds in (59.0, 200.0))
    assert store_share([short], 1.0) == ""
    assert store_share([long], 1.0).startswith("storage took 1.0% of 200 s of training (logs and ")
    assert store_share([long, long], 2.0).startswith("storage took 1.0% of 400 s of training, summed over ")


def test_the_next_commands_can_be_pasted(
    empty_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(SessionCell, "training_job", _training_job)
    words = ("env=tracking", "algo=ippo", *SMALL, "evaluation.rules=[random]", "seed=1", "study='my lines'")
    experiment = compose(words)
    finished = Path("runs", "toys", keep_run(Path("runs"), experiment, 0, "FINISHED", 1, final_reward=3.0))
    assert Runner([CellPlan(experiment, plan_jobs(experiment), (finished,))], plan_kept=True).run() == 2
    told = capsys.readouterr().err
    first, second = (shlex.split(line) for line in re.findall(r"(?:on one page|is fixed): (.*)", told))
    assert first[1:] == ["report", "my lines"]
    assert second[1:] == ["resume", "--study", "my lines"]


@pytest.mark.parametrize("plan_kept", [True, False])
def test_ctrl_c_while_rules_are_played_says_how_to_play_them(
    plan_kept: bool, empty_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("headway_launch.runner.cell.rule_episodes", _interrupted)
    experiment = compose(("env=trivial", "algo=ippo", *SMALL, "evaluation.rules=[optimal]", "study=toys"))
    finished = Path("runs", "toys", keep_run(Path("runs"), experiment, 0, "FINISHED", 1, final_reward=3.0))
    assert Runner([CellPlan(experiment, (), (finished,))], plan_kept=plan_kept).run() == 130
    shown = capsys.readouterr()
    assert "FINISHED" in shown.out
    line = shown.err.splitlines()[-1]
    command = "resume --study toys" if plan_kept else "compare toys"
    assert line.startswith("headway: stopped before all rules were played; to play them: ")
    assert line.endswith(f" {command}")


def _interrupted(*_: object) -> NoReturn:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_ctrl_c_keeps_all_resume_continues_and_a_killed_session_leaves_no_process(tmp_path: Path) -> None:
    # Seed 1 waits for seed 0, so one run never starts.
    words = ("seed=0,1", "backend.parallel=1", "backend.workers=2", "store.checkpoint_every=3")
    with headway("run", *TINY, *LONG, *words, folder=tmp_path) as running:
        running.wait_for(lambda: any(row.iterations for row in stored_rows(tmp_path)))
        running.process.send_signal(signal.SIGINT)
        running.wait_for(lambda: running.has_said("Ctrl-C again"))
        running.process.send_signal(signal.SIGTERM)  # belongs to the same request
        assert running.process.wait(PATIENCE_S) == 130
        shown = running.table()
    assert running.has_said("with a checkpoint")
    assert running.has_said("headway resume")
    first = {row.seed: row for row in stored_rows(tmp_path)}
    assert {seed: row.status for seed, row in first.items()} == {0: "KILLED", 1: "KILLED"}
    assert latest_iteration(Path(first[0].directory, CHECKPOINTS)) == first[0].iterations
    assert shown[0]["env steps"] == str(first[0].env_steps)

    with headway("resume", "--study", "default", folder=tmp_path) as running:
        running.wait_for(lambda: any(row.iterations > first[0].iterations for row in stored_rows(tmp_path)))
        children = running.training()
        assert len(children) >= 3  # a training process and two workers
        running.process.kill()
        running.process.wait()
        assert not psutil.wait_procs(children, timeout=20)[1]
    assert sorted((row.seed, row.status) for row in stored_rows(tmp_path)) == [(0, "KILLED"), (1, "KILLED")]


@pytest.mark.slow
def test_a_lost_training_process_prints_one_line_and_the_others_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive = TrainingProcess.receive

    def receive_and_kill_the_first(process: TrainingProcess) -> Event | None:
        event = receive(process)
        if process._process.name == "headway training 0" and isinstance(event, IterationFinished):
            process._process.kill()
        return event

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(TrainingProcess, "receive", receive_and_kill_the_first)
    words = ("env_steps=1e4", "backend=serial", "seed=0,1", "backend.parallel=2")
    told = failed("run", *TINY, *words)
    assert told.count("seed 0 failed: its training process was killed by SIGKILL") == 1
    assert {row.seed: row.status for row in stored_rows(tmp_path)} == {0: "FAILED", 1: "FINISHED"}


def _training_job(*_: object) -> NoReturn:
    raise HeadwayError("the scenario is gone")


def test_a_failed_environment_in_a_file_is_fixed_and_trained_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resuming would refuse the changed file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(SessionCell, "training_job", _training_job)
    (tmp_path / "ring.py").write_text(ENV_FILE)
    lines = failed("run", *TINY, "env=./ring.py", "seed=3", "env_steps=256", "backend=serial").splitlines()
    advice, _, resume = lines[-1].partition("; if the cause lies elsewhere: ")
    assert advice == "headway: fix ring.py, then give the first command again (a changed file is not resumed)"
    assert shlex.split(resume)[1] == "resume"


def test_the_error_of_a_failed_run_is_printed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(SessionCell, "training_job", _training_job)
    lines = failed("run", *TINY, "seed=3", "env_steps=256", "backend=serial").splitlines()
    assert any("to continue, once the cause of the failure is fixed: " in line for line in lines)
    [line] = [line for line in lines if "the scenario is gone" in line]
    told, path = line.split("; see ")
    assert told == "headway: seed 3 failed: the scenario is gone"
    [row] = stored_rows(tmp_path)
    assert Path(path).resolve() == (Path(row.directory) / "traceback.txt").resolve()
    assert "HeadwayError: the scenario is gone" in Path(path).read_text()


def test_bad_input_starts_nothing(empty_folder: Path) -> None:
    assert "algo.lrr" in refused("run", *TINY, "algo.lrr=1")
    assert not list(empty_folder.iterdir())


@pytest.mark.slow
def test_a_second_ctrl_c_kills_at_once_and_the_table_shows_what_is_stored(tmp_path: Path) -> None:
    often = ("store.checkpoint_every=1000000", "evaluation.every=1", "backend=serial")
    with headway("run", *TINY, *LONG, *often, folder=tmp_path) as running:
        running.wait_for(lambda: running.has_said(BEGUN))
        time.sleep(1.0)  # some hundred iterations
        children = running.training()
        children[0].send_signal(signal.SIGSTOP)  # it cannot write the promised checkpoint
        running.process.send_signal(signal.SIGINT)
        running.wait_for(lambda: running.has_said("Ctrl-C again"))
        time.sleep(1.1)  # sooner counts as the same request
        running.process.send_signal(signal.SIGINT)
        assert running.process.wait(PATIENCE_S) == 130
        assert not psutil.wait_procs(children, timeout=5)[1]
        shown = running.table()
    assert running.has_said("training after the last checkpoint is lost")
    assert running.has_said("nothing was kept: no checkpoint was written yet; to start again: .* resume ")
    [row] = stored_rows(tmp_path)
    assert (row.status, row.env_steps, row.final_reward) == ("KILLED", 0, None)
    assert (shown[0]["env steps"], shown[0]["final reward (1 episode)"]) == ("0", "")


def test_after_the_announcement_only_ctrl_c_is_a_second_request(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repeated SIGTERM, or Ctrl-C before the announcement, still leaves time for the promised checkpoint."""
    moments = iter(range(100, 200, 10))
    monkeypatch.setattr("headway_launch.runner.scheduler.time.monotonic", lambda: next(moments))
    with StopRequests() as requests:
        for number in (signal.SIGTERM, signal.SIGTERM, signal.SIGHUP):
            signal.raise_signal(number)
            assert requests.count == 1
        signal.raise_signal(signal.SIGINT)
        requests.acknowledge()
        assert requests.count == 1
        signal.raise_signal(signal.SIGTERM)
        assert requests.count == 1
        signal.raise_signal(signal.SIGINT)
        assert requests.count == 2
