"""The view with which MLflow's UI opens a study's runs."""

import json
from pathlib import Path

from headway.store.tracking.client import RUNS_VIEW, Tracker


def test_new_and_old_experiments_have_the_view(tmp_path: Path) -> None:
    tracker = Tracker(tmp_path)
    new, _ = tracker.cell("new", "cell", {}, {})
    old = tracker._ask("create_experiment", "old")
    for _ in range(2):
        tracker.add_view(old)
    for experiment in (new, old):
        tags = tracker._ask("get_experiment", experiment).tags
        view = json.loads(tags[f"mlflow.sharedViewState.{RUNS_VIEW}"])
        assert "metrics.`summary/final_reward`" in view["selectedColumns"]
        assert view["orderByKey"] in view["selectedColumns"]
        assert tags["mlflow.experimentKind"] == "custom_model_development"
