"""Plans of runs that this version or an earlier one stored, and damaged ones."""

import json
from pathlib import Path
from typing import Any

import pytest

from headway.contracts import HeadwayError
from headway.store.run_plan import RunPlan


def _plan(folder: Path, **content: Any) -> RunPlan:  # noqa: ANN401 - any JSON value
    (folder / "plan.json").write_text(json.dumps(content))
    return RunPlan.read(folder)


def test_what_earlier_versions_did_not_store_is_unknown(tmp_path: Path) -> None:
    assert _plan(tmp_path, stack=[3, 4]) == RunPlan((3, 4), None, None, False, None)
    stored = _plan(tmp_path, stack=[3], workers=2, rollout={"block": 8}, scaled_actions=True, spec={"a": 1})
    assert stored == RunPlan((3,), 2, 8, True, {"a": 1})


@pytest.mark.parametrize(
    "content",
    [{}, {"stack": 2**63}, {"stack": ["a"]}, {"stack": [1], "workers": []}, {"stack": [1], "rollout": 3}],
)
def test_a_damaged_plan_is_one_line(content: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match=r"plan\.json is damaged \(.*\): restore it$"):
        _plan(tmp_path, **content)
