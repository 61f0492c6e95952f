"""Comparison of a study with BusEnv's published table."""

from collections.abc import Callable
from pathlib import Path

import pytest
from covering import quick_or_slow
from sections import section_of, tables, words

from headway_launch.experiments.compose import compose
from headway_launch.report.elements import Section
from headway_launch.report.published.bus_published import bus_published_section
from headway_launch.report.published.episode_metrics import published_values

TABLE3 = "experiment=bus_table3"
NINE = ("coma", "happo", "hatrpo", "ia2c", "ippo", "itrpo", "maa2c", "mappo", "matrpo")
RULES = {"random": -140.0, "always_move": 14.0, "always_wait": -108.0, "move_with_service": 97.0}
Keep = Callable[..., Path]


def section(root: Path) -> Section:
    return section_of(root, bus_published_section)


def test_all_nine_algorithms_have_published_values() -> None:
    published = published_values("bus_published")
    assert sorted(published.index) == sorted(NINE)
    assert published.loc["happo", "final_reward"] == -506.84
    assert published.loc["mappo", "auc"] == 0.924
    assert published["kwh"].count() == 4


@pytest.mark.parametrize("algorithm", quick_or_slow({name: (name,) for name in NINE}, "mappo", "hatrpo"))
def test_the_study_has_the_published_settings(algorithm: str) -> None:
    experiment = compose([TABLE3, f"algo={algorithm}"])
    config, algo = experiment.config, experiment.algo_config
    assert (len(config.seed), config.env_steps) == (50, 400_000)
    assert config.rollout.copies * config.rollout.steps == 1000
    assert (algo.policies, algo.model.hidden) == ("independent", (128, 128))
    assert (experiment.env_config.agents, experiment.env_config.reward.scope) == (5, "own")
    assert len(config.seed) % config.backend.stack == 0


def test_training_rewards_are_summed_over_buses_and_ranked(keep_run: Keep, root: Path) -> None:
    """In the fixture the training curve has half of the evaluation's values."""
    for algorithm, final, kwh in (("maa2c", 16.0, 1e-3), ("ippo", 14.0, 2e-3), ("coma", -20.0, 5e-3)):
        for seed in range(2):
            energy = {"kwh": kwh, "kg_co2": kwh / 10}
            keep_run((TABLE3, f"algo={algorithm}"), seed, final + seed, rules=RULES, energy=energy)
    found = section(root)
    rows = tables(found)["busenv_table3"].exact.set_index("algorithm")
    assert rows.loc["maa2c", "final_reward"] == pytest.approx(5 * 16.5 / 2)
    assert rows.loc["maa2c", "final_reward_published"] == 77.41
    assert rows["final_reward_rank"].to_dict() == {"maa2c": 1.0, "ippo": 2.0, "coma": 3.0}
    assert rows["final_reward_published_rank"].to_dict() == {"maa2c": 1.0, "ippo": 6.0, "coma": 8.0}
    headings = tables(found)["busenv_table3"].headings
    assert len(set(headings)) == len(headings)
    caption = tables(found)["busenv_table3"].caption
    assert "published ranks are among all 9 algorithms, ours among the 3 of this table" in caption
    ranks = tables(found)["busenv_ranks"].exact.set_index("metric")
    assert ranks.loc["final_reward", ["spearman", "kendall"]].tolist() == pytest.approx([1.0, 1.0])
    assert ranks.loc["kwh", "spearman"] == pytest.approx(1.0)
    assert ranks.loc["auc", "algorithms"] == 3
    said = words(found)
    assert "The rule that always moves earns 77.50 here" in said  # 5 buses, days of 14 to 17
    assert "1 of 3 learners are within 5% of it (ippo)" in said
    assert "earns 492.5. So always moving is not optimal." in said
    assert "copies of one run" in said
    assert "64 cores and 5 GPUs" in said
    assert "During training" not in said
    assert "9 published algorithms, each with 50 seeds, 3 have finished runs here, with 2 seeds each" in said
    assert "there are no finished runs of happo, hatrpo, ia2c, itrpo, mappo, matrpo." in said
    assert "No rank correlation" not in said
    assert "same policy" not in said
    assert "averaged only over" not in said
    assert "+1.00 (0.33)" in tables(found)["busenv_ranks"].rows[0]


def test_ends_of_training_curves_stand_beside_those_of_the_released_runs(keep_run: Keep, root: Path) -> None:
    """In the fixture the training curve climbs from 0 to half of the final value."""
    for algorithm, final in (("maa2c", 16.0), ("ia2c", 10.0)):
        for seed in range(2):
            keep_run((TABLE3, f"algo={algorithm}"), seed, final + seed)
    table = tables(section(root))["busenv_rows"]
    exact = table.exact.set_index("controller")
    assert exact.loc["maa2c", ["first", "last"]].tolist() == pytest.approx([0.0, 5 * 16.5 / 2])
    assert exact.loc["maa2c", "last_std"] == pytest.approx(5 * 0.5 / 2 * 2**0.5)
    assert exact.loc["maa2c", ["first_reward_published", "last_reward_published"]].tolist() == [
        -517.23,
        77.05,
    ]
    assert {row[0]: row[1] for row in table.rows} == {"ia2c": "\N{EN DASH}", "maa2c": "-517.2"}


def test_seeds_without_a_value_are_counted(keep_run: Keep, root: Path) -> None:
    keep_run((TABLE3, "algo=coma"), 0, 10.0)
    for seed, trained in enumerate(((0, 2, 4), (1, 3), ())):
        keep_run((TABLE3, "algo=ippo"), seed, 10.0, trained=trained)
    found = section(root)
    ippo = tables(found)["busenv_table3"].exact.set_index("algorithm").loc["ippo"]
    assert ippo[["seeds", "final_reward_seeds", "auc_seeds"]].tolist() == [3, 2, 1]
    said = words(found)
    assert (
        "final reward is averaged only over seeds in which episodes ended during training: ippo (2 of 3)."
        in said
    )
    assert (
        "AUC is averaged only over seeds with at least 3 points in the training curve: ippo (1 of 3)." in said
    )


def test_two_algorithms_or_two_settings_of_one_have_no_correlation(keep_run: Keep, root: Path) -> None:
    for overrides in (("algo=ippo",), ("algo=ippo", "algo.lr=0.01"), ("algo=coma",)):
        keep_run((TABLE3, *overrides), 0, 10.0)
    found = section(root)
    assert len(tables(found)["busenv_table3"].rows) == 3
    assert tables(found)["busenv_ranks"].exact["spearman"].isna().all()
    said = words(found)
    assert "trained with several settings: ippo." in said
    assert "No rank correlation is given for final reward, AUC, energy per run: it needs at least 3" in said
    assert "The rule that always moves" not in words(found)  # no rule was run


def test_other_algorithms_have_no_such_table(keep_run: Keep, root: Path) -> None:
    keep_run((TABLE3, "algo=madqn", "preset=none", "rollout.steps=32"), 0, 10.0)
    assert "None of the published algorithms was trained." in words(section(root))


@pytest.mark.parametrize("value", [13.0, 14.0])
def test_visits_that_bring_no_more_than_moving_do_not_pay(keep_run: Keep, root: Path, value: float) -> None:
    keep_run((TABLE3, "algo=ippo"), 0, 14.0, rules={**RULES, "move_with_service": value})
    said = words(section(root))
    assert f"earns {5 * (value + 1.5):.2f}. So such visits do not pay here." in said
    assert "not optimal" not in said


@pytest.mark.parametrize(("visits", "never"), [((0.0, 0.0), True), ((0.0, 2.0), False), ((), False)])
def test_learners_that_earn_more_with_sampled_actions_are_named(
    keep_run: Keep, root: Path, visits: tuple[float, ...], never: bool
) -> None:
    """In the fixture training earns half of a loss of 20, which is what always moving loses here. That they
    never visited the service centre is said if no day of any seed has a visit."""
    rules = {**RULES, "always_move": -20.0}
    for seed in range(2):
        metrics = {"service_visits": visits[seed]} if visits else {}
        keep_run((TABLE3, "algo=maa2c"), seed, -20.0, rules=rules, **metrics)
        keep_run((TABLE3, "algo=ippo"), seed, 30.0, rules=rules, **metrics)
    said = words(section(root))
    assert "During training, with sampled actions, maa2c exceeded that rule" in said
    assert ("With greedy actions, maa2c never visited the service centre" in said) == never


MOVING = {"moves": 9.0, "waits": 0.0, "service_visits": 0.0, "services_refused": 0.0}


def test_learners_that_always_move_have_learned_the_same_policy(keep_run: Keep, root: Path) -> None:
    """This also holds if the days of seeds differ, as the service centre may."""
    for seed in range(2):
        keep_run((TABLE3, "algo=ippo"), seed, 14.0 + seed, **MOVING)
        keep_run((TABLE3, "algo=ia2c"), seed, 14.0 + seed, **MOVING)
        keep_run((TABLE3, "algo=coma"), seed, 14.0 + seed, **{**MOVING, "waits": float(seed)})
    said = words(section(root))
    assert "ia2c, ippo always moved, with every seed on every day" in said
    assert "as far as those days show" not in said


@pytest.mark.parametrize(("last", "same"), [(14.0, True), (14.0 + 1e-12, False)])
def test_learners_with_identical_days_have_learned_the_same_policy(
    keep_run: Keep, root: Path, last: float, same: bool
) -> None:
    keep_run((TABLE3, "algo=ippo"), 0, 14.0)
    keep_run((TABLE3, "algo=ia2c"), 0, 14.0)
    keep_run((TABLE3, "algo=ia2c"), 1, last)
    said = words(section(root))
    assert ("ia2c, ippo have the same reward to the last digit, with every seed on every day" in said) == same
    assert "with 1 to 2 seeds; there are no finished runs of coma," in said
