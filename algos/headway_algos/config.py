"""Configuration of on-policy algorithms: three choices (critic, update, order) and the hyper-parameters."""

from dataclasses import dataclass, field
from typing import Literal

from headway.contracts.checks import require


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
        require(all(size >= 1 for size in self.hidden), "hidden sizes must be at least 1")
        require(self.gru_size >= 1, "gru_size must be at least 1")
        require(self.sequence_length >= 1, "sequence_length must be at least 1")
        require(self.actor_gain > 0, "actor_gain must be above 0")


@dataclass(frozen=True)
class AlgoConfig:
    """An on-policy algorithm in free composition; named algorithms fix critic, update and order."""

    name: str = "custom"
    """Name in the registry: see `headway list algos`."""
    critic: str = "local"
    """`local`: V(o) of an agent's own observation; `central`: V(s) of the global state; `counterfactual`:
    Q(s, u) for each own action, the other agents' actions held fixed (Discrete actions only)."""
    update: str = "ppo"
    """Policy update. `ppo`: epochs of minibatch steps on a clipped surrogate; `a2c`: one gradient step on the
    whole batch; `trpo`: one natural-gradient step within a bound on the KL divergence; `kfac`: one
    natural-gradient step with Kronecker factors of the Fisher information; or one of another package."""
    critic_update: Literal["adam", "kfac"] = "adam"
    """Optimiser of the critic. `adam`; or `kfac`: natural gradients with Kronecker factors of the
    Gauss-Newton matrix."""
    order: Literal["simultaneous", "sequential"] = "simultaneous"
    """`simultaneous`: all policies are updated at once; `sequential`: one after another in a random order,
    each with its advantages weighted by the probability ratios of the policies updated before (needs several
    policies: `policies: independent` or `groups`)."""
    policies: Literal["independent", "shared", "groups"] = "independent"
    """`independent`: one policy per agent; `shared`: one for all; `groups`: one per group of the
    environment."""
    shared_until: float = 0.0
    """Share of training during which independent or group policies are trained as one shared policy. The
    first iteration that begins later copies it to each policy, and they are trained separately. 0: separate
    from the start."""
    apart_lr: float = 1.0
    """Factor on the learning rates once the shared policy is split (`shared_until`), when each policy sees
    only its own agents' experience and gradients are noisier. KL bounds are multiplied by its square."""
    model: ModelConfig = field(default_factory=ModelConfig)
    critic_actions: Literal["none", "others"] = "none"
    """`others`: a central critic also sees the actions of the other agents, V(s, u^-a)."""
    target_every: int = 4
    """Iterations between updates of the counterfactual critic's target network; 1: after every iteration."""
    gamma: float = 0.99
    """Discount factor per step."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation."""
    lr: float = 5e-4
    """Learning rate of the actor (Adam). With TRPO, used for the critic only. With K-FAC, the maximum step
    size along the natural gradient, reduced further by the KL bound."""
    critic_lr: float | None = None
    """Learning rate of the critic; null: `lr`."""
    lr_end: float = 1.0
    """Factor on the learning rates at the end of training, reached linearly; 1: constant. KL bounds are
    multiplied by its square, so that steps shrink alike."""
    epochs: int = 5
    """Passes over an iteration's batch: by the critic always, by the actor with PPO only (A2C, TRPO and K-FAC
    take one step on the whole batch)."""
    minibatches: int = 8
    """Minibatches per pass, wherever `epochs` applies; 1: the whole batch."""
    clip: float = 0.2
    """PPO's clip range of the probability ratio."""
    kl_coeff: float = 0.0
    """Initial coefficient of PPO's adaptive KL penalty; 0: none."""
    kl_target: float = 0.01
    """Target KL divergence of PPO's adaptive penalty."""
    kl_bound: float = 0.01
    """Bound on the mean KL divergence of a step (delta): of TRPO, enforced; of K-FAC, predicted."""
    accept_ratio: float = 0.1
    """Minimum ratio of actual to expected (first-order) improvement for TRPO to accept a step."""
    cg_iterations: int = 10
    """TRPO's iterations of conjugate gradient."""
    cg_damping: float = 0.1
    """Damping added to the diagonal of TRPO's Fisher information."""
    line_search_steps: int = 10
    """Maximum number of halvings in TRPO's line search; if none is accepted, the policy stays unchanged."""
    fisher_share: float = 1.0
    """Share of the rows, evenly strided, on which TRPO's Fisher information is computed (1, 1/2, 1/3 ...;
    other values are rounded to one of these). Smaller is faster, but learned worse on few hundred rows."""
    kfac_damping: float = 0.01
    """Damping of K-FAC's Fisher information (lambda), split over its factors."""
    kfac_decay: float = 0.95
    """Decay of K-FAC's running averages per batch; the first batches are weighted equally."""
    kfac_every: int = 1
    """Batches between inversions of K-FAC's factors; 1: after every batch."""
    kfac_length: Literal["exact", "factors"] = "exact"
    """Fisher information from which K-FAC predicts the KL divergence of a step. `exact`: of the batch;
    `factors`: the Kronecker approximation, as published, which can predict too little."""
    kfac_momentum: float = 0.0
    """Momentum of K-FAC's direction; 0: none."""
    critic_kl_bound: float = 0.3
    """K-FAC's bound for a step of the critic, on half the mean squared change of its values (the KL
    divergence of Gaussians with standard deviation 1). In normalised units with `normalise_values`."""
    entropy_coeff: float = 0.01
    """Weight of the policy's entropy in the objective (for TRPO: in the surrogate); 0: none."""
    value_clip: float | None = None
    """Bound on the critic's squared error, like RLlib's vf_clip_param, in units of squared return; with
    `normalise_values`, in units of the returns' variance. null: none."""
    grad_clip: float | None = 0.5
    """Bound on the gradient norm per policy and per critic, except for steps of TRPO and K-FAC, which have KL
    bounds; null: none."""
    normalise_advantages: bool = True
    """Standardise advantages per policy."""
    normalise_observations: bool = True
    """Normalise observations by running statistics per policy, stored with the parameters."""
    normalise_values: bool = True
    """Normalise returns by running statistics before the critic is trained on them."""
    precision: Literal["float32", "float64"] = "float32"
    """Dtype of networks and their inputs; normalisers, advantages and returns are always float64."""
    piece_samples: int = 5120
    """Samples, over all policies of a stack, processed at once, so that activations fit the cache. Affects
    results by rounding only."""

    def __post_init__(self) -> None:
        require(0 <= self.shared_until < 1, "shared_until must lie in [0, 1)")
        splits = self.shared_until > 0
        require(not splits or self.policies != "shared", "shared_until must be 0 with policies: shared")
        require(
            not splits or self.order == "simultaneous",
            "shared_until must be 0 with order: sequential",
        )
        require(self.apart_lr > 0, "apart_lr must be above 0")
        require(
            splits or self.apart_lr == 1,
            "apart_lr applies after shared_until: set shared_until, or leave apart_lr at 1",
        )
        require(0 <= self.gamma <= 1, "gamma must lie in [0, 1]")
        require(0 <= self.gae_lambda <= 1, "gae_lambda must lie in [0, 1]")
        require(self.lr > 0, "lr must be above 0")
        require(self.critic_lr is None or self.critic_lr > 0, "critic_lr must be above 0, or null")
        require(0 <= self.lr_end <= 1, "lr_end must lie in [0, 1]")
        require(
            self.critic_actions == "none" or self.critic == "central",
            "critic_actions must be none unless critic is central: a local critic sees its own agent only, "
            "and a counterfactual one always sees the others' actions",
        )
        require(
            self.model.core == "none" or "kfac" not in (self.update, self.critic_update),
            "model.core must be none with kfac, whose factors exist for multilayer perceptrons only",
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
