"""`headway compare` of rules alone, for which no store is asked, and of studies of several stores."""

import csv
import json
import math
import re
import shlex
from pathlib import Path
from shutil import copytree

import pytest
from command_lines import output, refused, rows_of
from kept_policies import keep_run_on

from headway.adapters.pettingzoo import episode_seed
from headway.contracts.errors import HeadwayError
from headway.registry import env_entry
from headway.rollout.episodes import evaluate_rule, evaluation_seeds
from headway_launch.commands.arguments import OTHER_EVALUATION_SEED, named_studies

pytestmark = pytest.mark.usefixtures("empty_folder")
GAME = ("env=tracking", "env.args.steps=7")


@pytest.mark.parametrize("words", [GAME, ("experiment=toy_tracking", "env.args.steps=7")])
def test_rules_are_compared_on_the_days_of_an_environment(words: tuple[str, ...], tmp_path: Path) -> None:
    asked = ["compare", *words, "--episodes", "4", "--seed", "9", "--metrics", "return,distance"]
    shown = output(*asked, "--format", "csv")
    rows = {(row["metric"], row["controller"]): row for row in csv.DictReader(shown.out.splitlines())}
    entry = env_entry("tracking")
    prepared = entry.prepare(entry.config(steps=7))
    for rule in ("random", "optimal"):
        played = evaluate_rule(entry.make, entry.rules[rule].make, prepared, 9, 4)
        for metric in ("return", "distance"):
            mean = sum(float(row[metric]) for row in played) / 4
            assert float(rows[metric, f"rule {rule}"]["mean"]) == pytest.approx(mean, rel=1e-12)
    assert len(rows) == 4
    assert float(rows["return", "rule random"]["95% high"]) < 0
    assert rows["return", "rule optimal"]["difference"] == ""
    assert "train at least" not in shown.err
    assert "4 episodes: the intervals assume a normal distribution" in shown.err
    assert list(tmp_path.iterdir()) == []


def test_rules_are_compared_where_the_default_algorithm_cannot_run() -> None:
    """The default preset of `bus` has initial logits of three actions."""
    words = ["env=bus", "env.args.control=holding", "env.args.hold_levels=0", "env.args.end_hour=6"]
    rows = rows_of("compare", *words, "--episodes", "2", "--rules", "always_move,two_way_headway")
    assert {row[0] for row in rows[1:]} == {"rule always_move", "rule two_way_headway"}


def test_the_piped_table_has_the_digits_of_the_narrowest_interval_and_no_heading_twice() -> None:
    """The differences of the four returns are -123, -36, -71 and -135: -91.2 +- 3.182 x 22.9, an interval of
    width 146, whose two digits are tens. Those of the distances are 12.75 +- 10.4."""
    assert rows_of("compare", *GAME, "--episodes", "4", "--seed", "9", "--metrics", "return,distance") == [
        [
            *("controller", "seeds", "return", "return minus optimal [95%]"),
            *("distance", "distance minus optimal [95%]"),
        ],
        ["rule optimal", "", "0", "", "0", ""],
        ["rule random", "", "-90", "-90 [-160, -20]", "13", "+13 [2, 23]"],
    ]


@pytest.mark.parametrize("form", ["markdown", "latex"])
def test_a_table_for_a_page_has_a_row_per_controller(form: str) -> None:
    asked = ["compare", *GAME, "--episodes", "4", "--metrics", "return,distance"]
    listed = json.loads(output(*asked, "--format", "json").out)
    exact = {(row["metric"], row["controller"]): row for row in listed}
    shown = output(*asked, "--format", form, "--store", "/lab/runs").out
    assert f"{shlex.join(['headway', *asked])} --format {form} --store FOLDER/runs" in " ".join(shown.split())
    ends = {"markdown": ("|", " |"), "latex": ("&", r" \\")}[form]
    lines = [line for line in shown.splitlines() if line.endswith(ends[1])]
    cells = [[cell.strip() for cell in line.strip("|\\ ").split(ends[0])] for line in lines]
    rows = {row[0]: row[1:] for row in cells if row[0].startswith("rule")}
    assert list(rows) == ["rule optimal", "rule random"]
    assert [row[2] for row in rows.values()].count("\N{EN DASH}" if form == "markdown" else "--") == 1
    for place, metric in ((1, "return"), (3, "distance")):
        found = exact[metric, "rule random"]
        unit = 10.0 ** (math.floor(math.log10(found["95% high"] - found["95% low"])) - 1)
        numbers = re.findall(r"[-+]?[\d.]+", " ".join(rows["rule random"][place:][:2]).replace("$-$", "-"))
        wanted = [found[name] for name in ("mean", "difference", "95% low", "95% high")]
        assert [float(number) for number in numbers] == pytest.approx(wanted, abs=0.5001 * unit)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["bus", "--best", "--keep", "env.args.steps=3"], "own environment; omit env.args.steps=3"),
        (["tracking"], "there is no store in 'runs'"),
        (["tracking"], "for rules alone: headway compare env=tracking"),
        (["toy_tracking"], "for rules alone: headway compare experiment=toy_tracking"),
        ([*GAME, "evaluation.episodes=2"], "'evaluation.episodes=2' has no effect if rules are compared"),
        (["algo=ippo", "env=tracking"], "'algo=ippo' has no effect if rules are compared"),
        ([*GAME, "env.training_args.noise=0"], "has no effect if rules are compared"),
        (["env.args.steps=7"], "no environment given; add env=ENV or experiment=EXPERIMENT"),
        (["env=tracking", "env.args.stepz=3"], "did you mean env.args.steps?"),
        ([*GAME, "--rules", "optimum"], "did you mean optimal?"),
        ([*GAME, "--against", "ippo"], "--against: unknown rule 'ippo'"),
        ([*GAME, "--against", "random,optimal"], "--against 'random,optimal': give one rule"),
        ([*GAME, "--against", ""], "--against '': give one rule"),
        ([*GAME, "--where", "seed<3"], "--where has no effect if rules are compared alone"),
        ([*GAME, "--rules", "lookahead"], "--rules: rule lookahead needs an environment that can be"),
        ([*GAME, "--metrics", "distanse"], "unknown metric 'distanse'; did you mean distance?"),
        ([*GAME, "--episodes", "1"], "--episodes 1: must be at least 2, because an interval needs two"),
        ([*GAME, "--rules", ","], "--rules is empty"),
        ([*GAME, "--seed", "-1"], "--seed -1: must not be negative"),
        ([*GAME, "bus"], "there is no store in 'runs'"),
        (["bus", "--keep"], "--keep stores the episodes of the best policies; add --best, or omit it"),
        (["other/runs:bus"], "there is no store in 'other/runs'"),
    ],
)
def test_what_cannot_be_compared_is_one_line(words: list[str], line: str) -> None:
    assert line in refused("compare", *words)


def test_the_reference_is_played_too_and_nothing_twice() -> None:
    words = [
        "--episodes",
        "2",
        "--rules",
        "random,random",
        "--against",
        " optimal",
        "--metrics",
        "return,return",
    ]
    heading, *rows = rows_of("compare", *GAME, *words)
    assert heading[2:] == ["return", "return minus optimal [95%]"]
    assert [row[0] for row in rows] == ["rule optimal", "rule random"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--episodes", "19"], True),
        (["--episodes", "20"], False),
        (["--episodes", "3", "--rules", "random"], False),
    ],
)
def test_few_episodes_are_noted_if_an_interval_is_over_them(words: list[str], told: bool) -> None:
    assert ("play at least 20 before" in output("compare", *GAME, *words).err) == told


def test_lookahead_is_played_where_it_is_named_and_is_no_reference() -> None:
    """A bus that waits earns less than one that moves; looking one step ahead from waiting finds that out."""
    words = ["env=bus_published", "env.args.scenario=line", "env.args.max_steps=6", "--episodes", "2"]
    words += ["--rules", "always_wait,lookahead:always_wait:2:1", "--format", "csv"]
    shown = output("compare", *words)
    rows = list(csv.DictReader(shown.out.splitlines()))
    assert [row["controller"] for row in rows] == ["rule lookahead:always_wait:2:1", "rule always_wait"]
    assert rows[0]["reference"] == "rule always_wait"
    assert float(rows[0]["difference"]) > 0
    assert "gap from always_wait, the best of the rules played, to lookahead:always_wait:2:1" in shown.err


def test_a_study_is_named_by_its_store_too(tmp_path: Path) -> None:
    for folder in ("runs", "old/runs", "older/runs"):
        (tmp_path / folder).mkdir(parents=True)
    assert named_studies(["bus", "merge", "old/runs:bus"], "runs") == {
        "bus": (Path("runs"), "bus"),
        "merge": (Path("runs"), "merge"),
        "old/runs:bus": (Path("old/runs"), "bus"),
    }
    assert list(named_studies(["bus", f"{tmp_path}/old/runs:bus"], "runs")) == ["bus", "FOLDER/runs:bus"]
    far = [f"{tmp_path}/old/runs:bus", f"{tmp_path}/older/runs:bus"]
    assert list(named_studies(["bus", *far], "runs")) == ["bus", "FOLDER/runs:bus", far[1]]
    assert named_studies(["a: b"], "runs") == {"a: b": (Path("runs"), "a: b")}
    with pytest.raises(HeadwayError, match="study 'bus' is named twice"):
        named_studies(["bus", "./runs:bus"], "runs")


@pytest.mark.parametrize("name", ["config.yaml", "plan.json"])
def test_a_damaged_run_is_left_out_unless_it_is_named(name: str, tmp_path: Path) -> None:
    damaged, whole = (keep_run_on(tmp_path / "runs", [*GAME, f"algo={algo}"]) for algo in ("ippo", "ia2c"))
    asked = ("compare", "kept", "--episodes", "2", "--rules", "random")
    assert [row[0] for row in rows_of(*asked)[1:4]] == ["ia2c", "ippo", "rule random"]
    (damaged / name).write_text("{[")
    shown = output(*asked)
    assert [line.split("\t")[0] for line in shown.out.splitlines()[1:]] == ["ia2c", "rule random"]
    assert f"headway: run {damaged.name} is left out: {damaged / name} " in shown.err
    assert len(rows_of("runs")) == 3
    assert f"{name} " in refused("evaluate", damaged.name)
    output("evaluate", whole.name, "--episodes", "1")


WAIT_OF_ODD_EPISODES = """
from gymnasium.spaces import Box, Discrete
from numpy import array, float32
from pettingzoo import ParallelEnv

from headway.api import RuleEntry


class Stop(ParallelEnv):
    metadata = {"name": "stop"}
    possible_agents = ["bus"]

    def observation_space(self, agent):
        return Box(0, 1, (1,), float32)

    def action_space(self, agent):
        return Discrete(2)

    def reset(self, seed=None, options=None):
        self.agents, self.wait = ["bus"], {"wait": 2.0} if seed % 2 else {}
        return {"bus": array([0], float32)}, {"bus": {}}

    def step(self, actions):
        self.agents, info = [], {"episode_metrics": {"stops": 1, **self.wait}}
        paid = float(actions["bus"])
        return {"bus": array([0], float32)}, {"bus": paid}, {"bus": True}, {"bus": False}, {"bus": info}


class Go:
    def act(self, env, observed):
        return array([[1]] * len(observed.alive))


def parallel_env():
    return Stop()


METRICS = {"stops": "number of stops", "wait": "mean wait, s"}
RULES = {"go": RuleEntry("goes", lambda prepared: Go())}
"""


def test_a_metric_that_some_episodes_lack_is_not_compared(tmp_path: Path) -> None:
    (tmp_path / "stop.py").write_text(WAIT_OF_ODD_EPISODES)
    asked = ("compare", "env=./stop.py", "--episodes", "20", "--metrics")
    seeds = [episode_seed(int(seed)) for seed in evaluation_seeds(OTHER_EVALUATION_SEED, 0, 20)]
    even = sum(seed % 2 == 0 for seed in seeds)
    assert 0 < even < 20
    assert f"--metrics: wait has no value in {even} of 20 episodes of rule " in refused(*asked, "return,wait")
    assert rows_of(*asked, "stops")[1][:3] == ["rule go", "", "1"]


def test_a_changed_environment_is_noted(tmp_path: Path) -> None:
    keep_run_on(tmp_path / "runs", [*GAME, "algo=ippo"])
    asked = ("compare", "kept", "--episodes", "2", "--rules", "random")
    line = "headway: evaluated on a changed environment: env.args.steps=3 (trained with 7)\n"
    assert line in output(*asked, "env.args.steps=3").err
    assert "changed environment" not in output(*asked).err


@pytest.mark.slow
def test_learners_of_two_stores_are_compared_and_their_best_policies_kept(
    trained: Path, tmp_path: Path
) -> None:
    copytree(trained, "runs")
    copytree(trained, "old/runs")
    asked = ("compare", "pair", "old/runs:pair", "--episodes", "3", "--rules", "random", "--best")
    learners = ["pair: ippo, best policies", "old/runs:pair: ippo, best policies"]
    rows = json.loads(output(*asked, "--format", "json", "--keep").out)
    assert [row["controller"] for row in rows] == [*learners, "rule random", learners[0]]
    assert rows[0]["mean"] == rows[1]["mean"]
    pair = rows[3]
    assert (pair["reference"], pair["difference"], pair["p"]) == (learners[1], 0.0, 1.0)
    assert pair["seeds needed"] == ">1,000"
    for store in ("runs", "old/runs"):
        [path] = (tmp_path / store / "pair").glob("*.best.json")
        kept = json.loads(path.read_text())
        assert (kept["seed"], kept["mode"], list(kept["rules"])) == (2_000_003, "greedy", ["random"])
        returns = [row["return"] for of_run in kept["runs"].values() for row in of_run["episodes"]]
        assert (len(kept["runs"]), len(returns)) == (2, 6)
        assert sum(returns) / 6 == pytest.approx(rows[0]["mean"])
    output("report", "pair", "--format", "csv", "--output", "tables-of-pair")
    text = Path("tables-of-pair/tables/absolute_metric.csv").read_text(encoding="utf-8")
    table = list(csv.DictReader(text.splitlines()))
    assert float(table[0]["mean"]) == pytest.approx(rows[0]["mean"])
    output("archive", "pair")
    output("report", "pair", "--archive", "pair.zip", "--format", "csv", "--output", "of-archive")
    assert Path("of-archive/tables/absolute_metric.csv").read_text(encoding="utf-8") == text
    line = refused("compare", "pair", "--best", "--keep", "--archive", "pair.zip")
    assert "--keep has no effect on an archive" in line
    page = output("compare", "pair", "old/runs:pair", "--episodes", "2", "--format", "markdown").out
    assert "Differences between learners, return. p (Holm): of a single pair." in " ".join(page.split())
    line = refused("compare", "pair", "--best", "--keep", "--seed", "1000003")
    assert "--keep: the episodes of --seed 1000003 selected the policies of ippo" in line
