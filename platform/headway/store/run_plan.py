"""How a run is trained beside others, as stored in its `plan.json` and used again when it is resumed."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from headway.contracts import HeadwayError
from headway.store.atomic_files import read_json

PLAN = "plan.json"


@dataclass(frozen=True)
class RunPlan:
    """The stored plan of a run."""

    stack: tuple[int, ...]
    """Seeds that are trained together; the checkpoints of each contain the whole stack."""
    workers: int
    """Number of rollout workers, each with a snapshot in the checkpoint."""
    block: int
    """Environment copies whose actions are computed together, possibly fewer than configured."""
    spec: Mapping[str, Any]
    """`headway.policies.stored_spec.spec_json` of the environment."""

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Return the plan in a run's folder. Raises HeadwayError if it is missing or damaged."""
        path = directory / PLAN
        plan = read_json(path)
        try:
            return cls(
                tuple(int(seed) for seed in plan["stack"]),
                int(plan["workers"]),
                int(plan["rollout"]["block"]),
                plan["spec"],
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise HeadwayError(f"{path} is damaged or of an earlier version ({error}): restore it") from error
