"""Composition of one validated experiment from names and `key=value` overrides, with Hydra."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from headway.adapters.env_file import EnvFile, absolute_id, is_file_id
from headway.algorithms import chosen_algo
from headway.config.experiment import NO_PRESET, EnvConfig, ExperimentConfig
from headway.config.schema import (
    ALIASES,
    build,
    describe,
    nearest,
    parse_seeds,
    plain,
    refuse_targets,
    suggestion,
)
from headway.contracts.entries import AlgoEntry, EnvEntry, RuleEntry
from headway.contracts.environment import EnvSpec
from headway.contracts.errors import HeadwayError, UnknownKeyError
from headway.contracts.random_rule import RANDOM
from headway.environments import chosen_env
from headway.registry import is_external, rule_entry, wrapper_entry
from headway.rollout.workers.shared_memory import give_back_memory
from headway.store.run_folder import find_run
from headway_launch.console.output import print_notice, prints_to_stderr
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
_LARGE_OBSERVATION = 2_000
_LARGE = (
    "{} has observations of {:,} numbers, and all networks are fully connected, without convolutions; images "
    "can be made smaller by wrappers, such as color_reduction_v0 and resize_v1 (`headway list wrappers`)"
)
_MAY_DIFFER = ("shared_reward", "shared_in_groups", "snapshots")
"""Parts of a specification in which the training environment may differ from that of evaluation."""
_KEYS = frozenset(field.name for field in fields(ExperimentConfig))
_DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")


@dataclass(frozen=True)
class PreparedEnv:
    """The prepared environment of an experiment."""

    entry: EnvEntry
    """Constructor and rules of the evaluation environment."""
    prepared: Any
    """Data that all copies of the evaluation environment share: the result of `EnvEntry.prepare`."""
    stages: tuple[Any, ...]
    """Shared data of each stage's training environment; a single item without `stages`."""
    spec: EnvSpec
    """Spec of the training environments."""

    @property
    def training(self) -> Any:  # noqa: ANN401 - opaque
        """The shared data of the training environment, in the first stage."""
        return self.stages[0]


@dataclass(frozen=True)
class Experiment:
    """A validated configuration with the registry entries and config records that it names."""

    config: ExperimentConfig
    env: EnvEntry
    """Evaluation environment, with its wrappers."""
    training_env: EnvEntry
    """Training environment, which includes the wrappers that only change rewards."""
    env_config: Any
    training_env_configs: tuple[Any, ...]
    """Config of the training environment of each stage: its `training_args` merged over
    `env.training_args`, and these over `env.args`."""
    env_mapping: Mapping[str, Any]
    """Keys of `env` other than `id` and `args`, with defaults written out."""
    algo: AlgoEntry
    algo_config: Any

    @property
    def algo_name(self) -> str:
        """The algorithm's name in the registry."""
        return str(self.config.algo["name"])

    @property
    def evaluated_env(self) -> Mapping[str, Any]:
        """Identity of the evaluation environment: its id, arguments, adapter options and wrappers.

        Wrappers that only change rewards are left out.
        """
        wrappers = [
            wrapper
            for wrapper in self.env_mapping.get("wrappers", ())
            if not wrapper_entry(wrapper["name"]).only_rewards
        ]
        args = plain(self.env_config)
        return {**self.env_mapping, "id": self.config.env.id, "args": args, "wrappers": wrappers}

    @property
    def rules(self) -> tuple[str, ...]:
        """Names of the rules that are evaluated for comparison; by default all but `lookahead`."""
        chosen = self.config.evaluation.rules
        return tuple(self.env.rules) if chosen is None else chosen

    @property
    def file_digest(self) -> str | None:
        """Digest of the files that `env` names, as they are now; None: none, or they cannot be read."""
        if is_file_id(self.config.env.id):
            return EnvFile.read(self.config.env.id).digest
        return _data_digest(self.env, self.env_config, *self.training_env_configs)

    def require_unchanged_files(self) -> None:
        """Raise HeadwayError if the environment's files have changed since their digest was stored.

        Training would otherwise store its curves under the digest of other files.
        """
        stored = self.config.env.file_digest
        if stored in (None, self.file_digest):
            return
        env = self.config.env.id
        raise HeadwayError(
            f"{env if is_file_id(env) else f'a file of env={env}'} has changed since its digest {stored} was "
            "stored: restore the file to continue, or train the new version as another cell"
        )

    def prepare(self, known: "dict[str, PreparedEnv] | None" = None) -> PreparedEnv:
        """Return the prepared environment and print its notices.

        `known`: cache of prepared environments for experiments that differ in their algorithm only.

        Raises HeadwayError for unusable data, a rule that is unknown or cannot play, training arguments that
        change observations or actions, and an algorithm that cannot run on the environment.
        """
        cache = {} if known is None else known
        key = self._environment_key
        if key not in cache:
            cache[key] = self.prepare_environment()
        if reason := self.algo.refuses(self.algo_config, cache[key].spec):
            raise HeadwayError(f"{self.algo_name} cannot run on {self.config.env.id}: {reason}")
        return cache[key]

    @property
    def _environment_key(self) -> str:
        """Key that is equal for experiments with the same environment, arguments, wrappers and rules."""
        args = [plain(self.env_config), plain(self.training_env_configs)]
        return json.dumps(
            [self.config.env.id, self.env_mapping, args, self.rules], sort_keys=True, default=str
        )

    def _rule(self, name: str) -> RuleEntry:
        try:
            return rule_entry(self.env, name)
        except HeadwayError as error:
            raise HeadwayError(
                f"evaluation.rules: {error}; if an experiment sets rules of another environment, "
                f"evaluation.rules=null selects those of {self.config.env.id}"
            ) from error

    @prints_to_stderr()
    def prepare_environment(self) -> PreparedEnv:
        """Return the prepared environment like `prepare`, also for an algorithm that cannot run on it: for
        rules, which need none."""
        rules = [self._rule(name) for name in self.rules]
        prepared = self.env.prepare(self.env_config)
        evaluated = spec = self._spec(prepared)
        stages: list[Any] = []
        for stage, config in enumerate(self.training_env_configs):
            key = f"stages[{stage}].training_args" if self.config.stages else "env.training_args"
            stages.append(self._training_data(config, prepared))
            own = evaluated if stages[-1] is prepared else self._spec(stages[-1])
            spec = own if stage == 0 else spec
            _require_alike(key, own, evaluated, "evaluation", _MAY_DIFFER)
            _require_alike(key, own, spec, "stages[0]")
        for rule in rules:
            try:
                rule.make(prepared)
            except HeadwayError as error:  # wrappers hide its inputs
                raise HeadwayError(f"evaluation.rules: {error}") from error
        give_back_memory()  # each training process loads the same data next
        of_data = (line for data in (prepared, *stages) for line in getattr(data, "notices", ()))
        for line in dict.fromkeys(of_data):
            print_notice(line)
        stored, env_id = self.config.env.file_digest, self.config.env.id
        if spec.observation_size > _LARGE_OBSERVATION:
            print_notice(_LARGE.format(env_id, spec.observation_size))
        if not is_external(env_id) and stored not in (None, self.file_digest):
            print_notice(f"a file of env={env_id} is not that of the run's training; results may differ")
        return PreparedEnv(self.env, prepared, tuple(stages), spec)

    def _training_data(self, config: object, prepared: object) -> object:
        """Return the shared data of a training environment: `prepared` if it is that of evaluation."""
        if self.training_env is self.env and config == self.env_config:
            return prepared
        if self.training_env.prepare_variant is None:
            return self.training_env.prepare(config)
        return self.training_env.prepare_variant(config, prepared)

    def _spec(self, prepared: object) -> EnvSpec:
        with closing(self.env.make(prepared, 1)) as env:
            return env.spec


def _require_alike(
    key: str, spec: EnvSpec, other: EnvSpec, whose: str, may_differ: Sequence[str] = ()
) -> None:
    """Raise HeadwayError if arguments `key` give a spec that differs from that of another environment."""
    names = [each.name for each in fields(EnvSpec) if each.compare and each.name not in may_differ]
    pairs = {name: (getattr(spec, name), getattr(other, name)) for name in names}
    differing = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    if not differing:
        return
    shown = [
        f"{len(a)} agents here and {len(b)}" if name == "agents" else f"{name} {a} here and {b}"
        for name, (a, b) in differing.items()
        if name != "metrics"
    ]
    what = f" ({', '.join(shown)} in {whose})" if shown else ""
    room = ", or set there one that makes room for all, such as max_density of merge" if shown else ""
    raise HeadwayError(
        f"{key} may change rewards and dynamics, not observations, actions or metrics{what}; set such "
        f"arguments in {f'env.args{room}' if whose == 'evaluation' else 'env.training_args'}"
    )


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
            group, _, key = error.key.rpartition(".")
            # `algo.steps` may as well be meant for `rollout.steps` or an environment's.
            if group in ("algo", "rollout") and key != "steps" and (ours := ALIASES.get(key)) in _KEYS:
                raise UnknownKeyError(error.key, _EXPERIMENT, f"did you mean {ours}?") from error
            raise

    return composed


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
        env = chosen_env(config.env)
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
        digest := _data_digest(env.entry, env_config, *training_env_configs)
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


def _data_digest(entry: EnvEntry, *configs: object) -> str | None:
    """Return the digest of the files that the configs of an environment name; None if there is none."""
    if entry.digest is None:
        return None
    return "-".join(digest for digest in dict.fromkeys(map(entry.digest, configs)) if digest) or None


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
    if head in names or head == "hydra":
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
