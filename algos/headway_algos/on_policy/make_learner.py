"""Construction of the on-policy learner for a configuration."""

from collections.abc import Sequence

from headway.contracts import AnchoredLearner, EnvSpec, Learner
from headway_algos.batches.device import resolve_device
from headway_algos.config import AlgoConfig, SimultaneousConfig
from headway_algos.on_policy.per_seed_learner import PerSeedLearner
from headway_algos.on_policy.split_learner import SplitLearner
from headway_algos.on_policy.warm_start import WarmStartLearner


def make_learner(config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> Learner:
    """Return a learner for one seed or a stack of seeds (see `headway.contracts.AlgoEntry.learner`)."""
    # On a CPU seeds share no matrix product: its rounding may depend on the number of rows.
    if len(seeds) == 1 or resolve_device(device).type != "cpu":
        return _one(config, spec, seeds, device)
    return PerSeedLearner([_one(config, spec, (seed,), device) for seed in seeds])


def _one(config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> AnchoredLearner:
    if config.splits and isinstance(config, SimultaneousConfig):
        return SplitLearner(config, spec, seeds, device)
    return WarmStartLearner(config, spec, seeds, device)
