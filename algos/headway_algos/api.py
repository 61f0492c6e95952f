"""Public interface of the algorithms, for recipes and updates in other packages.

All other modules of `headway_algos` are private. Importing this module does not import torch; critics and
updates do, when they are first used.
"""

from typing import TYPE_CHECKING

from headway.contracts.lazy import lazy_attributes
from headway_algos.config import AlgoConfig, ModelConfig
from headway_algos.registry import ENTRIES

if TYPE_CHECKING:
    from headway_algos.on_policy.critics import CRITICS, Critic
    from headway_algos.on_policy.updates import UPDATES, Update
    from headway_algos.on_policy.updates.a2c import A2C
    from headway_algos.on_policy.updates.kfac import KFAC
    from headway_algos.on_policy.updates.ppo import PPO
    from headway_algos.on_policy.updates.trpo import TRPO

__all__ = [
    "A2C",
    "CRITICS",
    "ENTRIES",
    "KFAC",
    "PPO",
    "TRPO",
    "UPDATES",
    "AlgoConfig",
    "Critic",
    "ModelConfig",
    "Update",
]
__getattr__ = lazy_attributes(
    __name__,
    {
        "A2C": "headway_algos.on_policy.updates.a2c:A2C",
        "CRITICS": "headway_algos.on_policy.critics:CRITICS",
        "Critic": "headway_algos.on_policy.critics:Critic",
        "KFAC": "headway_algos.on_policy.updates.kfac:KFAC",
        "PPO": "headway_algos.on_policy.updates.ppo:PPO",
        "TRPO": "headway_algos.on_policy.updates.trpo:TRPO",
        "UPDATES": "headway_algos.on_policy.updates:UPDATES",
        "Update": "headway_algos.on_policy.updates:Update",
    },
)
