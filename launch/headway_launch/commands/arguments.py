"""Arguments that several commands take."""

import argparse
import re
import shlex
from collections.abc import Collection, Sequence
from pathlib import Path

from headway.config.experiment import StoreConfig
from headway.contracts.errors import HeadwayError

OTHER_EVALUATION_SEED = 2_000_003
"""Root of the seeds of episodes that decide nothing during training."""
_FOLDERS = re.compile(r"(?<![^=,:\[{])~?/(?:[^/,\]}]+/)*")


def add_experiment_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what describes an experiment: a file, overrides, a folder of configurations."""
    parser.add_argument(
        "overrides",
        metavar="[FILE.yaml] KEY=VALUE",
        nargs="*",
        help="an experiment's file, and overrides in Hydra's grammar",
    )
    add_config_dir_argument(parser)


def add_config_dir_argument(parser: argparse.ArgumentParser) -> None:
    """Add --config-dir, shared by the commands that compose experiments."""
    parser.add_argument(
        "--config-dir",
        metavar="FOLDER",
        help="folder with more experiments, presets, searches and so on, in the same subfolders as configs/",
    )


def add_dry_run_argument(parser: argparse.ArgumentParser) -> None:
    """Add --dry-run, shared by the commands that train."""
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="list the runs and estimate time and energy, from a few iterations or, in a sweep or search, "
        "from finished runs of the same cell; stores nothing",
    )


def add_store_argument(parser: argparse.ArgumentParser, archives: bool = True) -> None:
    """Add --store, shared by the commands that read the store, and --archive if they only read it.

    `headway_launch.commands.main` unpacks an archive and sets `store` to its folder.
    """
    root = StoreConfig.root
    sources = parser.add_mutually_exclusive_group() if archives else parser
    sources.add_argument("--store", default=root, help=f"folder of the store (default: {root})")
    if archives:
        sources.add_argument(
            "--archive", metavar="FILE", help="archive to read instead of a store (see `headway archive`)"
        )


def add_where_argument(parser: argparse.ArgumentParser) -> None:
    """Add --where, shared by the commands that choose runs of a study."""
    parser.add_argument(
        "--where",
        action="append",
        default=[],
        metavar="CONDITION",
        help="only runs for which this holds, such as 'final_reward>300'; repeatable",
    )


def add_format_argument(parser: argparse.ArgumentParser, formats: Collection[str]) -> None:
    """Add --format, shared by the commands that print tables."""
    parser.add_argument("--format", choices=formats, default="table", help="output format (default: table)")


def add_best_argument(parser: argparse.ArgumentParser) -> None:
    """Add --best, shared by the commands that load policies."""
    parser.add_argument(
        "--best",
        action="store_true",
        help="the policy with the highest mean return in its training's evaluations (default: the newest)",
    )


def existing_store(folder: str) -> Path:
    """Return the folder of a store. Raises HeadwayError if it does not exist."""
    if not Path(folder).is_dir():
        raise HeadwayError(
            f"there is no store in {folder!r}; `headway run` creates one, --store selects another"
        )
    return Path(folder)


def named_studies(words: Sequence[str], store: str) -> dict[str, tuple[Path, str]]:
    """Return store and study of each word `STUDY` or `STORE:STUDY`, by a short unique name.

    Raises HeadwayError for a study that is named twice and for a store that does not exist.
    """
    found: dict[str, tuple[Path, str]] = {}
    for word in words:
        folder, _, study = word.rpartition(":")
        if "/" not in folder and not Path(folder).is_dir():  # a study's name may hold a colon
            folder, study = "", word
        place = existing_store(folder or store), study
        if place in found.values():
            raise HeadwayError(f"study {study!r} is named twice")
        name = without_folders(word) if any(known == study for _, known in found.values()) else study
        found[word if name in found else name] = place
    return found


def typed_line(arguments: argparse.Namespace) -> str:
    """Return the command line as typed, for a page: without the folders of absolute paths."""
    return shlex.join(["headway", *arguments.command.split(), *map(without_folders, arguments.typed)])


def without_folders(word: str) -> str:
    """Return a word of a command line with `FOLDER` for the folders of the absolute paths in it:
    `env.args.scenario=FOLDER/mine`."""
    return _FOLDERS.sub("FOLDER/", word)
