"""The scripts of `headway sweep --slurm` work in a real Slurm; small version of the trial."""

from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path

import pytest

from headway.contracts import HeadwayError
from tests.trials.slurm_jobs import STUDY, TURNS, slurm, trial
from tests.trials.two_nodes import SMALL

pytestmark = pytest.mark.cluster


@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_slurm_jobs_give_the_study_of_one_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ("env_steps=1024", "evaluation.rules=[]", "evaluation.modes=[greedy]", "energy=off")
    root = tmp_path / "a store, 50% #1"
    with ExitStack() as stack:
        try:
            jobs = stack.enter_context(slurm())
        except HeadwayError as error:
            pytest.skip(str(error))
        assert trial(jobs, root, (*SMALL, f"study={STUDY}", *settings), tuple(TURNS)) == []
    told = capsys.readouterr().out
    assert "cluster: COMPLETED" in told
    assert "array: COMPLETED" in told
    assert "failed: FAILED" in told
    assert "cancelled: CANCELLED" in told
    assert (root / "array" / STUDY / "slurm" / "array.sbatch").exists()
