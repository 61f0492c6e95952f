"""Environment entries with wrappers around them.

Wrappers are applied in the order of the list. All up to and including the last one without a batched form are
applied to the environment's ParallelEnv, which the adapter then turns into a batch; the others are applied to
batches. If all have a batched form, a native environment stays native.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from headway.adapters.modules import ModuleEnv
from headway.adapters.pettingzoo import AdapterOptions, ParallelEnvBatch
from headway.contracts import (
    RANDOM,
    BatchedEnv,
    BatchedWrapper,
    BatchWrapper,
    BranchingEnv,
    EnvEntry,
    HeadwayError,
    ObservationBounds,
    Observations,
    Rule,
    RuleEntry,
    StepResult,
)
from headway.wrappers.listed import ListedWrapper
from headway.wrappers.parallel import WrappedParallelEnv, bounds_of, wrapped_parallel_env


class ZeroAbsentObservations(BatchWrapper):
    """Sets rows of agents not alive to zero, as a ParallelEnv shows absent agents."""

    def __init__(self, inner: BatchedEnv) -> None:
        super().__init__(inner)
        spec = inner.spec
        shape = (inner.num_copies, spec.num_agents, spec.observation_size)
        self._observations = np.zeros(shape, dtype=np.float32)

    def branch_from(
        self, source: BatchedEnv, rows: NDArray[np.int64], seeds: NDArray[np.uint64]
    ) -> Observations:
        """Branch as `BranchingEnv` does, if the inner environment is one."""
        assert isinstance(source, ZeroAbsentObservations)
        self.inner_observed = cast(BranchingEnv, self.inner).branch_from(source.inner, rows, seeds)
        return self._begin(self.inner_observed)

    def _begin(self, observed: Observations) -> Observations:
        self._observations.fill(0)
        np.copyto(self._observations, observed.observations, where=observed.alive[..., None])
        return replace(observed, observations=self._observations)

    def _advance(self, outcome: StepResult, observed: Observations) -> tuple[StepResult, Observations]:
        return outcome, self._begin(observed)


@dataclass(frozen=True)
class Wrapped:
    """Data that all copies of a wrapped environment share. Picklable."""

    name: str
    """Name of the environment, for messages."""
    prepared: Any
    """Result of the environment's own `prepare`."""
    make: Callable[[Any, int], BatchedEnv]
    """The environment's own `make`."""
    parallel: WrappedParallelEnv | None
    """Factory of the ParallelEnv with the wrappers that are applied to it; None: all are batched and `make`
    is used."""
    options: AdapterOptions | None
    """Adapter options of the ParallelEnv; None if `parallel` is None."""
    batched: tuple[BatchedWrapper, ...]
    """Batched wrappers, the innermost first."""
    shows_native: bool = True
    """Rules can inspect the environment behind the wrappers."""
    notices: tuple[str, ...] = ()
    """Lines for the user."""

    @property
    def training_notices(self) -> tuple[str, ...]:
        """Lines for the user about settings of a new training."""
        notices: tuple[str, ...] = getattr(self.prepared, "training_notices", ())
        return notices

    def batch(self, copies: int) -> BatchedEnv:
        """Return the wrapped environment: `EnvEntry.make` of wrapped entries."""
        if self.parallel is None or self.options is None:
            env = self.make(self.prepared, copies)
        else:
            env = ParallelEnvBatch(self.parallel, copies, self.name, self.options)
        if env.spec.agents_come_and_go and not isinstance(env, ParallelEnvBatch):
            env = ZeroAbsentObservations(env)
        for wrapper in self.batched:
            env = wrapper.wrap(env)
        return env


def wrapped_entry(name: str, entry: EnvEntry, wrappers: Sequence[ListedWrapper]) -> EnvEntry:
    """Return the entry of an environment with wrappers around it, the first of the list innermost.

    The environment's own rules inspect the environment and its unwrapped observations while playing the
    wrapped one; `RANDOM` plays the wrapped environment. Behind a wrapper that changes the meaning of actions
    only `RANDOM` remains. `lookahead` is available only if all wrappers change rewards only; these are not
    among `wrappers` when rules play.
    """
    variant, renderer = entry.prepare_variant, entry.renderer
    rules = {rule: own if own is RANDOM else _rule_behind(rule, own) for rule, own in entry.rules.items()}
    if any(wrapper.entry.changes_actions for wrapper in wrappers):
        rules = {"random": RANDOM}
    prepare = partial(_prepare, name, entry, tuple(wrappers))
    return replace(
        entry,
        make=Wrapped.batch,
        prepare=lambda config: prepare(entry.prepare(config)),
        prepare_variant=variant and (lambda config, other: prepare(variant(config, other.prepared))),
        parallel_env=None,
        rules=rules,
        lookahead=None if wrappers else entry.lookahead,
        simulated=lambda wrapped: replace(wrapped, prepared=entry.simulated(wrapped.prepared)),
        renderer=renderer and (lambda wrapped: renderer(wrapped.prepared)),
    )


def behind_wrappers(env: BatchedEnv) -> BatchedEnv:
    """Return the environment inside all wrappers.

    If this is made of ParallelEnvs on top of native batches of one copy, return the first copy's batch.
    """
    inner, _ = _innermost(env, None)
    if isinstance(inner, ParallelEnvBatch) and _has_native(inner.parallel_envs[0]):
        return _natives(inner)[0][0]
    return inner


def _innermost(env: BatchedEnv, observed: Observations | None) -> tuple[BatchedEnv, Observations | None]:
    """Return the environment inside the batched wrappers and its last observations.

    Without wrappers these are `env` and `observed` themselves.
    """
    inner: Any = env
    while hasattr(inner, "inner"):
        observed, inner = inner.inner_observed, inner.inner
    return cast(BatchedEnv, inner), observed


def _has_native(parallel_env: Any) -> bool:  # noqa: ANN401 - PettingZoo comes without types
    return hasattr(type(parallel_env.unwrapped), "native")


def _natives(env: ParallelEnvBatch) -> list[tuple[BatchedEnv, Observations]]:
    """Return, per copy, the batch of one copy behind its ParallelEnv and that batch's last observations."""
    return [one.unwrapped.native for one in env.parallel_envs]


def _prepare(
    name: str,
    entry: EnvEntry,
    wrappers: tuple[ListedWrapper, ...],
    prepared: Any,  # noqa: ANN401 - the entry's own type
) -> Wrapped:
    """Apply the wrappers. Raises HeadwayError if one cannot be applied."""
    bounds = _native_bounds(name, entry, prepared) if wrappers else None
    own_notices = tuple(getattr(prepared, "notices", ()))
    parallel, unbatched, shows_native = None, "", True
    batched: list[BatchedWrapper] = []
    for index, wrapper in enumerate(wrappers):
        form = _batched_form(wrapper, bounds)
        if form is not None:
            batched.append(form)
            bounds = form.bounds
            continue
        if entry.parallel_env is None:
            raise HeadwayError(
                f"{wrapper.path}: {wrapper.name} has no batched form, and {name} has no ParallelEnv "
                "for SuperSuit to wrap; leave it out"
            )
        # Batched forms found so far are inside this wrapper, so they move to the ParallelEnv too.
        unbatched, batched = wrapper.name, []
        parallel = wrapped_parallel_env(name, entry.parallel_env, prepared, wrappers[: index + 1])
        env = parallel()
        bounds, shows_native = bounds_of(env), _has_native(env)
        env.close()
    if parallel is None:
        return Wrapped(name, prepared, entry.make, None, None, tuple(batched), notices=own_notices)
    options, notices = _adapter_options(name, entry, prepared, unbatched)
    notices = (*own_notices, *notices)
    return Wrapped(name, prepared, entry.make, parallel, options, tuple(batched), shows_native, notices)


def _native_bounds(name: str, entry: EnvEntry, prepared: object) -> ObservationBounds | None:
    """Return the bounds of the unwrapped environment's observations.

    Infinite if it has no ParallelEnv; None unless all agents observe one vector within the same bounds.
    """
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


def _batched_form(wrapper: ListedWrapper, bounds: ObservationBounds | None) -> BatchedWrapper | None:
    if wrapper.entry.batched is None or bounds is None:
        return None
    try:
        return wrapper.entry.batched(wrapper.arguments, bounds)
    except HeadwayError as error:
        raise HeadwayError(f"{wrapper.path}: {error}") from error


def _adapter_options(
    name: str, entry: EnvEntry, prepared: object, unbatched: str
) -> tuple[AdapterOptions, tuple[str, ...]]:
    """Return how the wrapped ParallelEnv is adapted, and the lines for the user."""
    if isinstance(prepared, ModuleEnv):
        return prepared.options, ()
    env = entry.make(prepared, 1)
    spec = env.spec
    env.close()
    lost = "; it has no snapshots: episodes restart on resume" if spec.snapshots else ""
    line = f"{unbatched} has no batched form: {name} is played as a ParallelEnv, one copy after another{lost}"
    options = AdapterOptions(
        shared_reward=spec.shared_reward,
        groups=spec.groups,
        agents_come_and_go=spec.agents_come_and_go,
        metrics=spec.metrics,
        max_copies_per_process=spec.max_copies_per_process,
    )
    return options, (line,)


def _rule_behind(name: str, own: RuleEntry) -> RuleEntry:
    """Return the entry of a rule that plays a wrapped environment."""

    def make_behind(wrapped: Wrapped) -> Rule:
        if not wrapped.shows_native:
            raise HeadwayError(
                f"rule {name!r} of {wrapped.name} cannot inspect the environment behind these wrappers; "
                "leave out the rule, or the wrappers without a batched form"
            )
        return RuleBehindWrappers(own.make(wrapped.prepared), wrapped.parallel is not None)

    return replace(own, make=make_behind)


@dataclass(frozen=True)
class RuleBehindWrappers:
    """A rule that plays a wrapped environment but inspects the environment behind the wrappers."""

    rule: Rule
    """The environment's own rule."""
    through_parallel_env: bool
    """The rule inspects a native batch behind a ParallelEnv."""

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """Return the rule's actions, given the environment behind the wrappers and its last observations."""
        inner, inner_observed = _innermost(env, observed)
        if not self.through_parallel_env:
            assert inner_observed is not None
            return self.rule.act(inner, inner_observed)
        assert isinstance(inner, ParallelEnvBatch)
        return np.concatenate([self.rule.act(*native) for native in _natives(inner)])
