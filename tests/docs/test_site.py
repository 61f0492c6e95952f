"""The site is built without a warning, and every link within it leads somewhere."""

import subprocess
import sys
from functools import cache
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from headway_launch.commands.main import run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("sphinx") is None, reason='Sphinx is missing: pip install -e ".[docs]"'),
]

DOCS = Path(__file__).resolve().parents[2] / "docs"


class _Page(HTMLParser):
    """The links and anchors of a page, and its text."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.pieces: list[str] = []
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.anchors.add(value)
            if name in ("href", "src") and value:
                self.links.append(value)

    def handle_data(self, data: str) -> None:
        self.pieces.append(data)

    @property
    def text(self) -> str:
        return "".join(self.pieces)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh build of the site."""
    folder = tmp_path_factory.mktemp("site")
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-E", "-a", "-W", "--keep-going", str(DOCS), str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    assert (built.returncode, built.stdout) == (0, "")
    return folder


def test_every_link_within_the_site_leads_to_a_page_and_a_place_on_it(site: Path) -> None:
    read = cache(_Page)
    pages = sorted(site.rglob("*.html"))
    broken, followed = [], 0
    for page in pages:
        for link in read(page).links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            followed += 1
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            named = read(target).anchors if target.suffix == ".html" and target.is_file() else None
            if not target.is_file() or (parts.fragment and named is not None and parts.fragment not in named):
                broken.append(f"{page.relative_to(site)}: {link}")
    assert broken == []
    assert len(pages) > 50
    assert followed > 1000


@pytest.mark.parametrize(
    ("words", "page"),
    [
        (["envs", "bus"], "environments/bus"), (["rules", "bus"], "environments/bus"),
        (["metrics", "bus"], "environments/bus"), (["observations", "bus"], "environments/bus"),
        (["algos", "mappo"], "algorithms/mappo"), (["algos", "ddpg"], "algorithms/ddpg"),
        (["keys"], "configuration"), (["envs"], "environments/index"), (["algos"], "algorithms/index"),
        (["wrappers"], "wrappers"), (["experiments"], "options"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_the_reference_has_what_the_terminal_lists(
    words: list[str], page: str, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["list", *words]) == 0
    header, *rows = capsys.readouterr().out.splitlines()
    columns = header.split("\t")
    place = 1 if columns[1] in ("rule", "metric", "name") else 0
    names = [row.split("\t")[place] for row in rows if words != ["keys"] or not row.split("\t")[3]]
    text = _Page(site / "reference" / f"{page}.html").text
    # Keys of an algorithm or environment, named in column "of", have pages of their own.
    # `configs/env` adds environments that have no entry, and so no page, of their own.
    missing = [
        name for name in names if name not in text and name not in ("intersection_paper", "mixed_autonomy")
    ]
    assert len(names) > 5
    assert missing == []
