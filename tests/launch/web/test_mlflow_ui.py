"""MLflow's UI, read-only: SQLite itself refuses changes, whatever request comes through."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import OperationalError

from headway.store.tracking.client import Tracker, database_path
from headway_launch.web.mlflow_ui import read_only_uri

DELETE = """
import sys
from pathlib import Path
from werkzeug.test import Client
from headway_launch.web.mlflow_ui import ReadOnlyUI

behind_the_list = Client(ReadOnlyUI(Path(sys.argv[1]))._application)
for name in ("search", "delete"):
    answer = behind_the_list.post(
        f"/mlflow/api/2.0/mlflow/experiments/{name}",
        data=sys.argv[2],
        content_type="application/json",
        base_url="http://127.0.0.1:5000",
    )
    print(name, answer.status_code, "readonly" in answer.text)
"""


@pytest.mark.slow
def test_a_write_that_passed_the_list_of_reads_would_fail(tmp_path: Path) -> None:
    tracker = Tracker(tmp_path)
    experiment, _ = tracker.cell("study", "cell", {}, {})
    body = json.dumps({"experiment_id": experiment, "max_results": 1})
    done = subprocess.run(
        [sys.executable, "-c", DELETE, str(tmp_path), body], capture_output=True, text=True, check=True
    )
    assert done.stdout.split("\n")[:2] == ["search 200 False", "delete 503 True"]
    assert tracker._ask("get_experiment", experiment).lifecycle_stage == "active"


@pytest.mark.slow
def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    root = tmp_path / "50% of what? #1 é"
    Tracker(tmp_path)
    root.mkdir()
    database_path(tmp_path).rename(database_path(root))
    with create_engine(read_only_uri(database_path(root))).connect() as connection:
        assert connection.execute(text("SELECT count(*) FROM experiments")).scalar() == 1
        with pytest.raises(OperationalError, match="readonly"):
            connection.execute(text("DELETE FROM experiments"))
