"""`headway export`: files that act alone as `headway evaluate` does, and what it refuses."""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_lines import failed, output, refused
from kept_policies import keep_run_on

from headway.api import Policy, child_seeds, load_policy
from headway.policies import files
from headway.policies.description import Arrays, PolicyDescription
from headway_launch.commands.main import run
from headway_launch.experiments.compose import HeadwayError, resolve
from headway_launch.experiments.experiment import Experiment
from headway_launch.runner.checkpointed_policy import policy_episodes, stored_policy
from headway_launch.runner.stored_run import StoredRun

GUIDE = Path(__file__).resolve().parents[3] / "docs" / "howto" / "policies.md"
SEED, EPISODES = 1_000_003, 3
HOURS = ("env.args.start_hour=6", "env.args.end_hour=8")
KINDS = {
    "shared with masks": ("env=visitors", "algo=ippo", "algo.policies=shared"),
    "independent box": ("env=tracking", "algo=ippo", "algo.policies=independent"),
    "recurrent": ("env=recall", "algo=ippo", "algo.policies=shared", "algo.model.core=gru"),
    "groups": ("env=bus", "env.args.scenario=corridor", *HOURS, "algo=ippo", "algo.policies=groups"),
}

pytestmark = pytest.mark.usefixtures("empty_folder")


def mean_return(policy: Policy, env: Any) -> float:  # noqa: ANN401 - a PettingZoo ParallelEnv
    """Play the first evaluation episodes; the return is the mean over all agents of the summed rewards."""
    returns = []
    for seed in child_seeds(SEED, "evaluation", 0, EPISODES):
        observations, infos = env.reset(seed=int(seed))
        state, total = None, 0.0
        while env.agents:
            present = [agent for agent in env.agents if infos[agent].get("alive", True)]
            masks = {agent: infos[agent]["action_mask"] for agent in present if "action_mask" in infos[agent]}
            shown = {agent: observations[agent] for agent in present}
            actions, state = policy.act(shown, masks or None, state=state)
            observations, rewards, *_, infos = env.step(actions)
            total += sum(rewards.values()) / len(policy.agents)
        returns.append(total)
    return float(np.mean(returns))


def made(origin: Mapping[str, Any]) -> Any:  # noqa: ANN401 - a PettingZoo ParallelEnv
    """Return the environment that a policy names, as a PettingZoo ParallelEnv."""
    experiment = resolve({"env": origin["env"], "algo": origin["algo"]})
    assert experiment.env.parallel_env is not None
    return experiment.env.parallel_env(experiment.env.prepare(experiment.env_config))


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_alone_has_the_mean_return_of_evaluate(kind: str, tmp_path: Path) -> None:
    folder = keep_run_on(tmp_path / "runs", KINDS[kind])
    captured = output("export", folder.name, "--output", "policy.npz")
    assert captured.out == "policy.npz\n"
    assert "observations of the training environment" in captured.err
    policy, stored = load_policy("policy.npz"), StoredRun.read(tmp_path / "runs", folder)
    rows = policy_episodes(stored_policy(stored, stored.experiment.prepare()), SEED, EPISODES, True)
    expected = float(np.mean([float(row["return"]) for row in rows]))
    assert mean_return(policy, made(policy.origin)) == pytest.approx(expected, abs=1e-3, rel=1e-4)


def test_the_printed_return_is_that_of_the_file(tmp_path: Path) -> None:
    folder = keep_run_on(tmp_path / "runs", KINDS["recurrent"])
    told = output("export", folder.name, "--output", "policy.npz").err.splitlines()
    assert told[0].startswith("preparing the training environment, to compare the file")
    assert told[1] == "making the file, npz"
    asked = ("--episodes", str(EPISODES), "--rules", "random", "--format", "json")
    shown = json.loads(output("evaluate", folder.name, *asked).out)[0]["mean"]
    policy = load_policy("policy.npz")
    assert mean_return(policy, made(policy.origin)) == pytest.approx(shown, rel=1e-4)


def test_the_example_of_the_guide_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = keep_run_on(tmp_path / "runs", ("env=bus", "algo=ippo", "algo.policies=shared"))
    assert run(["export", folder.name, "--output", "policy.npz"]) == 0
    assert "data" in load_policy("policy.npz").origin  # source of the scenario
    [program] = re.findall(r"^```python\n(.*?)^```$", GUIDE.read_text(), re.MULTILINE | re.DOTALL)
    capsys.readouterr()
    exec(program, {})
    stored = StoredRun.read(tmp_path / "runs", folder)
    rows = policy_episodes(stored_policy(stored, stored.experiment.prepare()), SEED, 2, True)
    printed = float(capsys.readouterr().out.removeprefix("mean return "))
    assert printed == pytest.approx(np.mean([float(row["return"]) for row in rows]), abs=1e-3, rel=1e-4)


@pytest.mark.parametrize(("form", "name"), [("torchscript", "policy.pt"), ("onnx", "policy.onnx")])
def test_other_formats_are_written_and_read(form: str, name: str, tmp_path: Path) -> None:
    if form == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    folder = keep_run_on(tmp_path / "runs", KINDS["recurrent"])
    assert run(["export", folder.name, "--format", form, "--output", name]) == 0
    policy = files.read_policy(Path(name))
    assert policy.origin == load_policy(folder).origin
    assert mean_return(policy, made(policy.origin)) == pytest.approx(
        mean_return(load_policy(folder), made(policy.origin)), rel=1e-4
    )


def test_without_the_environment_random_observations_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = keep_run_on(tmp_path / "runs", KINDS["shared with masks"])

    def prepare(self: Experiment) -> None:
        raise HeadwayError("its data are elsewhere")

    monkeypatch.setattr(Experiment, "prepare", prepare)
    assert "observations drawn at random (its data are elsewhere)" in output("export", folder.name).err
    assert load_policy(f"{folder.name}.npz").agents[0] == "visitor_0"


def test_a_file_that_acts_otherwise_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An earlier file of the same name stays."""
    folder = keep_run_on(tmp_path / "runs", KINDS["independent box"])
    Path("policy.npz").write_text("earlier")

    def wrong(description: PolicyDescription, arrays: Arrays) -> bytes:
        return write(description, {**arrays, "bias_0": arrays["bias_0"] + np.float32(1e-3)})

    write = files.FORMATS["npz"].contents
    monkeypatch.setitem(files.FORMATS, "npz", files.FORMATS["npz"]._replace(contents=wrong))
    assert "differs from the rollout workers'" in failed("export", folder.name, "--output", "policy.npz")
    assert Path("policy.npz").read_text() == "earlier"


def test_wrong_arguments_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = keep_run_on(tmp_path / "runs", KINDS["independent box"])
    export = "export", folder.name
    assert "unknown 'onyx'; did you mean onnx?" in refused(*export, "--format", "onyx")
    assert "must end in .npz" in refused(*export, "-o", "policy.onnx")
    assert "there is no folder nowhere; create it first" in refused(*export, "--output", "nowhere/policy.npz")
    Path("policy.npz").mkdir()
    assert "policy.npz cannot be written" in refused(*export, "--output", "policy.npz")
    assert "no run 'other'" in refused("export", "other")
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert 'pip install "headway[export]"' in refused(*export, "--format", "onnx")
    for checkpoint in folder.glob("checkpoints/*"):
        checkpoint.unlink()
    assert "there is no checkpoint" in refused(*export)
    assert [path.name for path in Path().glob("*.*")] == ["policy.npz"]
