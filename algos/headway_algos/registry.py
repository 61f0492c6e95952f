"""Registry of algorithms by name. Importing it imports neither torch nor numba."""

from dataclasses import fields
from functools import partial
from typing import Any

from headway.contracts import AlgoEntry, Box, Discrete, EnvSpec, Lazy
from headway_algos import records
from headway_algos.agent_id import impossible_ids
from headway_algos.components import component
from headway_algos.config import AlgoConfig, SimultaneousConfig
from headway_algos.off_policy_entry import replay_entry
from headway_algos.recipes import KERNELS, Recipe, recipes


def _simultaneous(config: AlgoConfig) -> str | None:
    """Return the choice that updates all policies at once, with the same critic and update."""
    if config.name == "custom":
        return "algo.order=simultaneous"
    alike = [
        name
        for name, recipe in recipes().items()
        if isinstance(recipe, Recipe)
        and (recipe.critic, recipe.update, recipe.order) == (config.critic, config.update, "simultaneous")
        and recipe.contributor is None
    ]
    return f"algo={alike[0]}" if alike else None


def _refuses(config: AlgoConfig, spec: EnvSpec) -> str | None:
    counterfactual = config.critic == "counterfactual"
    if counterfactual and not isinstance(spec.action_space, Discrete):
        return (
            f"{config.name} takes Discrete actions, which its counterfactual critic compares, and "
            f"{spec.name} has {type(spec.action_space).__name__} ones; use an algorithm with a local or "
            "central critic, such as algo=mappo"
        )
    if (line := impossible_ids(config, spec)) is not None:
        return line
    groups = len(set(spec.groups))
    single_policy = config.policies == "shared" or (config.policies == "groups" and groups <= 1)
    if config.splits and single_policy:
        return (
            f"algo.shared_until splits one policy into several, and algo.policies={config.policies} gives "
            f"only one on {spec.name}; use algo.policies=independent"
        )
    if config.order == "sequential" and single_policy:
        ways = [f"algo.policies={way}" for way in ("independent", "groups")[: 2 if groups > 1 else 1]]
        if (at_once := _simultaneous(config)) is not None:
            ways.append(f"or {at_once} for all at once")
        return (
            f"{config.name} updates one policy after another, and algo.policies={config.policies} gives only "
            f"one on {spec.name}; use {', '.join(ways)}"
        )
    actions, logits = spec.action_space, config.model.initial_logits
    if not isinstance(actions, Box) and config.model.log_std != type(config.model).log_std:
        return (
            f"algo.model.log_std is the spread of Box actions, and {spec.name} has {type(actions).__name__} "
            "ones; leave it out"
        )
    coeff = config.imitation_entropy_coeff
    if isinstance(actions, Box) and coeff != type(config).imitation_entropy_coeff:
        return (
            f"algo.imitation_entropy_coeff is for discrete actions, and {spec.name} has Box ones, whose "
            "spread is algo.model.log_std; leave it out"
        )
    if logits and not (isinstance(actions, Discrete) and actions.n == len(logits)):
        count = f"{actions.n} actions" if isinstance(actions, Discrete) else "no Discrete actions"
        remedy = "give one per action, or [] for none" if isinstance(actions, Discrete) else "set it to []"
        return f"algo.model.initial_logits has {len(logits)} entries, and {spec.name} has {count}; {remedy}"
    return None


def _refuses_anchor(config: AlgoConfig, kl_coeff: float, critic_iterations: int) -> str | None:
    if critic_iterations and config.critic == "none":
        return "algo.critic=none has no critic to train first; add start.critic_iterations=0"
    if kl_coeff == 0:
        return None
    if not component("update", config.update).penalises:
        return (
            f"start.kl_coeff is a penalty on a loss, and algo.update={config.update} bounds its steps by "
            "itself; lower algo.kl_bound, and add start.kl_coeff=0"
        )
    if config.model.core != "none":
        return (
            "start.kl_coeff is for feedforward policies, and the start policy of algo.model.core="
            f"{config.model.core} would need a hidden state of its own; use core=none, or add "
            "start.kl_coeff=0"
        )
    return None


def _refuses_budget(config: AlgoConfig, iterations: int) -> str | None:
    if not isinstance(config, SimultaneousConfig):
        return None
    # The last of n iterations begins when a share (n - 1) / n of training is done.
    begins = (iterations - 1) / iterations
    if begins >= config.shared_until:
        return None
    return (
        f"the last iteration begins after {begins:.3g} of training, before algo.shared_until="
        f"{config.shared_until:g}, so the shared policy would never be split; raise env_steps or lower "
        "algo.shared_until"
    )


def entry(recipe: Recipe) -> AlgoEntry:
    """Return the registry entry of an on-policy algorithm.

    Raises TypeError if the recipe has a default for a key that the algorithm does not have.
    """
    record = records.config_class(recipe, {})
    if unknown := set(recipe.defaults) - {key.name for key in fields(record)}:
        raise TypeError(f"recipe {recipe.name} has no key {', '.join(sorted(unknown))}")
    return AlgoEntry(
        recipe.summary,
        recipe.source,
        record,
        Lazy("headway_algos.acting.policy:acting_policy"),
        recipe.learner,
        _refuses,
        refuses_budget=_refuses_budget,
        starts=recipe.contributor is None,
        refuses_anchor=_refuses_anchor,
        contributor=recipe.contributor,
        preload=recipe.preload,
        kernels=KERNELS,
        record=partial(records.config_class, recipe),
        obsolete_keys=records.obsolete_keys(recipe),
        rollout=partial(records.rollout, recipe),
    )


ENTRIES = {
    name: entry(recipe) if isinstance(recipe, Recipe) else replay_entry(recipe)
    for name, recipe in sorted(recipes().items())
}
"""Every algorithm of Headway by name."""


def configure(name: str, **settings: Any) -> Any:  # noqa: ANN401 - any record
    """Return an algorithm's configuration record with these hyper-parameters.

    Raises TypeError for one that the algorithm does not have, ValueError for an invalid value.
    """
    return ENTRIES[name].record_for(settings)(**settings)
