"""PettingZoo environments by module path: allowed modules, arguments, errors."""

import pickle
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pettingzoo
import pytest

from headway.adapters import installed
from headway.adapters.conformance import CHECKS, play
from headway.adapters.modules import make_batch, module_entry
from headway.adapters.pettingzoo import AdapterOptions
from headway.config.schema import build, describe, plain
from headway.config.signatures import argument_record
from headway.contracts import Discrete, HeadwayError
from headway.registry import env_entry
from headway.rollout.episodes import evaluate_rule
from headway.wrappers.listed import listed_wrappers
from headway.wrappers.wrapped_env import wrapped_entry

SPREAD = "mpe2.simple_spread_v3"
KNIGHTS = "pettingzoo.butterfly.knights_archers_zombies_v11"
DEADLY = {"max_cycles": 200, "line_death": True, "spawn_delay": 5}
PAD = ["pad_observations_v0", "pad_action_space_v0"]

MODULES = {
    "turns_v0": "from mpe2.simple_spread_v3 import env",
    "unparallel_v0": """
        from mpe2 import simple_spread_v3

        def env(N: int = 3):
            made = simple_spread_v3.env(N=N)
            made.unwrapped.metadata = {**made.unwrapped.metadata, "is_parallelizable": False}
            return made
    """,
    "open_v0": """
        from mpe2 import simple_spread_v3

        def parallel_env(**anything):
            return simple_spread_v3.parallel_env(**anything)
    """,
    "stranger_v0": "parallel_env = object",
    "broken_v0": "raise RuntimeError('out of order')",
    "needy_v0": "import some_missing_simulator",
    "team_v0": """
        from mpe2 import simple_spread_v3

        def parallel_env(size: tuple[int, ...] = (3, 3), local: bool = False, factory=object()):
            assert isinstance(size, tuple)
            return simple_spread_v3.parallel_env(N=size[0], local_ratio=0.5 if local else 0.0)
    """,
    "paid_v0": """
        import time
        from scripted import Scripted

        played = []

        def parallel_env(pays: tuple[float, ...] = (1.0, 1.0), seconds: float = 0.0, seen: float = 0.0):
            def script(env):
                if env.steps == 2 and "b" in env.observations:
                    env.observations["b"][1] = seen
                if env.steps:
                    time.sleep(seconds)
                    played.append(env.steps)
                env.rewards = {agent: pay - 0 * pay for agent, pay in zip(env.agents, pays)}  # inf: NaN
                env.terminated = {agent: agent == "b" and env.steps > 3 for agent in env.agents}

            return Scripted(script, agents=["a", "b"][: len(pays)], length=8)
    """,
}


@pytest.fixture
def zoo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An installed package of environments that depends on PettingZoo, and one that does not."""
    for name, requirement in (("somezoo", "Requires-Dist: pettingzoo>=1.24\n"), ("plainpackage", "")):
        package = tmp_path / name
        package.mkdir()
        (package / "__init__.py").write_text("")
        for module, text in MODULES.items():
            (package / f"{module}.py").write_text(dedent(text))
        metadata = tmp_path / f"{name}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n{requirement}"
        )
        (metadata / "RECORD").write_text(f"{name}/__init__.py,,\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    installed._depends_on.cache_clear()
    yield "somezoo"
    for module in [module for module in sys.modules if module.split(".")[0] in ("somezoo", "plainpackage")]:
        del sys.modules[module]


def prepared(module: str, options: AdapterOptions | None = None, **arguments: object) -> Any:  # noqa: ANN401
    entry = module_entry(module, options or AdapterOptions(), arguments)
    return entry.prepare(build(entry.config, arguments, "env.args", module))


@pytest.mark.slow
def test_an_id_of_the_registry_is_the_environment_of_its_module() -> None:
    rewards = []
    for name in ("pettingzoo:sisl/pursuit-v5", "pettingzoo.sisl.pursuit_v5"):
        entry = module_entry(name, arguments=["n_pursuers"])
        env = entry.make(entry.prepare(build(entry.config, {"n_pursuers": 3}, "env.args", name)), 1)
        env.reset(np.array([7], np.uint64))
        assert env.spec.num_agents == 3
        rewards.append([env.step(np.full((1, 3), step % 5))[0].rewards.tolist() for step in range(30)])
    assert rewards[0] == rewards[1]
    pursuit = "pettingzoo.sisl.pursuit.pursuit:parallel_env"
    for number, entry_point in ((3, pursuit), (4, pettingzoo.parallel_registry["sisl/pursuit-v5"].make)):
        pettingzoo.register("parallel", f"few/pursuit{number}-v0", entry_point, kwargs={"n_pursuers": number})
        entry = module_entry(f"pettingzoo:few/pursuit{number}-v0")
        env = entry.make(entry.prepare(build(entry.config, {}, "env.args", "few")), 1)
        assert env.spec.num_agents == number
    with pytest.raises(
        HeadwayError, match=r"no such environment; did you mean env=pettingzoo:sisl/pursuit-v5"
    ):
        module_entry("pettingzoo:sisl/pursuit-v4")


def test_a_module_environment_keeps_the_contract() -> None:
    shared = pickle.loads(pickle.dumps(prepared(SPREAD, N=2)))
    assert shared.arguments == {"N": 2}
    recording = play(partial(make_batch, shared), max_steps=60)
    assert recording.spec.agents == ("agent_0", "agent_1")
    assert recording.spec.action_space == Discrete(5)
    assert recording.spec.groups == ()
    assert not recording.spec.shared_reward
    for check in ("spec", "alive", "ends", "determinism", "copies"):
        CHECKS[check](partial(make_batch, shared), recording)


def test_arguments_are_those_of_the_factory_with_its_defaults() -> None:
    rows = {row.key: (row.type, row.default) for row in describe(env_entry(SPREAD).config, "env.args")}
    assert rows["env.args.N"] == ("whole number", "3")
    assert rows["env.args.local_ratio"] == ("number", "0.5")
    assert rows["env.args.num_agent_neighbors"] == ("whole number or null", "null")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n": 3}, r"env.args.n is not a key of mpe2.simple_spread_v3; did you mean env.args.N\?"),
        ({"N": "three"}, "env.args.N='three' is text, where a whole number is expected"),
        ({"local_ratio": 2.0}, "simple_spread_v3 cannot be made with local_ratio=2.0: AssertionError: local"),
    ],
)
def test_unsuitable_arguments_are_one_line_errors(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        prepared(SPREAD, **arguments)


@pytest.mark.parametrize(
    ("module", "message"),
    [
        ("mpe2.simple_sprae_v3", r"no such module; did you mean mpe2.simple_spread_v3\?"),
        ("mpe3.simple_spread_v3", r"there is no package mpe3; install it \(pip install mpe3\)"),
        ("pettingzoo.butterfly.pistonball_v6", "needs the package pymunk, which is not installed: pip ins"),
        ("pettingzoo.classic.tictactoe_v2", "did you mean pettingzoo.classic.tictactoe_v3"),
        ("mpe2.all_modules", "nor env, nor a subclass of ParallelEnv: it is not a PettingZoo environment"),
        ("mpe2._mpe_utils.simple_env", "is not a public module; write package.module"),
        ("os.path", "os is not an installed package that depends on PettingZoo, and no other is imported"),
        ("plainpackage.turns_v0", "plainpackage is not an installed package that depends on PettingZoo"),
        ("somezoo.stranger_v0", "an object of type object, which is neither a ParallelEnv nor an AECEnv"),
        ("somezoo.broken_v0", "cannot be imported: RuntimeError: out of order"),
        ("somezoo.needy_v0", "needs the package some_missing_simulator"),
        ("somezoo.unparallel_v0", "is played turn by turn and its metadata does not set is_parallelizable"),
        ("pettingzoo.classic.rps_v2", "agent 'player_0' observes a Discrete.*flatten it to a Box"),
    ],
)
def test_unusable_modules_are_one_line_errors(module: str, message: str, zoo: str) -> None:
    with pytest.raises(HeadwayError, match=message):
        make_batch(prepared(module), 1)


def test_refused_modules_are_not_imported(zoo: str) -> None:
    with pytest.raises(HeadwayError):
        module_entry("plainpackage.turns_v0")
    assert "plainpackage" not in sys.modules
    assert "plainpackage.turns_v0" not in sys.modules


def test_a_parallelizable_aec_environment_becomes_parallel(zoo: str) -> None:
    turns, whole = make_batch(prepared(f"{zoo}.turns_v0", N=2), 1), make_batch(prepared(SPREAD, N=2), 1)
    seeds, actions = np.array([4], dtype=np.uint64), np.array([[1, 2]])
    np.testing.assert_array_equal(turns.reset(seeds).observations, whole.reset(seeds).observations)
    for _ in range(30):
        (one, _), (other, _) = turns.step(actions), whole.step(actions)
        np.testing.assert_array_equal(one.rewards, other.rewards)
        np.testing.assert_array_equal(one.truncated, other.truncated)


def test_a_factory_with_open_arguments_gets_those_given(zoo: str) -> None:
    assert make_batch(prepared(f"{zoo}.open_v0", N=4), 1).spec.num_agents == 4
    with pytest.raises(HeadwayError, match=r"cannot be made with M=4: TypeError.*unexpected keyword arg"):
        prepared(f"{zoo}.open_v0", M=4)


def test_lists_become_tuples_and_non_yaml_arguments_are_left_out(zoo: str) -> None:
    entry = module_entry(f"{zoo}.team_v0")
    assert [row.key for row in describe(entry.config)] == ["size", "local"]
    config = build(entry.config, {"size": [2, 2]}, "env.args", "team")
    again = build(entry.config, plain(config), "env.args", "team")
    assert make_batch(entry.prepare(again), 1).spec.num_agents == 2
    assert entry.prepare(build(entry.config, plain(entry.config()), "")).arguments == {}


def test_unknown_annotations_accept_any_value() -> None:
    def function(env: object, path: Path, sizes: "list[int]", odd: "Missing" = 3) -> None:  # type: ignore[name-defined]  # noqa: F821
        pass

    record = argument_record(function, first=1)
    defaults = {row.key: row.default for row in describe(record)}
    assert defaults == {"path": "required", "sizes": "required", "odd": "3"}
    assert build(record, {"path": "x", "sizes": [1]}, "") is not None


def test_arguments_are_described_by_lines_of_the_docstring() -> None:
    def function(cars: int, steps: int = 20, bus: bool = False, speed: float = 1.0) -> None:
        """Return a junction with cars: many of them.

        Args:
            cars: agents,
                besides the bus
            steps (int): length of an episode
        :param bus: whether there is a bus
        """

    described = {row.key: row.doc for row in describe(argument_record(function))}
    assert described == {
        "cars": "agents, besides the bus",
        "steps": "length of an episode",
        "bus": "whether there is a bus",
        "speed": "",
    }


def test_a_shared_reward_is_checked_against_the_rewards(zoo: str) -> None:
    team = AdapterOptions(shared_reward=True)
    make = prepared(f"{zoo}.team_v0", team)
    env = make_batch(make, 2)
    assert env.spec.shared_reward
    CHECKS["shared reward"](partial(make_batch, make), play(partial(make_batch, make)))
    selfish = prepared(f"{zoo}.team_v0", team, local=True)
    with pytest.raises(HeadwayError, match=r"all agents the same reward but returned agent_0 .*reward=false"):
        play(lambda copies: make_batch(selfish, copies))


SHARED = "set env.shared_reward=true"
INF = float("inf")


@pytest.mark.parametrize(
    ("module", "shared", "arguments", "said"),
    [
        ("team_v0", None, {}, True),
        ("team_v0", None, {"local": True}, False),
        ("team_v0", True, {}, False),
        ("team_v0", False, {}, False),
        *(("paid_v0", None, {"pays": pays}, False) for pays in ((0.0, 0.0), (1.0, 2.0), (1.0,), (INF, INF))),
    ],
)
def test_equal_rewards_are_noticed(
    zoo: str, module: str, shared: bool | None, arguments: dict[str, Any], said: bool
) -> None:
    """Unless the user said how rewards are, nothing was paid, or there is but one agent."""
    notices = prepared(f"{zoo}.{module}", AdapterOptions(shared_reward=shared), **arguments).training_notices
    assert [SHARED in line for line in notices] == [True] * said


def test_equal_rewards_are_noticed_behind_wrappers(zoo: str) -> None:
    """The wrappers are SuperSuit's or batched ones, also where the environment cannot be played
    without them."""
    for names in (["frame_stack_v1"], ["black_death_v3"]):
        entry = module_entry(f"{zoo}.paid_v0")
        wrapped = wrapped_entry("paid", entry, listed_wrappers([{"name": name} for name in names]))
        assert [SHARED in line for line in wrapped.prepare(wrapped.config()).training_notices] == [True]


@pytest.mark.parametrize(("seen", "said"), [(-9.0, 0), (-9.00001, 0), (INF, 1), (-12.0, 1)])
def test_an_observation_outside_its_space_is_noticed(zoo: str, seen: float, said: int) -> None:
    """Rounding is none."""
    lines = prepared(f"{zoo}.paid_v0", pays=(1.0, 2.0), seen=seen).notices
    expected = (
        f"agent 'b' observed {seen:g} at step 2, outside its observation_space (-9 to 2.147e+09 at index 1)"
    )
    assert [expected in line for line in lines] == [True] * said


@pytest.mark.slow
def test_a_slow_environment_is_not_played_for_long(zoo: str) -> None:
    begun = time.monotonic()
    assert len(prepared(f"{zoo}.paid_v0", seconds=0.5).training_notices) == 1
    assert time.monotonic() - begun < 6
    assert 1 < sys.modules[f"{zoo}.paid_v0"].played[-1] < 8


def test_unequal_agents_are_named_and_padding_makes_them_equal() -> None:
    entry = module_entry("mpe2.simple_tag_v3")
    with pytest.raises(HeadwayError, match=r"different observation spaces.*wrappers=\[pad_observations_v0\]"):
        entry.make(entry.prepare(entry.config()), 1)
    padded = wrapped_entry("mpe2.simple_tag_v3", entry, listed_wrappers(PAD))
    shared = pickle.loads(pickle.dumps(padded.prepare(entry.config())))
    recording = play(shared.batch, max_steps=60)
    spec = recording.spec
    assert spec.observation_size == 16
    assert spec.groups == ("adversary", "adversary", "adversary", "agent")
    prey = recording.trajectory.observations[:, :, spec.agents.index("agent_0")]
    assert prey[..., :14].any()
    assert not prey[..., 14:].any()
    CHECKS["determinism"](shared.batch, play(shared.batch))


@pytest.mark.parametrize("kept", [False, True], ids=["gone", "black death"])
def test_dead_knights_leave_or_stay(kept: bool) -> None:
    """A real environment whose agents die at different times."""
    entry = module_entry(KNIGHTS, AdapterOptions(agents_come_and_go=None if kept else True))
    config = build(entry.config, DEADLY, "", KNIGHTS)
    wrapped = wrapped_entry(KNIGHTS, entry, listed_wrappers(["black_death_v3"] if kept else []))
    shared = wrapped.prepare(config)
    recording = play(lambda copies: wrapped.make(shared, copies), copies=1, max_steps=400)
    track, ended = recording.trajectory, recording.episode_ended
    assert ended.any()
    over = (track.terminated | track.truncated) & ~ended[..., None]
    if kept:
        assert track.alive.all()
        assert not over.any()
        still = ~track.observations.any(axis=-1)
        assert still.any(), "no agent died: choose other seeds"
        assert not track.rewards[still[1:]].any()
    else:
        assert over.any(), "no agent died: choose other seeds"
        assert not track.alive.all()


def test_an_undeclared_death_names_the_key_to_set() -> None:
    entry = module_entry(KNIGHTS)
    shared = entry.prepare(build(entry.config, DEADLY, "", KNIGHTS))
    with pytest.raises(HeadwayError, match=r"set env\.agents_come_and_go=true, or keep it alive with the wr"):
        play(lambda copies: entry.make(shared, copies), copies=2, max_steps=700)


def test_random_play_is_a_rule_of_every_environment() -> None:
    entry = env_entry(SPREAD)
    rows = evaluate_rule(entry.make, entry.rules["random"].make, entry.prepare(entry.config()), 0, 3)
    assert [row["length"] for row in rows] == [25, 25, 25]


def test_native_environments_do_not_import_pettingzoo_in_workers() -> None:
    code = (
        "import sys, headway.rollout.workers.worker, headway.wrappers.frame_stack; "
        "print([name for name in ('pettingzoo', 'supersuit', 'gymnasium', 'torch') if name in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"
