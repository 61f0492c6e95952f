"""A run's folder and its record `run.json`, which only the session process writes.

run.json config.yaml plan.json            identity, configuration, resolved plan
curve-*.parquet episodes-*.parquet evaluation-*.parquet checkpoints/   written by the training process
energy.parquet summary.json               written by the session process
tracking*.json                            what MLflow has received
"""

import os
import re
import secrets
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from difflib import SequenceMatcher, get_close_matches
from hashlib import sha256
from json import dumps
from operator import itemgetter
from pathlib import Path
from platform import node
from typing import Any, Literal, Self, get_args

import psutil

from headway.config.experiment import StoreConfig
from headway.config.schema import build
from headway.contracts import HeadwayError
from headway.events import Row
from headway.store.atomic_files import make_folder, read_json, write_json
from headway.wording import environment_name

Status = Literal["RUNNING", "FINISHED", "KILLED", "FAILED"]
STATUSES: tuple[Status, ...] = get_args(Status)
RECORD = "run.json"
SUMMARY = "summary.json"
CHECKPOINTS = "checkpoints"
_MOMENT = re.compile(r"-\d{8}-\d{6}-[0-9a-f]+$")
"""End of a run's name: when it was begun, and random digits."""
_LARGEST = 1e100
"""Bound of the numbers in a summary; beyond it, sums and axes of plots overflow."""
_MAX_NAMED = 5
"""Most runs that an error names."""


@dataclass(frozen=True)
class Process:
    """Identity of a process; its start time distinguishes it from a later one with the same pid."""

    host: str
    pid: int
    created: float
    """Seconds since 1970."""

    @classmethod
    def current(cls) -> Self:
        """The calling process."""
        return cls(node(), os.getpid(), psutil.Process().create_time())

    def may_live(self) -> bool:
        """False if the process has certainly ended; a process on another machine may be alive."""
        if self.host != node():
            return True
        try:
            process = psutil.Process(self.pid)
            # A killed process stays as a zombie until its parent asks for its exit code, which not all do.
            ended = process.status() in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
            return not ended and abs(process.create_time() - self.created) < 1.0
        except psutil.NoSuchProcess:
            return False


def status_of_all(statuses: Iterable[Status]) -> Status:
    """Return the status of a cell from those of its ended runs.

    FAILED if any failed, FINISHED if all finished, else KILLED.
    """
    distinct = set(statuses)
    if "FAILED" in distinct:
        return "FAILED"
    return "FINISHED" if distinct <= {"FINISHED"} else "KILLED"


def settled(status: Status, session: Process) -> Status:
    """Return the status of a run: KILLED if it is stored as RUNNING but its session process has ended."""
    return "KILLED" if status == "RUNNING" and not session.may_live() else status


@dataclass(frozen=True)
class RunRecord:
    """Contents of `run.json`: the identity of a run and its progress."""

    run_id: str
    study: str
    environment: str
    algorithm: str
    seed: int
    iterations: int
    """Budget in iterations."""
    started: str
    """UTC, ISO 8601."""
    session: Process
    """Session process that runs it, or ran it last."""
    status: Status = "RUNNING"
    policies: str = ""
    ended: str | None = None
    duration_s: float = 0.0
    """Wall time over all sessions."""
    durable_iteration: int = 0
    durable_env_steps: int = 0
    parameters: Mapping[str, str] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    tracking_uri: str | None = None
    """MLflow server that receives the run; None: the SQLite database in the store's root."""
    curve_points: int = StoreConfig.curve_points
    """Number of points per metric sent to MLflow."""
    preset: str = ""
    """Hyper-parameter preset; empty if unknown."""
    candidate: str = ""
    """Name of the search candidate; empty if the run is not part of a search."""

    @property
    def cell(self) -> str:
        """Key of its cell: the same for all seeds of one environment, algorithm and set of parameters."""
        return cell_name(self.environment, self.algorithm, self.parameters)

    @property
    def settled_status(self) -> Status:
        """Status, with KILLED for a run whose session process ended without recording it."""
        return settled(self.status, self.session)

    def require_free(self) -> None:
        """Raise HeadwayError if a session process is running it, or may be on another host."""
        if self.settled_status != "RUNNING":
            return
        killed = ', or, if it was killed, set "status": "KILLED" in the run\'s run.json'
        raise HeadwayError(
            f"run {self.run_id} is being run by process {self.session.pid} on {self.session.host}: "
            f"stop that process first{killed if self.session.host != node() else ''}"
        )

    def write(self, directory: Path) -> None:
        """Write `run.json` durably. Raises HeadwayError if that fails."""
        write_json(directory / RECORD, asdict(self))

    @classmethod
    def read(cls, directory: Path) -> Self:
        """Read the record in a run's folder. Raises HeadwayError if it is missing or broken."""
        content = read_json(directory / RECORD)
        known = {item.name for item in fields(cls)}
        try:
            record = build(cls, {key: value for key, value in content.items() if key in known})
            milliseconds(record.started)
        except (HeadwayError, ValueError, OverflowError) as error:
            raise HeadwayError(
                f"{directory / RECORD} is not a valid run record ({error}): remove or repair it"
            ) from error
        return record


def now() -> str:
    """Return the current UTC time, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def milliseconds(moment: str) -> int:
    """Convert a time in the format of `now` to milliseconds since 1970."""
    return round(datetime.fromisoformat(moment).timestamp() * 1000)


def cell_name(environment: str, algorithm: str, parameters: Mapping[str, str]) -> str:
    """Return the key of a cell: readable, with a hash of the parameters."""
    from headway.registry import hashed_parameters

    first = hashed_parameters(algorithm, parameters)
    digest = sha256(dumps(sorted(first.items())).encode()).hexdigest()[:6]
    return f"{_slug(environment_name(environment).removesuffix('.py'))}-{_slug(algorithm)}-{digest}"


def study_folder(root: Path, study: str) -> Path:
    """Return the folder of a study's runs in the store `root`."""
    return root / _slug(study)


def create_run_folder(root: Path, study: str, cell: str, seed: int) -> tuple[str, Path]:
    """Create a run folder in `root/study` and return (run_id, folder).

    Raises HeadwayError if it cannot be created.
    """
    parent = study_folder(root, study)
    make_folder(parent)
    while True:
        moment = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
        run_id = f"{cell}-s{seed}-{moment}-{secrets.token_hex(2)}"
        try:
            (parent / run_id).mkdir()
        except FileExistsError:
            continue
        except OSError as error:
            raise HeadwayError(f"cannot create {parent / run_id} ({error.strerror})") from error
        return run_id, parent / run_id


def folders_of_seed(root: Path, study: str, cell: str, seed: int) -> list[Path]:
    """Return the folders of all runs of one seed of a cell, in no particular order."""
    return [path.parent for path in study_folder(root, study).glob(f"{cell}-s{seed}-*/{RECORD}")]


def rules_file(root: Path, study: str, cell: str) -> Path:
    """Return the path of the JSON file with the episodes of a cell's classical rules: rule name -> rows."""
    return study_folder(root, study) / f"{cell}.rules.json"


def read_rules(root: Path, study: str, cell: str) -> dict[str, list[Row]]:
    """Read the episodes of a cell's classical rules: rule name -> rows; empty if none are stored.

    Raises HeadwayError if the file is damaged.
    """
    path = rules_file(root, study, cell)
    played = read_json(path) if path.exists() else {}
    if not all(isinstance(rows, list) and all(map(_is_episode, rows)) for rows in played.values()):
        raise HeadwayError(f"{path} does not hold the episodes of rules: remove or repair it")
    return played


def _is_episode(row: object) -> bool:
    return isinstance(row, dict) and "episode_seed" in row and isinstance(row.get("return"), int | float)


def best_file(root: Path, study: str, cell: str) -> Path:
    """Return the path of the JSON file with new episodes of the best policies of a cell's runs, and of rules.

    Keys: `seed` (root of the episodes' seeds), `mode`, `rules` (rule name -> rows), `runs` (run name ->
    `iteration` of the policies and `episodes`, their rows).
    """
    return study_folder(root, study) / f"{cell}.best.json"


def cell_summary_file(root: Path, study: str, cell: str) -> Path:
    """Return the path of the JSON file with rule returns, session energy and status of a cell."""
    return study_folder(root, study) / f"{cell}.summary.json"


def plans_folder(root: Path, study: str) -> Path:
    """Return the folder of a study's stored sweep plans."""
    return study_folder(root, study) / "sweeps"


def search_database(root: Path, study: str) -> Path:
    """Return the path of the database with the candidates of a study that is a search."""
    return root / "searches" / f"{_slug(study)}.db"


def run_folders(root: Path) -> Iterator[Path]:
    """Yield every run folder under `root`, in no particular order."""
    try:
        studies = _folders(root)
    except FileNotFoundError:
        return
    for study in studies:
        yield from (Path(folder) for folder in _folders(study) if Path(folder, RECORD).exists())


def _folders(path: str | Path) -> list[str]:
    return [entry.path for entry in os.scandir(path) if _is_folder(entry)]


def _is_folder(entry: "os.DirEntry[str]") -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link to itself
        return False


def find_run(root: Path, run_id: str) -> Path:
    """Return the folder of a run, given its `run_id` or any unique part of it.

    Raises HeadwayError, with up to five runs to choose from or the nearest name, if none or several match.
    """
    folders = {folder.name: folder for folder in run_folders(root)}
    if run_id in folders:
        return folders[run_id]
    matches = [name for name in folders if run_id in name] if run_id else []
    if len(matches) == 1:
        return folders[matches[0]]
    if runs := [name for name, folder in folders.items() if folder.parent.name == _slug(run_id)]:
        raise HeadwayError(
            f"{run_id!r} is a study in {root}: name one of its runs, {first_runs(runs, folders)}"
        )
    if matches:
        raise HeadwayError(
            f"{run_id!r} is part of the names of {len(matches)} runs: name one, "
            f"{first_runs(matches, folders)}; `headway runs` shows in what they differ"
        )
    hint = "`headway runs` lists the runs" if folders else "the store holds no runs"
    for nearest in get_close_matches(run_id, folders, n=1, cutoff=0.0):
        # Names are long: a short one resembles if most of it is a piece of the name.
        if 2 * SequenceMatcher(None, run_id, nearest).find_longest_match().size > len(run_id):
            hint = f"the nearest is {nearest}"
    raise HeadwayError(f"no run {run_id!r} in {root}: {hint}")


def first_runs(names: Sequence[str], among: Collection[str]) -> str:
    """Return the runs for an error that asks for one of them: `a, b or c`; the newest five if there are more:
    `such as a, b, c, d or e (12 in all)`.

    They are sorted by cell and seed, to which a name is cut if it stays unique `among` the names of all runs.
    """
    newest = sorted(sorted(names), key=lambda name: name.split("-")[-3:-1], reverse=True)
    short = {name: _MOMENT.sub("", name) for name in newest[:_MAX_NAMED]}
    *most, last = (
        part if sum(part in other for other in among) == 1 else name
        for name, part in sorted(short.items(), key=itemgetter(1))
    )
    listed = f"{', '.join(most)} or {last}" if most else last
    return f"such as {listed} ({len(names)} in all)" if len(names) > _MAX_NAMED else listed


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.]+", "-", name).strip("-.") or "unnamed"


def read_summary(directory: Path) -> dict[str, Any]:
    """Read a run's `summary.json`; empty if it has none yet. Raises HeadwayError if the file is broken.

    Values of `energy.*` are strings, others numbers. None: an unknown value, NaN, a number of 1e100 or more,
    or an integer of more than 64 bits.
    """
    path = directory / SUMMARY
    content = read_json(path) if path.exists() else {}
    return {
        name: str(value) if name.startswith("energy.") else value if _is_plausible(value) else None
        for name, value in content.items()
    }


def _is_plausible(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < (2**63 if isinstance(value, int) else _LARGEST)
