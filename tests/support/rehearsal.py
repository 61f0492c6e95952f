"""Plans, parameters and environments that fail on cue, for the tests of rollouts.

Worker processes import this module, so it must not be part of a test module.
"""

import os
import signal
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from headway.config.experiment import BackendConfig
from headway.config.schema import build
from headway.contracts import (
    BatchedEnv,
    Contribution,
    EnvSpec,
    Observations,
    StepResult,
    Trajectory,
    generator,
)
from headway.contracts.acting_policy import Parameters
from headway.rollout.backends import open_collector
from headway.rollout.collector import Collector
from headway.rollout.plan import RolloutPlan
from headway.rollout.sampler import Episode
from headway.rollout.workers.worker_pool import Notify
from headway_algos.acting.policy import acting_policy
from headway_algos.config import ModelConfig
from headway_algos.registry import configure
from headway_envs.toy.tracking import Tracking, TrackingConfig
from headway_envs.toy.trivial import Trivial, TrivialConfig
from headway_envs.toy.visitors import Visitors, VisitorsConfig

Arrays = dict[str, NDArray[Any]]
Fault = Literal[
    "kill",
    "raise",
    "nan observation",
    "nan reward",
    "nan final",
    "nan state",
    "bad snapshot",
    "exit",
    "hang up",
    "kill parent",
    "fork",
    "fork in reset",
    "fork and raise",
    "hang",
    "stop",
]

VISITORS = VisitorsConfig(agents=3, steps=12)


@dataclass(frozen=True)
class FaultConfig:
    """Configuration of `FaultyVisitors`."""

    fault: Fault
    marks: str
    """Folder of marks that count, across processes, how often the fault has struck."""
    at: int
    """Step of an environment since its first reset (kept by snapshots) at which the fault strikes."""
    copies: int
    """Number of copies of the environments that it strikes, to spare those of evaluation for instance."""
    times: int = 1
    """Number of times that the fault strikes."""
    snapshots: bool = True
    limit: int | None = None
    """Declared limit of copies per process, which is not enforced."""


class FaultyVisitors:
    """`Visitors` with a fault at one step."""

    def __init__(self, config: FaultConfig, copies: int) -> None:
        self._config = config
        self._env = Visitors(VISITORS, copies)
        self._steps = np.zeros(1, np.int64)

    @property
    def spec(self) -> EnvSpec:
        snapshots, limit = self._config.snapshots, self._config.limit
        return replace(self._env.spec, name="faulty", snapshots=snapshots, max_copies_per_process=limit)

    @property
    def num_copies(self) -> int:
        return self._env.num_copies

    def reset(self, seeds: NDArray[np.uint64]) -> Observations:
        self._steps[:] = 0
        if self._config.fault == "fork in reset" and self._strikes():
            os.fork()
        return self._env.reset(seeds)

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        outcome, observed = self._env.step(actions)
        self._steps += 1
        due = self._steps[0] >= self._config.at and self._config.fault != "fork in reset"
        if due and self._strikes():
            self._fail(outcome, observed)
        return outcome, observed

    def snapshot(self) -> Any:  # noqa: ANN401 - the contract's type
        if self._config.fault == "bad snapshot" and self._strikes():
            return lambda: "this cannot be pickled"
        return {"visitors": self._env.snapshot(), "steps": self._steps.copy()}

    def restore(self, snapshot: Any) -> Observations:  # noqa: ANN401 - the contract's type
        self._steps[:] = snapshot["steps"]
        return self._env.restore(snapshot["visitors"])

    def close(self) -> None:
        self._env.close()

    def _strikes(self) -> bool:
        """Return whether the fault strikes now, and count it; atomic among processes."""
        if self._env.num_copies != self._config.copies:
            return False
        for number in range(self._config.times):
            try:
                os.close(os.open(Path(self._config.marks, f"struck-{number}"), os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            return True
        return False

    def _fail(self, outcome: StepResult, observed: Observations) -> None:
        match self._config.fault:
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "kill parent":  # for a Ray worker, the daemon of its node
                os.kill(os.getppid(), signal.SIGKILL)
                time.sleep(60)
            case "hang":
                time.sleep(600)
            case "stop":
                os.kill(os.getpid(), signal.SIGSTOP)
            case "fork":
                os.fork()
            case "fork and raise":
                if os.fork() == 0:
                    raise RuntimeError("the child fails")
            case "exit":
                sys.exit(3)
            case "hang up":
                for descriptor in range(256):
                    with suppress(OSError):
                        if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                            os.close(descriptor)
                time.sleep(60)
            case "raise":
                raise RuntimeError("the bridge is out")
            case "nan observation":
                observed.alive[1, 2] = True
                observed.observations[1, 2] = [0, np.nan, 0, 0]
            case "nan reward":
                outcome.rewards[1, 2] = np.inf
            case "nan state":
                observed.states[1, 2] = np.nan
            case "nan final":
                outcome.truncated[1, 2] = True
                outcome.final_observations[1, 2] = np.nan


class Unloadable:
    """A factory of environments that cannot be unpickled."""

    def __call__(self, prepared: object, copies: int) -> BatchedEnv:
        return Visitors(VISITORS, copies)

    def __reduce__(self) -> tuple[Any, ...]:
        return import_module, ("nowhere",)


class TediousVisitors(Visitors):
    """`Visitors` whose steps take half a CPU second in environments of two copies."""

    def step(self, actions: NDArray[Any]) -> tuple[StepResult, Observations]:
        until = time.process_time() + (0.5 if self.num_copies == 2 else 0)
        while time.process_time() < until:
            pass
        return super().step(actions)


class RareVisitors(Visitors):
    """`Visitors` with a limit of two copies per process, and an error beyond it."""

    LIMIT = 2
    held = 0

    def __init__(self, config: VisitorsConfig, copies: int) -> None:
        RareVisitors.held += copies
        if RareVisitors.held > self.LIMIT:
            raise RuntimeError(f"{RareVisitors.held} copies in one process")
        super().__init__(config, copies)

    @property
    def spec(self) -> EnvSpec:
        return replace(super().spec, max_copies_per_process=self.LIMIT)

    def close(self) -> None:
        RareVisitors.held -= self.num_copies


class LoneVisitors(RareVisitors):
    """`Visitors` with a limit of one copy per process."""

    LIMIT = 1


class Showing:
    """A contributor whose contribution is the trajectory and the number."""

    def adopt(self, published: Parameters) -> Parameters:
        return published

    def contribute(self, trajectory: Trajectory, number: int) -> Contribution:
        arrays = {field.name: getattr(trajectory, field.name).copy() for field in fields(trajectory)}
        return Contribution({**arrays, "number": np.array(number)}, {"policy/entropy": np.zeros(1)})

    def snapshot(self) -> None:
        return None

    def restore(self, snapshot: None) -> None:
        assert snapshot is None


TOYS: dict[str, tuple[Callable[[Any, int], BatchedEnv], Any]] = {
    "trivial": (Trivial, TrivialConfig(agents=3, steps=7)),
    "visitors": (Visitors, VISITORS),
    "tracking": (Tracking, TrackingConfig(agents=2, steps=9)),
}


def plan_of(
    make: Callable[[Any, int], BatchedEnv],
    config: object,
    seeds: Sequence[int] = (5,),
    copies: int = 4,
    steps: int = 20,
    block: int = 1,
    precision: Literal["float32", "float64"] = "float32",
    core: Literal["none", "gru"] = "none",
) -> RolloutPlan:
    """Return a plan with IPPO's acting policy: one small network per agent."""
    with closing(make(config, 1)) as env:
        spec = env.spec.for_policies
    config_of_policy = configure(
        "ippo",
        precision=precision,
        model=ModelConfig(core=core, **({"gru_size": 4} if core == "gru" else {})),
    )
    policy = acting_policy(config_of_policy, spec)
    return RolloutPlan(make, (), config, spec, policy, tuple(seeds), copies, steps, block)


def plan_of_toy(name: str, **choices: Any) -> RolloutPlan:  # noqa: ANN401 - those of `plan_of`
    """Return a plan on one of the TOYS."""
    return plan_of(*TOYS[name], **choices)


def parameters_of(plan: RolloutPlan) -> Arrays:
    """Return random parameters; those of a replica depend on its seed only."""
    alone = plan.policy.parameter_shapes(1)
    draws = [generator(seed, "test parameters") for seed in plan.seeds]
    return {
        name: np.concatenate([draw.standard_normal(shape) for draw in draws]).astype(dtype)
        for name, (shape, dtype) in alone.items()
    }


def backend_of(name: str) -> BackendConfig:
    """Return the default configuration of a backend."""
    return build(BackendConfig, {"name": name})


@contextmanager
def collector_of(
    plan: RolloutPlan,
    name: str = "process",
    workers: int = 2,
    notify: Notify = lambda line: None,
    worker_timeout_s: float | None = None,
) -> Iterator[Collector]:
    """Open a collector and close it at the end."""
    backend = replace(backend_of(name), worker_timeout_s=worker_timeout_s)
    collector = open_collector(backend, plan, workers, notify)
    try:
        yield collector
    finally:
        collector.close()


@dataclass(frozen=True)
class Taken:
    """A copy of one iteration's data."""

    arrays: Arrays
    """Arrays of the trajectory, with zeros in rows that are not valid."""
    episodes: list[Episode]


def take(trajectory: Trajectory, episodes: list[Episode]) -> Taken:
    """Copy an iteration out of the memory that the next one overwrites."""
    arrays = {field.name: getattr(trajectory, field.name).copy() for field in fields(trajectory)}
    over = arrays["terminated"] | arrays["truncated"]
    arrays["final_observations"][~over] = 0
    arrays["final_states"][~over.all(axis=2)] = 0
    return Taken(arrays, episodes)


def iterations_of(collector: Collector, parameters: Arrays, first: int, last: int) -> list[Taken]:
    """Collect iterations first to last."""
    return [take(collector.trajectory, collector.collect(i, parameters)) for i in range(first, last + 1)]


def assert_same(one: Sequence[Taken], other: Sequence[Taken]) -> None:
    """Assert that iterations are equal bit for bit, with NaN equal to NaN."""
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        for name, array in a.arrays.items():
            assert array.dtype == b.arrays[name].dtype
            np.testing.assert_array_equal(array, b.arrays[name], err_msg=name)
        assert a.episodes == b.episodes
