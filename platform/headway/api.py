"""Public interface of the platform: everything that packages, scripts and notebooks import from `headway`.

Environments, algorithms and wrappers are written against the contracts; `select` returns stored runs as
pandas frames, `frames` and `plots` summarise and draw them; `load_policy` returns a trained policy. Importing
this module imports neither pandas nor torch, so light workers may import modules that use it. Every other
module of the package is private.
"""

from typing import TYPE_CHECKING

from headway import contracts
from headway.contracts import *  # noqa: F403 - every contract is public
from headway.contracts.lazy import lazy_attributes

if TYPE_CHECKING:
    from headway.adapters.conformance import CHECKS, play
    from headway.adapters.parallel_entry import parallel_entry
    from headway.adapters.pettingzoo import AdapterOptions, episode_seed
    from headway.policies.files import load_policy
    from headway.policies.policy import Policy
    from headway.stats import frames, plots
    from headway.store.query import RunSelection, select
    from headway.wrappers.observations import ChangedObservations

_LOADED_LATER = {
    "CHECKS": "headway.adapters.conformance:CHECKS",
    "AdapterOptions": "headway.adapters.pettingzoo:AdapterOptions",
    "ChangedObservations": "headway.wrappers.observations:ChangedObservations",
    "Policy": "headway.policies.policy:Policy",
    "RunSelection": "headway.store.query:RunSelection",
    "episode_seed": "headway.adapters.pettingzoo:episode_seed",
    "frames": "headway.stats.frames",
    "load_policy": "headway.policies.files:load_policy",
    "parallel_entry": "headway.adapters.parallel_entry:parallel_entry",
    "play": "headway.adapters.conformance:play",
    "plots": "headway.stats.plots",
    "select": "headway.store.query:select",
}
__all__ = [
    "CHECKS",
    "AdapterOptions",
    "ChangedObservations",
    "Policy",
    "RunSelection",
    "episode_seed",
    "frames",
    "load_policy",
    "parallel_entry",
    "play",
    "plots",
    "select",
]
__all__ += contracts.__all__
__getattr__ = lazy_attributes(__name__, _LOADED_LATER)
