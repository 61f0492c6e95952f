"""`headway runs` and `headway diff`: conditions, order, two runs beside each other."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_lines import output, refused, rows_of
from stored_runs import keep, write_plan

from headway.events import Row
from headway.store.run_folder import RunRecord

REWARDS = {0: 310.0, 1: 355.5, 2: None, 3: 290.0}


@pytest.fixture
def store(tmp_path: Path) -> Path:
    for seed, reward in REWARDS.items():
        algorithm = "ippo" if seed < 2 else "mappo"
        summary = {"final_reward": reward, "auc": 0.5, "cpu_seconds": 100.0 + seed, "kwh": 0.25}
        config = {"algo": {"name": algorithm, "lr": 0.001}, "env": {"id": "bus"}, "seed": [seed]}
        rows: list[Row] = [
            {
                "iteration": iteration, "mode": "greedy", "final": 1, "episode_seed": day,
                "env_steps": 100 * iteration, "return": 100.0 * seed + day + iteration,
            } for iteration in (0, 10) for day in range(2)
        ]  # fmt: skip
        directory = keep(
            tmp_path, "bus", seed, "bus", algorithm, f"bus-{algorithm}-1f2e3d", summary, config,
            {"evaluation": rows}, status="FINISHED" if reward else "KILLED", tags={"git.revision": "abc"},
            parameters={
                "algo.lr": "0.001" if seed else "3e-05", "algo.core": "gru", "algo.agent_id": str(not seed),
                "algo.lr_end": "None", "algo.hidden": "[64, 0.001]",
            },
        )  # fmt: skip
        write_plan(directory, [seed])
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--where", "final_reward>300"], [0, 1]),
        (["--where", "final_reward <= 310 and seed!=3"], [0]),
        (["--where", "algorithm=mappo"], [2, 3]),
        (["--where", "algo.lr<1e-4"], [0]),
        (["--where", "final_reward>0", "--where", "algo.lr=1e-3"], [1, 3]),
        (["--where", "cpu_seconds>=102"], [2, 3]),
        (["--where", "algorithm=mappo and (seed=2 or algo.lr=1e-3)"], [2, 3]),
        (["--where", "not seed in (0, 3) and final_reward between 1e-1 and 4e+2"], [1]),
        (["--where", "algo.agent_id=false"], [1, 2, 3]),
        (["--where", "algo.agent_id!=FALSE"], [0]),
        (["--where", "algo.agent_id=False and algo.lr_end=null and algo.hidden=[64,0.001]"], [1, 2, 3]),
        (["--where", "algorithm like 'm%' and run_id!=\"it's\""], [2, 3]),
        (["--sort", "final_reward"], [3, 0, 1, 2]),
        (["--sort", "final_reward desc"], [1, 0, 3, 2]),
        (["--sort", "algorithm desc, final_reward"], [3, 2, 0, 1]),
        (["--sort", "algo.lr, seed desc"], [0, 3, 2, 1]),
    ],
)
def test_conditions_and_order(store: Path, arguments: list[str], expected: list[int]) -> None:
    told = output("runs", "--store", str(store), "--format", "csv", *arguments).out
    assert [int(row["seed"]) for row in csv.DictReader(io.StringIO(told))] == expected


def test_lines_of_csv_end_as_those_of_other_commands_do(store: Path) -> None:
    """`cut`, `sort` and `while read` take a carriage return for a part of the last column."""
    told = output("runs", "--store", str(store), "--format", "csv").out
    assert told.count("\n") == 5
    assert "\r" not in told


def _learning_rates_differ(store: Path) -> None:
    """Put the two ippo runs into cells of their own, as a sweep over algo.lr does."""
    for name, text in {"s0": "3e-05", "s1": "0.001"}.items():
        (old,) = store.glob(f"bus/bus-ippo-1f2e3d-{name}-*")
        new = old.rename(old.with_name(old.name.replace("1f2e3d", f"{name}aaaa")))
        record = replace(RunRecord.read(new), run_id=new.name)
        replace(record, parameters={**record.parameters, "algo.lr": text}).write(new)


def test_what_a_sweep_varied_has_a_column(store: Path) -> None:
    """The two ippo cells differ in algo.lr; mappo, which has one cell, shows its own value there."""
    _learning_rates_differ(store)
    rows = list(csv.DictReader(io.StringIO(output("runs", "--store", str(store), "--format", "csv").out)))
    assert {row["seed"]: row["algo.lr"] for row in rows} == {
        "0": "3e-05", "1": "0.001", "2": "0.001", "3": "0.001",
    }  # fmt: skip
    assert "algo.core" not in rows[0]
    assert "algo.lr" not in output("runs", "--store", str(store), "--algo", "mappo").out


def test_a_run_whose_record_broke_is_left_out(store: Path) -> None:
    """The other ippo run has then no cell to differ from."""
    _learning_rates_differ(store)
    words = ["runs", "--store", str(store)]
    assert rows_of(*words)[0].count("algo.lr") == 1
    [record] = store.glob("bus/*-s1-*/run.json")
    record.write_text(record.read_text()[:40])
    assert "algo.lr" not in rows_of(*words)[0]
    listed, notice = output(*words, "--format", "csv", "--columns", "seed,status,algo.lr")
    assert listed.splitlines()[1:] == ["0,FINISHED,3e-05", "2,KILLED,0.001", "3,FINISHED,0.001"]
    assert notice.startswith(f"headway: run {record.parent.name} is left out: {record} cannot be read (")
    assert notice.endswith("): remove or repair it\n")


def test_chosen_columns(store: Path) -> None:
    chosen = ["--columns", "seed, algo.core,final_reward"]
    lines = rows_of("runs", "--store", str(store), *chosen)
    assert lines[:2] == [["seed", "algo.core", "final reward"], ["0", "gru", "310"]]
    told = output("runs", "--store", str(store), "--format", "json", *chosen).out
    assert json.loads(told)[1] == {"seed": 1, "algo.core": "gru", "final_reward": 355.5}


def test_json_has_the_parameters(store: Path) -> None:
    first = json.loads(output("runs", "--store", str(store), "--format", "json").out)[0]
    assert first["parameters"] == {
        "algo.lr": 3e-05, "algo.core": "gru", "algo.agent_id": "True", "algo.lr_end": "None",
        "algo.hidden": "[64, 0.001]",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--where", "final_rewrd>3"], "did you mean final_reward?"),
        (["--where", "algo.lrr<1"], "--where: no run has the parameter 'algo.lrr'; did you mean algo.lr?"),
        (["--sort", "seed, algo.lrr desc"], "--sort: no run has the parameter 'algo.lrr'"),
        (["--where", "status>3"], "status>3 orders text (FINISHED)"),
        (["--where", "algo.core>3"], "algo.core>3 orders text (gru)"),
        (["--where", "final_reward<abc"], "a run has no field 'abc'"),
        (["--where", "seed in (1, 2"], "'seed in (1, 2' is not a condition ("),
        (["--where", "seed=1) or (seed=2"], "'seed=1) or (seed=2' is not a condition ("),
        (["--seed", "99"], "--seed 99: no run has such a seed"),
        (["--where", "final_reward"], "'final_reward' is not a condition; write FIELD<VALUE"),
        (["--columns", "seed,sede"], "--columns: a run has no field 'sede'; did you mean seed?"),
        (["--columns", "algo.lrr"], "--columns: no run has the parameter 'algo.lrr'; did you mean algo.lr?"),
        (["--where", "core=gru"], "--where: a run has no field 'core'; did you mean algo.core?"),
        (["--sort", "sede"], "did you mean seed?"),
        (["--sort", "seed downwards"], "write FIELD, FIELD asc or FIELD desc"),
    ],
)
def test_bad_conditions_are_one_line(store: Path, arguments: list[str], part: str) -> None:
    assert part in refused("runs", "--store", str(store), *arguments)


def test_two_runs_beside_each_other(store: Path) -> None:
    lines = rows_of("diff", "ippo-1f2e3d-s0", "mappo-1f2e3d-s3", "--store", str(store))
    assert lines[:3] == [["setting", "A", "B"], ["algo.name", "ippo", "mappo"], ["seed", "[0]", "[3]"]]
    figures = {line[0]: line[1:] for line in lines[5:]}
    assert figures["final_reward"] == ["310", "290", "-20"]
    assert figures["cpu_seconds"] == ["100", "103", "3"]
    # Of the last evaluation only: the means of 10, 11 and 310, 311.
    assert figures["last evaluation, greedy: return"] == ["10.5", "310.5", "300"]


def test_a_run_beside_one_that_is_not_there(store: Path) -> None:
    assert "no run 'nothing'" in refused("diff", "ippo-1f2e3d-s0", "nothing", "--store", str(store))
