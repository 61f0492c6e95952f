"""PettingZoo environments and wrappers from the command line."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from command_lines import failed, output, refused, rows_of
from small_runs import SMALL, end_as, stored_rows

from headway.contracts import HeadwayError
from headway.store.checkpoint import load_latest, save_checkpoint
from headway.store.parquet_log import read_curve
from headway.store.run_folder import CHECKPOINTS
from headway_launch.commands.main import run
from headway_launch.experiments.compose import compose, resolve
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import cell_parameters, full_mapping

SPREAD = ("env=mpe2.simple_spread_v3", "env.args.N=3")
STACK = "env.wrappers=[{name: frame_stack_v1, stack_size: 2}, clip_reward_v0]"
TINY = (
    "algo=ippo", *SMALL, "backend=serial", "rollout.steps=25", "env_steps=300", "store.checkpoint_every=1"
)  # fmt: skip


@pytest.fixture(autouse=True)
def _two_cores(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway_launch.runner.runner.usable_cores", lambda: 2)


def _size(experiment: Experiment) -> int:
    return experiment.prepare().spec.observation_size


def test_a_pettingzoo_environment_composes_by_its_module() -> None:
    experiment = compose([*SPREAD, "algo=ippo"])
    assert experiment.env_config.N == 3
    assert experiment.prepare().spec.agents == ("agent_0", "agent_1", "agent_2")
    assert _size(compose(["env=mpe2.simple_spread_v3", "env.args.N=2"])) == 12
    args = full_mapping(experiment, [0])["env"]["args"]
    assert args["local_ratio"] == 0.5  # a default, written out
    assert "wrappers" not in full_mapping(experiment, [0])["env"]


def test_stages_may_set_arguments_of_an_environment_that_takes_any() -> None:
    making = "def parallel_env(**given):\n    return Scripted(agents='ab'[: given['agents']])\n"
    Path("any.py").write_text(f"from scripted import Scripted\n\n\n{making}")
    stages = ", ".join(f"{{env_steps: 9_000, training_args: {{pay: {pay}}}}}" for pay in (1, 2))
    found = compose(["env=./any.py", "algo=ippo", "env.args.agents=2", f"stages=[{stages}]"]).prepare()
    assert found.prepared.arguments == {"agents": 2}
    assert [stage.arguments for stage in found.stages] == [{"agents": 2, "pay": 1}, {"agents": 2, "pay": 2}]


_LOUD = """
from scripted import Scripted

class parallel_env(Scripted):
    metadata = {"name": "loud"}

    def __init__(self):
        print("beep: made")
        super().__init__()

    def reset(self, seed=None, options=None):
        print("beep: reset")
        return super().reset(seed, options)

    def step(self, actions):
        print("beep: step", flush=True)
        return super().step(actions)
"""


@pytest.mark.slow
def test_what_an_environment_prints_is_not_among_the_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Neither from workers, nor from the session, which makes it and evaluates it again."""
    metadata = "Metadata-Version: 2.1\nName: loud\nVersion: 1.0\nRequires-Dist: pettingzoo\n"
    files = {"METADATA": metadata, "RECORD": "loud/__init__.py,,\n"}
    for folder, contents in (
        ("loud", {"__init__.py": "", "street.py": _LOUD}),
        ("loud-1.0.dist-info", files),
    ):
        (tmp_path / folder).mkdir()
        for name, text in contents.items():
            (tmp_path / folder / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    words = ("env=loud.street", "seed=0", *TINY, "backend=process", "rollout.block=2")
    assert run(["run", *words]) == 0
    [row] = stored_rows()
    assert run(["evaluate", row.run_id]) == 0
    shown = capfd.readouterr()
    assert "beep" not in shown.out
    assert "FINISHED" in shown.out
    assert {f"beep: {what}" for what in ("made", "reset", "step")} <= set(shown.err.splitlines())


@pytest.mark.parametrize("environment", [("env=trivial",), SPREAD], ids=["native", "PettingZoo"])
def test_wrappers_are_stored_and_distinguish_cells(environment: tuple[str, ...]) -> None:
    plain, wrapped = compose([*environment, "algo=ippo"]), compose([*environment, "algo=ippo", STACK])
    assert _size(wrapped) == 2 * _size(plain)
    mapping = full_mapping(wrapped, [0])
    assert mapping["env"]["wrappers"] == [
        {"name": "frame_stack_v1", "stack_size": 2, "stack_dim": -1},
        {"name": "clip_reward_v0", "lower_bound": -1.0, "upper_bound": 1.0},
    ]
    again = resolve(yaml.safe_load(yaml.safe_dump(mapping)))
    assert full_mapping(again, [0]) == mapping
    assert _size(again) == _size(wrapped)
    assert cell_parameters(again) == cell_parameters(wrapped) != cell_parameters(plain)
    assert "env.wrappers" in cell_parameters(wrapped)
    assert "env.wrappers" not in cell_parameters(plain)


@pytest.mark.parametrize(
    "environment", [("env=trivial",), ("env=matrix",), SPREAD], ids=lambda words: words[-1]
)
def test_rewards_are_changed_while_learning_and_reported_as_they_are(environment: tuple[str, ...]) -> None:
    """A learner that is paid a tenth is reported on in full, and its rules are paid in full."""
    experiment = compose([*environment, "env.wrappers=[{name: scale_reward_v0, scale: 0.1}, flatten_v0]"])
    found = experiment.prepare()
    plain = compose([*environment]).prepare()
    seeds, paid = np.arange(2, dtype=np.uint64), []
    for shared in (found.prepared, found.training):
        env = experiment.env.make(shared, 2)
        env.reset(seeds)
        actions = np.zeros((2, env.spec.num_agents), dtype=np.int64)
        paid.append(env.step(actions)[0].rewards.copy())
    assert paid[0].any()
    np.testing.assert_allclose(paid[1], 0.1 * paid[0], rtol=1e-6)
    assert found.spec == plain.spec


@pytest.mark.parametrize(
    ("wrappers", "message"),
    [
        (
            "[{name: max_observation_v0, memory: 2}]",
            r"^evaluation\.rules: rule 'optimal' of trivial cannot inspect",
        ),
        # The key is that of the whole list, also where what is reported on goes without the first.
        (
            "[clip_reward_v0, color_reduction_v0]",
            r"^env.wrappers\[1\]: color_reduction_v0 cannot wrap trivial",
        ),
    ],
)
def test_wrappers_that_hide_or_do_not_fit_are_named_before_training(wrappers: str, message: str) -> None:
    experiment = compose(["env=trivial", f"env.wrappers={wrappers}"])
    with pytest.raises(HeadwayError, match=message):
        experiment.prepare()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("env=pettingzoo",), "or a PettingZoo module, such as env=mpe2.simple_spread_v3, a file"),
        (("env=mpe2.simple_sprae_v3",), "did you mean mpe2.simple_spread_v3"),
        ((*SPREAD, "env.args.max_cycle=3"), "max_cycle is not a key of mpe2.simple_spread_v3; did you"),
        (
            ("env=trivial", "env.shared_reward=true"),
            "env.shared_reward is for PettingZoo and Gymnasium environments",
        ),
        ((*SPREAD, "env.max_copies_per_process=0"), "env.max_copies_per_process must be at least 1, or null"),
        (
            ("env=trivial", "env.wrappers=[frame_stak_v1]"),
            r"env.wrappers\[0\]: unknown wrapper 'frame_stak_v1'",
        ),
        (
            ("env=trivial", "env.wrappers=frame_stack_v1"),
            r"is text, where a list is expected; write env.wrappers=\[frame_stack_v1\]",
        ),
        (("env=trivial", "env.wrappers=[{name: clip_reward_v0, _target_: x}]"), "_target_.* is not allowed"),
        (("env=os.path",), "os is not an installed package that depends on PettingZoo"),
        (("env=../../evil.yaml",), "is not a Python file; give one, whose name ends in .py"),
        (("env=../lab",), "is not a Python file; give one, whose name ends in .py"),
    ],
)
def test_invalid_environments_and_wrappers_print_one_line(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        compose(overrides)


def test_adapter_options_are_stored_and_reach_the_adapter() -> None:
    experiment = compose(
        [*SPREAD, "env.args.local_ratio=0", "env.shared_reward=true", "env.max_copies_per_process=4"]
    )
    spec = experiment.prepare().spec
    assert spec.shared_reward
    assert spec.max_copies_per_process == 4
    env = full_mapping(experiment, [0])["env"]
    assert env["shared_reward"] is True
    assert resolve(full_mapping(experiment, [0])).prepare().spec == spec


def test_training_arguments_reach_the_training_environment_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the factory's signature is unknown, only the given arguments are known."""
    monkeypatch.setattr("headway.adapters.factories.takes_any_arguments", lambda function: True)
    for wrappers in ("[]", "[clip_reward_v0]"):
        words = ("env.training_args.local_ratio=0.1", f"env.wrappers={wrappers}")
        experiment = compose([*SPREAD, *words])
        found = experiment.prepare()
        given = [getattr(each, "prepared", each).arguments for each in (found.prepared, found.training)]
        assert given == [{"N": 3}, {"N": 3, "local_ratio": 0.1}]
        again = resolve(full_mapping(experiment, [0]))
        assert cell_parameters(again) == cell_parameters(experiment)


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        (*SPREAD, STACK),
        ("env=mpe2.simple_adversary_v3", "env.wrappers=[pad_observations_v0, agent_indicator_v0]"),
        (*SPREAD, "env.args.continuous_actions=true", "env.wrappers=[{name: scale_actions_v0, scale: 0.5}]"),
    ],
    ids=["twins", "padded", "Box"],
)
def test_a_pettingzoo_environment_trains_with_a_random_rule(overrides: tuple[str, ...]) -> None:
    shown = output("run", *overrides, *TINY, "evaluation.rules=[random]").out
    assert "FINISHED" in shown
    assert "rule random" in shown


@pytest.mark.slow
def test_workers_make_a_wrapped_pettingzoo_environment() -> None:
    """Everything sent to the workers can be pickled."""
    tiny = [word for word in TINY if word != "backend=serial"]
    wrappers = "[{name: sticky_actions_v0, repeat_action_probability: 0.1}, pad_observations_v0]"
    words = ("backend=process", "backend.workers=2", "evaluation.rules=[random]", f"env.wrappers={wrappers}")
    assert run(["run", *SPREAD, *tiny, *words]) == 0
    assert [row.status for row in stored_rows()] == ["FINISHED"]


@pytest.mark.slow
def test_the_cost_of_a_wrapper_without_a_batched_form_is_printed_once() -> None:
    wrappers = "env.wrappers=[{name: delay_observations_v0, delay: 1}]"
    told = output("run", "env=matrix", wrappers, *TINY).err
    lines = [line for line in told.splitlines() if "no batched form" in line]
    assert lines == [
        "headway: delay_observations_v0 has no batched form: matrix is played as a ParallelEnv, one copy "
        "after another; it has no snapshots: episodes restart on resume"
    ]


@pytest.mark.slow
def test_a_wrapped_run_is_resumed_and_evaluated_with_its_wrappers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stacked frames are in the checkpoint: the curve is that of an uninterrupted run."""
    assert run(["run", "env=visitors", STACK, *TINY]) == 0
    row = stored_rows()[0]
    directory = Path(row.directory)
    curves = [f"{group}/return" for group in ("training", "evaluation_greedy", "evaluation_sampled")]
    before = [read_curve(directory, name) for name in curves]
    sorted((directory / CHECKPOINTS).iterdir())[-1].unlink()
    end_as(directory)
    output("resume", row.run_id)
    assert [read_curve(directory, name) for name in curves] == before
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    shown, notices = output("evaluate", row.run_id, "--episodes", "2")
    assert "episodes played: 6 of 6 (rule " in notices
    assert "episodes played" not in shown
    assert "rule optimal" in shown
    assert "rule random" in shown


@pytest.mark.slow
def test_cells_with_different_training_environments_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    """They differ by training arguments and by a reward wrapper. The progress counts episodes of rules, cells
    and their seeds."""
    for words in (("env.wrappers=[clip_reward_v0]",), ("seed=0,1",), ("env.training_args.steps=9",)):
        output("run", "env=trivial", *TINY, "env.args.agents=2", *words)
    with monkeypatch.context() as terminal:
        terminal.setattr("sys.stderr.isatty", lambda: True, raising=False)
        shown, notices = output("compare", "default", "--episodes", "2")
    assert "episodes played: 12 of 12 (" in notices  # two rules and four seeds
    assert "episodes played" not in shown
    rows = [line.split("\t") for line in shown.splitlines() if "\t" in line]
    cells = [row[0] for row in rows[1:6] if not row[0].startswith("rule ")]
    assert len(cells) == 3
    assert any("env.training_args.steps=9" in cell for cell in cells)
    assert sum("clip_reward_v0" in cell for cell in cells) == 1
    assert run(["run", "env=trivial", *TINY, "env.args.agents=3"]) == 0
    error = refused("compare", "default", "--episodes", "2")
    assert "holds several environments, which differ in env.args.agents (3, 2): choose one, such as" in error
    assert run(["compare", "default", "--episodes", "2", "--where", "env.args.agents=2"]) == 0


@pytest.mark.slow
def test_rules_whose_inputs_wrappers_hide_are_left_out_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    hiding = "env.wrappers=[{name: max_observation_v0, memory: 2}]"
    assert run(["run", "env=trivial", hiding, *TINY, "evaluation.rules=[random]"]) == 0
    name = stored_rows()[0].run_id
    for words in (["compare", "default"], ["evaluate", name]):
        printed = output(*words, "--episodes", "2")
        assert "rule random" in printed.out
        assert "rule optimal" not in printed.out
        [line] = [line for line in printed.err.splitlines() if "optimal" in line]
        assert line.startswith("headway: left out: rule 'optimal' of trivial cannot inspect")

    def play(*_: object) -> None:
        raise AssertionError("played before the rules were checked")

    monkeypatch.setattr("headway_launch.runner.checkpointed_policy.policy_episodes", play)
    for words in (["compare", "default"], ["evaluate", name]):
        line = failed(*words, "--episodes", "2", "--rules", "random,optimal").splitlines()[-1]
        assert line.startswith("headway: --rules: rule 'optimal' of trivial cannot inspect")
        assert "evaluation.rules" not in line


@pytest.mark.slow
def test_a_checkpoint_with_other_observations_prints_one_line() -> None:
    """The run is evaluated as if this version of the environment had smaller observations."""
    assert run(["run", "env=trivial", *TINY]) == 0
    row = stored_rows()[0]
    folder = Path(row.directory) / CHECKPOINTS
    iteration, state, _ = load_latest(folder)
    for name in ("observation_mean", "observation_scale"):
        state["acting"][name] = np.repeat(state["acting"][name], 2, axis=-1)
    save_checkpoint(folder, iteration, state)
    for command in ("evaluate", "compare", "resume"):
        if command == "resume":
            end_as(row.directory)
        notices = failed(command, "default" if command == "compare" else row.run_id)
        assert f"run {row.run_id} was trained on a version of trivial with other observations" in notices
        assert "train it again" in notices
        assert "ValueError" not in notices


def test_wrappers_are_listed_with_their_arguments() -> None:
    rows = rows_of("list", "wrappers")
    assert rows[0] == ["wrapper", "arguments", "batched", "description"]
    by_name = {row[0]: row[1:3] for row in rows}
    assert by_name["frame_stack_v1"] == ["stack_size=4, stack_dim=-1", "yes"]
    assert by_name["sticky_actions_v0"] == ["repeat_action_probability", "no"]
    assert "reward_lambda_v0" not in by_name
    keys = rows_of("list", "wrappers", "clip_reward_v0")
    assert ["lower_bound", "number", "-1.0", "Smallest reward, at most 0."] in keys
    assert "did you mean clip_reward_v0?" in refused("list", "wrappers", "clip_rewards")
    arguments = [row[:3] for row in rows_of("list", "envs", "mpe2.simple_tag_v3")]
    assert ["env.args.num_adversaries", "whole number", "3"] in arguments
