"""Notices before training."""

import pytest

from headway_launch.experiments.compose import compose
from headway_launch.experiments.notices import print_notices


@pytest.mark.parametrize(
    ("words", "lines"),
    [
        (["env=bus"], ["no algo is named: algo=mappo, with preset=default_bus (`headway list algos`)"]),
        (["env=trivial"], ["no algo is named: algo=mappo (`headway list algos`)"]),
        (["experiment=bus_mappo"], []),
        (
            ["experiment=bus_mappo", "env_steps=30_000"],
            [
                "evaluation.every=45_600 is not below env_steps=30_000: the curve has two points, before and "
                "after training; set evaluation.every=5_000"
            ],
        ),
        (["experiment=bus_mappo", "env_steps=30_000", "evaluation.every=5_000"], []),
        (
            ["env=bus", "algo=mappo", "evaluation.final_episodes=5"],
            [
                "evaluation.final_episodes=5 becomes 10, since the last evaluation includes the episodes of "
                "all others; lower evaluation.episodes too for fewer"
            ],
        ),
        (["env=bus", "algo=mappo", "evaluation.episodes=50"], []),
    ],
)
def test_what_was_defaulted_or_has_no_effect_is_said_once(
    words: list[str], lines: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    experiment = compose(words)
    print_notices(words, [experiment, experiment])
    assert capsys.readouterr().err.splitlines() == [f"headway: {line}" for line in lines]
