"""An experiment as frozen records. Every default of the engine stands here and nowhere else."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from headway.contracts.checks import require

NO_PRESET = "none"
"""The preset of experiments that have none."""
_STUDY_LENGTH = 100
_HOST_AND_PORT = re.compile(r"\S+:\d{1,5}")


def _require_study(name: str) -> None:
    """It names a folder of the store and, by default, a picture."""
    forms = "write letters, digits, spaces and . _ -, such as study=bus_line"
    shown = repr(name) if len(name) <= _STUDY_LENGTH else f"{name[:20]!r}..."
    named = any(letter.isascii() and letter.isalnum() for letter in name)
    require(named, f"study {shown} has no letter or digit; {forms}")
    wrong = "".join(letter for letter in name if letter in "/\\" or not letter.isprintable())
    require(not wrong, f"study {shown} has {wrong[:1]!r} in it; {forms}")
    require(".." not in name, f"study {shown} has '..' in it; {forms}")
    require(name == name.strip(), f"study {shown} begins or ends with a blank; {forms}")
    require(len(name) <= _STUDY_LENGTH, f"study {shown} is longer than {_STUDY_LENGTH} letters; {forms}")


@dataclass(frozen=True)
class EnvConfig:
    """Which environment, with which arguments."""

    id: str = "bus"
    """Name in the registry (see `headway list envs`), or the module of a PettingZoo environment, such as
    `mpe2.simple_spread_v3`."""
    args: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of that environment; its own record validates them."""
    training_args: Mapping[str, Any] | None = None
    """Arguments laid over `args` while learning only: a reward that is easier to learn from, say.
    null: none, a preset's neither (`{}` leaves those). Evaluation, rules and every figure reported are of
    `args`; only the columns `training/...` of a curve are of what was learned from."""
    wrappers: tuple[Any, ...] = ()
    """Wrappers by name (see `headway list wrappers`), the innermost first: `[{name: frame_stack_v1,
    stack_size: 4}, clip_reward_v0]`. Those that only change rewards are there while learning only."""
    shared_reward: bool | None = None
    """Of a PettingZoo environment by module: it pays all agents the same at every step, so that a team's
    critic reads one. Checked against what it pays; null: no."""
    agents_come_and_go: bool | None = None
    """Of a PettingZoo environment by module: agents may leave before the episode ends; null: what its
    metadata or infos say, else no."""
    max_copies_per_process: int | None = None
    """Of a PettingZoo environment by module: copies that one process may hold; null: any number."""

    def __post_init__(self) -> None:
        limit = self.max_copies_per_process
        require(limit is None or limit >= 1, "max_copies_per_process must be at least 1, or null")


@dataclass(frozen=True)
class RolloutConfig:
    """How experience is collected. These numbers are part of a run's plan: they decide its draws."""

    copies: int = 8
    """E: environment copies of one seed."""
    steps: int = 512
    """T: steps of each copy in one iteration; an iteration is copies x steps environment steps."""
    block: int = 4
    """Copies whose actions are computed in one piece; divides `copies`. Worker processes get whole blocks.
    Smaller where a process can hold few copies of the environment: a run's `plan.json` has what it was."""

    def __post_init__(self) -> None:
        require(self.copies >= 1, "copies must be at least 1")
        require(self.steps >= 1, "steps must be at least 1")
        require(self.block >= 1, "block must be at least 1")
        require(self.copies % self.block == 0, f"block {self.block} must divide copies {self.copies}")


@dataclass(frozen=True)
class BackendConfig:
    """Where rollouts run and how many seeds train at once. On a CPU no result depends on it: curves are the
    same bit for bit, except those of asynchronous algorithms and, in the last bits of some network sizes, of
    `madqn` and `ddpg` in a `stack`. A GPU rounds differently: the first updates agree in float64, and from
    there training goes its own way."""

    name: Literal["serial", "process", "ray"] = "process"
    """`serial`: in the training process itself; `process`: in worker processes; `ray`: in actors of a Ray
    cluster."""
    workers: int | None = None
    """Worker processes of each training process; null: what the machine's cores allow, and more where a
    process can hold only few copies of the environment, of all seeds of a stack. An asynchronous algorithm
    has one a block."""
    parallel: int | None = None
    """Training processes at once; null: one per core, at most one per seed, and fewer where each has a fixed
    number of workers."""
    stack: int = 1
    """Seeds trained in one process. On a GPU they learn together. On a CPU they share workers and, with
    `madqn` and `ddpg`, torch's calls, which are most of a small batch; with other algorithms each learns by
    itself, and processes side by side are faster. Where a process can hold fewer copies of the environment
    than one block of every seed, each worker has copies of a part of the seeds only, and each part is
    evaluated apart; `serial` refuses such a stack."""
    address: str = "local"
    """Of `ray`: HOST:PORT of a cluster's head; `auto`: the cluster that this machine is part of, or that
    RAY_ADDRESS names; `local`: one on this machine, for this session only."""
    worker_cpus: float | None = None
    """Of `ray`: CPUs that the cluster is asked for each worker; null: 1, on a `local` one none, as the cores
    are shared out already."""
    learners: Literal["here", "cluster"] | None = None
    """Of `ray`: whether runs train on this machine, with workers on the cluster, or are placed on the cluster
    whole, each with its workers beside it (`store.root` must be on a file system that all machines share);
    null: `cluster` where a session trains several on one that is not `local`."""

    def __post_init__(self) -> None:
        require(self.workers is None or self.workers >= 1, "workers must be at least 1, or null")
        require(self.parallel is None or self.parallel >= 1, "parallel must be at least 1, or null")
        require(self.stack >= 1, "stack must be at least 1")
        is_address = self.address in ("auto", "local") or _HOST_AND_PORT.fullmatch(self.address) is not None
        require(is_address, f"address must be auto, local or HOST:PORT, not {self.address!r}")
        cpus = self.worker_cpus
        require(cpus is None or cpus >= 0, "worker_cpus must be at least 0, or null")

    @property
    def cpus_of_a_worker(self) -> float:
        """That the cluster is asked for."""
        if self.worker_cpus is not None:
            return self.worker_cpus
        return 0.0 if self.address == "local" else 1.0


@dataclass(frozen=True)
class EvaluationConfig:
    """Episodes on fixed seeds of their own, the same for every run, algorithm and rule."""

    episodes: int = 10
    """Episodes at each evaluation."""
    every: int = 40_000
    """Environment steps between evaluations, each after the iteration that reaches its multiple; the first is
    before training, the last after it. In steps, so that curves of algorithms with iterations of any
    length compare."""
    modes: tuple[Literal["greedy", "sampled"], ...] = ("greedy", "sampled")
    """`greedy`: the distribution's mode; `sampled`: as in training."""
    final_episodes: int = 30
    """Episodes of the last evaluation and of the rules, for the paired comparison; `episodes` where that is
    more, as the last evaluation has the days of every other."""
    seed: int = 1_000_003
    """Root of the evaluation seeds, kept apart from every training seed."""
    rules: tuple[str, ...] | None = None
    """Rules of the environment evaluated beside the learner; null: all that it has, [] none."""

    def __post_init__(self) -> None:
        require(self.episodes >= 1, "episodes must be at least 1")
        require(self.every >= 1, "every must be at least 1")
        require(self.final_episodes >= 1, "final_episodes must be at least 1")
        require(len(self.modes) >= 1, "modes must name at least one of greedy, sampled")

    @property
    def last_episodes(self) -> int:
        """Episodes of the last evaluation and of the rules: those of every evaluation are among them."""
        return max(self.final_episodes, self.episodes)


@dataclass(frozen=True)
class StoreConfig:
    """Where runs are kept."""

    root: str = "runs"
    """Folder of run folders, the MLflow database and the index."""
    tracking_uri: str | None = None
    """MLflow tracking URI; null: SQLite in the root."""
    curve_points: int = 200
    """Points of each metric's curve sent to MLflow; the Parquet log keeps all."""
    checkpoint_every: int = 20
    """Iterations between checkpoints; the log is made durable with each."""

    def __post_init__(self) -> None:
        require(self.curve_points >= 2, "curve_points must be at least 2")
        require(self.checkpoint_every >= 1, "checkpoint_every must be at least 1")


@dataclass(frozen=True)
class EnergyConfig:
    """Energy and CO2 by CodeCarbon, offline."""

    enabled: bool = True
    """Measure at all."""
    country: str | None = None
    """ISO 3166 three-letter code of the country whose electricity is used, such as DEU, for its CO2 per kWh;
    null: energy is measured, and no CO2 given."""
    cpu_power_w: float | None = None
    """The CPU's power at full load, W, for machines whose counters cannot be read; null: CodeCarbon's guess
    from the processor's name, which can be far off."""
    interval_s: float = 5.0
    """Seconds between measurements."""

    def __post_init__(self) -> None:
        require(self.cpu_power_w is None or self.cpu_power_w > 0, "cpu_power_w must be above 0, or null")
        require(self.interval_s > 0, "interval_s must be above 0")


@dataclass(frozen=True)
class ExperimentConfig:
    """One experiment: an algorithm on an environment, over seeds."""

    study: str = "default"
    """Groups runs in the store (an MLflow experiment)."""
    seed: tuple[int, ...] = (0,)
    """Training seeds: `7`, `0,1,2` or `0..49`."""
    env_steps: int = 100_000
    """Environment steps of each seed (one step moves all agents of one copy), rounded up to whole iterations
    of `rollout.copies` x `rollout.steps`."""
    device: str = "auto"
    """`cpu`, `cuda`, or `auto`: a GPU if there is one."""
    env: EnvConfig = field(default_factory=EnvConfig)
    algo: Mapping[str, Any] = field(default_factory=dict)
    """`name` and hyper-parameters; the algorithm's own record validates them."""
    preset: str = ""
    """The file of configs/preset whose values lie below all others; `none` leaves the defaults. It names the
    cells of a study that has several; empty: not known."""
    candidate: str = ""
    """What it is called among the candidates of a search, whose cells it names; `headway search` sets it."""
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    energy: EnergyConfig = field(default_factory=EnergyConfig)

    def __post_init__(self) -> None:
        _require_study(self.study)
        require(len(self.seed) >= 1, "seed must name at least one seed")
        require(all(seed >= 0 for seed in self.seed), "seeds must be at least 0")
        require(len(set(self.seed)) == len(self.seed), "seeds must differ from each other")
        require(self.env_steps >= 1, "env_steps must be at least 1")

    @property
    def iterations(self) -> int:
        """Iterations that reach `env_steps` (rounded up)."""
        return -(-self.env_steps // (self.rollout.copies * self.rollout.steps))
