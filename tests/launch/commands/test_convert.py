"""`headway convert`: a study's logs in other forms, held to the log itself."""

import json
import math
import sys
from pathlib import Path

import pandas as pd
import pytest
from command_lines import output, refused
from stored_runs import RESULTS, keep

from headway.events import Row
from headway.store.atomic_files import write_json
from headway.store.index import RunIndex
from headway.store.run_folder import best_file
from headway_launch.commands.main import run

STARTED = "2026-01-02T03:04:05+00:00"
CURVE: list[Row] = [
    {"iteration": 0, "env_steps": 0, "wall_s": 0.5, "evaluation_greedy/return": 1.25},
    {"iteration": 1, "env_steps": 64, "wall_s": 2.0, "training/return": -3.5, "policy/entropy": 0.75},
    {
        "iteration": 2, "env_steps": 128, "wall_s": 3.5, "training/return": 4.5,
        "evaluation_greedy/return": 2.5,
    },
]  # fmt: skip
EPISODE: Row = {"iteration": 1, "env_steps": 64, "copy": 0, "mean_wait_min": 7.0}


@pytest.fixture(autouse=True)
def runs(empty_folder: Path) -> list[str]:
    """Names of two runs of a study, in a store in the working directory."""
    logs = {"curve": CURVE, "episodes": [EPISODE]}
    summary = {"final_reward": 2.5, "kwh": 0.125}
    config = {**RESULTS["config"], "algo": {"name": "ippo", "lr": 0.001}}
    whole = {"summary": summary, "config": config, "logs": logs, "iterations": 2, "started": STARTED}
    return [keep(Path("runs"), "lines", seed, **whole).name for seed in range(2)]


def test_csv_has_a_file_per_table_with_the_unit_of_each_column(runs: list[str]) -> None:
    assert output("convert", "lines", "--to", "csv").out == "csv-lines\n"
    tables = {file.stem: pd.read_csv(file) for file in Path("csv-lines").glob("*.csv")}
    assert set(tables) == {"runs", "curves", "episodes", "columns"}
    curves = tables["curves"]
    assert curves["run_id"].tolist() == [name for name in runs for _ in CURVE]
    for row, point in zip(curves.to_dict("records"), CURVE * 2, strict=True):
        shown = {name: row[name] for name in row if name in CURVE[0] | CURVE[1]}
        assert {name: value for name, value in shown.items() if not math.isnan(value)} == point
    assert tables["runs"]["kwh"].tolist() == [0.125, 0.125]
    meanings = tables["columns"].fillna("").set_index(["table", "column"])["meaning"]
    assert {(name, column) for name in tables if name != "columns" for column in tables[name]} == {
        *meanings.index
    }
    assert meanings["episodes", "mean_wait_min"].endswith(", minutes")
    assert meanings["curves", "evaluation_greedy/return"].startswith("sum of rewards over the episode")
    assert meanings["curves", "wall_s"].endswith(", s")
    assert meanings["runs", "kwh"].endswith(", kWh")
    assert sorted(file.stem for file in Path("csv-lines", "configs").iterdir()) == sorted(runs)


def test_tensorboard_reads_every_point_of_every_run(runs: list[str]) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator
    from tensorboard.util.tensor_util import make_ndarray

    assert run(["convert", "lines", "--to", "tensorboard", "--output", "events"]) == 0
    assert sorted(folder.name for folder in Path("events").iterdir()) == sorted(runs)
    for name in runs:
        events = EventAccumulator(f"events/{name}").Reload()
        shown = {
            (tag, event.step, event.wall_time, float(make_ndarray(event.tensor_proto)))
            for tag in events.Tags()["tensors"]
            for event in events.Tensors(tag)
        }
        started = pd.Timestamp(STARTED).timestamp()
        assert shown == {
            (tag, point["env_steps"], started + point["wall_s"], value)
            for point in CURVE
            for tag, value in point.items()
            if "/" in tag
        }
        described = events.SummaryMetadata("evaluation_greedy/return").summary_description
        assert described.startswith("sum of rewards over the episode")


@pytest.mark.slow
def test_wandb_writes_offline_runs(runs: list[str]) -> None:
    pytest.importorskip("wandb")
    assert run(["convert", "lines", "--to", "wandb"]) == 0
    [*files] = Path("wandb-lines", "wandb").glob("offline-run-*/*.wandb")
    assert sorted(file.stem.removeprefix("run-") for file in files) == sorted(runs)
    for file in files:
        content = file.read_bytes()
        for word in (b"lines", b"evaluation_greedy/return", b"1.25", b"-3.5", b"final_reward", b"0.001"):
            assert word in content


@pytest.mark.parametrize("to", ["tensorboard", "wandb"])
def test_a_missing_package_is_named(to: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (to, f"{to}.summary.writer.event_file_writer"):
        monkeypatch.setitem(sys.modules, module, None)
    needed = f'the package {to}; install it with pip install "headway[{to}]"\n'
    assert refused("convert", "lines", "--to", to) == f"headway: --to {to} needs {needed}"
    assert not Path(f"{to}-lines").exists()


def _keep_evaluated(algo: str, seed: int, points: tuple[int, ...] = (0, 64)) -> None:
    """Keep a run with two episodes per evaluation and two more in the last; episode i of a point returns
    its steps + the seed + i / 10."""
    rows: list[Row] = []
    for iteration, steps in enumerate(points):
        final = steps == points[-1]
        label = {"iteration": iteration, "env_steps": steps, "mode": "greedy", "final": int(final)}
        played: list[Row] = [
            {**label, "episode_seed": episode, "return": steps + seed + episode / 10, "mean_wait_min": 7}
            for episode in range(4 if final else 2)
        ]
        rows += [*played, {**played[0], "mode": "sampled", "return": -1.0}]
    config = {**RESULTS["config"], "evaluation": {"episodes": 2, "modes": ["greedy", "sampled"]}}
    logs = {**RESULTS["logs"], "evaluation": rows}
    keep(Path("runs"), "marl", seed, "Bus", algo, algo, config=config, logs=logs)


def test_marl_eval_has_the_tree_that_the_package_documents() -> None:
    """environment, task, algorithm, run, step, metric: one value per episode; and lower-case names, which it
    looks up."""
    for algo in ("ippo", "mappo"):
        for seed in (3, 4):
            _keep_evaluated(algo, seed)
    assert run(["convert", "marl", "--to", "marl-eval"]) == 0
    tree = json.loads(Path("marl-eval-marl", "metrics.json").read_text())
    wait = "mean wait min"
    expected = {
        f"seed_{seed}": {
            "step_0": {"step_count": 0, "return": [seed, seed + 0.1], wait: [7, 7]},
            "step_1": {"step_count": 64, "return": [64 + seed, 64 + seed + 0.1], wait: [7, 7]},
            "absolute_metrics": {"return": [64 + seed + episode / 10 for episode in range(4)], wait: [7] * 4},
        }
        for seed in (3, 4)
    }
    assert tree == {"bus": {"bus": {"ippo": expected, "mappo": expected}}}
    for whole in tree["bus"]["bus"]["ippo"].values():
        assert list(whole)[-1] == "absolute_metrics"  # which it takes by its place


def test_absolute_metrics_are_of_the_best_policies_if_all_runs_have_them() -> None:
    for algo in ("ippo", "mappo"):
        _keep_evaluated(algo, 3)
    rows = RunIndex(Path("runs")).rows("marl")
    for number, row in enumerate(rows):
        runs = {row.run_id: {"iteration": 0, "episodes": [{"return": 90 + number, "mean_wait_min": 6}] * 2}}
        kept = {"seed": 5, "mode": "greedy", "rules": {}, "runs": runs}
        write_json(best_file(Path("runs"), "marl", row.cell), kept)
        assert run(["convert", "marl", "--to", "marl-eval", "--output", f"tree-{number}"]) == 0
    first, last = (json.loads(Path(f"tree-{number}", "metrics.json").read_text()) for number in (0, 1))
    assert len(first["bus"]["bus"]["ippo"]["seed_3"]["absolute_metrics"]["return"]) == 4
    found = {name: whole["seed_3"]["absolute_metrics"] for name, whole in last["bus"]["bus"].items()}
    assert found == {
        row.algorithm: {"return": [90 + number] * 2, "mean wait min": [6, 6]}
        for number, row in enumerate(rows)
    }


@pytest.mark.parametrize(
    ("others", "line"),
    [
        ([("mappo", 3, (0, 64))], "mappo on bus; choose runs with --where"),
        (
            [("mappo", 3, (0, 64)), ("mappo", 4, (0, 32, 64))],
            "seed_3 (2 evaluations), seed_4 (3 evaluations)",
        ),
    ],
)
def test_marl_eval_needs_equal_numbers(others: list[tuple[str, int, tuple[int, ...]]], line: str) -> None:
    for algo, seed, points in [("ippo", 3, (0, 64)), ("ippo", 4, (0, 64)), *others]:
        _keep_evaluated(algo, seed, points)
    assert line in refused("convert", "marl", "--to", "marl-eval")
    assert not Path("marl-eval-marl").exists()


def test_nothing_is_overwritten_and_a_failure_leaves_no_files() -> None:
    Path("csv-lines").mkdir()
    Path("csv-lines", "notes.txt").write_text("mine")
    assert "csv-lines exists; remove it or name a new folder" in refused("convert", "lines", "--to", "csv")
    assert "there is no folder no" in refused("convert", "lines", "--to", "csv", "--output", "no/such")
    assert "invalid choice" in refused("convert", "lines", "--to", "cvs")
    assert "did you mean lines?" in refused("convert", "linse", "--to", "csv")
    assert [file.name for file in Path("csv-lines").iterdir()] == ["notes.txt"]
    assert sorted(file.name for file in Path.cwd().iterdir()) == ["csv-lines", "runs"]
