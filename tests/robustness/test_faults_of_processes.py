"""A kill, a misbehaving environment and a storage fault end as they should; a planted loss is noticed."""

import json
import random
import shutil
import signal
import sqlite3
from contextlib import ExitStack
from pathlib import Path

import pytest

from headway.store.index import RunIndex
from tests.robustness.environments import Case, install_module, run_case
from tests.robustness.kills import BASE, STUDIES, Disturbance, DisturbedStudy, compared, undisturbed
from tests.robustness.outcomes import Outcome
from tests.robustness.storage import size_limit

pytestmark = pytest.mark.slow


def test_a_disturbed_study_equals_the_undisturbed_one_and_losses_are_noticed(tmp_path: Path) -> None:
    sweep = [*STUDIES["workers"], *BASE, "seed=0,1", "env_steps=2400"]
    table, whole = undisturbed(sweep, tmp_path / "whole"), tmp_path / "whole" / "runs"
    disturbed = DisturbedStudy(sweep, tmp_path / "disturbed", random.Random(1))
    disturbed.session(["sweep", *sweep], [Disturbance("rollout worker", signal.SIGKILL)])
    assert disturbed.outcomes == [Outcome.ACCEPTED]
    assert "SIGKILL to rollout worker" in disturbed.history
    assert compared(disturbed.table, disturbed.root, table, whole) == []

    # A lost row, points sent at another step, another result and a run twice.
    first, second = RunIndex(disturbed.root).rows()
    next(Path(first.directory).glob("curve-*.parquet")).unlink()
    with sqlite3.connect(disturbed.root / "mlflow.db") as database:
        database.execute("UPDATE metrics SET step = step + 1 WHERE key LIKE 'policy/%'")
    shutil.copytree(second.directory, f"{second.directory}-again")
    summary = Path(first.directory, "summary.json")
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"final_reward": 1.0}))
    found = "\n".join(compared(disturbed.table, disturbed.root, table, whole))
    for line in ("curve differ", "MLflow's curves differs", "has 2 runs", "results differ"):
        assert line in found


def test_an_environment_that_ends_the_session_is_one_clear_line(tmp_path: Path) -> None:
    install_module(tmp_path)
    case = Case("sys.exit(5)", "constructor", 1, once=False, spares_session=False, backend="process")
    outcome, why, _ = run_case(case, tmp_path, tmp_path / "case")
    assert outcome is Outcome.CLEAR, why
    assert "sys.exit(5)" in why


def test_a_store_whose_files_cannot_grow_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    with ExitStack() as kept:
        end = size_limit(tmp_path, random.Random(1), kept, blocks=2)
    assert end.outcome is Outcome.CLEAR, end.how
