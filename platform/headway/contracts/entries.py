"""Registry entries: everything that the platform uses of a named environment or algorithm.

Third parties register theirs by entry point (`headway.envs`, `headway.algos`), each a mapping from name to
entry. Wrapper entries are in `headway.contracts.wrapper`. A callable in an entry may be a `Lazy`, which is
imported when it is first called.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from headway.contracts.acting_policy import ActingPolicy
from headway.contracts.environment import BatchedEnv, EnvSpec, Observations
from headway.contracts.lazy import Lazy
from headway.contracts.learner import Contributor, Learner

LOOKAHEAD = "lookahead"
"""Name of the rule that improves on another rule by simulation."""


def _identity(config: Any) -> Any:  # noqa: ANN401 - any record
    return config


def _no_objection(*_: object) -> None:
    return None


def _no_anchor(config: Any, kl_coeff: float, critic_iterations: int) -> str | None:  # noqa: ANN401 - any record
    return (
        "this algorithm supports neither start.kl_coeff nor start.critic_iterations; add start.kl_coeff=0 "
        "start.critic_iterations=0, or use another algorithm, such as algo=ippo"
    )


class Rule(Protocol):
    """A classical controller. It may inspect the environment itself, not only the observations.

    Snapshots do not contain the state of a rule: training that starts from a rule with state is not resumed
    exactly.
    """

    def act(self, env: BatchedEnv, observed: Observations) -> NDArray[Any]:
        """Return the actions of every copy and agent, shaped as `BatchedEnv.step` takes them."""
        ...


def is_lookahead(rule: str) -> bool:
    """Return whether this is `lookahead`, a reference for the possible gain rather than a usable controller.

    It tries each action in simulations in which another rule acts from the next step on: the one in the name,
    `lookahead:RULE`, or that of `EnvEntry.lookahead`. It is played only where it is named, and never counts
    as the best rule.
    """
    return rule.partition(":")[0] == LOOKAHEAD


@dataclass(frozen=True)
class RuleEntry:
    """Registry entry of a rule (a controller that does not learn) for one environment."""

    summary: str
    """One line for `headway list rules`: what the rule does, and its source if it has one."""
    make: Callable[[Any], Rule]
    """(prepared) -> rule, where `prepared` is the result of `EnvEntry.prepare`."""
    internal: bool = False
    """No policy can imitate it: the environment ignores the actions that it returns, or they are none of the
    action space but others that `step` knows. The actions of other rules are checked in every step."""


class Renderer(Protocol):
    """Renders an environment as pictures."""

    def render(self, env: BatchedEnv, at_end: bool) -> NDArray[np.uint8]:
        """Return the first copy as an RGB picture, shape (height, width, 3), the same size on every call.

        `at_end`: show the end of the last episode instead of the beginning of the next.
        """
        ...


@dataclass(frozen=True)
class EnvEntry:
    """A named environment."""

    summary: str
    """One line for `headway list envs`."""
    config: type
    """Frozen dataclass of the environment's arguments, the keys of `env.args`.

    Each field needs a docstring, which `headway list envs NAME` shows. `__post_init__` raises ValueError for
    invalid values.
    """
    make: Callable[[Any, int], BatchedEnv]
    """(prepared, copies) -> batched environment of `copies` copies.

    Runs in light workers, so it imports neither pandas nor torch. Must be picklable: a function or class at
    the top level of a module, a `functools.partial` of one, or a `Lazy`.
    """
    prepare: Callable[[Any], Any] = _identity
    """(config) -> picklable data that all copies share, such as tables read or networks built.

    Runs once, in the parent process. Raises HeadwayError for data that cannot be used. Default: the config
    itself. Lines in its tuples `notices` and `training_notices`, if it has them, are printed, the latter only
    before a training.
    """
    digest: Callable[[Any], str | None] | None = None
    """(config) -> digest of the content of the files that its values name; None: none, or they cannot be
    read.

    It is stored with a run, whose training is then not continued on changed files. None: the environment
    reads no files, or they are not compared.
    """
    prepare_variant: Callable[[Any, Any], Any] | None = None
    """(config, prepared) -> an equal result to `prepare(config)` that shares unchanged parts with `prepared`.

    `prepared` is the result of `prepare` for another config of the same environment, with the same kind of
    wrapper record around it if the environment is wrapped. This saves memory where training uses other
    rewards than evaluation (`env.training_args`) and prepared data is large. Raises what `prepare` raises.
    None: `prepare` is called for each config.
    """
    parallel_env: Callable[[Any], Any] | None = None
    """(config, or the result of `prepare`) -> the same environment as a PettingZoo ParallelEnv.

    `reset(seed=s)` must begin the same episode as `reset([s])` of the batch. Episode metrics travel in info
    `episode_metrics`, their names in `metadata["episode_metrics"]`. The optional attribute `native` holds the
    batch of one copy behind it and that batch's last observations; the environment's rules inspect them.
    None: no PettingZoo wrapper can be used.
    """
    rules: Mapping[str, RuleEntry] = field(default_factory=dict)
    """Rules by name. The rule `random` is added unless the environment has a rule of this name."""
    lookahead: str | None = None
    """Default base rule of the rule `lookahead`. None: the environment has no `lookahead`, since its batches
    are no `BranchingEnv`."""
    simulated: Callable[[Any], Any] = _identity
    """(prepared) -> prepared data for the simulations of `lookahead`: the same environment, possibly with
    rewards that charge at once what an action will cost beyond the horizon."""
    metrics: Mapping[str, str] = field(default_factory=dict)
    """Description of each episode metric, its unit last (`..., m/s`), in the order of `EnvSpec.metrics`."""
    renderer: Callable[[Any], Renderer] | None = None
    """(prepared) -> renderer, for `headway render`; None: the environment cannot be rendered."""
    preload: tuple[str, ...] = ()
    """Modules that the forkserver imports once for all worker processes (compiled kernels).

    If a module has a function `warm()`, it is called once before training starts, so that its kernels are
    compiled once and not by every worker.
    """
    published: Lazy | None = None
    """Name of the `PublishedResults` of a paper on this environment, read with `load()`; None: no paper."""

    def __post_init__(self) -> None:
        for name, rule in self.rules.items():
            if not isinstance(rule, RuleEntry):
                raise TypeError(f"rule {name!r} must be a RuleEntry, not {type(rule).__name__}")


@dataclass(frozen=True)
class AlgoEntry:
    """A named algorithm. Neither this entry nor its `acting_policy` may import torch; `learner` does."""

    summary: str
    """One line for `headway list algos`."""
    source: str
    """Paper, with its arXiv number."""
    config: type
    """Frozen dataclass of the hyper-parameters (the keys of `algo`), unless `record` chooses another. Same
    rules as for `EnvEntry.config`.

    The class variable `VALUES_BEFORE` is for keys that were added later and whose default changes the
    behaviour: it maps each to the value that reproduces the earlier behaviour. Stored runs without the key
    have that value.
    """
    acting_policy: Callable[[Any, EnvSpec], ActingPolicy]
    """(config, spec) -> the policy that workers run. Here and for the learner and contributor `spec` is
    `EnvSpec.for_policies`; the platform scales actions to the environment's bounds."""
    learner: Callable[[Any, EnvSpec, Sequence[int], str], Learner]
    """(config, spec, seeds of the R replicas, device) -> learner. The device is `cpu`, `cuda` or
    `cuda:NUMBER`."""
    refuses: Callable[[Any, EnvSpec], str | None] = _no_objection
    """(config, spec) -> one line saying why the algorithm cannot run on the environment; None if it can."""
    replay_bytes: Callable[[Any, EnvSpec, int], int] = lambda config, spec, env_steps: 0
    """(config, spec, environment steps per seed) -> upper bound on the bytes of one seed's replay data, which
    are stored in addition to a checkpoint; 0 for algorithms without replay."""
    refuses_budget: Callable[[Any, int], str | None] = _no_objection
    """(config, iterations) -> one line saying why the config needs more iterations; None if they suffice."""
    starts: bool = False
    """Whether its learner is a `StartingLearner`: `start.rule` and `start.run` can be set."""
    refuses_anchor: Callable[[Any, float, int], str | None] = _no_anchor
    """(config, start.kl_coeff, start.critic_iterations) -> one line saying why `start.kl_coeff` or
    `start.critic_iterations` cannot be set; None if the learner is an `AnchoredLearner` and they can."""
    contributor: Callable[[Any, EnvSpec, Sequence[int]], Contributor] | None = None
    """(config, spec, seeds of the replicas) -> the worker's part of an `AsynchronousLearner`; it may import
    torch. None: the learner is synchronous."""
    preload: tuple[str, ...] = ()
    """Modules that the forkserver imports once for all processes that run contributors."""
    kernels: tuple[str, ...] = ()
    """Modules of compiled code that the learner calls. Their `warm()` is called before training starts."""
    rollout: Callable[[Any], Mapping[str, int]] = lambda config: {}
    """(config) -> default values of keys of `rollout`, such as `{"steps": 16}`. Every file and override takes
    precedence over them; keys left out have the platform's defaults (`headway list keys rollout`)."""
    record: Callable[[Mapping[str, Any]], type] | None = None
    """(given hyper-parameters) -> frozen dataclass of all of them, for algorithms in which some values decide
    which keys exist; None: always `config`."""

    obsolete_keys: Mapping[str, Any] = field(default_factory=dict)
    """Keys without effect that earlier versions stored, and their values. They stay in the hash that
    identifies a study's cells, so that old runs keep their cells."""

    def record_for(self, hyper_parameters: Mapping[str, Any]) -> type:
        """Return the dataclass whose keys apply with these hyper-parameters."""
        return self.config if self.record is None else self.record(hyper_parameters)
