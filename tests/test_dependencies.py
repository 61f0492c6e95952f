"""What Headway requires is enough for all commands but `headway browse`, which names its extra."""

from pathlib import Path

import pytest
from linked_packages import link_packages, run_with_packages

TINY = ("seed=0", "env_steps=256", "rollout.copies=4", "rollout.block=2", "rollout.steps=16")


@pytest.mark.slow
def test_the_required_packages_are_enough_for_all_but_browse(tmp_path: Path) -> None:
    link_packages(tmp_path, ["headway"])

    def headway(*words: str) -> str:
        ended = run_with_packages(tmp_path, "-m", "headway_launch", *words)
        assert ended.returncode == 0, ended.stderr
        assert "MLflow" not in ended.stderr
        return ended.stdout

    assert "FINISHED" in headway("run", "experiment=toy_trivial", "study=tiny", *TINY)
    assert "FINISHED" in headway("runs")
    assert "optimal" in headway("compare", "tiny")
    assert "optimal" in headway("evaluate", "trivial", "--episodes", "2")
    assert headway("report", "tiny").strip().endswith(".html")
    assert (tmp_path / "runs" / "mlflow.db").is_file()
    headway("sync")
    refused = run_with_packages(tmp_path, "-m", "headway_launch", "browse")
    assert refused.returncode == 2
    assert refused.stderr.strip().endswith('pip install "headway[browse]"')
