"""Construction of the on-policy learner for a configuration."""

from collections.abc import Sequence

from headway.contracts import EnvSpec, Learner
from headway_algos.batches.policy_stack import resolve_device
from headway_algos.config import AlgoConfig
from headway_algos.on_policy.learner import OnPolicyLearner
from headway_algos.on_policy.per_seed_learner import PerSeedLearner
from headway_algos.on_policy.split_learner import SplitLearner


def make_learner(config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> Learner:
    """Return a learner for one seed or a stack of seeds (see `headway.contracts.AlgoEntry.learner`)."""
    make = SplitLearner if config.shared_until > 0 else OnPolicyLearner
    # On a CPU seeds share no matrix product: its rounding may depend on the number of rows.
    if len(seeds) == 1 or resolve_device(device).type != "cpu":
        return make(config, spec, seeds, device)
    return PerSeedLearner([make(config, spec, (seed,), device) for seed in seeds])
