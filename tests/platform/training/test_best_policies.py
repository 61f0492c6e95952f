"""The best policies of a training are kept, whatever the order of evaluations and interruptions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import job_of, trained

from headway.contracts import HeadwayError
from headway.store.checkpoint import load_latest, save_checkpoint, stored_parameters
from headway.store.parquet_log import read_rows
from headway.training.best_policies import BestPolicies


def _parameters(value: float) -> dict[str, np.ndarray]:
    """Two seeds with three policies each; the second seed's are 100 higher."""
    return {"weight": value + np.repeat([0.0, 100.0], 3)[:, None], "bias": value + np.repeat([0.0, 100.0], 3)}


def test_each_seed_keeps_its_own_best() -> None:
    best = BestPolicies(2)
    offers = {0: (1.0, 5.0), 4: (3.0, 4.0), 8: (2.0, 6.0), 12: (3.0, np.nan)}
    for iteration, returns in offers.items():
        best.offer(returns, iteration, _parameters(iteration))
    assert best.returns.tolist() == [3.0, 6.0]
    assert best.iterations.tolist() == [4, 8]  # the first of equals
    assert best.parameters["bias"].tolist() == [4, 4, 4, 108, 108, 108]
    assert best.parameters["weight"].tolist() == [[4], [4], [4], [108], [108], [108]]


def test_arrays_that_are_changed_in_place_are_copied() -> None:
    best, parameters = BestPolicies(2), _parameters(0.0)
    best.offer((1.0, 1.0), 0, parameters)
    parameters["bias"] += 7
    assert best.parameters["bias"].tolist() == [0, 0, 0, 100, 100, 100]


def test_a_checkpoint_holds_the_policies_of_the_evaluation_with_the_highest_return(tmp_path: Path) -> None:
    job = job_of(tmp_path, seeds=(5, 6))
    held: dict[int, dict[str, np.ndarray]] = {}
    trained(job)
    for iteration in (2, 4, 6):  # the same training, ended at each evaluation
        short = job_of(tmp_path / str(iteration), seeds=(5, 6), iterations=iteration)
        trained(short)
        held[iteration] = load_latest(*short.checkpoints)[1]["acting"]
    for place, directory in enumerate(job.directories):
        rows = read_rows(Path(directory), "curve")
        returns = {int(row["iteration"]): row.get("evaluation_greedy/return") for row in rows}
        curve = {iteration: float(value) for iteration, value in returns.items() if value is not None}
        expected = max(curve, key=lambda iteration: (curve[iteration], -iteration))
        found, parameters, _ = stored_parameters(
            Path(directory), job.plan.policy, job.seeds[place], job.seeds, "visitors", best=True
        )
        assert found == expected
        assert expected > 0
        for name, array in parameters.items():
            np.testing.assert_array_equal(array, np.split(held[expected][name], 2)[place])


def test_a_resumed_training_keeps_the_best_of_before(tmp_path: Path) -> None:
    """Its stored return is made so high that no later evaluation reaches it."""
    job = job_of(tmp_path)
    trained(job, stop_after=3)
    iteration, state, _ = load_latest(*job.checkpoints)
    state["best"]["returns"][:], state["best"]["iterations"][:] = np.inf, 2
    save_checkpoint(job.checkpoints[0], iteration, state)
    trained(replace(job, resume=True))
    best = load_latest(*job.checkpoints)[1]["best"]
    assert best["iterations"].tolist() == [2]
    for name, array in state["best"]["acting"].items():
        np.testing.assert_array_equal(best["acting"][name], array)


def test_a_checkpoint_without_them_is_one_line(tmp_path: Path) -> None:
    job = job_of(tmp_path)
    trained(job)
    _, state, _ = load_latest(*job.checkpoints)
    del state["best"]
    save_checkpoint(job.checkpoints[0], 7, state)
    with pytest.raises(HeadwayError, match="do not hold its best policies: it was trained with an earlier"):
        stored_parameters(Path(job.directories[0]), job.plan.policy, 5, job.seeds, "visitors", best=True)
