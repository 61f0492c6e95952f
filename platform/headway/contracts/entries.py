"""Registry entries: a name tied to objects. Third parties add theirs by entry point
(`headway.envs`, `headway.algos`; wrappers stand in `wrapping`), each a mapping from name to entry."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts.acting_policy import ActingPolicy
from headway.contracts.environment import BatchedEnv, EnvSpec, Observations
from headway.contracts.learner import Contributor, Learner


def _itself(config: Any) -> Any:  # noqa: ANN401 - any record
    return config


def _refuses_nothing(config: Any, spec: EnvSpec) -> str | None:  # noqa: ANN401 - any record
    return None


def _takes_any_budget(config: Any, iterations: int) -> str | None:  # noqa: ANN401 - any record
    return None


def _keeps_nothing(config: Any, spec: EnvSpec, env_steps: int) -> int:  # noqa: ANN401 - any record
    return 0


class Rule(Protocol):
    """A classical controller. It may look into the environment, not only at the observations."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """Actions for every copy and agent, shaped as `BatchedEnv.step` takes them."""
        ...


@dataclass(frozen=True)
class RuleEntry:
    """A rule of an environment, by its name there."""

    summary: str
    """One line for `headway list rules`: what it does, with its source where it has one."""
    make: Callable[[Any], Rule]
    """(prepared) -> rule."""


class Renderer(Protocol):
    """Draws what happens, for people."""

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """The first copy now, as an RGB picture (height, width, 3) of always the same size; `at_end`: as its
        last episode ended, not as its next begins."""
        ...


@dataclass(frozen=True)
class EnvEntry:
    """An environment by name."""

    summary: str
    """One line for `headway list envs`."""
    config: type
    """Frozen dataclass of its arguments (the keys of `env.args`), each field with a docstring; its
    `__post_init__` raises ValueError for impossible values."""
    make: Callable[[Any, int], BatchedEnv]
    """(prepared, copies) -> batched environment. Runs in light workers: no pandas, no torch."""
    prepare: Callable[[Any], Any] = _itself
    """(config) -> what all copies share (tables read, networks built), once in the parent; picklable.
    Raises HeadwayError for data that cannot be used."""
    prepare_beside: Callable[[Any, Any], Any] | None = None
    """(config, what `prepare` gave for another config) -> the same as `prepare(config)`, with what does not
    differ shared: an environment is often learned from by other rewards than it is reported by, and what it
    prepares may be large. The other is of the same environment, and wrapped where this is. Raises what
    `prepare` raises. None: it shares nothing."""
    parallel_env: Callable[[Any], Any] | None = None
    """(config, or what `prepare` gave) -> the same as a PettingZoo ParallelEnv: `reset(seed=s)` begins what
    `reset([s])` of the batch does; metrics travel in info `episode_metrics`, their names in
    `metadata["episode_metrics"]`. Its attribute `native`, where it has one, is the batch of one copy behind
    it and what that observed last: the environment's rules look there."""
    rules: Mapping[str, RuleEntry] = field(default_factory=dict)
    """By name; `random` is added where it is not among them."""
    metrics: Mapping[str, str] = field(default_factory=dict)
    """What each episode metric is, with its unit, in the order of `EnvSpec.metrics`: for `headway list`."""
    renderer: Callable[[Any], Renderer] | None = None
    """(prepared) -> what draws it, for `headway render`."""
    preload: tuple[str, ...] = ()
    """Modules that worker processes import once, before forking (compiled kernels). A module's `warm()`, if
    it has one, is called before training starts, so that what it compiles is compiled once, not by each."""

    def __post_init__(self) -> None:
        for name, rule in self.rules.items():
            if not isinstance(rule, RuleEntry):
                raise TypeError(f"rule {name!r} must be a RuleEntry, not {type(rule).__name__}")


@dataclass(frozen=True)
class AlgoEntry:
    """An algorithm by name. Neither the entry nor `acting_policy` imports torch; `learner` does."""

    summary: str
    source: str
    """Paper, with its arXiv number."""
    config: type
    """Frozen dataclass of its hyper-parameters, as for environments."""
    acting_policy: Callable[[Any, EnvSpec], ActingPolicy]
    learner: Callable[[Any, EnvSpec, Sequence[int], str], Learner]
    """(config, spec, seeds of the replicas, device) -> learner."""
    refuses: Callable[[Any, EnvSpec], str | None] = _refuses_nothing
    """One line why it cannot run on that environment, or None."""
    kept_bytes: Callable[[Any, EnvSpec, int], int] = _keeps_nothing
    """(config, spec, environment steps of a seed) -> about how many bytes of a seed's experience stand beside
    a checkpoint, at most."""
    refuses_budget: Callable[[Any, int], str | None] = _takes_any_budget
    """(config, iterations) -> one line why training of so many would not be what the config asks for, or
    None."""
    contributor: Callable[[Any, EnvSpec, Sequence[int]], Contributor] | None = None
    """(config, spec, seeds of the replicas) -> the part of an `AsynchronousLearner` that workers run; it may
    import torch. None: the learner learns by itself."""
    preload: tuple[str, ...] = ()
    """Modules that processes with contributors import once, before forking."""
    kernels: tuple[str, ...] = ()
    """Modules of compiled code that its learner calls: their `warm()` is called before training starts."""
