"""Environments in Python files of the user's own."""

import pickle
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from shuttle import SHUTTLE

from headway.adapters.env_file import EnvFile, absolute_id
from headway.adapters.modules import module_entry
from headway.api import RANDOM, child_seeds, episode_seed
from headway.config.schema import build, describe
from headway.contracts import BatchedEnv, HeadwayError
from headway.contracts.errors import EnvironmentRaisedError
from headway.rollout.episodes import evaluate_rule

ROUNDS = """
from mpe2 import simple_spread_v3

def parallel_env(agents: int = 2):
    return simple_spread_v3.parallel_env(N=agents)
"""


def written(folder: Path, text: str, name: str = "shuttle.py") -> str:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(dedent(text))
    return str(path)


def one_copy(path: str, **arguments: object) -> BatchedEnv:
    entry = module_entry(path, arguments=arguments)
    return entry.make(entry.prepare(build(entry.config, arguments, "env.args", path)), 1)


def first_rewards(env: BatchedEnv) -> list[float]:
    env.reset(np.zeros(1, dtype=np.uint64))
    rewards: list[float] = env.step(np.zeros((1, env.spec.num_agents), dtype=np.int64))[0].rewards[0].tolist()
    return rewards


def test_the_only_class_of_a_file_is_the_environment(tmp_path: Path) -> None:
    path = written(tmp_path, SHUTTLE)
    keys = {row.key: row.default for row in describe(module_entry(path).config)}
    assert keys == {"cars": "2", "steps": "5", "fare": "1.0"}
    assert first_rewards(one_copy(path, cars=3, fare=2.0)) == [2.0, 4.0, 6.0]


def test_a_function_is_preferred_to_classes(tmp_path: Path) -> None:
    path = written(tmp_path, SHUTTLE + "\n\ndef parallel_env(size: int):\n    return Shuttle(cars=size)\n")
    assert one_copy(path, size=4).spec.num_agents == 4
    assert one_copy(written(tmp_path, ROUNDS, "rounds.py"), agents=3).spec.num_agents == 3


def test_a_function_may_return_a_gymnasium_environment(tmp_path: Path) -> None:
    path = written(tmp_path, "import gymnasium\n\ndef env():\n    return gymnasium.make('CartPole-v1')\n")
    assert one_copy(path).spec.agents == ("agent",)


def test_neighbours_can_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    written(tmp_path, "FARE = 7.0", "fares_nearby.py")
    beside = written(tmp_path, SHUTTLE.replace("FARE = 1.0", "from fares_nearby import FARE"))
    assert first_rewards(one_copy(beside)) == [7.0, 14.0]
    for name in ("ownlab/__init__.py", "ownlab/envs/__init__.py"):
        written(tmp_path, "", name)
    written(tmp_path, "FARE = 8.0", "ownlab/fares.py")
    text = SHUTTLE.replace("FARE = 1.0", "from ..fares import FARE")
    inside = written(tmp_path, text, "ownlab/envs/shuttle.py")
    assert first_rewards(one_copy(inside)) == [8.0, 16.0]


def test_another_process_runs_the_text_that_was_read(tmp_path: Path) -> None:
    """The text is the same if the file was changed or removed after the session began."""
    path = written(tmp_path, SHUTTLE)
    entry = module_entry(path)
    prepared = entry.prepare(entry.config())
    Path(path).write_text(SHUTTLE.replace("FARE = 1.0", "FARE = 100.0"))
    (tmp_path / "prepared").write_bytes(pickle.dumps((entry.make, prepared)))
    code = (
        "import pickle, sys, numpy as np; make, prepared = pickle.load(open(sys.argv[1], 'rb'))\n"
        "env = make(prepared, 1); env.reset(np.zeros(1, np.uint64))\n"
        "print(env.step(np.zeros((1, 2), int))[0].rewards.tolist())"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "prepared")]
    shown = subprocess.run(command, capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines()[-1] == "[[1.0, 2.0]]"


def test_an_edited_file_is_read_again_and_said_to_have_changed(tmp_path: Path) -> None:
    path = written(tmp_path, SHUTTLE)
    digest = EnvFile.read(path).digest
    assert first_rewards(one_copy(path)) == [1.0, 2.0]

    def notices() -> tuple[str, ...]:
        entry = module_entry(path, stored_digest=digest)
        found: tuple[str, ...] = entry.prepare(entry.config()).notices
        return found

    assert notices() == ()
    written(tmp_path, SHUTTLE.replace("FARE = 1.0", "FARE = 3.0"))
    assert first_rewards(one_copy(path)) == [3.0, 6.0]
    [line] = notices()
    assert line.startswith(f"{path} has changed since the run was started")


def test_an_evaluation_episode_can_be_replayed_without_headway(tmp_path: Path) -> None:
    """By the seeds that docs/howto/policies.md names."""
    drawn = SHUTTLE.replace("self.time, ", "self.fare, self.time, ").replace(
        "= 0, list", "= seed % 997, 0, list"
    )
    path = written(tmp_path, drawn)
    entry = module_entry(path)
    rows = evaluate_rule(entry.make, RANDOM.make, entry.prepare(entry.config()), 1_000_003, 2)
    env, returns = EnvFile.read(path).load().Shuttle(), []
    for seed in child_seeds(1_000_003, "evaluation", 0, 2):
        env.reset(seed=episode_seed(int(seed)))
        rewards = [env.step(dict.fromkeys(env.agents, 0))[1] for _ in range(env.steps)]
        returns.append(sum(sum(each.values()) for each in rewards) / 2)
    assert [row["return"] for row in rows] == returns
    assert returns[0] != returns[1]


def test_paths_are_made_absolute_and_other_ids_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert absolute_id("lab/../shuttle.py") == str(tmp_path.resolve() / "shuttle.py")
    assert absolute_id("mpe2.simple_spread_v3") == "mpe2.simple_spread_v3"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "has neither parallel_env nor env, nor a subclass of ParallelEnv"),
        ("from pettingzoo import ParallelEnv", "has neither parallel_env nor env, nor a subclass"),
        (
            SHUTTLE + "\nclass Other(Shuttle): pass\n",
            r"several environments \(Shuttle, Other\).*parallel_env = ",
        ),
        ("def broken(:", r"cannot be imported: SyntaxError: .*shuttle.py, line 1\)"),
        ("1 / 0", "cannot be imported: ZeroDivisionError"),
        ("import some_missing_simulator", "needs the package some_missing_simulator"),
        ("def env():\n    return 3", "an object of type int, which is neither a ParallelEnv nor an AECEnv"),
        (
            "def env():\n    raise ValueError('no fuel')",
            "cannot be made with its defaults: ValueError: no fuel",
        ),
    ],
)
def test_unusable_files_are_one_line_errors(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match=message) as caught:
        one_copy(written(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_an_error_in_the_first_reset_or_in_a_space_is_named_with_its_line(tmp_path: Path) -> None:
    """Also one in a function that `reset` calls, and one in a Gymnasium environment."""
    lines = SHUTTLE.splitlines()
    [place] = [number for number, line in enumerate(lines) if line.strip().startswith("def reset(")]
    lines.insert(place + 1, "        load()")
    lines += ["def load():", "    raise RuntimeError('no data')"]
    with pytest.raises(EnvironmentRaisedError) as caught:
        one_copy(written(tmp_path, "\n".join(lines)))
    told = f"raised RuntimeError: no data in reset (shuttle.py, line {len(lines)})"
    assert str(caught.value).endswith(told)
    changed = SHUTTLE.replace("return Box(0, 1", "1 / 0; return Box(0, 1")
    with pytest.raises(EnvironmentRaisedError, match=r"in observation_space \(shuttle.py, line \d+\)"):
        one_copy(written(tmp_path, changed))
    single = (
        "import gymnasium\nclass Single(gymnasium.Env):\n    action_space = gymnasium.spaces.Discrete(2)\n"
    )
    single += "    observation_space = gymnasium.spaces.Box(0, 1, (1,))\n"
    single += "    def reset(self, **given):\n        1 / 0"
    with pytest.raises(EnvironmentRaisedError, match=r"in reset \(shuttle.py, line 6\)"):
        one_copy(written(tmp_path, f"{single}\nenv = Single"))


def test_an_answer_of_the_first_reset_that_cannot_be_read_is_a_one_line_error(tmp_path: Path) -> None:
    changed = SHUTTLE.replace("def reset(self", "def reset(self, **given): return {}\n    def unused(self")
    with pytest.raises(HeadwayError, match=r"at step 0 that cannot be read .*\(observations, infos\)"):
        one_copy(written(tmp_path, changed))


def test_a_missing_file_is_a_one_line_error(tmp_path: Path) -> None:
    for path in (tmp_path / "gone.py", tmp_path):
        with pytest.raises(
            HeadwayError, match="there is no such file; correct the path, or restore the file"
        ):
            EnvFile.read(str(path))
    (tmp_path / "depots.py").touch()
    with pytest.raises(HeadwayError, match=r"no such file; did you mean depots\.py, beside it\?"):
        EnvFile.read(str(tmp_path / "depot.py"))


DECLARED = (
    SHUTTLE
    + """
from headway.api import RuleEntry

class Still:
    def act(self, env, observed):
        return np.zeros(observed.observations.shape[:2], np.int64)

METRICS = {"late": "departures after their time"}
RULES = {"still": RuleEntry("all cars wait", lambda prepared: Still())}
"""
)


def test_a_file_describes_its_metrics_and_has_rules(tmp_path: Path) -> None:
    entry = module_entry(written(tmp_path, DECLARED))
    assert entry.metrics == {"late": "departures after their time"}
    assert list(entry.rules) == ["random", "still"]
    assert module_entry(written(tmp_path, SHUTTLE, "plain.py")).metrics == {}


@pytest.mark.parametrize(
    ("declared", "problem"),
    [
        ("METRICS = ['late']", r"METRICS must be a dict, not \['late'\]"),
        ("METRICS = {'late': 3}", "METRICS must map names to str, not 'late' to 3"),
        ("RULES = {'still': 'wait'}", "RULES must map names to RuleEntry, not 'still' to 'wait'"),
    ],
)
def test_metrics_and_rules_of_a_file_are_checked(declared: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match=rf"^env\.id=.*shuttle\.py: {problem}$"):
        module_entry(written(tmp_path, f"{SHUTTLE}\n{declared}\n"))
