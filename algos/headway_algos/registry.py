"""Registry of algorithms by name. Importing it imports no torch."""

from dataclasses import replace

from headway.contracts import AlgoEntry, Box, Discrete, EnvSpec, Lazy, MultiDiscrete
from headway_algos.acting.gru import acting_policy
from headway_algos.components import critics, updates
from headway_algos.config import AlgoConfig
from headway_algos.grouping import missing_groups
from headway_algos.off_policy.entries import OFF_POLICY
from headway_algos.recipes import (
    a3c,
    coma,
    custom,
    happo,
    hatrpo,
    ia2c,
    ippo,
    itrpo,
    maa2c,
    maacktr,
    mappo,
    matrpo,
)

LEARNER = Lazy("headway_algos.on_policy.make_learner:make_learner")
_SIMULTANEOUS = {"happo": "algo=mappo", "hatrpo": "algo=matrpo"}
"""Simultaneous counterpart of each named sequential algorithm."""


def _refuses(config: AlgoConfig, spec: EnvSpec) -> str | None:
    for key, chosen, known in (
        ("critic", config.critic, critics()),
        ("update", config.update, updates()),
    ):
        if chosen not in known:
            return f"algo.{key}={chosen} is not possible; available: {', '.join(sorted(known))}"
    counterfactual = config.critic == "counterfactual"
    if isinstance(spec.action_space, MultiDiscrete):
        supported = "Discrete" if counterfactual else "Discrete or Box"
        return f"{config.name} takes {supported} actions, and {spec.name} has MultiDiscrete ones"
    if counterfactual and isinstance(spec.action_space, Box):
        return (
            f"{config.name} takes Discrete actions, which its counterfactual critic compares, and "
            f"{spec.name} has Box ones; use an algorithm with a local or central critic, such as algo=mappo"
        )
    if (line := missing_groups(config.policies, spec)) is not None:
        return line
    groups = len(set(spec.groups))
    single_policy = config.policies == "shared" or (config.policies == "groups" and groups == 1)
    if config.order == "sequential" and single_policy:
        simultaneous = _SIMULTANEOUS.get(config.name, "algo.order=simultaneous")
        several = "independent, algo.policies=groups," if groups > 1 else "independent,"
        return (
            f"{config.name} updates one policy after another, and algo.policies={config.policies} gives only "
            f"one on {spec.name}; use algo.policies={several} or {simultaneous} for all at once"
        )
    actions, logits = spec.action_space, config.model.initial_logits
    if logits and not (isinstance(actions, Discrete) and actions.n == len(logits)):
        count = f"{actions.n} actions" if isinstance(actions, Discrete) else "no Discrete actions"
        remedy = "give one per action, or leave it out" if isinstance(actions, Discrete) else "leave it out"
        return f"algo.model.initial_logits has {len(logits)} entries, and {spec.name} has {count}; {remedy}"
    return None


def _refuses_budget(config: AlgoConfig, iterations: int) -> str | None:
    # The last of n iterations begins when a share (n - 1) / n of training is done.
    begins = (iterations - 1) / iterations
    if begins >= config.shared_until:
        return None
    return (
        f"the last iteration begins at {begins:.3g} of training, before algo.shared_until="
        f"{config.shared_until:g}, so the shared policy would never be split; train for more env_steps, or "
        "lower it"
    )


def _entry(summary: str, source: str, config: type[AlgoConfig]) -> AlgoEntry:
    return AlgoEntry(
        summary, source, config, acting_policy, LEARNER, _refuses, refuses_budget=_refuses_budget
    )


_ALL = {
    "a3c": AlgoEntry(
        a3c.SUMMARY,
        a3c.SOURCE,
        a3c.A3CConfig,
        acting_policy,
        Lazy("headway_algos.on_policy.a3c_learner:AsynchronousA2CLearner"),
        _refuses,
        contributor=Lazy("headway_algos.on_policy.a3c_learner:A2CContributor"),
        preload=("headway_algos.on_policy.a3c_learner",),
    ),
    "coma": _entry(coma.SUMMARY, coma.SOURCE, coma.COMAConfig),
    "custom": _entry(custom.SUMMARY, custom.SOURCE, AlgoConfig),
    "happo": _entry(happo.SUMMARY, happo.SOURCE, happo.HAPPOConfig),
    "hatrpo": _entry(hatrpo.SUMMARY, hatrpo.SOURCE, hatrpo.HATRPOConfig),
    "ia2c": _entry(ia2c.SUMMARY, ia2c.SOURCE, ia2c.IA2CConfig),
    "ippo": _entry(ippo.SUMMARY, ippo.SOURCE, ippo.IPPOConfig),
    "itrpo": _entry(itrpo.SUMMARY, itrpo.SOURCE, itrpo.ITRPOConfig),
    "maa2c": _entry(maa2c.SUMMARY, maa2c.SOURCE, maa2c.MAA2CConfig),
    "maacktr": _entry(maacktr.SUMMARY, maacktr.SOURCE, maacktr.MAACKTRConfig),
    "mappo": _entry(mappo.SUMMARY, mappo.SOURCE, mappo.MAPPOConfig),
    "matrpo": _entry(matrpo.SUMMARY, matrpo.SOURCE, matrpo.MATRPOConfig),
    **OFF_POLICY,
}

KERNELS = ("headway_algos.optim.kernel",)
"""Modules of compiled kernels. Every algorithm uses at least Adam's."""

ENTRIES = {name: replace(entry, kernels=KERNELS) for name, entry in _ALL.items()}
