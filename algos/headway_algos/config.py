"""Hyper-parameters common to all algorithms, and to all on-policy algorithms.

Critics, updates and orders add their own; `headway_algos.records` combines them into an algorithm's record.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import ClassVar, Literal

from headway.contracts.checks import require_default, require_finite, require_key, require_value


@dataclass(frozen=True)
class ModelConfig:
    """Architecture of the actor's network; the critic has a separate network of the same architecture."""

    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation function of the hidden layers."""
    actor_gain: float = 0.01
    """Gain of the orthogonal initialisation of the actor's last layer."""
    initial_logits: tuple[float, ...] = ()
    """Initial logits of Discrete actions, one per action, as a prior for every policy; empty: all equal."""
    log_std: float = -0.5
    """Initial log standard deviation of a Box action's Gaussian."""
    core: Literal["none", "gru"] = "none"
    """Recurrence between the hidden layers and the output layer. `none`: feedforward policies, which see the
    current observation only; `gru`: gated recurrent units in actor and critic. A cheaper alternative to
    recurrence is the wrapper frame_stack_v1, which stacks the last few observations."""
    gru_size: int = 64
    """Number of gated recurrent units per network, for `core: gru`: the size of the hidden state."""
    sequence_length: int = 16
    """Maximum steps of backpropagation through time, for `core: gru`. Sequences are cut at multiples of it
    from an iteration's first step and at the ends of episodes; minibatches hold whole sequences. Longer
    sequences can learn longer dependencies, and are slower."""

    def __post_init__(self) -> None:
        require_finite(self)
        require_key(all(size >= 1 for size in self.hidden), "hidden", "must hold sizes of at least 1")
        require_value(self, "gru_size", self.gru_size >= 1, "must be at least 1")
        require_value(self, "sequence_length", self.sequence_length >= 1, "must be at least 1")
        require_value(self, "actor_gain", self.actor_gain > 0, "must be above 0")
        logits = self.initial_logits
        require_key(all(isfinite(logit) for logit in logits), "initial_logits", "must hold finite numbers")
        # Beyond, exp overflows in float32.
        require_value(self, "log_std", -20 <= self.log_std <= 5, "must lie in [-20, 5]")
        for key in ("gru_size", "sequence_length"):
            problem = "applies only with core=gru: set it too, or leave this out"
            require_default(self, key, self.core == "gru", problem)


@dataclass(frozen=True)
class LearnerConfig:
    """Hyper-parameters common to all algorithms."""

    VALUES_BEFORE: ClassVar[Mapping[str, object]] = {"agent_id": False}

    name: str = ""
    """Name in the registry: see `headway list algos`."""
    policies: Literal["independent", "shared", "groups"] = "groups"
    """`groups`: one policy per group of alike agents, which the environment names; without groups, one for
    all. `shared`: one for all agents; `independent`: one per agent."""
    agent_id: bool | None = None
    """Append the agent's index, one-hot, to the observations of agents that share a policy, for all networks,
    so that agents with equal observations may act differently. null: yes, if at most 64 agents share it and
    they do not come and go; otherwise the index would identify a slot, not an agent."""
    gamma: float = 0.99
    """Discount factor per step."""
    lr: float = 5e-4
    """Learning rate (Adam)."""
    lr_end: float = 1.0
    """Factor on the learning rates at the end of training, reached linearly; 1: constant."""
    normalise_observations: bool = True
    """Normalise observations by running statistics per policy, stored with the parameters."""
    precision: Literal["float32", "float64"] = "float32"
    """Dtype of networks and their inputs; normalisers, advantages and returns are always float64."""

    @property
    def splits(self) -> bool:
        """Whether policies begin as one shared policy that is split later."""
        return False

    def lr_factor(self, progress: float) -> float:
        """Return the factor on the learning rates once a share `progress` of training is done."""
        return 1 - (1 - self.lr_end) * progress

    def __post_init__(self) -> None:
        require_finite(self)
        require_value(self, "gamma", 0 <= self.gamma <= 1, "must lie in [0, 1]")
        require_value(self, "lr", self.lr > 0, "must be above 0")
        require_value(self, "lr_end", 0 <= self.lr_end <= 1, "must lie in [0, 1]")


@dataclass(frozen=True)
class AlgoConfig(LearnerConfig):
    """Hyper-parameters common to all on-policy algorithms.

    Base of the records of critics, updates and orders.
    """

    VALUES_BEFORE: ClassVar[Mapping[str, object]] = {
        **LearnerConfig.VALUES_BEFORE,
        "imitation_entropy_coeff": 0.3,
    }

    name: str = "custom"
    """Name in the registry: see `headway list algos`."""
    critic: str = "local"
    update: str = "ppo"
    order: str = "simultaneous"
    model: ModelConfig = field(default_factory=ModelConfig)
    lr: float = LearnerConfig.lr
    """Learning rate of the actor (Adam) and, if `critic_lr` is null, of the critic."""
    lr_end: float = LearnerConfig.lr_end
    """Factor on the learning rates at the end of training, reached linearly; 1: constant. KL bounds are
    multiplied by its square, so that steps shrink alike."""
    normalise_advantages: bool = True
    """Standardise advantages per policy."""
    imitation_entropy_coeff: float = 0.3
    """Weight of the entropy while policies with discrete actions imitate `start.rule`. Without it they would
    no longer explore: with two actions, the probability of the rule's tends to 0.97 instead of 1; to 0.994
    with 0.2."""
    piece_samples: int = 5120
    """Samples, over all policies of a stack, processed at once, so that activations fit the cache; on a GPU
    at least 2^20. Affects results by rounding only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "piece_samples", self.piece_samples >= 1, "must be at least 1")
        require_value(
            self, "imitation_entropy_coeff", self.imitation_entropy_coeff >= 0, "must be at least 0"
        )


def require_for_critic(config: AlgoConfig, *keys: str) -> None:
    """Raise InvalidValueError if one of `keys`, which only a critic's training reads, is set without one."""
    for key in keys:
        problem = "applies to a critic: leave it out with critic=none"
        require_default(config, key, config.critic != "none", problem)


@dataclass(frozen=True)
class SequentialConfig(AlgoConfig):
    """Policies are updated one after another."""

    policies: Literal["independent", "shared", "groups"] = "independent"
    """`independent`: one policy per agent; `groups`: one per group of alike agents, which the environment
    names. `shared`, one for all, cannot be updated in turns."""


@dataclass(frozen=True)
class SimultaneousConfig(AlgoConfig):
    """All policies are updated at once. With `shared_until` they start as one shared policy."""

    shared_until: float = 0.0
    """Share of training during which independent or group policies are trained as one shared policy. The
    first iteration that begins later copies it to each policy, and they are trained separately. 0: separate
    from the start."""
    apart_lr: float = 1.0
    """Factor on the learning rates once the shared policy is split (`shared_until`), when each policy sees
    only its own agents' experience and gradients are noisier. KL bounds are multiplied by its square."""

    @property
    def splits(self) -> bool:
        """Whether policies begin as one shared policy that is split later."""
        return self.shared_until > 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_value(self, "shared_until", 0 <= self.shared_until < 1, "must lie in [0, 1)")
        require_value(
            self,
            "shared_until",
            not self.splits or self.policies != "shared",
            "must be 0 with policies: shared",
        )
        require_value(
            self, "agent_id", not (self.splits and self.agent_id), "must be false or null with shared_until"
        )
        require_value(self, "apart_lr", self.apart_lr > 0, "must be above 0")
        require_key(
            self.splits or self.apart_lr == 1,
            "apart_lr",
            "applies after shared_until: set shared_until, or leave apart_lr at 1",
        )
