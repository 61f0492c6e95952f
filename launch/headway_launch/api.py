"""Public interface of the session: what scripts and notebooks import from `headway_launch`.

Every other module of the package is private.
"""

from headway_launch.studies.runs import rules_beside
from headway_launch.training import run, sweep

__all__ = ["rules_beside", "run", "sweep"]
