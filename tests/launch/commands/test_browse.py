"""`headway browse`, as a real browser shows it: studies, reports, and MLflow's pages of curves and files."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from browse_server import browse_server
from chromium import Page

from headway.store.index import RunRow
from headway.store.query import select
from headway.store.tracking.sync import sync

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def address(trained: Path) -> Iterator[str]:
    sync(trained)  # so that the first page has its links
    with browse_server(trained) as printed:
        yield printed


@pytest.fixture
def start_page(address: str, browser_page: Page) -> Page:
    browser_page.open(address)
    browser_page.wait_for("pair")
    return browser_page


@pytest.fixture(scope="module")
def run(trained: Path) -> RunRow:
    return select(trained, study="pair").rows[0]


def test_the_token_is_not_kept_in_the_address(address: str, start_page: Page) -> None:
    assert start_page.value("location.href") == address.partition("?")[0]
    assert start_page.value("document.cookie") == ""


def test_a_study_s_runs_are_one_click_away(start_page: Page, run: RunRow) -> None:
    start_page.click("Runs in MLflow")
    start_page.wait_for("matching runs")
    for text in (run.cell, "summary/final_reward", "summary/auc", "summary/kwh", "seed"):
        start_page.wait_for(text)
    assert "Welcome to MLflow Assistant" not in start_page.text()
    assert "PERMISSION_DENIED" not in start_page.text()


def test_a_study_s_report_is_one_click_away(start_page: Page) -> None:
    start_page.click("Report")
    start_page.wait_for("Study pair")
    start_page.wait_for("from the store's files alone")
    assert start_page.value("[...document.images].every(image => image.naturalWidth > 100)")
    assert start_page.errors == []


def page_of(address: str, run: RunRow, tab: str) -> str:
    tracking = json.loads((Path(run.directory) / "tracking.json").read_text())
    root = address.partition("/?")[0]
    return f"{root}/mlflow/#/experiments/{tracking['experiment']}/runs/{tracking['run']}/{tab}"


def test_a_study_and_its_runs_are_found(address: str, run: RunRow, start_page: Page) -> None:
    start_page.open(f"{address.partition('/?')[0]}/mlflow/#/experiments")
    start_page.wait_for("pair")
    start_page.open(page_of(address, run, ""))
    for text in (run.run_id, "summary/final_reward", "algo.lr", "version.headway"):
        start_page.wait_for(text)


def test_curves_are_drawn(address: str, run: RunRow, start_page: Page) -> None:
    start_page.open(page_of(address, run, "model-metrics"))
    start_page.wait_for("evaluation_greedy")


def test_curves_tables_pictures_and_settings_are_files(address: str, run: RunRow, start_page: Page) -> None:
    start_page.open(page_of(address, run, "artifacts"))
    for name in ("config.yaml", "curves.png", "evaluations.csv", "curve-", "energy.parquet", "summary.json"):
        start_page.wait_for(name)
    start_page.click("config.yaml")
    start_page.wait_for("study: pair")
    start_page.click("evaluations.csv")
    start_page.wait_for("evaluation_greedy/return")
    start_page.click("curves.png")
    start_page.wait_until("[...document.images].some(image => image.naturalWidth > 500)")
