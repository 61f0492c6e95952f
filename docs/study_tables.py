"""Tables of the pages in `studies/`, each written by the command above it, and archives of their studies.

    python docs/study_tables.py --store runs                        the tables of all pages
    python docs/study_tables.py --store runs README.md
    python docs/study_tables.py --store runs --only bus_city        those whose command has bus_city
    python docs/study_tables.py --store runs --archives archives    STUDY.zip of every study of these tables

A table stands between `<!-- COMMAND -->` and `<!-- end -->`. What COMMAND prints replaces what is between. On
the store are run, with `--format markdown`, `headway compare ...`, of which only the first table is kept, and
`headway report STUDY --table NAME`; and `headway search SEARCH --show`, of which expected best of n and cost
are kept. `python -m MODULE ...` is run in the checkout. If a command fails, because the store has no such
study for example, the table stays, a line says so, and the exit code is 1.
"""

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from itertools import takewhile
from pathlib import Path

PAGES = Path(__file__).parent / "studies"
CHECKOUT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"^<!-- (?P<command>(?:headway|python -m) [^\n]+) -->\n(?P<table>.*?)^<!-- end -->$",
    re.MULTILINE | re.DOTALL,
)
COSTS = ("CPU s", "kWh")


def rewritten(page: str, output: Callable[[list[str]], str | None]) -> str:
    """Return a page with the tables that `output` returns for the words of their commands.

    None keeps a table.
    """

    def block(found: re.Match[str]) -> str:
        table = output(shlex.split(found["command"]))
        return found[0] if table is None else f"<!-- {found['command']} -->\n{table.strip()}\n<!-- end -->"

    return BLOCK.sub(block, page)


def search_table(printed: str) -> str | None:
    """Return, as one Markdown table, the expected best of n candidates and the cost of a search.

    None if not all algorithms have scores. `printed` is what `headway search SEARCH --show` prints: tables
    with tabs between their cells, one blank line between two tables.
    """
    _, spent, *best = ([line.split("\t") for line in part.splitlines()] for part in printed.split("\n\n"))
    rows = [row for part in best[:1] for row in part if len(row) > 1]
    if not rows or len(rows[0]) != len(spent):
        return None
    costs = [[name, *map(_short, column)] for name, *column in zip(*spent, strict=True) if name in COSTS]
    lines = [f"| {' | '.join(row)} |" for row in (*rows, *costs)]
    return "\n".join([lines[0], f"| --- |{' ---: |' * (len(rows[0]) - 1)}", *lines[1:]])


def _short(cell: str) -> str:
    if not cell:
        return "-"
    number = float(cell)
    return f"{number:,.0f}" if number >= 100 else f"{number:.2g}"


def studies_of(page: str) -> list[str]:
    """Return the names of the studies whose tables a page has."""
    commands = [shlex.split(found["command"]) for found in BLOCK.finditer(page)]
    words = [
        word
        for program, action, *rest in commands
        if program == "headway" and action != "search"
        for word in takewhile(lambda word: not word.startswith("-"), rest)
    ]
    return list(dict.fromkeys(word for word in words if "=" not in word))


def printed(words: Sequence[str], folder: Path) -> str | None:
    """Return what a command prints that is run in `folder`; None, after a line that says so, if it fails."""
    program, *rest = words
    module = ["-m", "headway_launch"] if program == "headway" else []
    done = subprocess.run(
        [sys.executable, *module, *rest], cwd=folder, stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode:
        print(f"{shlex.join(words)}: exit code {done.returncode}", file=sys.stderr)
        return None
    return done.stdout


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrite the tables or write the archives; return the exit code."""
    parser = argparse.ArgumentParser(description="Write the tables of the studies' pages from a store.")
    parser.add_argument("pages", nargs="*", type=Path, help="pages to rewrite (default: all of docs/studies)")
    parser.add_argument(
        "--store", type=Path, default=Path("runs"), help="folder of the store (default: runs)"
    )
    some = parser.add_mutually_exclusive_group()
    some.add_argument("--only", default="", metavar="TEXT", help="rewrite only tables whose command has TEXT")
    some.add_argument(
        "--archives",
        type=Path,
        metavar="FOLDER",
        help="write the archives of the studies to this folder instead",
    )
    asked = parser.parse_args(arguments)
    if not asked.store.is_dir():
        parser.error(f"there is no store {asked.store}; give one that has the studies' runs: --store FOLDER")
    pages = {page: page.read_text(encoding="utf-8") for page in asked.pages or sorted(PAGES.glob("*.md"))}
    found = [
        shlex.join(shlex.split(command)) for text in pages.values() for command, _ in BLOCK.findall(text)
    ]
    if asked.only and not any(asked.only in command for command in found):
        parser.error(f"--only: no command above a table of these pages has {asked.only!r}")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        # The name of the store is part of what is printed: a page shows the default one.
        (Path(folder) / "runs").symlink_to(asked.store.resolve())
        if asked.archives is not None:
            asked.archives.mkdir(parents=True, exist_ok=True)
            for study in dict.fromkeys(study for text in pages.values() for study in studies_of(text)):
                words = ["headway", "archive", study, "-o", str(asked.archives.resolve() / f"{study}.zip")]
                failed += printed(words, Path(folder)) is None
            return 1 if failed else 0

        def output(words: list[str]) -> str | None:
            nonlocal failed
            if asked.only not in shlex.join(words):
                return None
            if words[:2] == ["headway", "search"]:
                table = printed(words, Path(folder))
                table = table and search_table(table)
            elif words[0] == "headway":
                table = printed([*words, "--format", "markdown"], Path(folder))
                if table and words[1] == "compare":
                    table = "\n\n".join(table.split("\n\n")[:2])
            else:
                table = printed(words, CHECKOUT)
            failed += table is None
            return table

        for page, before in pages.items():
            after = rewritten(before, output)
            if after != before:
                page.write_text(after, encoding="utf-8")
                print(f"rewrote {page}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
