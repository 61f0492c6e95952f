"""The registry of algorithms, name to entry. Importing it imports no torch."""

from collections.abc import Sequence

from headway.contracts import AlgoEntry, Discrete, EnvSpec, Learner, MultiDiscrete
from headway_algos.acting import StackedActingPolicy
from headway_algos.config import AlgoConfig
from headway_algos.recipes import custom, ippo, mappo


def _learner(config: AlgoConfig, spec: EnvSpec, seeds: Sequence[int], device: str) -> Learner:
    from headway_algos.learner import OnPolicyLearner

    return OnPolicyLearner(config, spec, seeds, device)


def _refuses(config: AlgoConfig, spec: EnvSpec) -> str | None:
    if isinstance(spec.action_space, MultiDiscrete):
        return f"{config.name} takes Discrete or Box actions, and {spec.name} has MultiDiscrete ones"
    if config.policies == "groups" and not spec.groups:
        return f"{spec.name} names no groups of agents; use algo.policies=shared or algo.policies=independent"
    actions, logits = spec.action_space, config.model.initial_logits
    if logits and not (isinstance(actions, Discrete) and actions.n == len(logits)):
        count = f"{actions.n} actions" if isinstance(actions, Discrete) else "no Discrete actions"
        remedy = "give one an action, or leave it out" if isinstance(actions, Discrete) else "leave it out"
        return f"algo.model.initial_logits has {len(logits)} entries, and {spec.name} has {count}; {remedy}"
    return None


def _entry(summary: str, source: str, config: type[AlgoConfig]) -> AlgoEntry:
    return AlgoEntry(summary, source, config, StackedActingPolicy.of, _learner, _refuses)


ENTRIES = {
    "custom": _entry(custom.SUMMARY, custom.SOURCE, AlgoConfig),
    "ippo": _entry(ippo.SUMMARY, ippo.SOURCE, ippo.IPPOConfig),
    "mappo": _entry(mappo.SUMMARY, mappo.SOURCE, mappo.MAPPOConfig),
}
