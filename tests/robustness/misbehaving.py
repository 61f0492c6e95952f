"""A PettingZoo environment that misbehaves in a chosen way at a chosen moment."""

import contextlib
import multiprocessing
import os
import random
import resource
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

EPISODE_STEPS = 6
PRINTED = "beep"


class Misbehaving(ParallelEnv):  # type: ignore[misc]  # PettingZoo comes without types
    """Two agents observe numbers and are paid for their actions; see `parallel_env`."""

    metadata = {"name": "misbehaving"}  # noqa: RUF012 - as PettingZoo has it

    def __init__(self, fault: str, place: str, at: int, mark: str, spares_session: bool) -> None:
        self.possible_agents, self.agents = ["a", "b"], list[str]()
        self.fault, self.place, self.at, self.mark = fault, place, at, mark
        self.spared = spares_session and multiprocessing.parent_process() is None
        self.calls, self.steps, self.answer = {"reset": 0, "step": 0, "close": 0}, 0, tuple[Any, ...]()
        self.kept: list[Any] = []
        if place == "constructor" and self._is_due():
            ACTS[fault]()

    def observation_space(self, agent: str) -> Any:  # noqa: ANN401 - as PettingZoo has it
        return spaces.Box(-np.inf, np.inf, (3,))

    def action_space(self, agent: str) -> Any:  # noqa: ANN401 - as PettingZoo has it
        return spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: object = None) -> Any:  # noqa: ANN401 - may be wrong
        self.agents, self.steps, self.start = list(self.possible_agents), 0, float((seed or 0) % 1000) / 1000
        self.answer = self._observed()
        return self._called("reset")

    def step(self, actions: dict[str, int]) -> Any:  # noqa: ANN401 - may be wrong
        self.steps += 1
        ended = self.steps == EPISODE_STEPS
        observations, infos = self._observed()
        rewards = {agent: self.start + float(actions[agent]) * (agent == "a") for agent in self.agents}
        flags = [dict.fromkeys(self.agents, value) for value in (False, ended)]
        self.answer = (observations, rewards, *flags, infos)
        if ended:
            self.agents = []
        return self._called("step")

    def close(self) -> None:
        self._called("close")

    def _observed(self) -> tuple[dict[str, Any], dict[str, Any]]:
        row = np.array([self.start, self.steps / EPISODE_STEPS, 1.0], np.float32)
        return {agent: row.copy() for agent in self.agents}, {agent: {} for agent in self.agents}

    def _called(self, place: str) -> Any:  # noqa: ANN401 - may be wrong
        self.calls[place] += 1
        if place == self.place and self.calls[place] >= self.at and self._is_due():
            if self.fault in ANSWERS:
                return ANSWERS[self.fault](self)
            self.kept.append(ACTS[self.fault]())
        return self.answer

    def _is_due(self) -> bool:
        """Return whether to misbehave; with a mark, only the first time in all processes."""
        if self.spared or not self.fault:
            return False
        if not self.mark:
            return True
        with contextlib.suppress(FileExistsError):
            Path(self.mark).touch(exist_ok=False)
            return True
        return False


def parallel_env(
    fault: str = "", place: str = "step", at: int = 1, mark: str = "", spares_session: bool = True
) -> Misbehaving:
    """Return the environment.

    It misbehaves from call `at` of the method `place` of a copy on; at the first such call only if `mark` is
    the path of a file yet to be made. `spares_session`: only in processes that a session starts.
    """
    return Misbehaving(fault, place, at, mark, spares_session)


def _with_observation(value: object) -> Callable[[Misbehaving], Any]:
    def answer(env: Misbehaving) -> Any:  # noqa: ANN401 - wrong on purpose
        env.answer[0]["a"] = value
        return env.answer

    return answer


def _with_entry(index: int, agent: str, value: object) -> Callable[[Misbehaving], Any]:
    """Return an answer with a changed entry of one of the dictionaries, counted from the last if negative."""

    def answer(env: Misbehaving) -> Any:  # noqa: ANN401 - wrong on purpose
        env.answer[index % len(env.answer)][agent] = value
        return env.answer

    return answer


def _without(index: int) -> Callable[[Misbehaving], Any]:
    def answer(env: Misbehaving) -> Any:  # noqa: ANN401 - wrong on purpose
        env.answer[index % len(env.answer)].pop("b", None)
        return env.answer

    return answer


def _replaced(index: int, value: object) -> Callable[[Misbehaving], Any]:
    def answer(env: Misbehaving) -> Any:  # noqa: ANN401 - wrong on purpose
        changed = list(env.answer)
        changed[index % len(changed)] = value
        return tuple(changed)

    return answer


def _with_agents(agents: Any) -> Callable[[Misbehaving], Any]:  # noqa: ANN401 - wrong on purpose
    def answer(env: Misbehaving) -> Any:  # noqa: ANN401 - wrong on purpose
        env.agents = agents
        return env.answer

    return answer


def _never_ending(env: Misbehaving) -> Any:  # noqa: ANN401 - as PettingZoo has it
    env.steps, env.agents = 1, list(env.possible_agents)
    return (*env.answer[:-2], dict.fromkeys(env.agents, False), env.answer[-1])


ANSWERS: dict[str, Callable[[Misbehaving], Any]] = {
    "observation of another shape": _with_observation(np.zeros(5, np.float32)),
    "scalar observation": _with_observation(1.0),
    "text observation": _with_observation(np.array(["x", "y", "z"])),
    "complex observation": _with_observation(np.zeros(3, complex) + 1j),
    "integer observation": _with_observation(np.ones(3, np.int64)),
    "nan observation": _with_observation(np.full(3, np.nan, np.float32)),
    "infinite observation": _with_observation(np.full(3, np.inf)),
    "no observation": _with_observation(None),
    "observation of objects": _with_observation(np.array([object(), {}, "\n"], object)),
    "missing observation": _without(0),
    "missing info": _without(-1),
    "unknown agent": _with_entry(0, "c", np.zeros(3, np.float32)),
    "observations None": _replaced(0, None),
    "observations a list": _replaced(0, [np.zeros(3)] * 2),
    "infos None": _replaced(-1, None),
    "info no dictionary": _with_entry(-1, "a", 7),
    "wrong action mask": _with_entry(-1, "a", {"action_mask": [1, 0, 1]}),
    "alive a text": _with_entry(-1, "a", {"alive": "no"}),
    "answer None": lambda env: None,
    "one value less": lambda env: env.answer[:-1],
    "agents unknown": _with_agents(["c", "d"]),
    "agents None": _with_agents(None),
    "agents doubled": _with_agents(["a", "a", "b"]),
    "agents gone": _with_agents([]),
}
STEP_ANSWERS: dict[str, Callable[[Misbehaving], Any]] = {
    "nan reward": _with_entry(1, "a", float("nan")),
    "infinite reward": _with_entry(1, "a", 1e300),
    "reward None": _with_entry(1, "a", None),
    "reward a text": _with_entry(1, "a", "1.0"),
    "reward a word": _with_entry(1, "a", "much\nmore"),
    "reward a list": _with_entry(1, "a", [1.0, 2.0]),
    "reward an array": _with_entry(1, "a", np.ones(1)),
    "missing reward": _without(1),
    "reward of an unknown agent": _with_entry(1, "c", 1.0),
    "rewards None": _replaced(1, None),
    "missing flag": _without(2),
    "flag a text": _with_entry(3, "a", "no"),
    "flag None": _with_entry(2, "a", None),
    "flag an array": _with_entry(3, "a", np.array([True, False])),
    "never ending": _never_ending,
}
ANSWERS |= STEP_ANSWERS


class _Unspeakable(Exception):  # noqa: N818 - its name is printed
    def __str__(self) -> str:
        raise RuntimeError("no words")


class _Unpicklable(Exception):  # noqa: N818 - its name is printed
    def __init__(self, one: int, two: int) -> None:
        super().__init__("lock", threading.Lock())


def _raise(error: BaseException) -> Callable[[], NoReturn]:
    def act() -> NoReturn:
        raise error

    return act


def _loop() -> None:
    while True:
        time.sleep(0.01)


def _spin() -> None:
    while True:
        pass


def _recurse() -> None:
    _recurse()


def _fork_and_leave() -> None:
    """Fork off a process that stays for a while."""
    if os.fork() == 0:
        time.sleep(20)
        os._exit(0)


def _leave_thread() -> None:
    threading.Thread(target=time.sleep, args=(10.0,)).start()


def _leak_files() -> list[Any]:
    return [Path(os.devnull).open() for _ in range(200)]


def _exhaust_files() -> list[Any]:
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    return _leak_files()


def _print() -> None:
    print(PRINTED, flush=True)
    print(f"{PRINTED} \x1b[31m\x00", file=sys.stderr, flush=True)
    os.write(1, f"{PRINTED}\n".encode())


def _close_standard_files() -> None:
    for number in range(3):
        with contextlib.suppress(OSError):
            os.close(number)


def _change_random_state() -> None:
    np.random.seed(1)  # noqa: NPY002 - a global generator on purpose
    random.seed(1)
    np.seterr(all="raise")


def _change_process() -> None:
    os.umask(0o777)
    sys.stdout = None
    warnings.simplefilter("error")
    sys.setrecursionlimit(200)


HARMLESS: dict[str, Callable[[], Any]] = {
    "leave a thread": _leave_thread,
    "leak files": _leak_files,
    "print": _print,
    "change the folder": lambda: os.chdir("/"),
    "change the random state": _change_random_state,
    "clear the environment": lambda: os.environ.clear(),
    "leave a process": _fork_and_leave,
    "take a moment": lambda: time.sleep(0.5),
}
"""After these a run ends well, with the curve of an undisturbed one."""
FATAL: dict[str, Callable[[], Any]] = {
    "_exit(0)": lambda: os._exit(0),
    "_exit(3)": lambda: os._exit(3),
    "SIGKILL": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "SIGSEGV": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "SIGTERM": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "SIGSTOP": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "close files 0 to 2": _close_standard_files,
    "fork": os.fork,
    "exhaust files": _exhaust_files,
    "change the process": _change_process,
    "spin": _spin,
}
"""No session can survive these in its own process."""
ACTS: dict[str, Callable[[], Any]] = {
    **HARMLESS,
    **FATAL,
    "raise": _raise(ValueError("out of order")),
    "raise two lines": _raise(RuntimeError("first line\nsecond line")),
    "raise control characters": _raise(RuntimeError("red \x1b[31m bell \x07 null \x00 \u202e")),
    "raise a surrogate": _raise(RuntimeError("half \udc80")),
    "raise nothing": _raise(AssertionError()),
    "raise much": _raise(RuntimeError("x" * 100_000)),
    "raise KeyError": _raise(KeyError("agent")),
    "raise OSError": _raise(BrokenPipeError("a pipe")),
    "raise EOFError": _raise(EOFError()),
    "raise StopIteration": _raise(StopIteration()),
    "raise KeyboardInterrupt": _raise(KeyboardInterrupt()),
    "raise GeneratorExit": _raise(GeneratorExit()),
    "raise BaseException": _raise(BaseException("base")),
    "raise MemoryError": _raise(MemoryError()),
    "raise an unspeakable error": _raise(_Unspeakable()),
    "raise an unpicklable error": _raise(_Unpicklable(1, 2)),
    "sys.exit()": _raise(SystemExit()),
    "sys.exit(0)": _raise(SystemExit(0)),
    "sys.exit(5)": _raise(SystemExit(5)),
    "sys.exit(text)": _raise(SystemExit("I am off")),
    "allocate": lambda: np.ones(10**13),
    "recurse": _recurse,
    "loop": _loop,
}
HANGING = ("loop", "spin", "SIGSTOP")
"""Faults after which a user must interrupt the session, because nothing limits their time."""
