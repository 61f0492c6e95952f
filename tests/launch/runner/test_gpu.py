"""Sessions that train on a GPU."""

import json
from pathlib import Path

import pytest
from command_lines import output
from gpu import needs_gpu
from small_runs import SMALL, end_as

from headway.config.experiment import StoreConfig
from headway.store.index import RunIndex
from headway_launch.commands.main import run

pytestmark = [needs_gpu, pytest.mark.slow]
TINY = (
    "env=trivial", "algo=mappo", *SMALL, "env_steps=192", "env.args.agents=2", "env.args.steps=20",
    "device=cuda",
)  # fmt: skip


@pytest.mark.parametrize("backend", ["serial", "process"])
def test_a_session_trains_a_stack_of_seeds_on_a_gpu_and_resumes_it(backend: str, empty_folder: Path) -> None:
    assert run(["run", *TINY, "energy=codecarbon", f"backend={backend}", "backend.stack=2", "seed=0,1"]) == 0
    runs = RunIndex(Path(StoreConfig().root)).rows()
    assert [row.status for row in runs] == ["FINISHED", "FINISHED"]
    summaries = [Path(row.directory, "summary.json") for row in runs]
    first = [json.loads(summary.read_text()) for summary in summaries]
    assert all(summary["kwh"] > 0 for summary in first)
    for row in runs:
        end_as(row.directory)
    assert run(["resume", *(row.run_id for row in runs)]) == 0
    again = [json.loads(summary.read_text()) for summary in summaries]
    assert [summary["final_reward"] for summary in again] == [summary["final_reward"] for summary in first]


def test_what_a_gpu_imitated_and_trained_starts_another_run_and_is_evaluated(empty_folder: Path) -> None:
    by_rule = ["start.rule=optimal", "start.env_steps=640", "env_steps=704"]
    assert run(["run", *TINY, *by_rule, "backend=serial"]) == 0
    (parent,) = RunIndex(Path(StoreConfig().root)).rows()
    assert run(["run", *TINY, f"start.run={parent.run_id}", "backend=serial", "study=next"]) == 0
    assert "return" in output("evaluate", parent.run_id, "--episodes", "2").out
