"""An environment entry with wrappers around it.

Wrappers are applied in order. From the end of the list forward, those that have twins are applied to batches
of copies; where all have, a native environment stays native. The last that has none, and all before it, are
applied to the environment's ParallelEnv, and the adapter makes a batch of that.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from headway.adapters.modules import ModuleEnv
from headway.adapters.parallel_entry import AdapterOptions
from headway.adapters.pettingzoo import ParallelEnvBatch
from headway.contracts import (
    BatchedEnv,
    BatchedWrapper,
    EnvEntry,
    EnvSpec,
    HeadwayError,
    ObservationBounds,
    Observations,
    RandomRule,
    Renderer,
    Rule,
    RuleEntry,
)
from headway.wrappers.batch import AbsentObserveZeros
from headway.wrappers.listed import ListedWrapper
from headway.wrappers.parallel import WrappedParallelEnv, bounds_of, wrapped_parallel_env


@dataclass(frozen=True)
class Wrapped:
    """What all copies of a wrapped environment share. Picklable."""

    name: str
    prepared: Any
    """What the environment's own `prepare` gave."""
    make: Callable[[Any, int], BatchedEnv]
    """The environment's own `make`."""
    parallel: WrappedParallelEnv | None
    """The ParallelEnv with the wrappers that have no twin; None where all have: `make` is used."""
    options: AdapterOptions | None
    batched: tuple[BatchedWrapper, ...]
    """Twins, the innermost first."""
    shows_native: bool = True
    """Rules can look behind the wrappers."""
    notices: tuple[str, ...] = ()
    """Lines for the user."""

    def batch(self, copies: int) -> BatchedEnv:
        """The wrapped environment."""
        if self.parallel is None or self.options is None:
            env = self.make(self.prepared, copies)
        else:
            env = self.options.adapt(self.parallel, copies, self.name)
        if env.spec.agents_come_and_go and not isinstance(env, ParallelEnvBatch):
            env = AbsentObserveZeros(env)
        for wrapper in self.batched:
            env = wrapper.wrap(env)
        return env


def make_wrapped(wrapped: Wrapped, copies: int) -> BatchedEnv:
    """The wrapped entry's `make`."""
    return wrapped.batch(copies)


def wrapped_entry(name: str, entry: EnvEntry, wrappers: Sequence[ListedWrapper]) -> EnvEntry:
    """The entry of an environment with wrappers around it, the first of the list innermost.

    The environment's own rules look behind the wrappers: they see the environment and the observations
    that it gives, and play the wrapped game. Behind a wrapper that changes what actions mean only `random`
    is left, which plays the wrapped environment.
    """
    rules = {"random": entry.rules["random"]} if _any_changes_actions(wrappers) else entry.rules
    beside = entry.prepare_beside
    return replace(
        entry,
        make=make_wrapped,
        prepare=lambda config: _prepare(name, entry, tuple(wrappers), entry.prepare(config)),
        prepare_beside=None if beside is None else _prepare_beside(name, entry, tuple(wrappers), beside),
        parallel_env=None,
        rules={rule: _behind(rule, own) for rule, own in rules.items()},
        renderer=None if entry.renderer is None else _renderer_behind(entry.renderer),
    )


def _prepare_beside(
    name: str,
    entry: EnvEntry,
    wrappers: tuple[ListedWrapper, ...],
    beside: Callable[[Any, Any], Any],
) -> Callable[[Any, Wrapped], Wrapped]:
    """The wrapped entry's, from the entry's own."""
    return lambda config, other: _prepare(name, entry, wrappers, beside(config, other.prepared))


def _renderer_behind(make: Callable[[Any], Renderer]) -> Callable[[Wrapped], Renderer]:
    return lambda wrapped: make(wrapped.prepared)


def behind_wrappers(env: BatchedEnv) -> BatchedEnv:
    """The environment itself, of a ParallelEnv the batch of one copy behind the first, where it has one."""
    inner, _ = _innermost(env, None)
    return _natives(inner)[0][0] if _shows_native(inner) else inner


def _innermost(env: BatchedEnv, observed: Observations | None) -> tuple[BatchedEnv, Observations | None]:
    """What the batched wrappers are around, and what that observed last, where `env` observed `observed`."""
    inner: Any = env
    while hasattr(inner, "inner"):
        observed, inner = inner.inner_observed, inner.inner
    return cast(BatchedEnv, inner), observed


def _shows_native(env: BatchedEnv) -> TypeGuard[ParallelEnvBatch]:
    return isinstance(env, ParallelEnvBatch) and _has_native(env.parallel_envs[0])


def _has_native(parallel_env: Any) -> bool:  # noqa: ANN401 - PettingZoo comes without types
    return hasattr(type(parallel_env.unwrapped), "native")


def _natives(env: ParallelEnvBatch) -> list[tuple[BatchedEnv, Observations]]:
    """Of each copy, the batch of one behind its ParallelEnv, and what that observed last."""
    return [one.unwrapped.native for one in env.parallel_envs]


def _any_changes_actions(wrappers: Sequence[ListedWrapper]) -> bool:
    return any(wrapper.entry.changes_actions for wrapper in wrappers)


def _prepare(
    name: str,
    entry: EnvEntry,
    wrappers: tuple[ListedWrapper, ...],
    prepared: Any,  # noqa: ANN401 - the entry's
) -> Wrapped:
    """Raises HeadwayError where a wrapper cannot be applied."""
    bounds = _first_bounds(name, entry, prepared) if wrappers else None
    parallel, culprit, shows_native = None, "", True
    batched: list[BatchedWrapper] = []
    for index, wrapper in enumerate(wrappers):
        twin = _twin(wrapper, bounds)
        if twin is not None:
            batched.append(twin)
            bounds = twin.bounds
            continue
        if entry.parallel_env is None:
            raise HeadwayError(
                f"{wrapper.path}: {wrapper.name} has no batched form, and {name} no ParallelEnv that "
                "SuperSuit could wrap; leave it out"
            )
        culprit, batched = wrapper.name, []
        parallel = wrapped_parallel_env(name, entry.parallel_env, prepared, wrappers[: index + 1])
        env = parallel()
        bounds, shows_native = bounds_of(env), _has_native(env)
        env.close()
    if parallel is None:
        return Wrapped(name, prepared, entry.make, None, None, tuple(batched))
    options, notices = _adapting(name, entry, prepared, culprit)
    return Wrapped(name, prepared, entry.make, parallel, options, tuple(batched), shows_native, notices)


def _first_bounds(name: str, entry: EnvEntry, prepared: object) -> ObservationBounds | None:
    """Of the environment itself; none are known of one that has no ParallelEnv."""
    if entry.parallel_env is None:
        env = entry.make(prepared, 1)
        spec = env.spec
        env.close()
        unbounded = np.full(spec.observation_size, np.inf, dtype=np.float32)
        return ObservationBounds(spec.agents, -unbounded, unbounded)
    made = wrapped_parallel_env(name, entry.parallel_env, prepared, ())()
    bounds = bounds_of(made)
    made.close()
    return bounds


def _twin(wrapper: ListedWrapper, bounds: ObservationBounds | None) -> BatchedWrapper | None:
    if wrapper.entry.batched is None or bounds is None:
        return None
    try:
        return wrapper.entry.batched(wrapper.arguments, bounds)
    except HeadwayError as error:
        raise HeadwayError(f"{wrapper.path}: {error}") from error


def _adapting(
    name: str, entry: EnvEntry, prepared: object, culprit: str
) -> tuple[AdapterOptions, tuple[str, ...]]:
    """How the wrapped ParallelEnv is adapted, and what the user is told."""
    if isinstance(prepared, ModuleEnv):
        return prepared.options, ()
    env = entry.make(prepared, 1)
    spec = env.spec
    env.close()
    lost = "; it has no snapshots: episodes start anew on resume" if spec.snapshots else ""
    line = f"{culprit} has no batched form: {name} is played as a ParallelEnv, one copy after another{lost}"
    return _options(spec), (line,)


def _options(spec: EnvSpec) -> AdapterOptions:
    return AdapterOptions(
        shared_reward=spec.shared_reward,
        groups=spec.groups,
        agents_come_and_go=spec.agents_come_and_go,
        metrics=spec.metrics,
        max_copies_per_process=spec.max_copies_per_process,
    )


def _behind(name: str, own: RuleEntry) -> RuleEntry:
    def make_behind(wrapped: Wrapped) -> Rule:
        rule = own.make(wrapped.prepared)
        if not (wrapped.shows_native or isinstance(rule, RandomRule)):
            raise HeadwayError(
                f"rule {name!r} of {wrapped.name} cannot look behind these wrappers; leave out the rule, or "
                "the wrappers without a batched form"
            )
        return RuleBehindWrappers(rule, through_parallel_env=wrapped.parallel is not None)

    return replace(own, make=make_behind)


@dataclass(frozen=True)
class RuleBehindWrappers:
    """A rule of an environment that has wrappers around it."""

    rule: Rule
    through_parallel_env: bool
    """Between the wrappers and what the rule looks into is a ParallelEnv."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """As the rule does, given the environment behind the wrappers and what that observed last."""
        if isinstance(self.rule, RandomRule):
            return self.rule.act(env, observed)
        inner, seen = _innermost(env, observed)
        if not self.through_parallel_env:
            assert seen is not None
            return self.rule.act(inner, seen)
        assert isinstance(inner, ParallelEnvBatch)
        return np.concatenate([self.rule.act(*native) for native in _natives(inner)])
