"""The lines below the table of results."""

from pathlib import Path

import pytest

from headway.config.experiment import EvaluationConfig
from headway.contracts import HeadwayError
from headway.store.parquet_log import RunLog
from headway.store.run_folder import Process, RunRecord, now
from headway_launch.runner.results import SeedResult, _print_unchanged, last_evaluation


def _result(directory: Path) -> SeedResult:
    started, session = now(), Process.current()
    record = RunRecord("run-3", "study", "bus", "ippo", 3, 2, started, session, status="FINISHED")
    return SeedResult(directory, record, {"final_reward": 89.9})


@pytest.mark.parametrize(
    ("greedy", "line"),
    [
        (
            [89.9, 89.9, 89.9],
            "seed 3: greedy return 89.9 in all 3 evaluations, also before training, so its actions seem "
            "unchanged; sampled return from -5 to 7; to learn more, raise env_steps or algo.lr\n",
        ),
        ([89.9, 89.9, 90.0], ""),
        ([89.9], ""),
        ([float("nan"), 89.9, 89.9], ""),
    ],
)
def test_a_policy_whose_greedy_actions_have_not_changed_is_named(
    tmp_path: Path, greedy: list[float], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Name a run that looks dead although training changes the probabilities of its actions."""
    log, sampled = RunLog(tmp_path), [-5.0, 0.0, 7.0]
    for iteration, values in enumerate(zip(greedy, sampled, strict=False)):
        returns = dict(zip(("evaluation_greedy/return", "evaluation_sampled/return"), values, strict=True))
        log.append("curve", [{"iteration": iteration, "env_steps": 10 * iteration, "wall_s": 1.0, **returns}])
    log.commit(len(greedy))
    result = _result(tmp_path)
    _print_unchanged([result], ("greedy", "sampled"))
    assert capsys.readouterr().err == line


def test_a_finished_seed_without_last_episodes_is_named(tmp_path: Path) -> None:
    """A damaged log: its rows are of a mode that does not exist."""
    log = RunLog(tmp_path)
    log.append(
        "evaluation", [{"iteration": 1, "env_steps": 8, "mode": "1e308", "final": 1, "episode_seed": 0}]
    )
    log.commit(1)
    result = _result(tmp_path)
    with pytest.raises(
        HeadwayError, match=f"^{tmp_path}: greedy episodes of the last evaluation are missing"
    ):
        last_evaluation(EvaluationConfig(), [result])
