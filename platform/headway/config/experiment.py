"""An experiment as frozen records. Every default of the platform is written here and nowhere else."""

import re
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any, Literal

from headway.contracts.checks import (
    require_at_least,
    require_default,
    require_finite,
    require_key,
    require_value,
)
from headway.contracts.errors import InvalidValueError

NO_PRESET = "none"
"""Value of `preset` that leaves the defaults unchanged."""
_STUDY_LENGTH = 100
_HOST_AND_PORT = re.compile(r"\S+:\d{1,5}")


def without_password(uri: str) -> str:
    """Return a URI without the password after its user name, or in its query, if it has one."""
    address, mark, query = uri.partition("?")
    address = re.sub(r"(://[^/@:]*):[^@]*@", r"\1@", address)
    return address + mark + re.sub(r"(?<![^&])password=[^&]*&?", "", query)


def _require_study(name: str) -> None:
    """Raise ValueError for a study name that cannot be used as the name of a folder and of a picture file."""
    forms = "write letters, digits, spaces and . _ -, such as study=bus_line"
    shown = repr(name) if len(name) <= _STUDY_LENGTH else f"{name[:20]!r}..."
    named = any(letter.isascii() and letter.isalnum() for letter in name)
    require_key(named, "study", f"{shown} has no letter or digit; {forms}")
    wrong = "".join(letter for letter in name if letter in "/\\" or not letter.isprintable())
    require_key(not wrong, "study", f"{shown} has {wrong[:1]!r} in it; {forms}")
    require_key(".." not in name, "study", f"{shown} has '..' in it; {forms}")
    require_key(name == name.strip(), "study", f"{shown} begins or ends with a blank; {forms}")
    length = f"{shown} is longer than {_STUDY_LENGTH} letters; {forms}"
    require_key(len(name) <= _STUDY_LENGTH, "study", length)


@dataclass(frozen=True)
class EnvConfig:
    """The environment and its arguments."""

    id: str = "bus"
    """Registry name (see `headway list envs`), the module path of a PettingZoo environment, such as
    `mpe2.simple_spread_v3`, the path of a Python file that defines one, such as `./shuttle.py` (stored as an
    absolute path), or the id of a registered environment with the module that registers it with PettingZoo or
    Gymnasium, such as `pettingzoo:sisl/pursuit-v5` or `gymnasium:CartPole-v1`."""
    args: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the environment, validated by its own record."""
    training_args: Mapping[str, Any] | None = None
    """Arguments that override `args` in training only, such as a reward that is easier to learn from.
    Evaluation, rules and all reported metrics use `args`; only the `training/...` columns of a curve use
    these. Setting null drops the training arguments of a preset; setting `{}` keeps them."""
    wrappers: tuple[Any, ...] = ()
    """Wrappers by name (see `headway list wrappers`), the innermost first: `[{name: frame_stack_v1,
    stack_size: 4}, clip_reward_v0]`. Wrappers that only change rewards are used in training only."""
    shared_reward: bool | None = None
    """For PettingZoo environments by module path or file: whether all agents get the same reward at every
    step, so that one value per team suffices for a central critic. If true, rewards are checked for equality.
    null: false, with a notice before training if all rewards are equal in a few steps of random play, since
    only the user can know whether they always are."""
    agents_come_and_go: bool | None = None
    """For PettingZoo environments by module path or file: whether agents may leave before the episode ends.
    null: as declared by the environment's metadata or infos, otherwise false."""
    max_copies_per_process: int | None = None
    """For PettingZoo environments by module path or file: maximum number of copies in one process.
    null: no limit."""
    file_digest: str | None = None
    """Digest of the Python file that `id` names, or of the road network and demand that `args` of `junctions`
    name, written by Headway into a run's configuration: runs of changed files form another cell, and a notice
    says if they have changed since a run."""

    def __post_init__(self) -> None:
        limit = self.max_copies_per_process
        require_value(
            self, "max_copies_per_process", limit is None or limit >= 1, "must be at least 1, or null"
        )


@dataclass(frozen=True)
class RolloutConfig:
    """How experience is collected. These values are part of a run's plan: they decide its random draws.

    Algorithms may have different defaults, which `headway list algos NAME` shows.
    """

    copies: int = 8
    """E: environment copies per seed."""
    steps: int = 128
    """T: steps of each copy per iteration. An iteration is copies x steps environment steps."""
    block: int = 4
    """Copies whose actions are computed together; must divide `copies`. Worker processes get whole blocks.
    Reduced if a process cannot hold that many copies of the environment; a run's `plan.json` has the value
    used."""

    def __post_init__(self) -> None:
        require_at_least(1, copies=self.copies, steps=self.steps, block=self.block)
        require_value(self, "block", self.copies % self.block == 0, f"must divide copies ({self.copies})")


@dataclass(frozen=True)
class BackendConfig:
    """Where rollouts run and how many seeds train at once.

    On a CPU results do not depend on it: curves are equal bit for bit, except for asynchronous algorithms
    and, in the last bits at some network sizes, for `madqn` and `ddpg` in a `stack`. A GPU rounds
    differently: the first updates agree in float64, later ones diverge.
    """

    name: Literal["serial", "process", "ray"] = "process"
    """`serial`: in the training process itself; `process`: in worker processes; `ray`: in workers on a Ray
    cluster."""
    workers: int | None = None
    """Worker processes per training process. null: as many as the machine's cores allow, and more if a
    process can hold only few copies of the environment (counting all seeds of a stack). An asynchronous
    algorithm has one worker per block."""
    parallel: int | None = None
    """Training processes at once. null: one per core, at most one per seed, and fewer if `workers` is set."""
    stack: int = 1
    """Seeds trained in one process. On a GPU they learn together. On a CPU they share workers and, with
    `madqn` and `ddpg`, torch calls, which dominate small batches; with other algorithms each seed learns
    separately, and one process per seed is faster. If a process can hold fewer copies of the environment than
    one block of every seed, the seeds are divided among the workers and each part is evaluated separately;
    `serial` refuses such a stack."""
    address: str = "local"
    """For `ray`: `local`: a cluster on this machine, for this session only; `auto`: the cluster that this
    machine belongs to or that RAY_ADDRESS names; HOST:PORT: the head of a cluster."""
    worker_cpus: float | None = None
    """For `ray`: CPUs requested from the cluster per worker. null: 1, or 0 for `local`, where the session
    assigns the cores itself."""
    worker_timeout_s: float | None = None
    """Time limit, in s, on a worker's rollout or evaluation, after which the worker is replaced as if it had
    died; the replacement gets twice the time. null: ten times the longest time so far, at least 60. Making
    environments may take ten times the limit, at least 60; 900 for null."""
    learners: Literal["here", "cluster"] | None = None
    """For `ray`: `here`: runs train on this machine, with workers on the cluster; `cluster`: each run is
    placed on one node of the cluster, with its workers (`store.root` must be on a file system that all
    machines share). null: `cluster` if a session trains several runs on a cluster that is not `local`."""

    def __post_init__(self) -> None:
        require_value(
            self, "workers", self.workers is None or self.workers >= 1, "must be at least 1, or null"
        )
        require_value(
            self, "parallel", self.parallel is None or self.parallel >= 1, "must be at least 1, or null"
        )
        require_value(self, "stack", self.stack >= 1, "must be at least 1")
        timeout = self.worker_timeout_s
        require_value(self, "worker_timeout_s", timeout is None or timeout > 0, "must be above 0, or null")
        is_address = self.address in ("auto", "local") or _HOST_AND_PORT.fullmatch(self.address) is not None
        require_value(self, "address", is_address, "must be auto, local or HOST:PORT")
        cpus = self.worker_cpus
        require_value(self, "worker_cpus", cpus is None or cpus >= 0, "must be at least 0, or null")

    @property
    def cpus_per_worker(self) -> float:
        """CPUs requested from the cluster per worker."""
        if self.worker_cpus is not None:
            return self.worker_cpus
        return 0.0 if self.address == "local" else 1.0


@dataclass(frozen=True)
class StartConfig:
    """What training starts from, instead of random parameters."""

    rule: str | None = None
    """Rule of the environment that acts first, in training; the policies learn to imitate its actions and the
    critics to predict its returns. null: none."""
    env_steps: int = 50_000
    """Environment steps per seed in which the rule acts: the first of the experiment's `env_steps`, rounded
    up to whole iterations."""
    run: str | None = None
    """Run, by any unique part of its name, from whose newest checkpoint training starts: policies,
    normalisers and, with the same algorithm and shapes, critics. Optimisers and schedules start anew.
    null: none."""
    kl_coeff: float = 0.0
    """Coefficient of a penalty on the policies' loss, KL(start policy || policy) in the states that policies
    visit, which keeps them near where they started; 0: none. It falls linearly to 0 at the end of training.
    In this direction of the divergence, actions that are likely under the start policy must stay likely, as
    in imitation. The other direction would penalise most the actions that the start policy hardly takes, so
    that policies that imitate a rule would not explore."""
    critic_iterations: int = 0
    """Number of first iterations after the start in which only critics and normalisers learn: an untrained
    critic would spoil a good policy."""

    def __post_init__(self) -> None:
        require_finite(self)
        require_key(
            self.rule is None or self.run is None, "run", "excludes start.rule: leave one of them out"
        )
        require_value(self, "env_steps", self.env_steps >= 1, "must be at least 1")
        problem = "applies to a rule: set start.rule too, or leave this out"
        require_default(self, "env_steps", self.rule is not None, problem)
        require_at_least(0, kl_coeff=self.kl_coeff, critic_iterations=self.critic_iterations)
        for key in ("kl_coeff", "critic_iterations"):
            problem = "applies after a start: set start.rule or start.run too, or leave this out"
            require_default(self, key, self.rule is not None or self.run is not None, problem)

    @property
    def anchors(self) -> tuple[str, ...]:
        """Keys in use that keep policies near the start."""
        return tuple(key for key in ("kl_coeff", "critic_iterations") if getattr(self, key) > 0)


@dataclass(frozen=True)
class StageConfig:
    """One part of training, with its own length and changes to the training environment."""

    env_steps: int
    """Environment steps per seed."""
    training_args: Mapping[str, Any] = field(default_factory=dict)
    """Arguments that override `env.training_args` in this stage."""

    def __post_init__(self) -> None:
        require_value(self, "env_steps", self.env_steps >= 1, "must be at least 1")


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation episodes. Their seeds are fixed, the same for every run, algorithm and rule."""

    episodes: int = 10
    """Episodes per evaluation."""
    every: int = 40_000
    """Environment steps between evaluations, each after the iteration that reaches the next multiple. The
    first evaluation is before training, the last after it. Counted in steps so that curves of algorithms with
    different iteration lengths can be compared."""
    modes: tuple[Literal["greedy", "sampled"], ...] = ("greedy", "sampled")
    """`greedy`: the mode of the policy's distribution; `sampled`: drawn from it, as in training."""
    final_episodes: int = 30
    """Episodes of the last evaluation and of the rules, used for the paired comparison. At least `episodes`:
    the last evaluation includes the episodes of all others."""
    seed: int = 1_000_003
    """Root of the evaluation seeds, which differ from every training seed."""
    rules: tuple[str, ...] | None = None
    """Rules of the environment evaluated for comparison with the learner. null: all but the slow `lookahead`;
    []: none."""

    def __post_init__(self) -> None:
        require_at_least(1, episodes=self.episodes, every=self.every, final_episodes=self.final_episodes)
        require_at_least(0, seed=self.seed)
        require_key(len(self.modes) >= 1, "modes", "must name at least one of greedy, sampled")
        for key, names in (("modes", self.modes), ("rules", self.rules or ())):
            require_key(len(set(names)) == len(names), key, "must hold each name once")

    @property
    def last_episodes(self) -> int:
        """Episodes of the last evaluation and of the rules; they include those of every other evaluation."""
        return max(self.final_episodes, self.episodes)


@dataclass(frozen=True)
class StoreConfig:
    """Where runs are stored."""

    root: str = "runs"
    """Folder of the run folders, the MLflow database and the index."""
    tracking_uri: str | None = None
    """MLflow server that receives runs while they train, without a password. null: none; the MLflow database
    in `store.root` is filled by `headway browse` and `headway sync`."""
    curve_points: int = 200
    """Points of each metric's curve sent to MLflow. The Parquet log keeps all points."""
    checkpoint_every: int = 20
    """Iterations between checkpoints. The log is made durable with each checkpoint."""

    def __post_init__(self) -> None:
        if self.tracking_uri is not None and without_password(self.tracking_uri) != self.tracking_uri:
            raise InvalidValueError(
                "tracking_uri",
                "must hold no password, since it is stored with every run; set MLFLOW_TRACKING_USERNAME and "
                "MLFLOW_TRACKING_PASSWORD, or PGPASSWORD for PostgreSQL",
            )
        require_value(self, "curve_points", self.curve_points >= 2, "must be at least 2")
        require_value(self, "checkpoint_every", self.checkpoint_every >= 1, "must be at least 1")


@dataclass(frozen=True)
class EnergyConfig:
    """Energy and CO2 measurement by CodeCarbon, offline."""

    enabled: bool = True
    """Measure energy."""
    country: str | None = None
    """ISO 3166 three-letter code of the country whose electricity is used, such as DEU; it decides the CO2
    per kWh. null: energy is measured, CO2 is not reported."""
    cpu_power_w: float | None = None
    """Power of the CPU at full load, in W, for machines whose energy counters cannot be read. null:
    CodeCarbon's guess from the processor's name, which can be far off."""
    interval_s: float = 5.0
    """Seconds between measurements."""

    def __post_init__(self) -> None:
        require_finite(self)
        require_value(
            self, "cpu_power_w", self.cpu_power_w is None or self.cpu_power_w > 0, "must be above 0, or null"
        )
        require_value(self, "interval_s", self.interval_s > 0, "must be above 0")


@dataclass(frozen=True)
class ExperimentConfig:
    """One experiment: an algorithm on an environment, over several seeds."""

    study: str = "default"
    """Name of the study that runs are grouped under in the store (an MLflow experiment)."""
    seed: tuple[int, ...] = (0,)
    """Training seeds: `7`, `0,1,2` or `0..49`."""
    env_steps: int = 100_000
    """Environment steps per seed (one step moves all agents of one copy), rounded up to whole iterations of
    `rollout.copies` x `rollout.steps`. With `stages`, their sum."""
    device: str = "auto"
    """`cpu`, `cuda`, `cuda:NUMBER`, or `auto`: a GPU if there is one."""
    env: EnvConfig = field(default_factory=EnvConfig)
    algo: Mapping[str, Any] = field(default_factory=dict)
    """`name` and hyper-parameters, validated by the algorithm's own record."""
    preset: str = ""
    """File in configs/preset. Every other setting overrides its values. `none`: no preset. The preset is part
    of the cells' names in a study that has several presets. Empty: unknown."""
    candidate: str = ""
    """Name of the search candidate, part of the names of its cells; set by `headway search`."""
    start: StartConfig = field(default_factory=StartConfig)
    stages: tuple[StageConfig, ...] = ()
    """Stages of training, such as a curriculum: `[{env_steps: 300_000, training_args: {density: 1}},
    {env_steps: 700_000, training_args: {density: 3}}]`. In each, `training_args` override those of `env`, and
    training goes on with the same policies, optimisers and normalisers. Evaluation always uses `env.args`.
    Each stage ends with the iteration that reaches its last step. []: one stage, with `env.training_args`."""
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    energy: EnergyConfig = field(default_factory=EnergyConfig)

    def __post_init__(self) -> None:
        _require_study(self.study)
        require_key(len(self.seed) >= 1, "seed", "must name at least one seed")
        require_key(all(seed >= 0 for seed in self.seed), "seed", "must not be negative")
        require_key(len(set(self.seed)) == len(self.seed), "seed", "must hold each seed once")
        require_value(self, "env_steps", self.env_steps >= 1, "must be at least 1")
        total = sum(stage.env_steps for stage in self.stages)
        require_key(
            not self.stages or self.env_steps == total,
            "env_steps",
            f"of {self.env_steps} is not the sum of the stages', {total}; set env_steps={total:_}, or change "
            "the stages",
        )
        lengths = [end - begin for begin, end in pairwise((0, *self.stage_ends))]
        require_key(
            all(lengths),
            "stages",
            "must each last an iteration or longer, of "
            f"{self.iteration_steps} steps (rollout.copies x rollout.steps)",
        )
        require_key(
            self.rule_iterations < self.iterations,
            "start.env_steps",
            f"of {self.start.env_steps} leaves nothing of env_steps={self.env_steps} to learn in: both are "
            f"rounded up to iterations of {self.iteration_steps} steps (rollout.copies x "
            "rollout.steps); lower it, or raise env_steps",
        )
        require_key(
            self.rule_iterations <= self.stage_ends[0],
            "start.env_steps",
            f"of {self.start.env_steps} is more than the first stage has, in whose environment the rule "
            "acts; lower it, or raise stages[0].env_steps",
        )
        critic, largest = self.start.critic_iterations, self.iterations - self.rule_iterations - 1
        require_key(
            critic <= largest,
            "start.critic_iterations",
            f"of {critic} leaves no iteration in which policies learn: after the start there are "
            f"{largest + 1}, of {self.iteration_steps} steps (rollout.copies x "
            f"rollout.steps); set at most {largest}, or raise env_steps",
        )

    @property
    def iterations(self) -> int:
        """Iterations needed to reach `env_steps`, rounded up."""
        return -(-self.env_steps // self.iteration_steps)

    @property
    def stage_ends(self) -> tuple[int, ...]:
        """Last iteration of each stage."""
        lengths = (stage.env_steps for stage in self.stages)
        return last_iterations(lengths, self.iteration_steps) or (self.iterations,)

    def stage_after(self, iteration: int) -> int:
        """Return the index of the stage that training is in after `iteration` iterations."""
        return min(bisect_right(self.stage_ends, iteration), len(self.stage_ends) - 1)

    @property
    def rule_iterations(self) -> int:
        """Number of first iterations in which the rule `start.rule` acts; 0 without one."""
        return -(-self.start.env_steps // self.iteration_steps) if self.start.rule else 0

    def evaluates_after(self, iteration: int) -> bool:
        """Return whether an evaluation follows `iteration`, which counts from 1."""
        return iteration in self._changes or self._reaches_interval(iteration)

    def evaluations_until(self, iteration: int) -> int:
        """Return the number of evaluations after the iterations 1 to `iteration`."""
        # Either no iteration reaches two multiples of the interval, or every iteration reaches one.
        regular = min(iteration, iteration * self.iteration_steps // self.evaluation.every)
        return regular + sum(
            1 <= change <= iteration and not self._reaches_interval(change) for change in self._changes
        )

    @property
    def _changes(self) -> set[int]:
        """Iterations after which training changes, where curves have a point; 0 if no rule acts."""
        return {*self.stage_ends, self.rule_iterations}

    def _reaches_interval(self, iteration: int) -> bool:
        """Return whether `iteration` reaches or passes a multiple of `evaluation.every` steps."""
        every, steps = self.evaluation.every, iteration * self.iteration_steps
        return steps // every > (steps - self.iteration_steps) // every

    @property
    def iteration_steps(self) -> int:
        """Environment steps per seed and iteration."""
        return self.rollout.copies * self.rollout.steps


def steps_per_iteration(config: Mapping[str, Any]) -> int:
    """Return `ExperimentConfig.iteration_steps` of a stored configuration."""
    return int(config["rollout"]["copies"] * config["rollout"]["steps"])


def last_iterations(lengths: Iterable[int], iteration_steps: int) -> tuple[int, ...]:
    """Return the last iteration of each stage: the one that reaches the stage's last environment step."""
    return tuple(-(-total // iteration_steps) for total in accumulate(lengths))
