"""The report page of real runs in a real browser."""

from pathlib import Path

import pytest
from chromium import Page

from headway_launch.commands.main import run as run_command

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def address(trained: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("report")
    assert run_command(["report", "pair", "--store", str(trained), "--output", str(folder)]) == 0
    return (folder / "report.html").as_uri()


@pytest.mark.parametrize("width", [1280, 800])
def test_the_page_shows_everything_at_every_width_and_requests_nothing(
    width: int, address: str, browser_page: Page, tmp_path: Path
) -> None:
    browser_page.open(address, width)
    shown = browser_page.text()
    assert "Study pair" in shown
    assert "2 finished runs of 1 learner, and 2 classical rules" in shown
    cells = "[...document.querySelectorAll('td')].map(cell => cell.innerText.trim())"
    assert "ippo" in browser_page.value(cells)
    assert "rule optimal" in shown
    pictures = "[...document.images].filter(image => image.naturalWidth > 300).length"
    assert browser_page.value(pictures) == browser_page.value("document.images.length") >= 5
    assert browser_page.value("document.documentElement.scrollWidth") <= width
    anchors = "[...document.querySelectorAll('nav a')].every(a => document.querySelector(a.hash))"
    assert browser_page.value(anchors)
    asked = [url for url in browser_page.requests if not url.startswith("data:")]
    assert asked == [address]
    assert browser_page.errors == []
    picture = tmp_path / "page.png"
    browser_page.picture(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_folded_parts_open(address: str, browser_page: Page) -> None:
    browser_page.open(address)
    assert "checkpoint_every: 20" not in browser_page.text()
    browser_page.value("document.querySelectorAll('details').forEach(part => part.open = true)")
    shown = browser_page.text()
    assert "checkpoint_every: 20" in shown
    assert "headway run env=tracking algo=ippo" in shown
