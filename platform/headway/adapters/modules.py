"""Any PettingZoo or Gymnasium environment as a registry entry; `headway.adapters.factories` finds it.

`env.args` are the arguments of the function or class that makes it. A file may describe its episode metrics
in a dict `METRICS` and have rules in a dict `RULES`, as in `EnvEntry`.
"""

import re
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, make_dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from headway.adapters.env_file import EnvFile, is_file_id
from headway.adapters.factories import as_parallel, factory_of
from headway.adapters.pettingzoo import NO_OPTIONS, AdapterOptions, ParallelEnvBatch
from headway.config.signatures import argument_record, as_tuples
from headway.contracts import RANDOM, BatchedEnv, EnvEntry, HeadwayError, Observations, RandomRule, RuleEntry
from headway.contracts.errors import one_line

_PROBE_STEPS, _PROBE_SECONDS, _PROBE_OBSERVATIONS = 100, 2.0, 20
"""Limits of the random play that probes an environment: steps, seconds, and steps in which at least
observations are checked."""
_ROUNDING = 1e-5
_NUMBERED = re.compile(r"(.+?)_?\d+")
_Declared = TypeVar("_Declared", RuleEntry, str)


@dataclass(frozen=True)
class ModuleEnv:
    """An environment of a module with its arguments. Picklable."""

    module: str
    """Module path, path of a file, or MODULE:ID."""
    arguments: Mapping[str, Any]
    """Arguments that differ from the function's own defaults."""
    options: AdapterOptions
    """Adapter options."""
    file: EnvFile | None = None
    """The file, if `module` is its path."""
    notices: tuple[str, ...] = ()
    """Lines for the user."""
    training_notices: tuple[str, ...] = ()
    """Lines for the user about settings of a new training."""

    def make(self) -> Any:  # noqa: ANN401 - PettingZoo comes without types
        """Return a new ParallelEnv. Raises HeadwayError if the module or the arguments cannot be used."""
        factory, _ = factory_of(self.module, self.file)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                env = factory(**self.arguments)
        except Exception as error:  # the environment's own code
            given = ", ".join(f"{key}={value}" for key, value in self.arguments.items()) or "its defaults"
            raise HeadwayError(f"{self.module} cannot be made with {given}: {one_line(error)}") from error
        return as_parallel(self.module, env)


def module_entry(
    module: str,
    options: AdapterOptions = NO_OPTIONS,
    arguments: Iterable[str] = (),
    stored_digest: str | None = None,
) -> EnvEntry:
    """Return the entry of the environment in a module or file, or with the id MODULE:ID.

    `arguments` are the keys that the user sets; they become the config's keys if the environment's function
    accepts any keyword. `stored_digest`: `EnvFile.digest` when the configuration was stored; a notice says
    that the file has changed since. An agent's group is its name without the number. Raises HeadwayError if
    the module is not allowed, cannot be imported, or defines no environment.
    """
    file = EnvFile.read(module) if is_file_id(module) else None
    notices: tuple[str, ...] = ()
    if file is not None and stored_digest not in (None, file.digest):
        notices = (f"{module} has changed since the run was started; results may differ from the run's",)
    _, source = factory_of(module, file)
    if source is None:
        record = make_dataclass("Arguments", [(key, Any) for key in arguments], frozen=True)
    else:
        record = argument_record(source)
    rules: Mapping[str, RuleEntry] = {}
    metrics: Mapping[str, str] = {}
    if file is not None:
        rules, metrics = _declared(file, "RULES", RuleEntry), _declared(file, "METRICS", str)
    options = replace(options, metrics=tuple(metrics) or options.metrics)
    return EnvEntry(
        summary=f"the environment {module}",
        config=record,
        make=make_batch,
        prepare=partial(_prepare, ModuleEnv(module, {}, options, file, notices)),
        parallel_env=partial(_make_parallel, ModuleEnv(module, {}, options, file)),
        rules={"random": RANDOM, **rules},
        metrics=metrics,
        renderer=ModuleRenderer,
        preload=("headway.adapters.modules", *([] if file else [module.partition(":")[0]])),
    )


def _declared(file: EnvFile, name: str, kind: type[_Declared]) -> Mapping[str, _Declared]:
    """Return the dict `name` of an environment's file; empty without one. Raises HeadwayError unless it maps
    names to values of `kind`."""
    declared = vars(file.load()).get(name, {})
    if not isinstance(declared, Mapping):
        raise HeadwayError(f"env.id={file.path}: {name} must be a dict, not {declared!r}")
    for key, value in declared.items():
        if not isinstance(key, str) or not isinstance(value, kind):
            raise HeadwayError(
                f"env.id={file.path}: {name} must map names to {kind.__name__}, not {key!r} to {value!r}"
            )
    return declared


class ModuleRenderer:
    """Renderer of module environments, by their render mode `rgb_array`."""

    def __init__(self, prepared: ModuleEnv) -> None:
        self._module = prepared.module
        self._last: NDArray[np.uint8] | None = None

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """Return the first copy's picture, (height, width, 3).

        When an episode has ended and the environment has already begun the next, return the last picture
        again. Raises HeadwayError if the environment returns no picture.
        """
        if at_end and self._last is not None:
            return self._last
        assert isinstance(env, ParallelEnvBatch)
        shown = env.parallel_envs[0]
        # As if made with render_mode="rgb_array", which not every function passes on.
        shown.unwrapped.render_mode = "rgb_array"
        try:
            picture = np.asarray(shown.render())
        except Exception as error:  # the environment's own code
            # PettingZoo's own method raises it without words: the environment has none.
            has_none = isinstance(error, NotImplementedError) and not str(error)
            why = "write a method render() that returns an RGB picture" if has_none else one_line(error)
            raise HeadwayError(f"{self._module} cannot be rendered: {why}") from error
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise HeadwayError(
                f"{self._module} cannot be rendered: in the mode rgb_array its render() must return an RGB "
                "picture"
            )
        self._last = picture
        return picture


def make_batch(prepared: ModuleEnv, copies: int) -> BatchedEnv:
    """Return a batch of `copies` copies: `EnvEntry.make` of module environments."""
    return ParallelEnvBatch(prepared.make, copies, prepared.module, prepared.options)


def _prepare(named: ModuleEnv, config: Any) -> ModuleEnv:  # noqa: ANN401 - its own record
    prepared = replace(named, arguments=_non_default(config))
    module, options = prepared.module, prepared.options
    env = prepared.make()
    groups = _groups(getattr(env, "possible_agents", ()))
    played = _play_randomly(module, env, options)
    alike = (
        f"all agents of {module} got equal rewards in a few steps of random play: if they always do, set "
        "env.shared_reward=true, so that a central critic learns the team's return (false: no notice)"
    )
    env.close()
    return replace(
        prepared,
        options=replace(options, groups=groups),
        notices=(*prepared.notices, *played.outside),
        training_notices=(alike,) * (options.shared_reward is None and played.pays_all_alike),
    )


@dataclass
class _Play:
    """Findings from a few steps of random play."""

    pays_all_alike: bool = False
    """All live agents received equal rewards at each step, and not always 0."""
    outside: tuple[str, ...] = ()
    """The first observation outside its space, as a line for the user."""


def _play_randomly(module: str, env: Any, options: AdapterOptions) -> _Play:  # noqa: ANN401 - see ModuleEnv.make
    """Play up to _PROBE_STEPS steps, or fewer if they take longer than _PROBE_SECONDS or rewards differ.

    Returns no findings for an environment that cannot be played without wrappers.
    """
    options, rule = replace(options, agents_come_and_go=True), RandomRule()
    deadline, paid, alike, found = time.monotonic() + _PROBE_SECONDS, False, True, _Play()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            batch = ParallelEnvBatch(lambda: env, 1, module, options)
            bounds = _observation_bounds(env, batch.spec.agents)
            observed = batch.reset(np.zeros(1, np.uint64))
            found.outside = _outside(module, batch, observed, bounds, 0)
            for step in range(1, _PROBE_STEPS + 1):
                alive = observed.alive[0].copy()
                result, observed = batch.step(rule.act(batch, observed))
                found.outside = found.outside or _outside(module, batch, observed, bounds, step)
                rewards = result.rewards[0, alive]
                alike &= not (rewards != rewards[:1]).any()
                paid |= len(rewards) > 1 and bool(rewards[0] != 0)
                enough = not alike or batch.spec.num_agents == 1
                if time.monotonic() > deadline or (enough and step >= _PROBE_OBSERVATIONS):
                    break
    except Exception:  # the environment's own code, or a space that a wrapper has yet to change
        return found
    found.pays_all_alike = paid and alike
    return found


def _observation_bounds(env: Any, agents: Sequence[str]) -> NDArray[np.float64]:  # noqa: ANN401 - see above
    """Return the least and the greatest observation of each agent's space (2, N, D)."""
    spaces = [env.observation_space(agent) for agent in agents]
    low, high = [space.low for space in spaces], [space.high for space in spaces]
    return np.array([low, high], dtype=np.float64).reshape(2, len(spaces), -1)


def _outside(
    module: str, batch: BatchedEnv, observed: Observations, bounds: NDArray[np.float64], step: int
) -> tuple[str, ...]:
    """Return a line for the user if a live agent's observation is outside its space."""
    values = observed.observations[0]
    rounding = _ROUNDING * (1 + abs(bounds))
    outside = (values < bounds[0] - rounding[0]) | (values > bounds[1] + rounding[1])
    outside &= observed.alive[0][:, None]
    if not outside.any():
        return ()
    agent, place = np.argwhere(outside)[0]
    name, (low, high) = batch.spec.agents[agent], bounds[:, agent, place]
    return (
        f"{module}: agent '{name}' observed {values[agent, place]:g} at step {step}, outside "
        f"its observation_space ({low:.4g} to {high:.4g} at index {place}); correct one of them",
    )


def _make_parallel(named: ModuleEnv, given: Any) -> Any:  # noqa: ANN401 - config or prepared
    prepared = given if isinstance(given, ModuleEnv) else replace(named, arguments=_non_default(given))
    return prepared.make()


def _non_default(config: Any) -> dict[str, Any]:  # noqa: ANN401 - a record from a signature
    """Return the arguments that differ from their defaults; lists become tuples if the default is one."""
    changed = {}
    for field in fields(config):
        value, default = getattr(config, field.name), field.default
        if isinstance(default, tuple):
            value = as_tuples(value)
        if default is MISSING and field.default_factory is not MISSING:
            default = field.default_factory()
        if default is MISSING or value != default:
            changed[field.name] = value
    return changed


def _groups(agents: Sequence[str]) -> tuple[str, ...]:
    """Return each agent's group, its name without the number (`adversary` for `adversary_0`).

    Empty if all agents would be in one group, or each in its own.
    """
    kinds = [match[1] if (match := _NUMBERED.fullmatch(agent)) else agent for agent in agents]
    return tuple(kinds) if 1 < len(set(kinds)) < len(kinds) else ()
