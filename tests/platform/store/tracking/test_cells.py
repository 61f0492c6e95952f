"""Summaries of cells that several sessions write and send."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import pytest

from headway.contracts import HeadwayError
from headway.store.atomic_files import read_json, write_json
from headway.store.run_folder import Process, cell_summary_file, now
from headway.store.tracking.cells import CellSummary, send_cell
from headway.store.tracking.client import Tracker


def _summary(metrics: Mapping[str, float]) -> CellSummary:
    return CellSummary("study", "cell", {}, Process.current(), None, "FINISHED", now(), metrics)


class _Server:
    """Stands for MLflow's server; `meanwhile`: what another session stores while this one sends."""

    uri = "http://me:secret@host"

    def __init__(self, root: Path, meanwhile: Mapping[str, float] | None) -> None:
        self.root, self.meanwhile = root, meanwhile

    def cell(self, *_: object, **__: object) -> tuple[str, str]:
        return "1", "2"

    def finish(self, *_: object) -> None:
        if self.meanwhile is not None:
            _summary(self.meanwhile).keep(self.root)


@pytest.mark.parametrize("meanwhile", [None, {"other": 2.0}])
def test_what_another_session_stores_meanwhile_is_kept_and_not_taken_as_sent(
    tmp_path: Path, meanwhile: Mapping[str, float] | None
) -> None:
    path = cell_summary_file(tmp_path, "study", "cell")
    path.parent.mkdir()
    _summary({"own": 1.0}).keep(tmp_path)
    server = _Server(tmp_path, meanwhile)
    send_cell(tmp_path, cast(Tracker, server), "study", "cell")
    stored = CellSummary.read(path)
    assert stored.metrics == {"own": 1.0, **(meanwhile or {})}
    assert stored.is_sent(server.uri) == (meanwhile is None)
    assert "secret" not in path.read_text()


def test_a_store_that_cannot_be_locked_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(HeadwayError, match=r"cannot write .*\.cells\.lock \(No such file or directory\)"):
        _summary({}).keep(tmp_path / "absent")


@pytest.mark.parametrize("change", [{"ended": "yesterday"}, {"metrics": {"kwh": "much"}}, {"status": "DONE"}])
def test_a_damaged_summary_is_named(tmp_path: Path, change: dict[str, object]) -> None:
    path = cell_summary_file(tmp_path, "study", "cell")
    path.parent.mkdir()
    _summary({"own": 1.0}).keep(tmp_path)
    write_json(path, read_json(path) | change)
    with pytest.raises(HeadwayError, match=r"summary\.json is not the summary of a cell \(.*\): remove it"):
        CellSummary.read(path)
