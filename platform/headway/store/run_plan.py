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
    workers: int | None
    """Number of rollout workers, each with a snapshot in the checkpoint; None if not stored."""
    block: int | None
    """Environment copies whose actions are computed together, possibly fewer than configured; None if not
    stored."""
    scaled_actions: bool
    """Whether policies act in the units of `EnvSpec.for_policies`; False for runs of earlier versions, whose
    policies act in the environment's units."""
    spec: Mapping[str, Any] | None
    """`headway.policies.stored_spec.spec_json` of the environment; None for runs of earlier versions."""

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Return the plan in a run's folder. Raises HeadwayError if it is missing or damaged."""
        path = directory / PLAN
        plan = read_json(path)
        try:
            return cls(
                tuple(int(seed) for seed in plan["stack"]),
                _number(plan.get("workers")),
                _number(plan.get("rollout", {}).get("block")),
                bool(plan.get("scaled_actions", False)),
                plan.get("spec"),
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise HeadwayError(f"{path} is damaged ({error}): restore it") from error


def _number(value: Any) -> int | None:  # noqa: ANN401 - any JSON value
    return None if value is None else int(value)
