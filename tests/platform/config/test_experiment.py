"""Budgets of experiments."""

from typing import Any

import pytest

from headway.config.experiment import ExperimentConfig
from headway.config.schema import build
from headway.contracts import HeadwayError


def _config(*env_steps: int, **others: Any) -> ExperimentConfig:  # noqa: ANN401 - any key
    stages = [{"env_steps": steps} for steps in env_steps]
    given = {"stages": stages, "env_steps": sum(env_steps), "rollout": {"copies": 4, "steps": 25}, **others}
    return build(ExperimentConfig, given)


def test_a_stage_ends_with_the_iteration_that_reaches_its_last_step() -> None:
    config = _config(150, 250, 30)  # iterations of 100 steps
    assert config.stage_ends == (2, 4, 5)
    assert config.iterations == 5
    assert [config.stage_after(iteration) for iteration in range(6)] == [0, 0, 1, 1, 2, 2]
    plain = build(ExperimentConfig, {"env_steps": 430, "rollout": {"copies": 4, "steps": 25}})
    assert (plain.stage_ends, plain.stage_after(5)) == ((5,), 0)


@pytest.mark.parametrize(
    ("env_steps", "others", "line"),
    [
        (
            (200, 300),
            {"env_steps": 600},
            "env_steps of 600 is not the sum of the stages', 500; set env_steps=500, or",
        ),
        ((200, 30, 20), {}, r"stages must each last an iteration or longer, of 100 steps .rollout.copies x"),
        ((0, 300), {}, r"stages\[0\].env_steps must be at least 1, not 0"),
        (
            (200, 300),
            {"start": {"rule": "fixed", "env_steps": 201}},
            r"start.env_steps of 201 is more than the first stage has, .* raise stages\[0\].env_steps",
        ),
    ],
)
def test_budgets_of_stages_that_do_not_fit_are_refused(
    env_steps: tuple[int, ...], others: dict[str, Any], line: str
) -> None:
    with pytest.raises(HeadwayError, match=line):
        _config(*env_steps, **others)
