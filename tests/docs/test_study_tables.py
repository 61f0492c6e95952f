"""The tables of the studies' pages, and the script that writes them from a store."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "docs" / "study_tables.py"
NAMES = runpy.run_path(str(SCRIPT))
rewritten, search_table, studies_of = NAMES["rewritten"], NAMES["search_table"], NAMES["studies_of"]
PAGE = """Before.

<!-- headway compare bus --metrics 'return,wait time' -->
| old |
<!-- end -->

Between.

<!-- headway report merge_study bus --table scaling -->
<!-- end -->

<!-- headway compare env=merge -->
<!-- end -->

<!-- python -m benchmarks merge -->
<!-- end -->
"""
SEARCHED = """algorithm\tcandidate\tscore\tsteps\tsettings
ippo\t0\t2\t800\talgo.lr=1
mappo\t1\t3\t800\talgo.lr=2

algorithm\tcandidates\tto the end\tfailed\tsteps\tCPU s\tkWh
ippo\t2 of 2\t2\t0\t1600\t1366.85\t0.000456464
mappo\t2 of 2\t2\t0\t1600\t22.6\t0.000789767

candidates n\tippo\tmappo
1\t15.54 ± 29\t68.54 ± 3.5
2\t32 ± 22\t70.53 ± 2.8
n = 1 to 2: mappo, then ippo
"""


def test_each_block_gets_the_output_of_its_command() -> None:
    asked: list[list[str]] = []

    def output(words: list[str]) -> str:
        asked.append(words)
        return f"| table {len(asked)} |\n"

    assert rewritten(PAGE, output) == (
        "Before.\n\n"
        "<!-- headway compare bus --metrics 'return,wait time' -->\n| table 1 |\n<!-- end -->\n\n"
        "Between.\n\n"
        "<!-- headway report merge_study bus --table scaling -->\n| table 2 |\n<!-- end -->\n\n"
        "<!-- headway compare env=merge -->\n| table 3 |\n<!-- end -->\n\n"
        "<!-- python -m benchmarks merge -->\n| table 4 |\n<!-- end -->\n"
    )
    assert asked == [
        ["headway", "compare", "bus", "--metrics", "return,wait time"],
        ["headway", "report", "merge_study", "bus", "--table", "scaling"],
        ["headway", "compare", "env=merge"],
        ["python", "-m", "benchmarks", "merge"],
    ]


def test_the_studies_of_a_page_are_those_of_its_tables() -> None:
    assert studies_of(PAGE) == ["bus", "merge_study"]


def test_the_table_of_a_search_is_the_expected_best_of_n_with_its_cost() -> None:
    assert search_table(SEARCHED).splitlines() == [
        "| candidates n | ippo | mappo |",
        "| --- | ---: | ---: |",
        "| 1 | 15.54 ± 29 | 68.54 ± 3.5 |",
        "| 2 | 32 ± 22 | 70.53 ± 2.8 |",
        "| CPU s | 1,367 | 23 |",
        "| kWh | 0.00046 | 0.00079 |",
    ]
    assert search_table(SEARCHED.rpartition("\n\n")[0]) is None
    assert studies_of("<!-- headway search merge --show -->\n<!-- end -->\n") == []


def test_a_block_whose_command_fails_stays() -> None:
    assert rewritten(PAGE, lambda _: None) == PAGE


def test_every_table_on_a_page_is_that_of_its_command() -> None:
    tables = 0
    for page in (SCRIPT.parent / "studies").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        opened = re.findall(r"<!-- headway ((?:compare|report) .*?) -->", text)
        printed = re.findall(r"Written\sby\s`headway (.*) --format markdown`\.", text)
        assert opened == printed, page.name
        tables += len(opened)
    assert tables


def test_a_missing_store_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--store", str(tmp_path / "none")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith(
        f"there is no store {tmp_path}/none; give one that has the studies' runs: --store FOLDER"
    )


def test_commands_are_run_and_a_failing_one_keeps_its_table(tmp_path: Path) -> None:
    page, store = tmp_path / "page.md", tmp_path / "store"
    page.write_text(
        "<!-- python -m calendar 2026 1 -->\n<!-- end -->\n\n"
        "<!-- headway compare bus -->\n| old |\n<!-- end -->\n"
    )
    store.mkdir()
    command = [sys.executable, str(SCRIPT), "--store", str(store), str(page)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == "headway compare bus --format markdown: exit code 2"
    assert "January 2026" in page.read_text()
    assert "| old |" in page.read_text()
    page.write_text(
        "<!-- headway compare bus -->\n| old |\n<!-- end -->\n\n"
        "<!-- python -m calendar 2026 1 -->\n<!-- end -->\n"
    )
    assert subprocess.run([*command, "--only", "calendar 2026"], check=False).returncode == 0
    assert "January 2026" in page.read_text()
    done = subprocess.run([*command, "--only", "bus_city"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.endswith("--only: no command above a table of these pages has 'bus_city'\n")
