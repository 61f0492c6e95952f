"""`headway browse`, as a real browser shows it: MLflow's pages with a run's curves and files."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import Page

from headway.store.index import RunRow
from headway.store.query import select

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def address(trained: Path) -> Iterator[str]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "headway_launch", "browse", "--port", str(port), "--store", str(trained)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert server.stdout is not None
        assert "studies in the MLflow UI" in server.stdout.readline()
        study, page = server.stdout.readline().split()
        assert (study, page.partition("/#/")[0]) == ("pair", f"http://127.0.0.1:{port}")
        yield page
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(server.pid, signal.SIGKILL)


@pytest.fixture(scope="module")
def run(trained: Path) -> RunRow:
    return select(trained, study="pair").rows[0]


def test_the_printed_address_shows_the_study_s_runs(address: str, run: RunRow, browser_page: Page) -> None:
    browser_page.open(address)
    browser_page.wait_for(run.cell)
    browser_page.wait_for("matching runs")


def page_of(address: str, run: RunRow, tab: str) -> str:
    tracking = json.loads((Path(run.directory) / "tracking.json").read_text())
    root = address.partition("/#/")[0]
    return f"{root}/#/experiments/{tracking['experiment']}/runs/{tracking['run']}/{tab}"


def test_a_study_and_its_runs_are_found(address: str, run: RunRow, browser_page: Page) -> None:
    browser_page.open(f"{address.partition('/#/')[0]}/#/experiments")
    browser_page.wait_for("pair")
    browser_page.open(page_of(address, run, ""))
    for text in (run.run_id, "summary/final_reward", "algo.lr", "version.headway"):
        browser_page.wait_for(text)


def test_curves_are_drawn(address: str, run: RunRow, browser_page: Page) -> None:
    browser_page.open(page_of(address, run, "model-metrics"))
    browser_page.wait_for("evaluation_greedy")


def test_curves_tables_pictures_and_the_configuration_are_files(
    address: str, run: RunRow, browser_page: Page
) -> None:
    browser_page.open(page_of(address, run, "artifacts"))
    for name in ("config.yaml", "curves.png", "evaluations.csv", "curve-", "energy.parquet", "summary.json"):
        browser_page.wait_for(name)
    browser_page.click("config.yaml")
    browser_page.wait_for("study: pair")
    browser_page.click("evaluations.csv")
    browser_page.wait_for("evaluation_greedy/return")
    browser_page.click("curves.png")
    browser_page.wait_until("[...document.images].some(image => image.naturalWidth > 500)")
