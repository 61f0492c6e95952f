"""What an algorithm is, as one frozen record: three choices (critic, update, order) and its numbers."""

from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require


@dataclass(frozen=True)
class ModelConfig:
    """Networks: one for the actor, another of the same form for the critic."""

    hidden: tuple[int, ...] = (64, 64)
    """Sizes of the hidden layers."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Between the layers."""
    actor_gain: float = 0.01
    """Gain of the orthogonal initialisation of the actor's last layer."""
    initial_logits: tuple[float, ...] = ()
    """Logits of Discrete actions that every policy starts near: what is known before learning, one a
    action; empty: all equal."""
    log_std: float = -0.5
    """Initial log standard deviation of a Box action's Gaussian."""
    core: Literal["none", "gru"] = "none"
    """What follows the hidden layers: `none`: the output layer, so that policies act on what they observe now
    alone; `gru`: gated recurrent units, by which actor and critic remember what came before in the episode.
    The cheap alternative is the wrapper frame_stack_v1, which shows the last few observations at once."""
    gru_size: int = 64
    """Gated recurrent units of a network, for `core: gru`: how many numbers an agent remembers."""
    sequence_length: int = 16
    """Steps in a row that `core: gru` learns from as one: gradients flow back no further. Sequences are cut
    at multiples of it from an iteration's first step, and at the ends of episodes; minibatches hold whole
    ones. Longer ones learn what must be remembered for longer, and are slower."""

    def __post_init__(self) -> None:
        require(all(size >= 1 for size in self.hidden), "hidden sizes must be at least 1")
        require(self.gru_size >= 1, "gru_size must be at least 1")
        require(self.sequence_length >= 1, "sequence_length must be at least 1")
        require(self.actor_gain > 0, "actor_gain must be above 0")


@dataclass(frozen=True)
class AlgoConfig:
    """An on-policy algorithm, freely composed. A named algorithm fixes critic, update and order."""

    name: str = "custom"
    """Name in the registry: see `headway list algos`."""
    critic: Literal["local", "central", "counterfactual"] = "local"
    """`local`: V(o) of an agent's own observation; `central`: V(s) of the global state; `counterfactual`:
    Q(s, u) of each own action, the others' held fixed (Discrete actions only)."""
    update: Literal["ppo", "a2c", "trpo", "kfac"] = "ppo"
    """How a policy is improved from its advantages: `ppo`: epochs of minibatch steps on a clipped surrogate;
    `a2c`: one gradient step on the whole batch; `trpo`: one natural-gradient step within a bound of the KL
    divergence; `kfac`: one natural-gradient step too, by Kronecker factors of the Fisher information."""
    critic_update: Literal["adam", "kfac"] = "adam"
    """How the critic goes down its errors: `adam`, or `kfac`: along the natural gradient, by Kronecker
    factors of the Gauss-Newton matrix."""
    order: Literal["simultaneous", "sequential"] = "simultaneous"
    """Whether policies are updated all at once, or one after another in a random order, each weighing its
    advantages by what those before it have changed (needs several: `policies: independent` or `groups`)."""
    policies: Literal["independent", "shared", "groups"] = "independent"
    """One policy an agent, one for all, or one for each group the environment names."""
    shared_until: float = 0.0
    """Share of training during which independent or group policies are one, learned from all experience; then
    each goes on from it by itself, in the first iteration that begins after that. 0: never."""
    apart_lr: float = 1.0
    """Share of the learning rates with which policies learn once they have parted: each then has only its own
    agents' experience, and noisier gradients. KL bounds are multiplied by the square."""
    model: ModelConfig = field(default_factory=ModelConfig)
    critic_actions: Literal["none", "others"] = "none"
    """`others`: a central critic also sees what the other agents chose, V(s, u^-a)."""
    target_every: int = 4
    """Iterations between copies of a counterfactual critic to its target network; 1: after every one."""
    gamma: float = 0.99
    """Discount factor a step."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    lr: float = 5e-4
    """Learning rate of the actor (Adam). TRPO's actor has none: there it is the critic's alone. For K-FAC the
    most of the natural gradient that a step goes, where the KL bound allows as much."""
    critic_lr: float | None = None
    """Learning rate of the critic; null: `lr`."""
    lr_end: float = 1.0
    """Share of the learning rates left at the end of training (linear); 1: constant. Steps within KL bounds
    shrink alike: the bounds are multiplied by the square."""
    epochs: int = 5
    """Passes over an iteration's experience: the critic's always, the actor's for PPO alone (A2C, TRPO and
    K-FAC take one step on the whole batch)."""
    minibatches: int = 8
    """Minibatches a pass, for whom `epochs` counts; 1: the whole batch."""
    clip: float = 0.2
    """PPO's clip of the probability ratio."""
    kl_coeff: float = 0.0
    """Initial coefficient of PPO's adaptive KL penalty; 0: none."""
    kl_target: float = 0.01
    """KL divergence that PPO's adaptive coefficient aims at."""
    kl_bound: float = 0.01
    """TRPO's bound of the mean KL divergence of a step (delta); K-FAC's of what that is expected to be."""
    accept_ratio: float = 0.1
    """Least share of the improvement expected to first order that a step of TRPO must bring."""
    cg_iterations: int = 10
    """TRPO's iterations of conjugate gradient."""
    cg_damping: float = 0.1
    """Added to the diagonal of TRPO's Fisher information."""
    line_search_steps: int = 10
    """How often TRPO halves a step that it does not accept; then the policy stays as it was."""
    fisher_share: float = 1.0
    """Share of the rows, evenly strided, over which TRPO's Fisher information is taken (1, 1/2, 1/3 ...;
    others are rounded to one of these). Less is faster, and was seen to learn worse on a few hundred rows."""
    kfac_damping: float = 0.01
    """Added to the diagonal of K-FAC's Fisher information (lambda), in factors."""
    kfac_decay: float = 0.95
    """Share of K-FAC's running averages that is left after another batch; the first batches weigh alike."""
    kfac_every: int = 1
    """Batches from one inversion of K-FAC's factors to the next; 1: after every one."""
    kfac_length: Literal["exact", "factors"] = "exact"
    """By which Fisher information K-FAC expects a step's KL divergence: `exact`: that of the batch;
    `factors`: its own approximation, as published, which can expect too little."""
    kfac_momentum: float = 0.0
    """Share of K-FAC's last direction in the next one; 0: none."""
    critic_kl_bound: float = 0.3
    """K-FAC's bound for a step of the critic: of half the mean squared change of its values, which is the
    divergence of Gaussians with standard deviation 1; with `normalise_values` in normalised units."""
    entropy_coeff: float = 0.01
    """Weight of the policy's entropy in the objective (for TRPO: in the surrogate); 0: none."""
    value_clip: float | None = None
    """Bound of the critic's squared error, as RLlib's vf_clip_param, in units of return squared; with
    `normalise_values` in normalised ones, in which an error of 1 is a standard deviation. null: none."""
    grad_clip: float | None = 0.5
    """Bound of the gradient's norm, for each policy and each critic (but TRPO's and K-FAC's, which the KL
    bounds); null: none."""
    normalise_advantages: bool = True
    """Standardise advantages per policy."""
    normalise_observations: bool = True
    """Running mean and standard deviation per policy, part of the parameters."""
    normalise_values: bool = True
    """The critic learns returns in units of their running mean and standard deviation."""
    precision: Literal["float32", "float64"] = "float32"
    """Of networks and of what they learn from; normalisers, advantages and returns are float64 always."""
    piece_samples: int = 5120
    """Samples, over all policies of a stack, worked on at once, so that activations stay in the cache. No
    effect on results beyond rounding."""

    def __post_init__(self) -> None:
        require(0 <= self.shared_until < 1, "shared_until must lie in [0, 1)")
        parting = self.shared_until > 0
        require(not parting or self.policies != "shared", "shared_until is for policies that are not shared")
        require(
            not parting or self.order == "simultaneous",
            "shared_until must be 0 where policies are updated one after another",
        )
        require(self.apart_lr > 0, "apart_lr must be above 0")
        require(
            parting or self.apart_lr == 1,
            "apart_lr is for policies that part: set shared_until, or leave apart_lr at 1",
        )
        require(0 <= self.gamma <= 1, "gamma must lie in [0, 1]")
        require(0 <= self.gae_lambda <= 1, "gae_lambda must lie in [0, 1]")
        require(self.lr > 0, "lr must be above 0")
        require(self.critic_lr is None or self.critic_lr > 0, "critic_lr must be above 0, or null")
        require(0 <= self.lr_end <= 1, "lr_end must lie in [0, 1]")
        require(
            self.critic_actions == "none" or self.critic == "central",
            "critic_actions must be none unless critic is central: a local critic sees no one else, and a "
            "counterfactual one sees the others' actions always",
        )
        require(
            self.model.core == "none" or "kfac" not in (self.update, self.critic_update),
            "model.core must be none with kfac, whose factors are of multilayer perceptrons",
        )
        require(self.target_every >= 1, "target_every must be at least 1")
        require(self.epochs >= 1, "epochs must be at least 1")
        require(self.minibatches >= 1, "minibatches must be at least 1")
        require(self.clip > 0, "clip must be above 0")
        require(self.kl_coeff >= 0, "kl_coeff must be at least 0")
        require(self.kl_target > 0, "kl_target must be above 0")
        require(self.kl_bound > 0, "kl_bound must be above 0")
        require(0 <= self.accept_ratio < 1, "accept_ratio must lie in [0, 1)")
        require(self.cg_iterations >= 1, "cg_iterations must be at least 1")
        require(self.cg_damping > 0, "cg_damping must be above 0")
        require(self.line_search_steps >= 0, "line_search_steps must be at least 0")
        require(0 < self.fisher_share <= 1, "fisher_share must lie in (0, 1]")
        require(self.kfac_damping > 0, "kfac_damping must be above 0")
        require(0 <= self.kfac_decay < 1, "kfac_decay must lie in [0, 1)")
        require(self.kfac_every >= 1, "kfac_every must be at least 1")
        require(0 <= self.kfac_momentum < 1, "kfac_momentum must lie in [0, 1)")
        require(self.critic_kl_bound > 0, "critic_kl_bound must be above 0")
        require(self.value_clip is None or self.value_clip > 0, "value_clip must be above 0, or null")
        require(self.grad_clip is None or self.grad_clip > 0, "grad_clip must be above 0, or null")
        require(self.piece_samples >= 1, "piece_samples must be at least 1")
