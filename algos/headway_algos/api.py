"""Public interface of the algorithms, for recipes and updates in other packages.

All other modules of `headway_algos` are private. Importing this module does not import torch; critics and
updates do, when they are first used.
"""

from typing import TYPE_CHECKING

from headway.contracts.lazy import lazy_attributes
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.registry import ENTRIES

if TYPE_CHECKING:
    from headway_algos.networks.distributions import Distribution
    from headway_algos.on_policy.critics import Critic
    from headway_algos.on_policy.updates import Update
    from headway_algos.on_policy.updates.a2c import A2C
    from headway_algos.on_policy.updates.gradient_update import GradientUpdate
    from headway_algos.on_policy.updates.kfac import KFAC
    from headway_algos.on_policy.updates.policy_loss import Minibatch, PolicyLoss
    from headway_algos.on_policy.updates.ppo import PPO
    from headway_algos.on_policy.updates.trpo import TRPO

__all__ = [
    "A2C",
    "ENTRIES",
    "KFAC",
    "PPO",
    "TRPO",
    "AlgoConfig",
    "Critic",
    "Distribution",
    "GradientUpdate",
    "Minibatch",
    "ModelConfig",
    "PolicyLoss",
    "Update",
]
__getattr__ = lazy_attributes(
    __name__,
    {
        "A2C": "headway_algos.on_policy.updates.a2c:A2C",
        "Critic": "headway_algos.on_policy.critics:Critic",
        "Distribution": "headway_algos.networks.distributions:Distribution",
        "GradientUpdate": "headway_algos.on_policy.updates.gradient_update:GradientUpdate",
        "KFAC": "headway_algos.on_policy.updates.kfac:KFAC",
        "Minibatch": "headway_algos.on_policy.updates.policy_loss:Minibatch",
        "PPO": "headway_algos.on_policy.updates.ppo:PPO",
        "PolicyLoss": "headway_algos.on_policy.updates.policy_loss:PolicyLoss",
        "TRPO": "headway_algos.on_policy.updates.trpo:TRPO",
        "Update": "headway_algos.on_policy.updates:Update",
    },
)
