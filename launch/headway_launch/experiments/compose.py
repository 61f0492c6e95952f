"""From names and `key=value` overrides to one validated experiment, by Hydra's composition."""

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from itertools import dropwhile, takewhile
from pathlib import Path
from typing import Any

from headway.config.experiment import NO_PRESET, ExperimentConfig
from headway.config.schema import build, describe, nearest, parse_seeds, plain, refuse_targets, suggestion
from headway.contracts.entries import AlgoEntry, EnvEntry
from headway.contracts.environment import EnvSpec
from headway.contracts.errors import HeadwayError
from headway.environments import chosen_env, notices_of
from headway.registry import algo_entries, algo_entry, env_entries, is_module_path, wrapper_entry
from headway.rollout.workers.shared_memory import give_back_memory
from headway_launch.console.output import print_line

_OVERRIDE = re.compile(r"(?P<prefix>\+{0,2})(?P<key>[^=+~]+)=(?P<value>.*)", re.DOTALL)
_DELETION = re.compile(r"~(?P<key>[^=+~]+)(=.*)?", re.DOTALL)
_SEVERAL = re.compile(r"Ambiguous value for argument '(?P<key>[^=]*)=(?P<value>.*)'")
_DEFAULT = "default_"
"""Begins the names of presets that stand where none is chosen: `default_bus` with `env=bus`."""
_NO_ENV = "none"
"""The option of the group `env` that stands where none is chosen."""
_SENTENCE = re.compile(r".*?\.(?=\s|$)")
_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")


@dataclass(frozen=True)
class PreparedEnv:
    """An experiment's environment, ready to be made."""

    entry: EnvEntry
    """What makes it; its rules."""
    prepared: Any
    """What all copies share of the one that is reported on."""
    training: Any
    """The same of the one that is learned from."""
    spec: EnvSpec
    """What is learned from."""


@dataclass(frozen=True)
class Experiment:
    """A valid configuration with the objects that its names stand for."""

    config: ExperimentConfig
    env: EnvEntry
    """What is reported on, with its wrappers."""
    training_env: EnvEntry
    """What is learned from, with wrappers that change rewards, too."""
    env_config: Any
    training_env_config: Any
    """With `env.training_args` over `env.args`."""
    env_mapping: Mapping[str, Any]
    """What `env.*` has beside `id` and `args`, spelt out."""
    algo: AlgoEntry
    algo_config: Any

    @property
    def algo_name(self) -> str:
        """The algorithm's name in the registry."""
        return str(self.config.algo["name"])

    @property
    def evaluated_env(self) -> Mapping[str, Any]:
        """What evaluation, rules and every figure are of: the environment, its arguments, what its adapter is
        told and the wrappers that do more than change rewards."""
        wrappers = [
            wrapper
            for wrapper in self.env_mapping.get("wrappers", ())
            if not wrapper_entry(wrapper["name"]).only_rewards
        ]
        args = plain(self.env_config)
        return {**self.env_mapping, "id": self.config.env.id, "args": args, "wrappers": wrappers}

    @property
    def rules(self) -> tuple[str, ...]:
        """Rules of the environment that are evaluated beside the learner."""
        chosen = self.config.evaluation.rules
        return tuple(self.env.rules) if chosen is None else chosen

    def prepare(self, known: "dict[str, PreparedEnv] | None" = None) -> PreparedEnv:
        """What all environment copies share, and what the environment is. Tells the user what its wrappers
        cost. `known` keeps what has been prepared, for experiments that differ in their algorithm only.

        Raises HeadwayError for data that cannot be used, a rule that is unknown or cannot be played, training
        arguments that change what agents observe or do, and an algorithm that cannot run on this environment.
        """
        kept = {} if known is None else known
        key = self._environment_key
        if key not in kept:
            kept[key] = self._prepare_environment()
        if reason := self.algo.refuses(self.algo_config, kept[key].spec):
            raise HeadwayError(f"{self.algo_name} cannot run on {self.config.env.id}: {reason}")
        return kept[key]

    @property
    def _environment_key(self) -> str:
        """The same for experiments of the same environment, arguments, wrappers and rules."""
        args = [plain(self.env_config), plain(self.training_env_config)]
        return json.dumps(
            [self.config.env.id, self.env_mapping, args, self.rules], sort_keys=True, default=str
        )

    def _prepare_environment(self) -> PreparedEnv:
        for rule in self.rules:
            if rule not in self.env.rules:
                raise HeadwayError(
                    f"evaluation.rules: {rule!r} is no rule of {self.config.env.id}; "
                    f"{suggestion(rule, self.env.rules)}"
                )
        prepared = training = self.env.prepare(self.env_config)
        spec = self._spec(prepared)
        if self.training_env is not self.env or self.training_env_config != self.env_config:
            beside = self.training_env.prepare_variant
            if beside is None:
                training = self.training_env.prepare(self.training_env_config)
            else:
                training = beside(self.training_env_config, prepared)
            reported, spec = spec, self._spec(training)
            alike = replace(
                reported,
                shared_reward=spec.shared_reward,
                shared_in_groups=spec.shared_in_groups,
                snapshots=spec.snapshots,
            )
            if alike != spec:
                raise HeadwayError(
                    "env.training_args may change rewards and dynamics, not what agents observe, do or are "
                    "measured by; set such arguments by env.args"
                )
        for rule in self.rules:
            try:
                self.env.rules[rule].make(prepared)
            except HeadwayError as error:  # its wrappers hide what it looks at
                raise HeadwayError(f"evaluation.rules: {error}") from error
        give_back_memory()  # before it is all there again in each training process
        for line in dict.fromkeys((*notices_of(prepared), *notices_of(training))):
            print_line(f"headway: {line}")
        return PreparedEnv(self.env, prepared, training, spec)

    def _spec(self, prepared: object) -> EnvSpec:
        with closing(self.env.make(prepared, 1)) as env:
            return env.spec


def compose(overrides: Sequence[str]) -> Experiment:
    """The experiment that `overrides` describe (`experiment=bus_mappo algo.lr=3e-4 seed=0..4`).

    Overrides follow Hydra's grammar; `key=value` may set any key, whether or not a YAML file has it.
    A preset's values stand below everything else but the defaults. Raises HeadwayError for whatever
    cannot be used.
    """
    mapping, choices = _compose_mapping([_prepared(override, overrides) for override in overrides])
    presets = mapping.pop("preset", None) or {}
    preset = choices.get("preset") or NO_PRESET
    values = _preset_values(presets, mapping, by_default=preset.startswith(_DEFAULT))
    try:
        return resolve({**_merged(values, mapping), "preset": preset if values else NO_PRESET})
    except HeadwayError as error:
        key = str(error).partition(" is not a key of ")[0]
        if _has(values, key) and not _has(mapping, key):
            raise HeadwayError(f"preset={preset} is not for this: {error}") from error
        raise


def _preset_values(
    presets: Mapping[str, Any], mapping: Mapping[str, Any], by_default: bool
) -> Mapping[str, Any]:
    """The values that a preset has for the algorithm of an experiment. None where that is not among them and
    the preset was taken by default, with the environment; raises HeadwayError where it was chosen."""
    name = str((mapping.get("algo") or {}).get("name"))
    if not presets or (by_default and name not in presets):
        return {}
    if name not in presets:
        raise HeadwayError(
            f"the preset has no values for algo={name}; it has them for {', '.join(sorted(presets))} "
            f"(preset={NO_PRESET} leaves the defaults)"
        )
    values: Mapping[str, Any] = presets[name] or {}
    return values


def _has(mapping: object, key: str) -> bool:
    """Whether nested mappings have a dotted key."""
    for part in key.split("."):
        if not isinstance(mapping, Mapping) or part not in mapping:
            return False
        mapping = mapping[part]
    return True


def resolve(mapping: Mapping[str, Any]) -> Experiment:
    """Validate a whole experiment, given as nested mappings (a composed or a stored configuration)."""
    refuse_targets(mapping)
    values = dict(mapping)
    if "seed" in values:
        values["seed"] = parse_seeds(values["seed"])
    config = build(ExperimentConfig, values)
    if not _DEVICE.fullmatch(config.device):
        raise HeadwayError(f"device={config.device} is none; write auto, cpu, cuda or cuda:NUMBER")
    if config.device.startswith("cuda") and not Path("/dev/nvidiactl").exists():
        raise HeadwayError(f"device={config.device}, but this machine has no NVIDIA GPU; use auto or cpu")
    env = chosen_env(config.env)
    hyper_parameters = dict(config.algo)
    name = hyper_parameters.pop("name", None)
    if not isinstance(name, str):
        raise HeadwayError(f"algo.name is missing; choose one of {', '.join(algo_entries())}")
    algo = algo_entry(name)
    if any(field.name == "name" for field in fields(algo.config)):
        hyper_parameters["name"] = name
    training_args = _merged(config.env.args, config.env.training_args or {})
    return Experiment(
        config=config,
        env=env.entry,
        training_env=env.training_entry,
        env_config=build(env.entry.config, config.env.args, "env.args", config.env.id),
        training_env_config=build(
            env.training_entry.config, training_args, "env.training_args", config.env.id
        ),
        env_mapping=env.mapping,
        algo=algo,
        algo_config=build(algo.config, hyper_parameters, "algo", name),
    )


def configs_folder() -> Path:
    """The project's `configs`, or the copy packaged with an installed Headway."""
    in_project = Path(__file__).resolve().parents[3] / "configs"
    packaged = Path(__file__).resolve().parents[1] / "packaged_configs"
    for folder in (in_project, packaged):
        if (folder / "config.yaml").is_file():
            return folder
    raise HeadwayError(f"there are no configurations in {in_project}; reinstall headway")


def groups() -> dict[str, tuple[str, ...]]:
    """The groups of configuration files, each with its options."""
    folders = sorted(folder for folder in configs_folder().iterdir() if folder.is_dir())
    return {
        folder.name: tuple(
            sorted(
                option
                for file in folder.rglob("*.yaml")
                if (option := str(file.relative_to(folder).with_suffix(""))) != _NO_ENV
                or folder.name != "env"
            )
        )
        for folder in folders
    }


def summary_of(group: str, option: str) -> str:
    """The first sentence of a configuration file's first comment that is not an instruction to Hydra."""
    lines = (configs_folder() / group / f"{option}.yaml").read_text(encoding="utf-8").splitlines()
    words = (line for line in lines if not line.startswith("# @"))
    comment = takewhile(
        lambda line: line.startswith("#"), dropwhile(lambda line: not line.strip("# "), words)
    )
    text = " ".join(line.removeprefix("#").strip() for line in comment)
    sentence = _SENTENCE.match(text)
    return sentence[0] if sentence else text


def _prepared(override: str, overrides: Sequence[str]) -> str:
    """One of the overrides as Hydra must see it: seeds spelt out, values added where no file has them."""
    if deletion := _DELETION.fullmatch(override):
        if deletion["key"] in groups():
            raise HeadwayError(f"{override}: {deletion['key']} cannot be taken away; choose another option")
        return override
    parts = _OVERRIDE.fullmatch(override)
    if parts is None:
        raise HeadwayError(f"{override!r} is not an override; write key=value{_meant_experiment(override)}")
    prefix, key, value = parts["prefix"], parts["key"].strip(), parts["value"]
    if key == "seed":
        return f"++seed=[{','.join(str(seed) for seed in parse_seeds(value))}]"
    if prefix:
        return override
    known = groups()
    if key not in known:
        _require_a_key(key, value, overrides)
        return f"++{override}"
    if "," in value and not value.startswith(("[", "{", "'", '"')):
        raise HeadwayError(f"{override}: one option at a time; `headway sweep` takes several")
    if value not in known[key]:
        return _option_without_file(key, value, known[key])
    return override


def _require_a_key(key: str, value: str, overrides: Sequence[str]) -> None:
    """Refuse a key of nothing here, where the files that are chosen by name are known too."""
    head, _, rest = key.partition(".")
    names = {field.name for field in fields(ExperimentConfig)} | {"experiment", "preset"}
    if head in names or head == "hydra":
        return
    if whole := _keys_that_end_in(key, [other for other in overrides if _head_of(other) in names]):
        raise HeadwayError(
            f"{key} is not a key of the experiment; did you mean {' or '.join(whole)}={value}?"
        )
    if not rest and nearest(head, names) in ("experiment", "preset"):
        near = f"did you mean {nearest(head, names)}={value}? Available: {', '.join(sorted(names))}"
        raise HeadwayError(f"{head} is not a key of the experiment; {near}")
    raise HeadwayError(f"{head} is not a key of the experiment; {suggestion(head, names)}")


def _head_of(override: str) -> str:
    return re.split(r"[.=]", override.lstrip("+~"), maxsplit=1)[0]


def _keys_that_end_in(key: str, overrides: Sequence[str]) -> list[str]:
    """Keys of the experiment that `overrides` describe, in which the first parts are missing from `key`."""
    try:
        found = compose(overrides if _names_env(overrides) else [*overrides, "env=trivial"])
    except HeadwayError:
        return []
    described = (
        *describe(ExperimentConfig),
        *describe(type(found.env_config), "env.args"),
        *describe(type(found.algo_config), "algo"),
    )
    return [field.key for field in described if field.key.endswith(f".{key}")]


def _names_env(overrides: Sequence[str]) -> bool:
    return any(_head_of(override) in ("env", "experiment") for override in overrides)


def _option_without_file(group: str, option: str, options: Sequence[str]) -> str:
    """A registered environment or algorithm, and a module path, need no file of their own."""
    if group == "env" and (option in env_entries() or is_module_path(option)):
        return f"++env={{id:{option}}}"
    if group == "algo" and option in algo_entries():
        return f"++algo={{name:{option}}}"
    raise HeadwayError(
        f"{group}={option}: there is no such {group}; {suggestion(option, options, f'{group}=')}"
    )


def _meant_experiment(word: str) -> str:
    near = nearest(word, groups().get("experiment", ()))
    return f"; did you mean experiment={near}?" if near else " (such as experiment=bus_mappo)"


def _compose_mapping(overrides: Sequence[str]) -> tuple[dict[str, Any], Mapping[str, str]]:
    """What the files and overrides come to, and the option chosen of each group."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf, open_dict
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
    from yaml import YAMLError

    # Data beside the project is found from whatever folder the command is given in.
    OmegaConf.register_new_resolver(
        "project", lambda path: str((configs_folder().parent / path).resolve()), replace=True
    )
    try:
        with initialize_config_dir(str(configs_folder()), version_base="1.3"):
            composed = hydra_compose("config", overrides=list(overrides), return_hydra_config=True)
        chosen = composed.hydra.runtime.choices
        with open_dict(composed):
            del composed["hydra"]
        mapping = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        key = error.full_key
        if key == "env.id" and chosen.get("env") == _NO_ENV:
            raise HeadwayError(
                "no experiment is named; write experiment=NAME (`headway list experiments`), such as "
                "experiment=bus_mappo, or env=NAME and algo=NAME of your own choice"
            ) from error
        raise HeadwayError(f"{key} is missing and has no default; write {key}=VALUE") from error
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError) as error:
        deleted = [override for override in overrides if _DELETION.fullmatch(override)]
        if deleted:
            others = [override for override in overrides if override not in deleted]
            _require_set(deleted, _compose_mapping(others)[0])
        raise HeadwayError(_one_line(error)) from error
    assert isinstance(mapping, dict)
    return {str(key): value for key, value in mapping.items()}, chosen


def _require_set(deleted: Sequence[str], mapping: Mapping[str, Any]) -> None:
    """Raise HeadwayError for the first of the deletions whose key nothing sets."""
    for override in deleted:
        key = override[1:].partition("=")[0]
        if not _has(mapping, key):
            raise HeadwayError(f"{override}: nothing sets {key}, so its default holds already")


def _one_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    kept = [line for line in lines if not line.lower().startswith(("see https", "set the environment"))]
    if kept and (several := _SEVERAL.match(kept[0])):
        key = several["key"].lstrip("+")
        values = several["value"]
        return f"{key}={values} is several values; `headway sweep` takes them, a list is {key}=[{values}]"
    return "the configuration cannot be composed: " + "; ".join(kept[:3])


def _merged(lower: Mapping[str, Any], upper: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(lower)
    for key, value in upper.items():
        below = merged.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            value = _merged(below, value)
        merged[key] = value
    return merged
