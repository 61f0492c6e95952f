"""The start page's list of studies, and the reports beside it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from werkzeug.test import Client

from headway.contracts.errors import HeadwayError
from headway.store.index import RunIndex
from headway.store.tracking.sync import sync
from headway_launch.web import pages
from headway_launch.web.pages import Pages, study_entries


@pytest.fixture
def client(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Client:
    monkeypatch.setattr(pages, "ReadOnlyUI", lambda root: None)
    return Client(Pages(trained, lambda: True))


def test_studies_are_listed_with_their_runs_and_pages(trained: Path) -> None:
    sync(trained)
    (entry,) = study_entries(trained)
    rewards = [row.final_reward or 0.0 for row in RunIndex(trained).rows()]
    assert (entry.name, entry.environments, entry.runs) == ("pair", "tracking", "2 finished")
    assert float(entry.best.split()[0]) == pytest.approx(sum(rewards) / 2, rel=1e-3)
    assert entry.best.endswith("2 seeds)")
    assert entry.report == "/report/pair"
    assert entry.runs_page.endswith("/runs?workflowType=machine_learning&viewStateShareKey=headway")
    assert study_entries(trained, has_views=False)[0].runs_page.endswith("workflowType=machine_learning")


def test_the_study_with_the_newest_run_is_first(monkeypatch: pytest.MonkeyPatch, trained: Path) -> None:
    first, last = RunIndex(trained).rows()
    rows = [
        replace(first, study="old"),
        replace(first, study="new/one", status="FAILED"),
        replace(last, study="old", status="KILLED", final_reward=None),
        replace(last, study="new/one", status="RUNNING", environment="bus"),
    ]
    monkeypatch.setattr(RunIndex, "rows", lambda index: rows)
    new, old = study_entries(trained)
    assert (new.name, new.environments, new.runs) == ("new/one", "2 environments", "1 failed, 1 running")
    assert (new.report, new.best) == ("", "")
    assert (old.name, old.runs, old.report) == ("old", "1 finished, 1 killed", "/report/old")


def test_no_cell_is_best_of_several_environments(monkeypatch: pytest.MonkeyPatch, trained: Path) -> None:
    """Nor is a cell the best of several settings of one environment: their returns are not on one scale."""
    names = {
        key: SimpleNamespace(task=f"tracking, env.args.steps={steps}")
        for key, steps in (("short", 8), ("long", 50))
    }
    monkeypatch.setattr(pages, "cell_names", lambda rows: {row.cell: names[row.cell] for row in rows})
    first, last = RunIndex(trained).rows()
    rows = [replace(first, cell="short", final_reward=-9.0), replace(last, cell="long", final_reward=-150.0)]
    monkeypatch.setattr(RunIndex, "rows", lambda index: rows)
    assert study_entries(trained)[0].best == ""
    rows[1] = replace(rows[1], cell="short")
    assert study_entries(trained)[0].best == "-79.50 (ippo, 2 seeds)"


def test_a_report_is_made_anew_only_for_changed_runs(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    page = client.get("/report/pair")
    assert page.status_code == 200
    assert "Study pair" in page.text
    assert "script-src 'nonce-" in page.headers["Content-Security-Policy"]

    def unwanted(*arguments: object) -> None:
        raise HeadwayError("made again")

    monkeypatch.setattr("headway_launch.report.study_data.StudyData", unwanted)
    assert client.get("/report/pair").text == page.text
    rows = RunIndex.rows
    monkeypatch.setattr(
        RunIndex, "rows", lambda index, study: [replace(row, iterations=99) for row in rows(index, study)]
    )
    assert "made again" in client.get("/report/pair").text


def test_what_does_not_exist_is_one_line_with_a_link_back(client: Client) -> None:
    page = client.get("/report/<b>absent")
    assert page.status_code == 404
    assert "there is no study &#39;&lt;b&gt;absent&#39;" in page.text
    assert 'href="/"' in page.text
    assert client.get("/absent").status_code == 404
