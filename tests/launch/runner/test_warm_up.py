"""Kernels are compiled before training starts, with a notice if that happens."""

import sys
from collections.abc import Iterable
from pathlib import Path
from threading import Event
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest

import headway_algos
import headway_envs
from headway.contracts.entries import AlgoEntry, EnvEntry
from headway.registry import algo_entry, env_entry
from headway_launch.commands.main import run as run_command
from headway_launch.experiments.compose import compose
from headway_launch.experiments.experiment import Experiment
from headway_launch.runner.warm_up import compile_kernels, compile_kernels_of, kernel_modules


def entry(*preload: str) -> EnvEntry:
    return EnvEntry("toy", object, lambda prepared, copies: None, preload=preload)  # type: ignore[arg-type, return-value]


def test_compiling_is_reported_once_and_only_if_it_happens(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kernels = ModuleType("kernels_of_a_test")
    functions = [numba.njit(lambda x: x + 1), numba.njit(lambda x: x * 2)]
    monkeypatch.setattr(kernels, "warm", lambda: [function(3) for function in functions], raising=False)
    monkeypatch.setitem(sys.modules, "kernels_of_a_test", kernels)
    compile_kernels(entry("kernels_of_a_test"))
    told = "compiling the kernels of kernels_of_a_test (1 of 1), once (a few minutes)\n"
    assert capsys.readouterr().err == told
    compile_kernels(entry("kernels_of_a_test"))
    compile_kernels(entry("json"))
    assert capsys.readouterr().err == ""


def test_a_long_compilation_prints_its_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    printed, again = list[str](), Event()

    def noted(line: str) -> None:
        printed.append(line)
        if len(printed) == 2:
            again.set()

    monkeypatch.setattr("headway_launch.runner.warm_up._EVERY_S", 0.01)
    monkeypatch.setattr("headway_launch.runner.warm_up.print_line", noted)
    kernels = ModuleType("slow_kernels")
    compile_and_wait = [lambda: numba.njit(lambda x: x + 1)(3), again.wait]
    monkeypatch.setattr(kernels, "warm", lambda: [each() for each in compile_and_wait], raising=False)
    monkeypatch.setitem(sys.modules, "slow_kernels", kernels)
    compile_kernels(entry("slow_kernels"))
    assert printed[1].startswith("still compiling the kernels of slow_kernels (1 of 1), for 0:00:0")


@pytest.mark.parametrize("arguments", [{}, {"observation": "published", "state": "aggregate"}])
def test_the_warm_up_compiles_all_that_training_needs(arguments: dict[str, str]) -> None:
    from headway_envs.bus.kernel import tick

    bus = env_entry("bus")
    compile_kernels(bus)
    functions: tuple[Any, ...] = (tick.begin, tick.step, tick.start_next_days)
    before = [list(function.signatures) for function in functions]
    env = bus.make(bus.prepare(bus.config(end_hour=6, **arguments)), 2)
    env.reset(np.arange(2, dtype=np.uint64))
    ended = False
    while not ended:
        outcome, _ = env.step(np.ones((2, len(env.spec.agents)), np.int64))
        ended = bool(outcome.episode_ended.any())
    assert [list(function.signatures) for function in functions] == before
    assert all(before)


def test_a_session_compiles_before_storing_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[tuple[EnvEntry, AlgoEntry]] = []

    def stop(experiments: Iterable[Experiment]) -> None:
        compiled.extend((experiment.env, experiment.algo) for experiment in experiments)
        raise KeyboardInterrupt

    monkeypatch.setattr("headway_launch.runner.runner.compile_kernels_of", stop)
    assert run_command(["run", "env=trivial", "algo=ippo", f"store.root={tmp_path}", "energy=off"]) == 130
    assert compiled == [(env_entry("trivial"), algo_entry("ippo"))]
    assert not list(tmp_path.iterdir())


def test_kernels_of_learners_and_environments_are_compiled_together(monkeypatch: pytest.MonkeyPatch) -> None:
    warmed = []
    monkeypatch.setattr("headway_algos.kernels.warm", lambda: warmed.append("learning"))
    monkeypatch.setattr("headway_envs.bus.kernel.warm", lambda: warmed.append("stepping"))
    compile_kernels_of([compose([f"env={env}", "algo=ippo"]) for env in ("bus", "trivial")])
    assert sorted(warmed) == ["learning", "stepping"]


def test_setup_compiles_all_kernels_there_are() -> None:
    written = []
    for package in (headway_envs, headway_algos):
        folder = Path(package.__path__[0])
        for file in folder.rglob("*.py"):
            if "\ndef warm(" in file.read_text(encoding="utf-8"):
                parts = file.relative_to(folder.parent).with_suffix("").parts
                written.append(".".join(parts).removesuffix(".__init__"))
    assert len(written) > 3
    assert set(written) <= set(kernel_modules())
