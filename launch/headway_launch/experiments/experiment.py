"""An experiment: its validated configuration, the entries that it names, and its prepared environment."""

import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from typing import Any

from headway.adapters.env_file import EnvFile, is_file_id
from headway.config.experiment import ExperimentConfig
from headway.config.schema import plain
from headway.contracts.entries import AlgoEntry, EnvEntry, RuleEntry
from headway.contracts.environment import EnvSpec
from headway.contracts.errors import HeadwayError
from headway.registry import is_external, rule_entry, wrapper_entry
from headway.rollout.workers.shared_memory import give_back_memory
from headway_launch.console.output import print_notice, prints_to_stderr

_LARGE_OBSERVATION = 2_000
_LARGE = (
    "{} has observations of {:,} numbers, and all networks are fully connected, without convolutions; images "
    "can be made smaller by wrappers, such as color_reduction_v0 and resize_v1 (`headway list wrappers`)"
)
_MAY_DIFFER = ("shared_reward", "shared_in_groups", "snapshots")
"""Parts of a specification in which the training environment may differ from that of evaluation."""


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
        wrappers, args = wrappers_of(self.env_mapping, only_rewards=False), plain(self.env_config)
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
        return data_digest(self.env, self.env_config, *self.training_env_configs)

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


def wrappers_of(env: Mapping[str, Any], only_rewards: bool) -> list[Mapping[str, Any]]:
    """Return the wrappers that only change rewards and hence apply only in training, or all others."""
    return [
        each for each in env.get("wrappers", ()) if wrapper_entry(each["name"]).only_rewards == only_rewards
    ]


def data_digest(entry: EnvEntry, *configs: object) -> str | None:
    """Return the digest of the files that the configs of an environment name; None if there is none."""
    if entry.digest is None:
        return None
    return "-".join(digest for digest in dict.fromkeys(map(entry.digest, configs)) if digest) or None
