"""`run` and `sweep` of `headway_launch.api`, in this process and in a script."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from command_lines import output
from shuttle import SHUTTLE
from small_runs import SMALL

from headway.contracts import HeadwayError
from headway_launch.api import run, sweep
from headway_launch.console.threads import ONE_THREAD
from headway_launch.experiments.compose import compose
from headway_launch.experiments.override_words import override_words
from headway_launch.experiments.sweep import compose_sweep

TINY = ("env=trivial", "algo=ippo", *SMALL, "env.args.agents=2", "env.args.steps=20")
pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.slow
def test_run_and_sweep_return_their_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """`run` returns its own runs only, `sweep` also those that had finished before. They equal the runs of
    the commands."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    first = run(*TINY, seed=range(2), **{"algo.lr": np.float64(1e-3)})
    assert "rule random" in capsys.readouterr().out
    again = run(*TINY, seed=1, **{"algo.lr": 1e-3})
    assert [(row.seed, row.status) for row in first.rows] == [(0, "FINISHED"), (1, "FINISHED")]
    assert [row.seed for row in again.rows] == [1]
    assert {row.run_id for row in first.rows}.isdisjoint(row.run_id for row in again.rows)
    frame = first.curves(["evaluation_greedy/return"])
    assert set(frame["run_id"]) == {row.run_id for row in first.rows}

    swept = sweep(*TINY, seed=[0, 1], **{"algo.lr": [1e-3, 1e-2]})
    assert len(swept.rows) == 4
    # The newer of the two runs of seed 1 counts.
    assert {first.rows[0].run_id, again.rows[0].run_id} < {row.run_id for row in swept.rows}
    assert {name: os.environ.get(name) for name in ONE_THREAD} == before
    assert "4 finished and skipped" in output("sweep", *TINY, "seed=0..1", "algo.lr=1e-3,1e-2").err


def test_python_values_are_those_of_the_command_line() -> None:
    keys = {
        "env": "trivial", "seed": range(3), "env_steps": np.int64(512), "study": "a b, c: d", "device": "cpu",
        "algo.lr": 1e-3, "algo.model.hidden": (8, 4), "evaluation.rules": [], "env.training_args": None,
        "env.wrappers": [{"name": "clip_reward_v0", "lower_bound": -2.0}], "store.root": "my 'runs'",
    }  # fmt: skip
    experiment = compose(override_words(keys))
    config = experiment.config
    found = (config.seed, config.env_steps, config.study, config.device)
    assert found == ((0, 1, 2), 512, "a b, c: d", "cpu")
    assert (experiment.algo_config.lr, experiment.algo_config.model.hidden) == (1e-3, (8, 4))
    assert config.evaluation.rules == ()
    assert config.env.training_args is None
    assert experiment.env_mapping["wrappers"][0]["lower_bound"] == -2.0
    assert config.store.root == "my 'runs'"
    assert compose(override_words({"env": "trivial", "seed": "0..2"})).config.seed == (0, 1, 2)


@pytest.mark.parametrize(
    "text",
    [
        *("s\u00e3o paulo", "caf\u00e9", "a\\b/c", "end\\", 'a "b" c', 'a\\"b', "a\tb", "${x}", "\\", '"'),
        *("null", "1e3"),
    ],
)
def test_text_arrives_unchanged(text: str) -> None:
    words = override_words({"env": "bus", "env.args.scenario": text, "algo": "ippo"})
    assert compose(words).env_config.scenario == text


def test_lists_of_a_sweep_are_values() -> None:
    keys = {
        "env": "trivial", "algo": ["ippo", "mappo"], "algo.lr": np.array([0.1, 0.2]).tolist(), "seed": (3, 4),
        "algo.model.hidden": [[8], [4, 4]], "study": ["one"],
    }  # fmt: skip
    cells = compose_sweep(override_words(keys, sweep=True))
    found = [(each.algo_name, each.algo_config.lr, each.algo_config.model.hidden) for each in cells]
    rates, sizes = (0.1, 0.2), ((8,), (4, 4))
    assert found == [(name, lr, size) for name in ("ippo", "mappo") for lr in rates for size in sizes]
    assert {each.config.seed for each in cells} == {(3, 4)}


@pytest.mark.parametrize("value", [object(), {1, 2}, [object()], b"bytes"])
def test_values_that_yaml_cannot_hold_are_one_line(value: object) -> None:
    line = r"algo.lr cannot be a .*; give None, a number, text, or a list or map"
    with pytest.raises(HeadwayError, match=line):
        run(*TINY, **{"algo.lr": value})


def test_errors_are_those_of_the_command_line() -> None:
    with pytest.raises(HeadwayError, match=r"study=\['a', 'b'\]: a sweep has one study; give one name"):
        sweep(*TINY, study=["a", "b"])
    with pytest.raises(HeadwayError, match=r"algo.lrr is not a key of ippo; did you mean algo.lr"):
        run(*TINY, **{"algo.lrr": 1})
    with pytest.raises(HeadwayError, match="seed=-1"):
        sweep(*TINY, seed=-1)
    with pytest.raises(HeadwayError, match="--config-dir nowhere: there is no such folder"):
        run("experiment=mine", config_dir="nowhere")
    Path("leaves.py").write_text(f"{SHUTTLE}\nraise SystemExit(3)\n")
    with pytest.raises(HeadwayError, match=r"the environment's code called sys.exit\(3\)"):
        run("env=./leaves.py")
    assert not Path("runs").exists()


def test_only_the_main_thread_may_train() -> None:
    caught: list[HeadwayError] = []

    def train() -> None:
        try:
            run(*TINY)
        except HeadwayError as error:
            caught.append(error)

    thread = threading.Thread(target=train)
    thread.start()
    thread.join()
    assert str(caught[0]).startswith("run and sweep work in the main thread only")


@pytest.mark.slow
def test_a_script_without_guard_is_interrupted_in_order() -> None:
    """Started processes do not run the script again; its run can be resumed."""
    Path("shuttle.py").write_text(SHUTTLE)
    Path("script.py").write_text(
        dedent(f"""
        from headway_launch.api import run

        print("script", flush=True)
        try:
            run("env=./shuttle.py", "algo=ippo", *{SMALL}, env_steps=10**9)
        except KeyboardInterrupt:
            print("interrupted")
        """)
    )
    command = [sys.executable, "script.py"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as script:
        assert script.stderr is not None
        shown = []
        for line in script.stderr:
            shown.append(line)
            if line.startswith("seed 0") and line.endswith("training\n"):
                script.send_signal(signal.SIGINT)
                break
        out, rest = script.communicate(timeout=300)
    assert script.returncode == 0, (shown, rest)
    ours = ["script", "interrupted"]
    assert [line for line in out.splitlines() if line in ours] == ours
    [record] = Path("runs/default").glob("*/run.json")
    assert json.loads(record.read_text())["status"] == "KILLED"
