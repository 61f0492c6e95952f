"""The grammar of sweeps: the cells that a command line describes."""

import pytest

from headway.contracts.errors import HeadwayError
from headway_launch.experiments.sweep import combinations, compose_sweep
from headway_launch.studies.plan import cell_labels, distinct


def test_every_combination_is_a_cell_and_seeds_stay_together() -> None:
    chosen = combinations(
        ["algo=ippo,ia2c", "algo.lr=choice(1e-3,3e-4)", "rollout.steps=range(8,10)", "seed=0..2"]
    )
    assert len(chosen) == 8
    assert chosen[0] == ("algo=ippo", "algo.lr=0.001", "rollout.steps=8", "seed=0..2")
    assert chosen[1] == ("algo=ippo", "algo.lr=0.001", "rollout.steps=9", "seed=0..2")
    assert chosen[-1] == ("algo=ia2c", "algo.lr=0.0003", "rollout.steps=9", "seed=0..2")


@pytest.mark.parametrize(
    ("override", "values"),
    [
        ("algo=glob(*a2c)", ["algo=ia2c", "algo=maa2c"]),
        ("seed=choice(3,5)", ["seed=3,5"]),
        ("seed=range(0,4)", ["seed=range(0,4)"]),
        ("env.wrappers=[{name: frame_stack_v1, stack_size: 4}]", None),
        ("evaluation.rules=[random],[optimal]", ["evaluation.rules=[random]", "evaluation.rules=[optimal]"]),
        ("env=trivial,mpe2.simple_spread_v3", ["env=trivial", "env=mpe2.simple_spread_v3"]),
        ("~algo.lr", None),
    ],
)  # fmt: skip
def test_values_of_sweep_overrides(override: str, values: list[str] | None) -> None:
    assert combinations([override]) == [(value,) for value in values or [override]]


def test_cells_are_named_by_their_differences() -> None:
    experiments = compose_sweep(["env=trivial", "algo=ippo,ia2c", "algo.lr=1e-3,3e-4", "seed=0..4"])
    assert [experiment.config.seed for experiment in experiments] == [(0, 1, 2, 3, 4)] * 4
    assert cell_labels(experiments) == [
        "ippo, algo.lr=0.001", "ippo, algo.lr=0.0003", "ia2c, algo.lr=0.001", "ia2c, algo.lr=0.0003",
    ]  # fmt: skip
    assert cell_labels(experiments[::2]) == ["ippo", "ia2c"]
    assert cell_labels(experiments[:1]) == [""]
    wrapped = compose_sweep(["env=trivial", "algo=ippo", "env.wrappers=[],[clip_reward_v0]"])
    assert cell_labels(wrapped)[0] == "ippo, without env.wrappers"  # the store's name too


def test_cells_of_several_presets_are_named_by_these() -> None:
    cells = compose_sweep(["experiment=merge_study", "preset=merge_tuned,merge_paper", "algo=mappo"])
    assert cell_labels(cells) == ["mappo merge_tuned", "mappo merge_paper"]


def test_a_repeated_cell_is_merged() -> None:
    twice = compose_sweep(["env=trivial", "algo=ippo,ippo", "seed=0..4"])
    assert len(distinct(twice)) == 1


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("algo.epochs=range(3,0)", "has no values to sweep"),
        ("algo.epochs=range(0,10000000)", "at most 1,000 combinations"),
        ("algo.epochs=range(0,1,0)", "must not be zero"),
        ("store.root=a,b", "store takes one value per sweep"),
        ("backend.parallel=1,2", "backend.parallel takes one value"),
        ("algo.lr=interval(0,1)", "has no values to sweep; write KEY=a,b"),
        ("algo=glob(x*)", "matches nothing"),
        ("algo=ippo,mapo", "did you mean algo=mappo?"),
    ],
)
def test_invalid_sweeps_are_refused(override: str, part: str) -> None:
    with pytest.raises(HeadwayError, match=part.replace("?", r"\?")):
        compose_sweep(["env=trivial", override])
