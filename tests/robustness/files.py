"""Damaged files: scenarios, feeds and stores of runs, and the commands that read them.

    python -m tests.robustness.files SEED CASE FOLDER

repeats one case and leaves the damaged files in FOLDER.
"""

import io
import json
import os
import random
import shutil
import sys
import zipfile
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from unittest.mock import patch

from headway_launch.commands.main import run
from tests.robustness.damage import damage_file
from tests.robustness.forked import run_forked
from tests.robustness.outcomes import FAILURES, Ended, Outcome, Scale, Tally, outcome_of, signature_of
from tests.robustness.overrides import shell_line, without_training
from tests.support.raw_feeds import SUNDAY, WEEKDAY, records, write_gtfs, write_raw

SECONDS = 180.0
"""Bound of one command."""
_SMALL_RUNS = (
    "run", "env=tracking", "algo=ippo", "seed=0,1", "study=small", "energy=off", "backend=serial",
    "rollout.copies=4", "rollout.block=2", "rollout.steps=16", "env_steps=256", "env.args.steps=8",
    "evaluation.every=64", "evaluation.episodes=1", "evaluation.final_episodes=2",
    "evaluation.rules=[random]", "algo.model.hidden=[8]", "store.checkpoint_every=1",
)  # fmt: skip
_FREQUENCIES = "trip_id,start_time,end_time,headway_secs\nout,10:00:00,12:00:00,600\n"
_DATES = "service_id,date,exception_type\nwork,20240511,1\n"


def campaign(scale: Scale, seed: int, folder: Path) -> list[Tally]:
    """Damage copies of each material and run the commands that read it."""
    tally, known = Tally("files"), set[str]()
    materials = build_materials(folder / "whole")
    with patch("headway_launch.studies.dry_run.calibrate", without_training):
        for case in range(scale.files):
            outcome, shown, signature = try_case(materials, seed, case, folder / "case")
            new = outcome in FAILURES and signature not in known
            known.add(signature)
            repeat = f"python -m tests.robustness.files {seed} {case} FOLDER\n    {shown}"
            tally.add(outcome, repeat if new else "")
    return [tally]


@dataclass(frozen=True)
class Material:
    """Undamaged files, and commands that read them in a folder that holds them."""

    folder: Path
    commands: tuple[tuple[str, ...], ...]
    damaged: str = ""
    """Pattern of the files that may be damaged; empty: all."""
    intact: str = ""
    """Folder of a run that no damage elsewhere may touch."""
    tried: int = 2
    """Number of commands run on each damaged copy."""


def build_materials(folder: Path) -> list[Material]:
    """Write all materials, and check that each command accepts them undamaged."""
    folder.mkdir(parents=True)
    materials = [_scenario(folder / "scenario"), _gtfs(folder / "gtfs"), _zipped(folder / "zipped")]
    materials += [_sunt(folder / "sunt"), *_stores(folder / "store")]
    with patch("headway_launch.studies.dry_run.calibrate", without_training):
        commands = [(material, words) for material in materials for words in material.commands]
        for number, (material, words) in enumerate(commands):  # each imports what it needs for all cases
            _copy(material, folder / f"checked-{number}")
            _run_here(folder / f"checked-{number}", words)
    return materials


def _scenario(folder: Path) -> Material:
    _build(folder, "data", "synthetic", "town", "--size", "line")
    return Material(
        folder,
        (
            ("data", "describe", "town"),
            ("data", "plot", "town", "--output", "map.png"),
            ("run", "env=bus", "algo=mappo", "env.args.scenario=town", "--dry-run"),
        ),
    )


def _gtfs(folder: Path) -> Material:
    folder.mkdir()
    write_gtfs(folder / "feed", {"frequencies": _FREQUENCIES, "calendar_dates": _DATES})
    return Material(folder, (("data", "gtfs", "feed", "town"),))


def _zipped(folder: Path) -> Material:
    feed = write_gtfs(folder.with_name("unzipped"), {"frequencies": _FREQUENCIES, "calendar_dates": _DATES})
    folder.mkdir()
    with zipfile.ZipFile(folder / "feed.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(feed.iterdir()):
            archive.write(file, file.name)
    return Material(folder, (("data", "gtfs", "feed.zip", "town"),))


def _sunt(folder: Path) -> Material:
    folder.mkdir()
    write_raw(folder / "raw", {WEEKDAY: records(WEEKDAY), SUNDAY: records(SUNDAY)})
    return Material(folder, (("data", "sunt", "raw", "town"),))


def _stores(folder: Path) -> list[Material]:
    """A store with two runs: damage to one of them, and to what both share."""
    _build(folder, *_SMALL_RUNS)
    damaged, intact = (next(folder.glob(f"runs/small/*-s{seed}-*")) for seed in (0, 1))
    record = json.loads((damaged / "run.json").read_text())
    name = str(record["run_id"])
    listed = ("runs", "--format", "json")
    reading = (
        listed, ("evaluate", name, "--episodes", "1"), ("report", "small"), ("plot", "small"),
        ("compare", "small", "--episodes", "2"), ("diff", name, intact.name), ("sync",),
        ("sweep", *_SMALL_RUNS[1:], "--dry-run"),
    )  # fmt: skip
    # The store as a session leaves it that is killed after the third iteration.
    stopped = folder.with_name("stopped")
    shutil.copytree(folder, stopped)
    of_stopped = stopped / damaged.relative_to(folder)
    record |= {"status": "KILLED", "durable_iteration": 3}
    (of_stopped / "run.json").write_text(json.dumps(record))
    own, kept = str(damaged.relative_to(folder)), str(intact.relative_to(folder))
    return [
        *[Material(folder, reading, f"{own}/**/*", kept)] * 3,
        Material(folder, reading, "runs/*", kept),
        Material(stopped, (("resume", name),), f"{own}/**/*", kept, 1),
    ]


def _build(folder: Path, *words: str) -> None:
    folder.mkdir()
    _run_here(folder, words)


def _run_here(folder: Path, words: Sequence[str]) -> None:
    before, errors = Path.cwd(), io.StringIO()
    os.chdir(folder)
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(errors):
            code = run(words)
    finally:
        os.chdir(before)
    if code:
        raise SystemExit(f"{shell_line(words)} on whole files ends with code {code}: {errors.getvalue()}")


def try_case(materials: Sequence[Material], seed: int, case: int, folder: Path) -> tuple[Outcome, str, str]:
    """Damage a copy of one material in `folder` and run commands on it.

    Returns the worst outcome, what was done, and a text that is equal for failures of one cause.
    """
    draws = random.Random(f"{seed} {case}")
    material = draws.choice(materials)
    _copy(material, folder)
    done = [
        damage_file(draws.choice(_files(folder, material)), draws) for _ in range(draws.choice((1, 1, 2)))
    ]
    words = draws.sample(material.commands, min(material.tried, len(material.commands)))
    if material.intact and words[0][0] != "resume":
        words = [material.commands[0], *words]
    before = _digest(folder / material.intact) if material.intact else ""
    worst, shown, signature = Outcome.ACCEPTED, "", ""
    for each in words:
        ended, output = _run(each, folder)
        outcome = outcome_of(ended)
        if material.intact and _is_lost(folder / material.intact, before, each, ended, output):
            outcome = Outcome.LOST
        if outcome in FAILURES and worst not in FAILURES:
            last = ended.errors.strip().rpartition("\n")[2][:300]
            signature = f"{outcome} {each[:1]} {signature_of(ended)}"
            shown = f"{'; '.join(done)}: {shell_line(each)}: {last!r}"
        if worst not in FAILURES and outcome is not Outcome.ACCEPTED:
            worst = outcome
    shown = shown or "; ".join(done)
    return worst, shown.replace(f"{folder}/", ""), signature


def _is_lost(intact: Path, before: str, words: Sequence[str], ended: Ended, output: str) -> bool:
    """Return whether the intact run has changed, or is missing in a list of runs that the command printed."""
    if _digest(intact) != before:
        return True
    listed = words[0] == "runs" and ended.code is not None
    return listed and str(json.loads((intact / "run.json").read_text())["run_id"]) not in output


def _digest(folder: Path) -> str:
    """Return a text that is equal for equal files, without the state of what MLflow has received."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and "tracking" not in path.name)
    return sha256(b"".join(str(file).encode() + file.read_bytes() for file in files)).hexdigest()


def _files(folder: Path, material: Material) -> list[Path]:
    pattern = material.damaged or "**/*"
    return sorted(path for path in folder.glob(pattern) if path.is_file() or path.is_symlink()) or [
        folder / "x"
    ]


def _copy(material: Material, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(material.folder, folder, symlinks=True)


def _run(words: Sequence[str], folder: Path) -> tuple[Ended, str]:
    """Run a command; return its end and what it wrote to stdout."""
    scratch = folder.with_name("output")
    scratch.mkdir(exist_ok=True)
    ended = run_forked(words, folder, SECONDS, scratch)
    return ended, (scratch / "stdout").read_text(errors="replace")


def main() -> None:
    """Repeat one case; see the module."""
    seed, case, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    materials = build_materials(folder / "whole")
    with patch("headway_launch.studies.dry_run.calibrate", without_training):
        print(*try_case(materials, seed, case, folder / "case"))


if __name__ == "__main__":
    main()
