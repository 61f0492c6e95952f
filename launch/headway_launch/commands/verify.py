"""`headway verify`: check an archive, train one of its runs again and compare the curves."""

import argparse
from pathlib import Path

from headway.contracts.errors import HeadwayError

EXIT_EQUAL, EXIT_DIFFERS = 0, 1

EXAMPLES = """\
examples:
  headway verify bus.zip
  headway verify bus.zip --runs 3 --seed 2026
  headway verify bus.zip bus-mappo-8ba3f6-s0          any unique part of a run's name
  headway verify bus.zip --steps 20_000               the first steps of a long run
  headway verify bus.zip env.args.scenario=data/line1 where a scenario or environment file is here

Checks the checksums of the whole archive, then trains a run again and compares its curve, training episodes
and evaluation episodes with the archived ones, without clocks. The runs are those with the lowest SHA-256 of
`SEED:RUN`. Where the versions of packages, the processor with its vector units and the C library are those of
the archive, every number must be equal bit for bit. Elsewhere numbers round differently and training
diverges, as it also does on GPUs and for algorithms that apply gradients in order of arrival; then the final
reward must lie in the interval that holds 99% of further seeds of its cell, by Student's t over the archived
seeds. Nothing is written to a store. Exit code: 0 equal, 1 a run differs, 2 the archive is damaged or the run
cannot be trained here, 130 interrupted.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the archive and the runs."""
    parser.add_argument("file", metavar="FILE", help="archive written by `headway archive`")
    parser.add_argument(
        "words",
        metavar="RUN|env.KEY=VALUE",
        nargs="*",
        default=[],
        help="names of runs (default: drawn); where a run's files are, by env.id= or env.args.KEY=",
    )
    parser.add_argument("--runs", type=int, metavar="N", help="number of runs to draw (default: 1)")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of the draw (default: 0)")
    parser.add_argument(
        "--steps",
        type=int,
        metavar="N",
        help="only the first environment steps, rounded up to whole iterations",
    )


def execute(arguments: argparse.Namespace) -> int:
    """Verify, print the table of runs and return the exit code."""
    from headway.store.archive.container import unpacked
    from headway.store.index import RunIndex
    from headway.store.provenance import provenance
    from headway.store.run_folder import find_run
    from headway.wording import counted
    from headway_launch.console.output import print_line
    from headway_launch.console.tables import print_table
    from headway_launch.runner.runner import EXIT_STOPPED
    from headway_launch.studies.verification import Verification, drawn

    named = [word for word in arguments.words if "=" not in word]
    overrides = [word for word in arguments.words if "=" in word]
    for word in overrides:
        if not word.startswith(("env.id=", "env.args.")):
            raise HeadwayError(
                f"{word}: a run is trained again as it was; only env.id=FILE and env.args.KEY=FOLDER can say "
                "where its files are"
            )
    if named and (arguments.runs is not None or arguments.seed is not None):
        raise HeadwayError("--runs and --seed draw runs; omit them, or the names of runs")
    for option in ("runs", "steps"):
        if (number := getattr(arguments, option)) is not None and number < 1:
            raise HeadwayError(f"--{option} {number}: must be at least 1")
    with unpacked(Path(arguments.file)) as (root, manifest):
        rows = [row for row in RunIndex(root).rows(manifest["study"]) if row.status == "FINISHED"]
        if named:
            folders = {find_run(root, name).name for name in named}
            chosen = [row for row in rows if row.run_id in folders]
            if others := sorted(folders - {row.run_id for row in chosen}):
                raise HeadwayError(
                    f"{others[0]} is no finished run of study {manifest['study']}, which the archive is of"
                )
        else:
            chosen = drawn(rows, arguments.runs or 1, arguments.seed or 0)
        verification = Verification(root, provenance(), overrides, arguments.steps)
        planned = [verification.plan(row, rows) for row in chosen]
        files = counted(len(manifest["files"]), "file")
        print_line(f"headway: {arguments.file}: {files}, all with the checksums of its manifest")
        verdicts = []
        for each in planned:
            if (verdict := verification.verify(each, arguments.debug)) is None:
                return EXIT_STOPPED
            verdicts.append(verdict)
    print_table(
        ("run", "steps", "numbers", "result"),
        [(each.run_id, each.env_steps, each.values, each.result) for each in verdicts],
        whole=("run",),
    )
    return EXIT_EQUAL if all(verdict.equal for verdict in verdicts) else EXIT_DIFFERS
