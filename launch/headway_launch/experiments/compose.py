"""Composition of one validated experiment from names and `key=value` overrides, with Hydra."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from headway.adapters.env_file import absolute_id, is_file_id
from headway.algorithms import chosen_algo
from headway.config.experiment import NO_PRESET, EnvConfig, ExperimentConfig
from headway.config.schema import (
    ALIASES,
    build,
    describe,
    nearest,
    parse_seeds,
    refuse_targets,
    suggestion,
)
from headway.contracts.entries import EnvEntry
from headway.contracts.errors import HeadwayError, UnknownKeyError
from headway.contracts.random_rule import RANDOM
from headway.environments import chosen_env
from headway.registry import is_external
from headway.store.run_folder import find_run
from headway_launch.console.output import prints_to_stderr
from headway_launch.experiments.experiment import Experiment, data_digest
from headway_launch.experiments.experiment_file import choice_of_file, split_experiment_file, unknown_option
from headway_launch.experiments.options import (
    NO_ENV,
    config_file,
    configs_folder,
    option_names,
    options,
    own_folder,
    store_registered,
)

_OVERRIDE = re.compile(r"(?P<prefix>\+{0,2})(?P<key>[^=+~]+)=(?P<value>.*)", re.DOTALL)
_DELETION = re.compile(r"~(?P<key>[^=+~]+)(=.*)?", re.DOTALL)
_SEVERAL_VALUES = re.compile(r"Ambiguous value for argument '(?P<key>[^=]*)=(?P<value>.*)'")
_DEFAULT = "default_"
"""Prefix of the presets that apply unless another is chosen: `default_bus` with `env=bus`."""
_EXPERIMENT = "the experiment"
_OTHER_ENVS = (
    ", or a PettingZoo module, such as env=mpe2.simple_spread_v3, a file, such as env=./shuttle.py, or a "
    "registered id, such as env=pettingzoo:sisl/pursuit-v5 or env=gymnasium:CartPole-v1"
)
_KEYS = frozenset(field.name for field in fields(ExperimentConfig))
_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")


def compose(overrides: Sequence[str]) -> Experiment:
    """Return the experiment that `overrides` describe (`experiment=bus_mappo algo.lr=3e-4 seed=0..4`).

    Overrides follow Hydra's grammar; `key=value` may set any key, also one that no YAML file sets. One word
    may be the path of an experiment's file (`choice_of_file`). The values of a preset take precedence
    over the defaults only. Raises HeadwayError for an invalid override.
    """
    return composer(overrides)({})


def composer(overrides: Sequence[str]) -> Callable[[Mapping[str, Any]], Experiment]:
    """Return a function that composes the experiment of `overrides` with values of further dotted keys.

    Hydra, which takes a tenth of a second, is called once. Both raise HeadwayError as `compose` does.
    """
    file, others = split_experiment_file(overrides)
    words = [choice_of_file(file)] if file else []
    words += [_hydra_override(override, overrides) for override in others]
    if own := own_folder():
        words.append(f'hydra.searchpath=["file://{own}"]')
    return _composer_of(words, file)


def _composer_of(words: Sequence[str], file: Path | None = None) -> Callable[[Mapping[str, Any]], Experiment]:
    """Return what `composer` does, for overrides in Hydra's form; `file`: that of the experiment, for
    messages."""
    mapping, choices = _compose_mapping(words)
    presets = mapping.pop("preset", None) or {}
    preset = choices.get("preset") or NO_PRESET
    if not preset.startswith(_DEFAULT) and preset not in option_names("preset"):
        raise HeadwayError(unknown_option(file, "preset", preset, option_names("preset")))
    values = _preset_values(presets, mapping, preset)

    def composed(further: Mapping[str, Any]) -> Experiment:
        given = mapping
        for key, value in further.items():
            for part in reversed(key.split(".")):
                value = {part: value}
            given = _merged(given, value)
        try:
            experiment = resolve({**_merged(values, given), "preset": preset if values else NO_PRESET})
            return _with_parent_named(experiment)
        except UnknownKeyError as error:
            if _has_key(values, error.key) and not _has_key(given, error.key):
                raise HeadwayError(f"preset={preset} does not fit this experiment: {error}") from error
            hinted = _with_hint(error, given, choices)
            raise HeadwayError(f"{file}: {hinted}" if in_file(error.key) else str(hinted)) from error
        except HeadwayError as error:
            env_id = str(given["env"]["id"]) if in_file("env.id") and _has_key(given, "env.id") else ""
            missing = f"env.id={absolute_id(env_id)}: there is no such file"
            if env_id != absolute_id(env_id) and (line := str(error)).startswith(missing):
                line = f"{missing}, nor one beside {file}{line.removeprefix(missing)}"
                raise HeadwayError(line) from error
            raise

    def in_file(key: str) -> bool:
        """Return whether the experiment's file sets a key, and no override sets it or a key above."""
        overridden = (word.lstrip("+").partition("=")[0] for word in words)
        return file is not None and not any(f"{key}.".startswith(f"{each}.") for each in overridden)

    return composed


def _with_hint(
    error: UnknownKeyError, mapping: Mapping[str, Any], choices: Mapping[str, str]
) -> UnknownKeyError:
    """Return the error with a suggestion of a key of another group, if the unknown key may stand for one."""
    group, _, key = error.key.rpartition(".")
    # `algo.steps` may as well be meant for `rollout.steps` or an environment's.
    if group in ("algo", "rollout") and key != "steps" and (ours := ALIASES.get(key)) in _KEYS:
        return UnknownKeyError(error.key, _EXPERIMENT, f"did you mean {ours}?")
    if (group == "env" or (not group and key not in ALIASES)) and _has_key(mapping, "env.id"):
        chosen = [f"env={mapping['env']['id']}", f"algo={choices.get('algo')}"]
        if full_keys := _keys_ending_in(key, chosen):
            hint = f"did you mean {' or '.join(full_keys)}?"
            return UnknownKeyError(error.key, group or _EXPERIMENT, hint)
    return error


def _with_parent_named(experiment: Experiment) -> Experiment:
    """Return the experiment with the full name of the run `start.run`, since that name is part of a cell's
    identity."""
    config = experiment.config
    if config.start.run is None:
        return experiment
    try:
        # Also the path of a run's folder, as `headway run` prints it.
        name = find_run(Path(config.store.root), Path(config.start.run).name).name
    except HeadwayError as error:
        raise HeadwayError(f"start.run: {error}") from error
    return replace(experiment, config=replace(config, start=replace(config.start, run=name)))


def _preset_values(presets: Mapping[str, Any], mapping: Mapping[str, Any], preset: str) -> Mapping[str, Any]:
    """Return the values of `preset` for the experiment's algorithm.

    If it has none, return nothing for a preset that applies by default and raise HeadwayError for any other.
    """
    name = str((mapping.get("algo") or {}).get("name"))
    if not presets or (preset.startswith(_DEFAULT) and name not in presets):
        return {}
    if name not in presets:
        raise HeadwayError(
            f"preset={preset} has no values for algo={name}; it has values for {', '.join(sorted(presets))} "
            f"(preset={NO_PRESET} keeps the defaults)"
        )
    values: Mapping[str, Any] = presets[name] or {}
    return values


def _has_key(mapping: object, key: str) -> bool:
    """Return whether nested mappings contain a dotted key."""
    for part in key.split("."):
        if not isinstance(mapping, Mapping) or part not in mapping:
            return False
        mapping = mapping[part]
    return True


def resolve(mapping: Mapping[str, Any]) -> Experiment:
    """Return the experiment of a composed or stored configuration, given as nested mappings.

    Raises HeadwayError if it is not valid.
    """
    refuse_targets(mapping)
    values = dict(mapping)
    if "seed" in values:
        values["seed"] = parse_seeds(values["seed"])
    algo, algo_config = chosen_algo(build(ExperimentConfig, {"algo": values.get("algo", {})}).algo)
    if isinstance(rollout := values.get("rollout", {}), Mapping):
        values["rollout"] = {**algo.rollout(algo_config), **rollout}
    try:
        config = build(ExperimentConfig, _with_budget(values))
    except HeadwayError:
        _require_known_rule(values)  # the budget of a rule that does not exist is beside the point
        raise
    config = replace(config, env=replace(config.env, id=absolute_id(config.env.id)))
    if not _DEVICE.fullmatch(config.device):
        raise HeadwayError(f"device={config.device} is not a device; write auto, cpu, cuda or cuda:NUMBER")
    if config.device.startswith("cuda") and not Path("/dev/nvidiactl").exists():
        raise HeadwayError(f"device={config.device}, but this machine has no NVIDIA GPU; use auto or cpu")
    with prints_to_stderr():  # an environment's module may print
        env = chosen_env(config.env, [key for stage in config.stages for key in stage.training_args])
    by_stage = {
        f"stages[{place}].training_args": stage.training_args for place, stage in enumerate(config.stages)
    }
    env_config: Any = build(env.entry.config, config.env.args, "env.args", config.env.id)
    training_env_configs = tuple(
        _training_config(env.training_entry.config, config.env, key, args)
        for key, args in (by_stage or {"env.training_args": config.env.training_args or {}}).items()
    )
    env_mapping = env.mapping
    if config.env.file_digest is None and (
        digest := data_digest(env.entry, env_config, *training_env_configs)
    ):
        env_mapping = {**env_mapping, "file_digest": digest}
    return Experiment(
        config=config,
        env=env.entry,
        training_env=env.training_entry,
        env_config=env_config,
        training_env_configs=training_env_configs,
        env_mapping=env_mapping,
        algo=algo,
        algo_config=algo_config,
    )


def _training_config(record: type, env: EnvConfig, key: str, args: Mapping[str, Any]) -> object:
    """Return the config of a training environment; `args` are the arguments of `key`, over those of `env`.

    Raises HeadwayError, which names an argument by the key under which it was written.
    """
    layers = {key: args, "env.training_args": env.training_args or {}, "env.args": env.args}
    try:
        return build(record, _merged(_merged(env.args, layers["env.training_args"]), args), key, env.id)
    except HeadwayError as error:
        line = str(error).removeprefix(f"{key}.")
        name = re.split(r"[^\w.]", line, maxsplit=1)[0]
        written = next((layer for layer, values in layers.items() if _has_key(values, name)), key)
        if written == key:
            raise
        raise HeadwayError(f"{key}: {written}.{line}") from error


@prints_to_stderr()
def _require_known_rule(values: Mapping[str, Any]) -> None:
    """Raise HeadwayError if a configuration's `start.rule` is not a rule to start from."""
    start = values.get("start")
    if isinstance(start, Mapping) and isinstance(rule := start.get("rule"), str):
        env = build(ExperimentConfig, {"env": values.get("env", {})}).env
        env = replace(env, id=absolute_id(env.id))
        require_rule(rule, env.id, chosen_env(env).training_entry)


def require_rule(name: str, env_id: str, entry: EnvEntry) -> None:
    """Raise HeadwayError if training cannot start from the rule `name` of an environment."""
    # The draws of `random` are no part of an environment's snapshots, so that a resumed run would differ.
    rules = [rule for rule, each in entry.rules.items() if each is not RANDOM and not each.internal]
    if not rules:
        raise HeadwayError(f"start.rule: {env_id} has no rule to start from; leave it out")
    if name not in rules:
        raise HeadwayError(
            f"start.rule: {name!r} is not a rule of {env_id} to start from; {suggestion(name, rules)}"
        )


def _with_budget(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a configuration with the sum of its stages' steps as `env_steps`, unless it has that key."""
    stages = values.get("stages")
    if "env_steps" in values or not isinstance(stages, Sequence):
        return values
    steps = [stage.get("env_steps") for stage in stages if isinstance(stage, Mapping)]
    numbers = [each for each in steps if isinstance(each, int | float)]
    return {**values, "env_steps": sum(numbers)} if numbers else values


def _hydra_override(override: str, overrides: Sequence[str]) -> str:
    """Return an override in Hydra's form: seeds written out, `++` before a key that no YAML file may set.

    Raises HeadwayError for an invalid one.
    """
    if deletion := _DELETION.fullmatch(override):
        if deletion["key"] in options():
            raise HeadwayError(f"{override}: {deletion['key']} cannot be removed; choose another option")
        return override
    parts = _OVERRIDE.fullmatch(override)
    if parts is None:
        raise HeadwayError(f"{override!r} is not an override; write key=value{_option_hint(override)}")
    prefix, key, value = parts["prefix"], parts["key"].strip(), parts["value"]
    if key == "algo.name":
        raise HeadwayError(f"{override}: algo.name follows from the choice of algo; write algo={value}")
    if re.match(r"hydra\b", key):
        raise UnknownKeyError(key, _EXPERIMENT, "leave it out (--config-dir finds further files)")
    if key == "seed":
        return f"++seed=[{','.join(str(seed) for seed in parse_seeds(value))}]"
    if prefix:
        return override
    known = options()
    if key not in known:
        _require_known_key(key, value, overrides)
        return f"++{override}"
    if "," in value and not value.startswith(("[", "{", "'", '"')):
        raise HeadwayError(f"{override}: choose one option; `headway sweep` takes several")
    if key == "env" and is_external(value.strip("'\"")):
        # Quoted, for Hydra's grammar: paths may contain spaces and other special characters.
        return "++env={id:" + (value if value.startswith(("'", '"')) else f'"{value}"') + "}"
    if value not in known[key]:
        or_module = ""
        if key == "env":
            or_module = (
                _OTHER_ENVS if not Path(f"{value}.py").is_file() else f", or your file env=./{value}.py"
            )
        near = suggestion(value, known[key], f"{key}=", f" (headway list {key}s)")
        raise HeadwayError(f"{override}: there is no such {key}; {near}{or_module}")
    if key == "experiment" and not (file := config_file(key, value)).is_relative_to(configs_folder()):
        return choice_of_file(file)
    return override


def _require_known_key(key: str, value: str, overrides: Sequence[str]) -> None:
    """Raise HeadwayError, with a suggestion, if a key is neither a key nor a group of the experiment."""
    head, _, rest = key.partition(".")
    names = _KEYS | {"experiment", "preset"}
    if head in names:
        return
    ours = ALIASES.get(key, key)
    known = [other for other in overrides if _first_part(other) in names]
    own = [ours] if ours in names else []
    if full_keys := [*own, *_keys_ending_in(key if own else ours, known)]:
        raise UnknownKeyError(key, _EXPERIMENT, f"did you mean {' or '.join(full_keys)}={value}?")
    if not rest and nearest(head, names) in ("experiment", "preset"):
        near = f"did you mean {nearest(head, names)}={value}? Available: {', '.join(sorted(names))}"
        raise UnknownKeyError(head, _EXPERIMENT, near)
    raise UnknownKeyError(head, _EXPERIMENT, suggestion(head, names))


def _first_part(override: str) -> str:
    return re.split(r"[.=]", override.lstrip("+~"), maxsplit=1)[0]


def _keys_ending_in(key: str, overrides: Sequence[str]) -> list[str]:
    """Return the keys that end in `key`, in the experiment that `overrides` describe."""
    try:
        has_env = any(_first_part(override) in ("env", "experiment") for override in overrides)
        found = compose(overrides if has_env else [*overrides, "env=trivial"])
    except HeadwayError:
        return []
    described = (
        *describe(ExperimentConfig),
        *describe(type(found.env_config), "env.args"),
        *describe(type(found.algo_config), "algo"),
    )
    return [field.key for field in described if field.key.endswith(f".{key}")]


def _option_hint(word: str) -> str:
    if is_file_id(word) and Path(word).is_file():
        return f"; did you mean env={word if word.startswith(('/', '.')) else f'./{word}'}?"
    for group in ("experiment", "env", "algo", "preset"):
        if word in options().get(group, ()):
            return f"; did you mean {group}={word}?"
    near = nearest(word, options().get("experiment", ()))
    return f"; did you mean experiment={near}?" if near else " (such as experiment=bus_mappo)"


def _compose_mapping(overrides: Sequence[str]) -> tuple[dict[str, Any], Mapping[str, str]]:
    """Return the composed configuration and the option chosen in each group.

    Raises HeadwayError if Hydra refuses an override.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf, open_dict
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
    from yaml import YAMLError

    # Paths of data in the project do not depend on the working directory.
    OmegaConf.register_new_resolver(
        "project", lambda path: str((configs_folder().parent / path).resolve()), replace=True
    )
    store_registered()
    try:
        with initialize_config_dir(str(configs_folder()), version_base="1.3"):
            composed = hydra_compose("config", overrides=list(overrides), return_hydra_config=True)
        chosen = composed.hydra.runtime.choices
        with open_dict(composed):
            del composed["hydra"]
        mapping = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        key = error.full_key
        if key == "env.id" and chosen.get("env") == NO_ENV:
            raise HeadwayError(
                "no experiment is named; write experiment=NAME (`headway list experiments`), such as "
                "experiment=bus_mappo, or env=NAME and algo=NAME"
            ) from error
        raise HeadwayError(f"{key} is missing and has no default; write {key}=VALUE") from error
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError) as error:
        deleted = [override for override in overrides if _DELETION.fullmatch(override)]
        if deleted:
            mapping = _compose_mapping([override for override in overrides if override not in deleted])[0]
            for override in deleted:
                key = override[1:].partition("=")[0]
                if not _has_key(mapping, key):
                    raise HeadwayError(
                        f"{override}: {key} is not set, so its default already applies"
                    ) from error
        require_grammar(overrides)
        raise HeadwayError(_one_line(error, overrides)) from error
    assert isinstance(mapping, dict)
    return {str(key): value for key, value in mapping.items()}, chosen


def require_grammar(overrides: Sequence[str]) -> None:
    """Raise HeadwayError for the first override that Hydra's grammar does not allow."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    for override in overrides:
        try:
            OverridesParser.create().parse_override(override)
        except HydraException as error:
            raise HeadwayError(
                f"{override.removeprefix('++')} is not valid in Hydra's grammar; close brackets and quotes, "
                "and quote text with special characters (in a shell, in two pairs): \"study='a: b'\""
            ) from error


def _one_line(error: Exception, overrides: Sequence[str]) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    kept = [line for line in lines if not line.lower().startswith(("see https", "set the environment"))]
    if kept and (several := _SEVERAL_VALUES.match(kept[0])):
        key = several["key"].lstrip("+")
        values = several["value"]
        others = [word for word in overrides if word.lstrip("+") != f"{key}={values}"]
        try:
            _composer_of([*others, f"++{key}=[{values}]"])({})
        except HeadwayError:  # the key holds no list
            or_list = ""
        else:
            or_list = f", or {key}=[{values}] for one list"
        return f"{key}={values} lists several values; use `headway sweep`{or_list}"
    return "the configuration cannot be composed: " + "; ".join(kept[:3])


def _merged(lower: Mapping[str, Any], upper: Mapping[str, Any]) -> dict[str, Any]:
    """Return `lower` with the values of `upper` merged over it, nested mappings key by key."""
    merged = dict(lower)
    for key, value in upper.items():
        replaced = merged.get(key)
        if isinstance(replaced, Mapping) and isinstance(value, Mapping):
            value = _merged(replaced, value)
        merged[key] = value
    return merged
