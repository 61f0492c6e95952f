"""Notices before training."""

from dataclasses import replace
from pathlib import Path

import pytest

from headway.config.experiment import EnvConfig
from headway_launch.console.output import distinct_notices
from headway_launch.experiments.compose import compose
from headway_launch.experiments.notices import print_notices

SHORT = ("evaluation.every=5_000", "evaluation.final_episodes=10")


@pytest.mark.parametrize(
    ("words", "lines"),
    [
        (["env=bus"], ["no algo is named: algo=mappo, with preset=default_bus (`headway list algos`)"]),
        (["env=trivial"], ["no algo is named: algo=mappo (`headway list algos`)"]),
        (["experiment=bus_mappo"], []),
        (
            ["experiment=bus_mappo", "env_steps=30_000", SHORT[1]],
            [
                "evaluation.every=45_600 is not below env_steps=30_000: the curve has two points, before and "
                "after training; set evaluation.every=5_000"
            ],
        ),
        (["experiment=bus_mappo", "env_steps=30_000", *SHORT], []),
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
    with distinct_notices():
        print_notices(words, [experiment, experiment])
    printed = capsys.readouterr().err.splitlines()
    assert [line for line in printed if "steps per run" not in line] == [f"headway: {line}" for line in lines]


def test_the_extent_of_a_run_is_said_with_its_rounding_and_its_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["env=trivial", "algo=ippo", "rollout.copies=4", "rollout.block=4", "rollout.steps=50"]
    words += ["evaluation.every=300", SHORT[1]]
    args = {"scenario": str(tmp_path), "none": "", "too_long": "x" * 300}
    few = replace(compose([*words, "env_steps=100"]).config, env=EnvConfig("e", args))
    many = compose([*words, "env_steps=1000"])
    with distinct_notices():
        print_notices(["algo=ippo"], [replace(many, config=few), many, many])
    of = "(rollout.copies x rollout.steps)"
    assert capsys.readouterr().err.splitlines() == [
        f"headway: 200 steps per run (env_steps=100 rounded up), in 1 iteration of 200 {of}, 2 evaluations, "
        f"the last with 2 rules, on 10 episodes each; env.args.scenario={tmp_path}",
        f"headway: 1,000 steps per run, in 5 iterations of 200 {of}, 4 evaluations, "
        "the last with 2 rules, on 10 episodes each",
    ]


def test_the_evaluations_counted_are_those_of_training() -> None:
    words = ["env=trivial", "algo=ippo", "rollout.copies=1", "rollout.block=1", "rollout.steps=50"]
    words += ["evaluation.every=120", "stages=[{env_steps: 100}, {env_steps: 400}]", "env_steps=500"]
    config = compose(words).config
    # Multiples of 120 are reached or passed at 150, 250, 400 and 500, and a stage ends at 100.
    assert [each for each in range(1, 11) if config.evaluates_after(each)] == [2, 3, 5, 8, 10]


@pytest.mark.parametrize("every", [30, 50, 120, 1000])
def test_evaluations_are_counted_without_a_walk_over_all_iterations(every: int) -> None:
    words = ["env=trivial", "algo=ippo", "rollout.copies=1", "rollout.block=1", "rollout.steps=50"]
    words += [f"evaluation.every={every}", "stages=[{env_steps: 130}, {env_steps: 370}]", "env_steps=500"]
    config = compose(words).config
    for iteration in range(11):
        walked = sum(map(config.evaluates_after, range(1, iteration + 1)))
        assert config.evaluations_until(iteration) == walked
    endless = replace(config, env_steps=10**15, stages=())
    assert endless.evaluations_until(endless.iterations) == 10**15 // max(every, 50)
