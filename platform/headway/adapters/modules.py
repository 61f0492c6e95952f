"""Any PettingZoo environment by module path: `env.id=mpe2.simple_spread_v3`.

The module defines `parallel_env`, or else `env` (agents act in turns, AEC), which PettingZoo converts to a
parallel environment if the environment declares this to be valid. `env.args` are the arguments of that
function.
"""

import importlib
import os
import re
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, make_dataclass, replace
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from headway.adapters.installed import require_environment_module
from headway.adapters.pettingzoo import NO_OPTIONS, AdapterOptions, ParallelEnvBatch
from headway.config.signatures import argument_record, as_tuples, takes_any_arguments
from headway.contracts import RANDOM, BatchedEnv, EnvEntry, HeadwayError, RandomRule
from headway.contracts.errors import one_line

_PROBE_STEPS, _PROBE_SECONDS = 100, 2.0
_NUMBERED = re.compile(r"(.+?)_?\d+")


@dataclass(frozen=True)
class ModuleEnv:
    """An environment of a module with its arguments. Picklable."""

    module: str
    """Module path."""
    arguments: Mapping[str, Any]
    """Arguments that differ from the function's own defaults."""
    options: AdapterOptions
    """Adapter options."""
    notices: tuple[str, ...] = ()
    """Lines for the user."""

    def make(self) -> Any:  # noqa: ANN401 - PettingZoo comes without types
        """Return a new ParallelEnv. Raises HeadwayError if the module or the arguments cannot be used."""
        module = _imported(self.module)
        factory = _factory(self.module, module)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                env = factory(**self.arguments)
        except Exception as error:  # the environment's own code
            given = ", ".join(f"{key}={value}" for key, value in self.arguments.items()) or "its defaults"
            raise HeadwayError(f"{self.module} cannot be made with {given}: {one_line(error)}") from error
        return _parallel(self.module, env)


def module_entry(
    module: str, options: AdapterOptions = NO_OPTIONS, arguments: Iterable[str] = ()
) -> EnvEntry:
    """Return the entry of the environment in a module.

    `arguments` are the keys that the user sets; they become the config's keys if the environment's function
    accepts any keyword. An agent's group is its name without the number. Raises HeadwayError if the module is
    not allowed, cannot be imported, or defines no environment.
    """
    source = _signature_source(_imported(module), module)
    if source is None:
        record = make_dataclass("Arguments", [(key, Any) for key in arguments], frozen=True)
    else:
        record = argument_record("Arguments", source)
    return EnvEntry(
        summary=f"the PettingZoo environment {module}",
        config=record,
        make=make_batch,
        prepare=partial(_prepare, module, options),
        parallel_env=partial(_make_parallel, module, options),
        rules={"random": RANDOM},
        preload=("headway.adapters.modules", module),
    )


def make_batch(prepared: ModuleEnv, copies: int) -> BatchedEnv:
    """Return a batch of `copies` copies: `EnvEntry.make` of module environments."""
    return ParallelEnvBatch(prepared.make, copies, prepared.module, prepared.options)


def _prepare(module: str, options: AdapterOptions, config: Any) -> ModuleEnv:  # noqa: ANN401 - its own record
    prepared = ModuleEnv(module, _non_default(config), options)
    env = prepared.make()
    groups = _groups(getattr(env, "possible_agents", ()))
    notices: tuple[str, ...] = ()
    if options.shared_reward is None and _pays_all_alike(module, env, options):
        notices = (
            f"all agents of {module} got equal rewards in a few steps of random play: if they always do, set "
            "env.shared_reward=true, so that a central critic learns the team's return (false: no notice)",
        )
    env.close()
    return replace(prepared, options=replace(options, groups=groups), notices=notices)


def _pays_all_alike(module: str, env: Any, options: AdapterOptions) -> bool:  # noqa: ANN401 - see ModuleEnv.make
    """Return whether all live agents' rewards were equal, and not always 0, at each step of random play.

    Plays _PROBE_STEPS steps, or fewer if they take longer than _PROBE_SECONDS. False for an environment of
    one agent, and for one that needs wrappers before it can be played.
    """
    options, rule = replace(options, agents_come_and_go=True), RandomRule()
    deadline, paid = time.monotonic() + _PROBE_SECONDS, False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            batch = ParallelEnvBatch(lambda: env, 1, module, options)
            observed = batch.reset(np.zeros(1, np.uint64))
            for _ in range(_PROBE_STEPS if batch.spec.num_agents > 1 else 0):
                alive = observed.alive[0].copy()
                result, observed = batch.step(rule.act(batch, observed))
                rewards = result.rewards[0, alive]
                if (rewards != rewards[:1]).any():
                    return False
                paid |= len(rewards) > 1 and bool(rewards[0] != 0)
                if time.monotonic() > deadline:
                    break
    except Exception:  # the environment's own code, or a space that a wrapper has yet to change
        return False
    return paid


def _make_parallel(module: str, options: AdapterOptions, given: Any) -> Any:  # noqa: ANN401 - config or prepared
    prepared = given if isinstance(given, ModuleEnv) else ModuleEnv(module, _non_default(given), options)
    return prepared.make()


def _imported(name: str) -> ModuleType:
    require_environment_module(name)
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # keeps pygame's greeting off stdout
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise HeadwayError(
            f"env.id={name} needs the package {error.name}, which is not installed: pip install {error.name}"
        ) from error
    except Exception as error:  # the module's own code
        raise HeadwayError(f"env.id={name} cannot be imported: {one_line(error)}") from error


def _factory(name: str, module: ModuleType) -> Callable[..., Any]:
    for attribute in ("parallel_env", "env"):
        factory = vars(module).get(attribute)
        if callable(factory):
            found: Callable[..., Any] = factory
            return found
    raise HeadwayError(f"env.id={name} has neither parallel_env nor env: it is not a PettingZoo environment")


def _signature_source(module: ModuleType, name: str) -> Callable[..., Any] | None:
    """Return the callable whose signature lists the environment's arguments; None if none does.

    PettingZoo's own functions pass `**kwargs` on to `raw_env`.
    """
    candidates = [_factory(name, module), vars(module).get("raw_env"), vars(module).get("env")]
    return next((call for call in candidates if callable(call) and not takes_any_arguments(call)), None)


def _parallel(name: str, env: Any) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils.conversions import aec_to_parallel

    if isinstance(env, ParallelEnv):
        return env
    if not isinstance(env, AECEnv):
        raise HeadwayError(
            f"env.id={name} makes an object of type {type(env).__name__}, which is neither a ParallelEnv nor "
            "an AECEnv of PettingZoo"
        )
    if not env.metadata.get("is_parallelizable", False):
        raise HeadwayError(
            f"env.id={name} is played turn by turn and its metadata does not set is_parallelizable: "
            "all agents must act at once here; choose an environment with parallel_env"
        )
    return aec_to_parallel(env)


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
