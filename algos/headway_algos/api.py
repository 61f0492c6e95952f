"""Public interface of the algorithms, for recipes and updates in other packages.

All other modules of `headway_algos` are private. Importing this module does not import torch; critics and
updates do, when they are first used.
"""

from typing import TYPE_CHECKING

from headway.contracts.lazy import lazy_attributes
from headway_algos.components import Component
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.grouping import Grouping
from headway_algos.on_policy.critics.config import CriticConfig
from headway_algos.on_policy.updates.config import GradientUpdateConfig, MinibatchConfig
from headway_algos.recipes import Recipe
from headway_algos.registry import ENTRIES, configure, entry

if TYPE_CHECKING:
    from headway_algos.batches.layout import Layout
    from headway_algos.batches.policy_batch import PolicyBatch
    from headway_algos.networks.actor import Actor
    from headway_algos.networks.distributions import Distribution
    from headway_algos.networks.timeline import Timeline
    from headway_algos.on_policy.behaviour_policy import BehaviourPolicy
    from headway_algos.on_policy.critics import Critic
    from headway_algos.on_policy.critics.estimate import CriticEstimate
    from headway_algos.on_policy.updates import Update
    from headway_algos.on_policy.updates.gradient_update import GradientUpdate
    from headway_algos.on_policy.updates.kfac import KFAC
    from headway_algos.on_policy.updates.losses import A2CLoss, LossRows, PolicyLoss, PPOLoss
    from headway_algos.on_policy.updates.trpo import TRPO

__all__ = [
    "ENTRIES",
    "KFAC",
    "TRPO",
    "A2CLoss",
    "Actor",
    "AlgoConfig",
    "BehaviourPolicy",
    "Component",
    "Critic",
    "CriticConfig",
    "CriticEstimate",
    "Distribution",
    "GradientUpdate",
    "GradientUpdateConfig",
    "Grouping",
    "Layout",
    "LossRows",
    "MinibatchConfig",
    "ModelConfig",
    "PPOLoss",
    "PolicyBatch",
    "PolicyLoss",
    "Recipe",
    "Timeline",
    "Update",
    "configure",
    "entry",
]
__getattr__ = lazy_attributes(
    __name__,
    {
        "A2CLoss": "headway_algos.on_policy.updates.losses:A2CLoss",
        "Actor": "headway_algos.networks.actor:Actor",
        "BehaviourPolicy": "headway_algos.on_policy.behaviour_policy:BehaviourPolicy",
        "Critic": "headway_algos.on_policy.critics:Critic",
        "CriticEstimate": "headway_algos.on_policy.critics.estimate:CriticEstimate",
        "Distribution": "headway_algos.networks.distributions:Distribution",
        "GradientUpdate": "headway_algos.on_policy.updates.gradient_update:GradientUpdate",
        "KFAC": "headway_algos.on_policy.updates.kfac:KFAC",
        "Layout": "headway_algos.batches.layout:Layout",
        "LossRows": "headway_algos.on_policy.updates.losses:LossRows",
        "PolicyBatch": "headway_algos.batches.policy_batch:PolicyBatch",
        "PolicyLoss": "headway_algos.on_policy.updates.losses:PolicyLoss",
        "PPOLoss": "headway_algos.on_policy.updates.losses:PPOLoss",
        "Timeline": "headway_algos.networks.timeline:Timeline",
        "TRPO": "headway_algos.on_policy.updates.trpo:TRPO",
        "Update": "headway_algos.on_policy.updates:Update",
    },
)
