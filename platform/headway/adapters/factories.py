"""The function or class that makes an environment, found by module path, Python file or id.

`env.id=mpe2.simple_spread_v3` and `env.id=/lab/shuttle.py`: the module or file defines `parallel_env`, or
else `env` (agents act in turns, AEC), which PettingZoo converts to a parallel environment if the environment
declares this to be valid, or else exactly one subclass of ParallelEnv. `env.id=pettingzoo:sisl/pursuit-v5`
and `env.id=gymnasium:CartPole-v1`: MODULE:ID, where importing the module registers the id with PettingZoo or
Gymnasium. A Gymnasium environment has one agent.
"""

import importlib
import os
import warnings
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any

from headway.adapters.env_file import EnvFile, is_file_id
from headway.adapters.installed import require_environment_module, require_registering_module
from headway.config.schema import nearest
from headway.config.signatures import takes_any_arguments
from headway.contracts import HeadwayError
from headway.contracts.errors import one_line

Factory = Callable[..., Any]


def factory_of(name: str, file: EnvFile | None) -> tuple[Factory, Factory | None]:
    """Return the function that makes an environment, and the function whose signature lists its arguments, if
    any.

    Raises HeadwayError if the environment is not found.
    """
    if file is None and ":" in name:
        require_registering_module(name)
        _imported(name.partition(":")[0], named=name)
        if (spec := _pettingzoo_spec(name)) is None:
            return _gymnasium_callables(name)
        factory, candidates = spec.make, [spec.entry_point]
        if isinstance(spec.entry_point, str):
            path, _, attribute = spec.entry_point.partition(":")
            module = _imported(path, named=name)
            candidates = [getattr(module, attribute), vars(module).get("raw_env")]
    else:
        module = _imported(name, file)
        factory = _factory(name, module)
        # PettingZoo's own functions pass `**kwargs` on to `raw_env`.
        candidates = [factory, vars(module).get("raw_env"), vars(module).get("env")]
    source = next((call for call in candidates if callable(call) and not takes_any_arguments(call)), None)
    return factory, source


def takes_any_keyword(module: str) -> bool:
    """Return whether the environment in a module or file, or with the id MODULE:ID, accepts any keyword, so
    that its arguments are not known. Raises HeadwayError as `factory_of` does."""
    return factory_of(module, EnvFile.read(module) if is_file_id(module) else None)[1] is None


def _pettingzoo_spec(name: str) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    """Return the entry of an id in PettingZoo's registry; None if it is not there.

    Raises HeadwayError, suggesting the nearest id, for an unknown id with the prefix `pettingzoo:`.
    """
    import pettingzoo

    module, _, env_id = name.partition(":")
    known = {**pettingzoo.aec_registry, **pettingzoo.parallel_registry}
    if module == "pettingzoo" and env_id not in known:
        near = nearest(env_id, known)
        hint = f"did you mean env=pettingzoo:{near}?" if near else "sisl/pursuit-v5 is one"
        raise HeadwayError(f"env.id={name}: PettingZoo registers no such environment; {hint}")
    return known.get(env_id)


def _gymnasium_callables(name: str) -> tuple[Factory, Factory | None]:
    import gymnasium
    from gymnasium.envs.registration import load_env_creator

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            entry_point = gymnasium.spec(name.partition(":")[2]).entry_point
            creator = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    except Exception as error:  # an unknown id, or the environment's own code
        raise HeadwayError(f"env.id={name} cannot be used: {one_line(error)}") from error
    listed = creator is not None and not takes_any_arguments(creator)
    return partial(gymnasium.make, name, disable_env_checker=True), creator if listed else None


def _imported(path: str, file: EnvFile | None = None, named: str = "") -> ModuleType:
    """Import a module or file; `named`: the environment's id, for messages, if it is not the path."""
    name = named or path
    if file is None and not named and "." in path:
        require_environment_module(path)
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # keeps pygame's greeting off stdout
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return file.load() if file else importlib.import_module(path)
    except ModuleNotFoundError as error:
        raise HeadwayError(
            f"env.id={name} needs the package {error.name}, which is not installed: pip install {error.name}"
        ) from error
    except Exception as error:  # the module's own code
        raise HeadwayError(f"env.id={name} cannot be imported: {one_line(error)}") from error


def _factory(name: str, module: ModuleType) -> Factory:
    from pettingzoo import ParallelEnv

    for attribute in ("parallel_env", "env"):
        factory = vars(module).get(attribute)
        if callable(factory):
            found: Factory = factory
            return found
    classes = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, ParallelEnv) and value.__module__ == module.__name__
    ]
    if len(classes) == 1:
        return classes[0]
    if classes:
        names = ", ".join(each.__name__ for each in classes)
        raise HeadwayError(
            f"env.id={name} defines several environments ({names}); choose one there with a line such as "
            f"parallel_env = {classes[-1].__name__}"
        )
    raise HeadwayError(
        f"env.id={name} has neither parallel_env nor env, nor a subclass of ParallelEnv: it is not a "
        "PettingZoo environment"
    )


def as_parallel(name: str, env: Any) -> Any:  # noqa: ANN401 - PettingZoo comes without types
    """Return an environment as a ParallelEnv. Raises HeadwayError if it cannot be one."""
    from gymnasium import Env
    from pettingzoo import AECEnv, ParallelEnv
    from pettingzoo.utils.conversions import aec_to_parallel

    from headway.adapters.gymnasium import SingleAgent

    if isinstance(env, ParallelEnv):
        return env
    if isinstance(env, Env):
        return SingleAgent(env)
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
