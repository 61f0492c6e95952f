"""`headway archive`: write the runs of a study to one file, to publish beside a paper."""

import argparse
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway_launch.commands.arguments import add_store_argument, existing_store

if TYPE_CHECKING:
    from headway.store.index import RunRow
    from headway.store.query import RunSelection

EXAMPLES = """\
examples:
  headway archive bus                              writes bus.zip
  headway archive bus -o lab/bus.zip --checkpoints
  headway runs --archive bus.zip                   read it; so do report, plot, convert, compare and others
  headway verify bus.zip                           train one of its runs again and compare

Holds the newest finished run of each cell and seed: curves, episodes, evaluation episodes and energy as
Parquet, configurations, versions and machine, and the rules' episodes; a README, the licence and checksums.
It leaves out the host's name and the store's folder. --checkpoints adds each run's last checkpoint, with its
last and best policies, which `compare`, `evaluate`, `export` and `render` load. Equal contents give equal
bytes.
docs/howto/archive.md says more.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the study, the file and what it holds."""
    parser.add_argument("study", metavar="STUDY", help="name of the study, as in `headway runs`")
    parser.add_argument("-o", "--output", metavar="FILE", help="new file to write (default: STUDY.zip)")
    parser.add_argument("--checkpoints", action="store_true", help="include the last checkpoint of each run")
    parser.add_argument(
        "--licence", metavar="SPDX", default="CC-BY-4.0", help="licence of the data (default: CC-BY-4.0)"
    )
    add_store_argument(parser, archives=False)


def execute(arguments: argparse.Namespace) -> int:
    """Write the archive and print its path."""
    from importlib.metadata import version

    from headway.store.archive.container import write_archive
    from headway.wording import counted
    from headway_launch.console.output import print_line
    from headway_launch.console.output_files import require_writable
    from headway_launch.studies.runs import finished_runs

    root = existing_store(arguments.store)
    output = Path(arguments.output or f"{arguments.study}.zip")
    if output.exists():
        raise HeadwayError(f"--output: {output} exists; remove it or name a new file")
    require_writable("--output", output, output.parent)
    runs = finished_runs(root, arguments.study)
    parents, notices = _needed(runs)
    about = {
        "headway": version("headway"),
        "study": arguments.study,
        "licence": arguments.licence,
        "checkpoints": arguments.checkpoints,
    }
    digest = write_archive(output, about, _files(runs, parents, notices, arguments))
    for line in notices:
        print_line(f"headway: {line}")
    kind = "with" if arguments.checkpoints else "without"
    print_line(
        f"{counted(len(runs.rows), 'run')} of {counted(len(runs.names), 'cell')}, {kind} checkpoints, "
        f"{output.stat().st_size / 1e6:.2f} MB, licence {arguments.licence}, SHA-256 {digest}"
    )
    print(output)
    return 0


def _files(
    runs: "RunSelection", parents: Sequence["RunRow"], notices: Sequence[str], arguments: argparse.Namespace
) -> Iterator[tuple[str, bytes]]:
    from headway.store.archive.study_files import study_files
    from headway_launch.console.progress_display import CountedProgress

    yield "README.md", _readme(runs, notices, arguments).encode()
    address = f"https://spdx.org/licenses/{arguments.licence}.html"
    yield (
        "LICENCE.txt",
        f"The data in this archive are licensed under {arguments.licence}: {address}\n".encode(),
    )
    own = {row.run_id for row in runs.rows}
    rows = [*runs.rows, *(row for row in parents if row.run_id not in own)]
    kept = {row.run_id for row in parents} | (own if arguments.checkpoints else set())
    with CountedProgress("runs archived", len(rows)) as progress:
        for name, content in study_files(runs.root, rows, kept):
            progress.add(name.endswith("/run.json"))
            yield name, content


def _needed(runs: "RunSelection") -> tuple[list["RunRow"], list[str]]:
    """Return the runs from which these start, and one line per file that is needed to train them again and
    that the archive does not hold."""
    from headway.adapters.env_file import is_file_id
    from headway.store.index import RunIndex
    from headway_launch.experiments.parameters import flat
    from headway_launch.studies.runs import configuration

    started, files = set[str](), dict[str, None]()
    for row in runs.rows:
        config = configuration(row.directory)
        if run := (config.get("start") or {}).get("run"):
            started.add(run)
        env = config["env"]
        if is_file_id(env["id"]):
            files[f"env.id={env['id']}"] = None
        for key, value in flat({"env.args": env.get("args") or {}}):
            if isinstance(value, str) and ({"/", "."} & set(value)) and Path(value).exists():
                files[f"{key}={value}"] = None
    parents = [row for row in RunIndex(runs.root).rows() if row.run_id in started]
    lines = [f"not in the archive, and needed to train its runs again: {file}" for file in files]
    missing = sorted(started - {row.run_id for row in parents})
    return parents, [
        *lines,
        *(f"runs start from {name}, which is no longer in the store" for name in missing),
    ]


def _readme(runs: "RunSelection", notices: Sequence[str], arguments: argparse.Namespace) -> str:
    from importlib.metadata import version
    from statistics import fmean

    from headway.store.cell_names import labelled_cells
    from headway.wording import counted, spans

    cells = []
    for label, members in labelled_cells(runs.rows, runs.beside).items():
        seeds, rewards = sorted(row.seed for row in members), [row.final_reward for row in members]
        known = [reward for reward in rewards if reward is not None]
        mean = f"{fmean(known):.6g}" if len(known) == len(rewards) else ""
        cells.append(f"| {label} | {spans(seeds)} | {members[0].env_steps:,} | {mean} |")
    lines = [
        f"# Study {arguments.study}",
        "",
        f"{counted(len(runs.rows), 'run')}, archived by Headway {version('headway')}. Licence: "
        f"{arguments.licence}.",
        "",
        "| cell | seeds | steps per seed | mean final reward |",
        "|---|---|---|---|",
        *cells,
        "",
        "With Headway, where FILE is the archive:",
        "",
        "    headway runs --archive FILE",
        f"    headway report {shlex.quote(arguments.study)} --archive FILE",
        "    headway verify FILE      # checks it, trains a run again and compares the curves",
        "",
        "Without: `runs/STUDY/RUN/` has `curve-*.parquet` (one row per iteration), `episodes-*.parquet` and",
        "`evaluation-*.parquet` (one row per episode), `energy.parquet`, `config.yaml` (all settings),",
        "`run.json` (seed, versions, machine) and `summary.json`; `runs/STUDY/CELL.rules.json` has the",
        "episodes of the rules. `manifest.json` has the SHA-256 of every file; of checkpoints that several",
        "runs share, one is stored.",
        *(["", *notices] if notices else []),
    ]
    return "\n".join(lines) + "\n"
