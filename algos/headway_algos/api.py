"""Public interface of the algorithms, for recipes and updates in other packages.

All other modules of `headway_algos` are private. Importing this module does not import torch; critics and
updates do, when they are first used.
"""

from typing import TYPE_CHECKING

from headway.contracts.lazy import lazy_attributes
from headway_algos.components import Component
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.on_policy.critics.config import CriticConfig
from headway_algos.on_policy.updates.config import GradientUpdateConfig, MinibatchConfig
from headway_algos.recipes import Recipe
from headway_algos.registry import ENTRIES, configure, entry

if TYPE_CHECKING:
    from headway_algos.networks.distributions import Distribution
    from headway_algos.on_policy.critics import Critic
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
    "AlgoConfig",
    "Component",
    "Critic",
    "CriticConfig",
    "Distribution",
    "GradientUpdate",
    "GradientUpdateConfig",
    "LossRows",
    "MinibatchConfig",
    "ModelConfig",
    "PPOLoss",
    "PolicyLoss",
    "Recipe",
    "Update",
    "configure",
    "entry",
]
__getattr__ = lazy_attributes(
    __name__,
    {
        "A2CLoss": "headway_algos.on_policy.updates.losses:A2CLoss",
        "Critic": "headway_algos.on_policy.critics:Critic",
        "Distribution": "headway_algos.networks.distributions:Distribution",
        "GradientUpdate": "headway_algos.on_policy.updates.gradient_update:GradientUpdate",
        "KFAC": "headway_algos.on_policy.updates.kfac:KFAC",
        "LossRows": "headway_algos.on_policy.updates.losses:LossRows",
        "PPOLoss": "headway_algos.on_policy.updates.losses:PPOLoss",
        "PolicyLoss": "headway_algos.on_policy.updates.losses:PolicyLoss",
        "TRPO": "headway_algos.on_policy.updates.trpo:TRPO",
        "Update": "headway_algos.on_policy.updates:Update",
    },
)
