"""The command line of a stored run composes that run's configuration again, whatever its values look like."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml
from shuttle import SHUTTLE

from headway_launch.experiments.compose import compose
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import full_mapping
from headway_launch.report.reproduction_line import reproducing_line


@pytest.mark.parametrize(
    "overrides",
    [
        ("experiment=bus_mappo", "preset=bus_tuned_independent", "algo=happo", "algo.lr=3e-5"),
        ("experiment=bus_mappo", "preset=paper", "rollout.steps=64", "algo=coma"),
        ("experiment=toy_matrix", "energy=off", "evaluation.rules=[]", "algo.grad_clip=null"),
        (
            "experiment=toy_trivial",
            "env.wrappers=[{name: frame_stack_v1, stack_size: 4}, clip_reward_v0]",
            "study=\"with spaces = and 'quotes'\"",
        ),
        ("experiment=merge_curriculum", "algo.lr=1e-3"),
        ("env=mpe2.simple_spread_v3", "algo=itrpo", "env.training_args={N: 3}", "backend.stack=2"),
    ],
)
def test_lines_compose_what_was_run(overrides: Sequence[str]) -> None:
    stored = full_mapping(compose([*overrides, "seed=3,4", "store.root=elsewhere"]), [3])
    program, command, *words = shlex.split(reproducing_line(stored, "3", "ring.yaml"))
    assert (program, command) == ("headway", "run")
    again = full_mapping(compose(words), [3])
    assert again["seed"] == [3]
    for key in ("study", "env", "algo", "rollout", "evaluation", "env_steps", "device", "energy", "stages"):
        assert again[key] == stored[key], key
    assert again["backend"]["stack"] == stored["backend"]["stack"]
    assert "elsewhere" not in words
    assert again["preset"] == stored["preset"]


def test_a_preset_replaces_the_keys_that_it_sets() -> None:
    stored = full_mapping(compose(["experiment=merge_study", "preset=merge_paper", "algo.lr=0.25"]), [3])
    line = reproducing_line(stored, "3", "ring.yaml")
    assert "preset=merge_paper" in line
    assert "algo.lr=0.25" in line
    assert "algo.gae_lambda" not in line


@pytest.mark.parametrize("preset", ["merge_tuned", "none"])
def test_a_cell_is_composed_once(preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside what all cells of its environment, algorithm and preset share."""
    words = ["experiment=merge_study", f"preset={preset}", "algo=ippo"]
    cells = [full_mapping(compose([*words, f"algo.lr={rate}"]), [3, 4]) for rate in (0.1, 0.2, 0.3)]
    composed: list[Sequence[str]] = []

    def counted(overrides: Sequence[str]) -> Experiment:
        composed.append(overrides)
        return compose(overrides)

    monkeypatch.setattr("headway_launch.report.reproduction_line.compose", counted)
    lines = [reproducing_line(cell, seed, "ring.yaml") for cell in cells for seed in ("3", "4")]
    assert len(set(lines)) == 6
    assert len(composed) <= 1 + len(cells)


def test_of_a_preset_that_is_gone_all_it_brought_is_written() -> None:
    stored = full_mapping(compose(["experiment=merge_study", "preset=merge_paper"]), [3])
    line = reproducing_line({**stored, "preset": "gone"}, "3", "ring.yaml")
    assert "preset" not in line
    assert "algo.gae_lambda=1.0" in line


def test_a_preset_of_which_something_cannot_be_taken_back_is_left_out() -> None:
    stored = full_mapping(compose(["experiment=merge_study", "preset=merge_tuned"]), [3])
    stored["env"]["training_args"] = {}
    words = shlex.split(reproducing_line(stored, "3", "ring.yaml"))[2:]
    assert not any(word.startswith("preset=") for word in words)
    assert full_mapping(compose(words), [3])["env"] == stored["env"]


def test_an_environment_in_a_file_is_trained_from_the_configuration(tmp_path: Path) -> None:
    (tmp_path / "shuttle.py").write_text(SHUTTLE)
    experiment = compose([f"env={tmp_path / 'shuttle.py'}", "algo=ippo", "algo.lr=1e-4", "seed=3"])
    stored = json.loads(json.dumps(full_mapping(experiment, [3]), default=str))
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump({key: value for key, value in stored.items() if key != "seed"}))
    again = compose(shlex.split(reproducing_line(stored, "3", str(file)))[2:])
    assert json.loads(json.dumps(full_mapping(again, [3]), default=str)) == stored
