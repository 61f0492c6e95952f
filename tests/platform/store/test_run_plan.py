"""Plans in run folders, and damaged ones."""

import json
from pathlib import Path
from typing import Any

import pytest
from stored_runs import write_plan

from headway.contracts import HeadwayError
from headway.store.run_plan import RunPlan


@pytest.mark.parametrize(
    ("key", "value"), [("stack", 2**63), ("stack", ["a"]), ("workers", []), ("workers", None), ("rollout", 3)]
)
def test_a_damaged_plan_is_one_line(key: str, value: object, tmp_path: Path) -> None:
    write_plan(tmp_path, [3, 4], {"a": 1})
    assert RunPlan.read(tmp_path) == RunPlan((3, 4), 1, 1, {"a": 1})
    plan: dict[str, Any] = json.loads((tmp_path / "plan.json").read_text())
    for damaged in ({**plan, key: value}, {part: plan[part] for part in plan if part != key}):
        (tmp_path / "plan.json").write_text(json.dumps(damaged))
        with pytest.raises(
            HeadwayError, match=r"plan\.json is damaged or of an earlier version \(.*\): restore it$"
        ):
            RunPlan.read(tmp_path)
