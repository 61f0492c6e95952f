"""The section beside BusEnv's published table."""

from collections.abc import Callable
from pathlib import Path

import pytest
from sections import section_of, tables, words

from headway_launch.report.parts import Section
from headway_launch.report.published.busenv import busenv_section, published_figures
from headway_launch.report.study_data import StudyData

TABLE3 = "experiment=bus_table3"
RULES = {"random": -140.0, "always_move": 14.0, "always_wait": -108.0, "move_with_service": 97.0}
Keep = Callable[..., Path]


def section(root: Path) -> Section:
    return section_of(root, busenv_section)


def test_the_nine_are_there_with_what_was_published() -> None:
    published = published_figures()
    assert sorted(published.index) == sorted(
        ["coma", "happo", "hatrpo", "ia2c", "ippo", "itrpo", "maa2c", "mappo", "matrpo"]
    )
    assert published.loc["happo", "final_reward"] == -506.84
    assert published.loc["mappo", "auc"] == 0.924
    assert published["kwh"].count() == 4


def test_figures_are_of_training_summed_over_buses_and_ranked(keep_run: Keep, root: Path) -> None:
    """In the fixture the training curve has half of the evaluation's values."""
    for algorithm, final, kwh in (("maa2c", 16.0, 1e-3), ("ippo", 14.0, 2e-3), ("coma", -20.0, 5e-3)):
        for seed in range(2):
            energy = {"kwh": kwh, "kg_co2": kwh / 10}
            keep_run((TABLE3, f"algo={algorithm}"), seed, final + seed, rules=RULES, energy=energy)
    found = section(root)
    rows = tables(found)["busenv_table3"].data.set_index("algorithm")
    assert rows.loc["maa2c", "final_reward"] == pytest.approx(5 * 16.5 / 2)
    assert rows.loc["maa2c", "final_reward_published"] == 77.41
    assert rows["final_reward_rank"].to_dict() == {"maa2c": 1.0, "ippo": 2.0, "coma": 3.0}
    assert rows["final_reward_published_rank"].to_dict() == {"maa2c": 1.0, "ippo": 6.0, "coma": 8.0}
    caption = tables(found)["busenv_table3"].caption
    assert "published ones are among all 9 algorithms, ours among the 3 of this table" in caption
    ranks = tables(found)["busenv_ranks"].data.set_index("figure")
    assert ranks.loc["final_reward", ["spearman", "kendall"]].tolist() == pytest.approx([1.0, 1.0])
    assert ranks.loc["kwh", "spearman"] == pytest.approx(1.0)
    assert ranks.loc["auc", "algorithms"] == 3
    said = words(found)
    assert "A rule that always moves comes to 77.50 here" in said  # 5 buses, days of 14 to 17
    assert "1 of 3 learners come within 5% of that (ippo)" in said
    assert "comes to 492.5. So always moving is not the best there is." in said
    assert "not public in full" in said
    assert "64 cores and 5 GPUs" in said
    assert "While training" not in said
    assert "9 algorithms published, each with 50 seeds, 3 have finished runs here, with 2 seeds each" in said
    assert "none of happo, hatrpo, ia2c, itrpo, mappo, matrpo has finished." in said
    assert "no correlation" not in said
    assert "same policy" not in said
    assert "those seeds only" not in said
    assert "+1.00 (0.33)" in tables(found)["busenv_ranks"].rows[0]


def test_figures_that_some_seeds_do_not_have_are_counted(keep_run: Keep, root: Path) -> None:
    keep_run((TABLE3, "algo=coma"), 0, 10.0)
    for seed, trained in enumerate(((0, 2, 4), (1, 3), ())):
        keep_run((TABLE3, "algo=ippo"), seed, 10.0, trained=trained)
    found = section(root)
    ippo = tables(found)["busenv_table3"].data.set_index("algorithm").loc["ippo"]
    assert ippo[["seeds", "final_reward_seeds", "auc_seeds"]].tolist() == [3, 2, 1]
    said = words(found)
    assert "final reward is over those seeds only in which episodes ended in training: ippo (2 of 3)." in said
    assert "AUC is over those seeds only whose training curve has at least 3 points: ippo (1 of 3)." in said


def test_two_algorithms_or_two_settings_of_one_have_no_correlation(keep_run: Keep, root: Path) -> None:
    for overrides in (("algo=ippo",), ("algo=ippo", "algo.lr=0.01"), ("algo=coma",)):
        keep_run((TABLE3, *overrides), 0, 10.0)
    found = section(root)
    assert len(tables(found)["busenv_table3"].rows) == 3
    assert tables(found)["busenv_ranks"].data["spearman"].isna().all()
    said = words(found)
    assert "more than one setting of each: ippo." in said
    assert "no correlation of final reward, AUC, energy a run: it needs at least 3 algorithms" in said
    assert "A rule that always moves" not in words(found)  # none was played


def test_other_environments_and_other_algorithms_have_no_such_table(keep_run: Keep, root: Path) -> None:
    keep_run(("experiment=toy_tracking",), 0, 10.0, study="toy")
    assert busenv_section(StudyData(root, "toy")) is None
    keep_run((TABLE3, "algo=madqn", "preset=none", "rollout=replay"), 0, 10.0)
    assert "None of the algorithms published was trained." in words(section(root))


@pytest.mark.parametrize("value", [13.0, 14.0])
def test_visits_that_bring_no_more_than_moving_do_not_pay(keep_run: Keep, root: Path, value: float) -> None:
    keep_run((TABLE3, "algo=ippo"), 0, 14.0, rules={**RULES, "move_with_service": value})
    said = words(section(root))
    assert f"comes to {5 * (value + 1.5):.2f}. So such visits do not pay here." in said
    assert "not the best there is" not in said


@pytest.mark.parametrize(
    ("metrics", "never"), [({"service_visits": 0.0}, True), ({"service_visits": 1.0}, False), ({}, False)]
)
def test_who_earns_more_by_drawn_actions_is_named(
    keep_run: Keep, root: Path, metrics: dict[str, float], never: bool
) -> None:
    """In the fixture training earns half of a loss of 20, which is what always moving loses here."""
    for algorithm, final in (("maa2c", -20.0), ("ippo", 30.0)):
        keep_run((TABLE3, f"algo={algorithm}"), 0, final, rules={**RULES, "always_move": -20.0}, **metrics)
    said = words(section(root))
    assert "While training, where actions are drawn, maa2c came to more than that rule" in said
    assert ("Played greedily, maa2c never went to the service centre" in said) == never


def test_one_day_with_a_visit_is_not_never(keep_run: Keep, root: Path) -> None:
    for seed, visits in enumerate((0.0, 2.0)):
        rules = {**RULES, "always_move": -20.0}
        keep_run((TABLE3, "algo=maa2c"), seed, -20.0, rules=rules, service_visits=visits)
    said = words(section(root))
    assert "While training, where actions are drawn, maa2c came to more than that rule" in said
    assert "never went" not in said


MOVING = {"moves": 9.0, "waits": 0.0, "service_visits": 0.0, "services_refused": 0.0}


def test_learners_that_always_move_came_to_the_same_policy(keep_run: Keep, root: Path) -> None:
    """Also where a seed's days differ from another's, as the service centre may."""
    for seed in range(2):
        keep_run((TABLE3, "algo=ippo"), seed, 14.0 + seed, **MOVING)
        keep_run((TABLE3, "algo=ia2c"), seed, 14.0 + seed, **MOVING)
        keep_run((TABLE3, "algo=coma"), seed, 14.0 + seed, **{**MOVING, "waits": float(seed)})
    said = words(section(root))
    assert "ia2c, ippo did nothing but move, all seeds on all days" in said
    assert "as far as those days show" not in said


@pytest.mark.parametrize(("last", "same"), [(14.0, True), (14.0 + 1e-12, False)])
def test_learners_with_the_same_days_came_to_the_same_policy(
    keep_run: Keep, root: Path, last: float, same: bool
) -> None:
    keep_run((TABLE3, "algo=ippo"), 0, 14.0)
    keep_run((TABLE3, "algo=ia2c"), 0, 14.0)
    keep_run((TABLE3, "algo=ia2c"), 1, last)
    said = words(section(root))
    assert ("ia2c, ippo have the same reward to the last digit, all seeds on all days" in said) == same
    assert "with 1 to 2 seeds; none of coma," in said
