"""Tables of the pages in `studies/`, each written by the command above it.

    python docs/study_tables.py --store runs            all pages
    python docs/study_tables.py --store runs docs/studies/bus.md

A table stands between `<!-- headway compare ... -->` and `<!-- end -->`. The command is run on the store with
`--format markdown`, and its output replaces what is between. If it fails, because the store has no such
study for example, the table stays, a line says so, and the exit code is 1.
"""

import argparse
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

PAGES = Path(__file__).parent / "studies"
BLOCK = re.compile(
    r"^<!-- headway (?P<words>[^\n]+) -->\n(?P<table>.*?)^<!-- end -->$", re.MULTILINE | re.DOTALL
)


def rewritten(page: str, output: Callable[[list[str]], str | None]) -> str:
    """Return a page with the tables that `output` returns for the words of their commands.

    None keeps a table.
    """

    def block(found: re.Match[str]) -> str:
        table = output(shlex.split(found["words"]))
        return (
            found[0] if table is None else f"<!-- headway {found['words']} -->\n{table.strip()}\n<!-- end -->"
        )

    return BLOCK.sub(block, page)


def main(arguments: Sequence[str] | None = None) -> int:
    """Rewrite the tables; return the exit code."""
    parser = argparse.ArgumentParser(description="Write the tables of the studies' pages from a store.")
    parser.add_argument("pages", nargs="*", type=Path, help="pages to rewrite (default: all of docs/studies)")
    parser.add_argument(
        "--store", type=Path, default=Path("runs"), help="folder of the store (default: runs)"
    )
    asked = parser.parse_args(arguments)
    if not asked.store.is_dir():
        parser.error(f"there is no store {asked.store}; give one that has the studies' runs: --store FOLDER")
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        # The name of the store is part of what is printed: a page shows the default one.
        (Path(folder) / "runs").symlink_to(asked.store.resolve())

        def output(words: list[str]) -> str | None:
            nonlocal failed
            command = [sys.executable, "-m", "headway_launch", *words, "--format", "markdown"]
            done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
            if done.returncode == 0:
                return done.stdout
            failed += 1
            print(
                f"kept the table of headway {shlex.join(words)}: exit code {done.returncode}", file=sys.stderr
            )
            return None

        for page in asked.pages or sorted(PAGES.glob("*.md")):
            before = page.read_text(encoding="utf-8")
            after = rewritten(before, output)
            if after != before:
                page.write_text(after, encoding="utf-8")
                print(f"rewrote {page}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
