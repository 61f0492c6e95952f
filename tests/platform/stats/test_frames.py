"""Statistics of frames equal those of arrays; unknown values are NaN."""

import numpy as np
import pandas as pd
import pytest

from headway.stats import frames
from headway.stats.intervals import mean_and_half_width
from headway.stats.pairs import LearnerDifference, holm
from headway.stats.scores import normalised


def scores(**by_controller: dict[str, list[float]]) -> pd.DataFrame:
    rows = [
        {"controller": controller, "task": task, "final_reward": score}
        for controller, tasks in by_controller.items()
        for task, values in tasks.items()
        for score in values
    ]
    return pd.DataFrame(rows)


def curves(**by_run: list[float]) -> pd.DataFrame:
    """Runs named CONTROLLER_NUMBER of one task, with a point every ten steps."""
    return pd.DataFrame(
        [
            {"controller": run[0], "task": "bus", "run_id": run, "env_steps": 10 * index, "value": value}
            for run, values in by_run.items()
            for index, value in enumerate(values)
        ]
    )


def test_both_areas_of_a_curve_by_hand() -> None:
    """The range of the study is 0 to 10; b has the shape of a at half its height."""
    found = frames.curve_metrics(curves(a_0=[0, 10, 10], b_0=[0, 5, 5]))
    assert found["auc_own"].tolist() == [0.75, 0.75]
    assert found["auc_study"].tolist() == [0.75, 0.375]
    assert found["final_reward"].tolist() == [10, 5]


def test_statistics_take_the_metrics_of_curves() -> None:
    found = frames.curve_metrics(curves(a_0=[0, 4], a_1=[0, 6], b_0=[0, 5], b_1=[0, 8]))
    assert frames.summary(found)["mean"].to_dict() == {"a": 5, "b": 6.5}
    assert frames.improvements(found)["probability"].tolist() == [0.25, 0.75]
    assert set(frames.profiles(found)["controller"]) == {"a", "b"}


def test_areas_of_constant_curves_are_half() -> None:
    assert frames.curve_metrics(curves(a_0=[3, 3, 3]))["auc_study"].tolist() == [0.5]


def test_mean_curves_have_t_intervals_at_common_steps() -> None:
    found = frames.mean_curves(curves(a_0=[0, 1, 2], a_1=[2, 5], b_0=[1, 1]))
    of_a = found[found["controller"] == "a"]
    assert of_a["env_steps"].tolist() == [0, 10]
    mean, half = mean_and_half_width(np.array([[0.0, 1.0], [2.0, 5.0]]))
    assert of_a["mean"].tolist() == mean.tolist()
    assert of_a["high"].tolist() == (mean + half).tolist()
    assert found[found["controller"] == "b"]["low"].isna().all()


def test_curves_are_interpolated_to_common_steps() -> None:
    apart = curves(a_0=[0.0, 1.0, 2.0], a_1=[2.0, 5.0], b_0=[1.0, 1.0], b_1=[3.0, 4.0])
    apart.loc[apart["run_id"] == "a_1", "env_steps"] += 5  # at 5 and 15
    apart.loc[apart["run_id"] == "b_1", "env_steps"] += 50  # after all of b_0
    found = frames.on_common_steps(apart)
    of_a = found[found["controller"] == "a"]
    by_run = {run: (of["env_steps"].tolist(), of["value"].tolist()) for run, of in of_a.groupby("run_id")}
    assert by_run == {"a_0": ([5, 10, 15], [0.5, 1, 1.5]), "a_1": ([5, 10, 15], [2, 3.5, 5])}
    of_b = found[found["controller"] == "b"].reset_index(drop=True)
    assert of_b.equals(apart[apart["controller"] == "b"].reset_index(drop=True))
    assert set(frames.mean_curves(found)["controller"]) == {"a"}


def test_curves_with_the_same_steps_are_unchanged() -> None:
    alike = curves(a_0=[0.1, 0.7, 0.2], a_1=[2, 5, 1], b_0=[1, 1])
    assert frames.on_common_steps(alike).equals(alike)
    assert frames.on_common_steps(alike.iloc[:0]).empty


def test_one_run_has_no_deviation_and_no_interval() -> None:
    found = frames.summary(scores(a={"bus": [3.0]}, b={"bus": [1.0, 2.0, 4.0, 9.0]}))
    assert found.loc["a", ["mean", "iqm"]].tolist() == [3, 3]
    assert found.loc["a", ["std", "iqm_low", "iqm_high"]].isna().all()
    assert found.loc["b", "iqm"] == 3
    assert found.loc["b", "iqm_low"] < 3 < found.loc["b", "iqm_high"]


def test_bands_of_single_runs_have_no_ends() -> None:
    one, two = {"bus": [3.0], "merge": [1.0]}, {"bus": [3.0, 4.0], "merge": [1.0, 2.0]}
    found = frames.profiles(scores(a=one, b=two))
    known = found.groupby("controller")[["low", "high"]].count()
    assert known.loc["a"].tolist() == [0, 0]
    assert known.loc["b"].tolist() == [found["controller"].eq("b").sum()] * 2
    assert found["share"].notna().all()
    assert frames.summary(scores(a=one, b=two))["iqm_low"].isna().tolist() == [True, False]
    found = frames.efficiency(curves(a_0=[0, 1], b_0=[2, 3], b_1=[4, 5])).set_index("controller")
    assert found.loc["a", "iqm"].tolist() == [0, 1]
    assert found.loc["a", ["low", "high"]].isna().all(axis=None)
    assert found.loc["b", "low"].tolist() == [2, 3]


def test_improvements_are_over_common_tasks_and_pairs_sum_to_one() -> None:
    found = frames.improvements(
        scores(a={"bus": [1.0, 4.0]}, b={"bus": [1.0, 3.0], "merge": [9.0]}, c={"merge": [2.0, 3.0]})
    )
    chance = found.set_index(["a", "b"])["probability"]
    assert chance["a", "b"] == (0.5 + 0 + 1 + 1) / 4
    assert chance["a", "b"] + chance["b", "a"] == 1
    assert set(chance.index) == {("a", "b"), ("b", "a")}  # b has one run on merge


def test_runs_of_which_all_resamples_agree_have_no_interval_of_improvement() -> None:
    above, below, mixed = [4.0, 5.0, 6.0], [1.0, 2.0, 3.0], [0.0, 7.0, 2.5]
    found = frames.improvements(scores(a={"bus": above}, b={"bus": below}, c={"bus": mixed}))
    known = found.set_index(["a", "b"])[["low", "high"]].notna().all(axis="columns")
    assert {pair for pair, interval in known.items() if not interval} == {("a", "b"), ("b", "a")}
    assert found["probability"].tolist()[0] == 1
    # On two tasks one that is undecided is enough.
    both = frames.improvements(scores(a={"bus": above, "merge": mixed}, b={"bus": below, "merge": above}))
    assert (both["low"] < both["high"]).all()
    alike = frames.improvements(scores(a={"bus": [2.0, 2.0]}, b={"bus": [2.0, 2.0]}))
    assert alike["probability"].tolist() == [0.5, 0.5]
    assert alike["low"].isna().all()


def test_pairs_of_learners_are_compared_on_their_common_episodes() -> None:
    played = {
        "a": [[1.0, 2.0, 4.0], [2.0, 5.0, 3.0]],
        "b": [[4.0, 6.0, 9.0], [7.0, 5.0, 8.0]],
        "c": [[1, 2, 9]],
    }
    episodes = pd.DataFrame(
        {"task": "bus", "controller": name, "run_id": f"{name}{run}", "episode_seed": seed, "return": value}
        for name, runs in played.items()
        for run, values in enumerate(runs)
        for seed, value in enumerate(values)
        if (name, seed) != ("c", 2)
    )
    common = {name: np.array(runs)[:, :2] for name, runs in played.items()}
    found = frames.learner_pairs(episodes).set_index(["a", "b"])
    assert list(found.index) == [("a", "b"), ("a", "c"), ("b", "c")]
    expected = [LearnerDifference.of(common[a], common[b]) for a, b in found.index]
    assert found["difference"].tolist() == [each.estimate for each in expected]
    assert found["low"].tolist() == [each.interval.low for each in expected]
    assert (
        found["p_holm"].tolist()
        == holm(found["p"]).tolist()
        == holm([each.p_value for each in expected]).tolist()
    )
    assert found["seeds_needed"].tolist()[0] == expected[0].seeds_needed(0.05 / 3)
    assert found["seeds_needed"].isna().tolist() == [False, True, True]
    assert frames.learner_pairs(episodes[episodes["episode_seed"] == 0]).empty
    with pytest.raises(ValueError, match="several times"):
        frames.learner_pairs(pd.concat([episodes, episodes]))


def test_efficiency_needs_common_steps() -> None:
    two_tasks = pd.concat([curves(a_0=[0, 1, 5]), curves(a_1=[4]).assign(task="merge")])
    found = frames.efficiency(two_tasks)
    assert found[["env_steps", "iqm"]].to_numpy().tolist() == [[0, 2]]
    apart = pd.concat([curves(a_0=[0]), curves(a_1=[4]).assign(task="merge", env_steps=7)])
    assert frames.efficiency(apart).empty


def test_costs_are_of_measured_runs_only() -> None:
    rows = [("a", 1.0, 4.0), ("a", 3.0, 6.0), ("a", None, 99.0), ("b", 5.0, 7.0)]
    summaries = pd.DataFrame(
        [
            {"task": "bus", "controller": name, "kwh": kwh, "cpu_seconds": seconds, "gpu_kwh": None}
            for name, kwh, seconds in rows
        ]
    )
    found = frames.costs(summaries)
    of_a = found.loc[("bus", "a"), ["runs", "kwh", "kwh_std", "cpu_seconds"]]
    assert of_a.tolist() == [2, 2, np.sqrt(2), 5]
    assert np.isnan(found.loc[("bus", "b"), "kwh_std"])
    assert found["gpu_kwh"].isna().all()
    assert frames.costs(summaries.assign(kwh=None)).empty


def test_normalised_scores_are_0_for_random_play_and_1_for_the_best_rule() -> None:
    frame = scores(a={"bus": [-100.0, 300.0], "merge": [5.0]})
    found = frames.normalised_by_rules(frame, "final_reward", {"bus": (-100, 100), "merge": (0, 10)})
    assert found["final_reward"].tolist() == [0, 2, 0.5]
    with pytest.raises(ValueError, match="are unknown for merge"):
        frames.normalised_by_rules(frame, "final_reward", {"bus": (-100, 100)})
    with pytest.raises(ValueError, match="must score above random play"):
        normalised(1.0, 3.0, 3.0)


def test_profiles_span_all_scores() -> None:
    found = frames.profiles(scores(a={"bus": [0.0, 1.0]}, b={"bus": [10.0]}))
    of_a, of_b = (found[found["controller"] == name]["share"].tolist() for name in "ab")
    assert (of_a[0], of_a[-1], of_b[0], of_b[-1]) == (1, 0, 1, 0)
    assert sum(of_b) > 5 * sum(of_a)
