"""A run's folder: `run.json` says what the run is, and only its session process writes it.

run.json config.yaml plan.json            identity, configuration, resolved plan
curve-*.parquet episodes-*.parquet evaluation-*.parquet checkpoints/   the training process's
energy.parquet summary.json tracking*.json curves.png evaluations.csv  the session's
"""

import os
import re
import secrets
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from difflib import get_close_matches
from hashlib import sha256
from json import dumps
from pathlib import Path
from platform import node
from typing import Any, Literal, Self, get_args

import psutil

from headway.config.experiment import StoreConfig
from headway.contracts import HeadwayError
from headway.store.atomic_files import make_folder, read_json, write_json

Status = Literal["RUNNING", "FINISHED", "KILLED", "FAILED"]
STATUSES: tuple[Status, ...] = get_args(Status)
RECORD = "run.json"
SUMMARY = "summary.json"
CHECKPOINTS = "checkpoints"


@dataclass(frozen=True)
class Process:
    """A process, told apart from a later one with the same number."""

    host: str
    pid: int
    created: float
    """Seconds since 1970."""

    @classmethod
    def current(cls) -> Self:
        """The calling process."""
        return cls(node(), os.getpid(), psutil.Process().create_time())

    def may_live(self) -> bool:
        """False if it is surely gone; a process of another machine may live."""
        if self.host != node():
            return True
        try:
            return abs(psutil.Process(self.pid).create_time() - self.created) < 1.0
        except psutil.NoSuchProcess:
            return False


def status_of_all(statuses: Iterable[Status]) -> Status:
    """That of a cell whose runs have ended so: FAILED where any has, FINISHED where all have."""
    known = set(statuses)
    if "FAILED" in known:
        return "FAILED"
    return "FINISHED" if known <= {"FINISHED"} else "KILLED"


def settled(status: Status, session: Process) -> Status:
    """The status of a run, KILLED if it is RUNNING by a session that is gone."""
    return "KILLED" if status == "RUNNING" and not session.may_live() else status


@dataclass(frozen=True)
class RunRecord:
    """What a run is and how far it came: the contents of `run.json`."""

    run_id: str
    study: str
    environment: str
    algorithm: str
    seed: int
    iterations: int
    """Iterations of its budget."""
    started: str
    """UTC, ISO 8601."""
    session: Process
    """The session process that runs it, or did."""
    status: Status = "RUNNING"
    policies: str = ""
    ended: str | None = None
    duration_s: float = 0.0
    """Wall time of all sessions that ran it."""
    durable_iteration: int = 0
    durable_env_steps: int = 0
    parameters: Mapping[str, str] = field(default_factory=dict)
    tags: Mapping[str, str] = field(default_factory=dict)
    tracking_uri: str | None = None
    """Where MLflow is to know of it; None: SQLite in the store's root."""
    curve_points: int = StoreConfig.curve_points
    """Points of each metric's curve that MLflow is to have."""
    preset: str = ""
    """Of hyper-parameters, as it was chosen; empty where that is not known."""
    candidate: str = ""
    """What it is called in the search that it is a part of; empty where it is of none."""

    @property
    def cell(self) -> str:
        """Name of its cell: the same for all seeds of one environment, algorithm and parameters."""
        return cell_name(self.environment, self.algorithm, self.parameters)

    @property
    def settled_status(self) -> Status:
        """Its status as `settled` has it."""
        return settled(self.status, self.session)

    def require_free(self) -> None:
        """Raise HeadwayError where a session runs it, or, on another host, may."""
        if self.settled_status != "RUNNING":
            return
        killed = ', or, where it was killed, set "status": "KILLED" in the run\'s run.json'
        raise HeadwayError(
            f"run {self.run_id} is being run by process {self.session.pid} on {self.session.host}: "
            f"stop that one first{killed if self.session.host != node() else ''}"
        )

    def write(self, directory: Path) -> None:
        """Write `run.json` durably. Raises HeadwayError if that fails."""
        write_json(directory / RECORD, asdict(self))

    @classmethod
    def read(cls, directory: Path) -> Self:
        """The record in a run's folder. Raises HeadwayError if it is missing or broken."""
        content = read_json(directory / RECORD)
        known = {item.name for item in fields(cls)}
        try:
            session = Process(**content.pop("session"))
            return cls(session=session, **{key: value for key, value in content.items() if key in known})
        except (KeyError, TypeError) as error:
            raise HeadwayError(f"{directory / RECORD} is no record of a run: remove or repair it") from error

    def ended_as(self, status: Status) -> Self:
        """The record of the run ended now."""
        return replace(self, status=status, ended=now())


def now() -> str:
    """The time, UTC, ISO 8601, in milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def milliseconds(moment: str) -> int:
    """Milliseconds since 1970 of a time as `now` writes it."""
    return round(datetime.fromisoformat(moment).timestamp() * 1000)


def cell_name(environment: str, algorithm: str, parameters: Mapping[str, str]) -> str:
    """Readable, and different for different parameters."""
    digest = sha256(dumps(sorted(parameters.items())).encode()).hexdigest()[:6]
    return f"{_slug(environment)}-{_slug(algorithm)}-{digest}"


def create_run_folder(root: Path, study: str, cell: str, seed: int) -> tuple[str, Path]:
    """A new (run_id, folder) in `root/study`. Raises HeadwayError if it cannot be created."""
    parent = root / _slug(study)
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


def rules_file(root: Path, study: str, cell: str) -> Path:
    """Where the episodes of a cell's rules are kept: a JSON object, name -> rows."""
    return root / _slug(study) / f"{cell}.rules.json"


def plans_folder(root: Path, study: str) -> Path:
    """Where a study keeps what its sweeps set out to do."""
    return root / _slug(study) / "sweeps"


def run_folders(root: Path) -> Iterator[Path]:
    """Every folder under `root` that holds a run, in no order."""
    try:
        studies = [entry for entry in os.scandir(root) if entry.is_dir()]
    except FileNotFoundError:
        return
    for study in studies:
        for entry in os.scandir(study.path):
            if entry.is_dir() and Path(entry.path, RECORD).exists():
                yield Path(entry.path)


def find_run(root: Path, run_id: str) -> Path:
    """The folder of a run by its identity, or by a beginning or part of it that only one run has.

    Raises HeadwayError that gives the nearest ones.
    """
    folders = {folder.name: folder for folder in run_folders(root)}
    if run_id in folders:
        return folders[run_id]
    matches = [name for name in folders if run_id in name] if run_id else []
    if len(matches) == 1:
        return folders[matches[0]]
    if matches:
        shown = ", ".join(sorted(matches)[:3])
        raise HeadwayError(f"{len(matches)} runs match {run_id!r} ({shown}, ...): give more of the name")
    nearest = get_close_matches(run_id, folders, n=1, cutoff=0.0)
    hint = f"the nearest is {nearest[0]}" if nearest else "the store holds no runs"
    raise HeadwayError(f"no run {run_id!r} in {root}: {hint}")


def _slug(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.]+", "-", name).strip("-.") or "unnamed"


def read_summary(directory: Path) -> dict[str, Any]:
    """The run's summary figures; empty if it has none yet. Raises HeadwayError if the file is broken."""
    path = directory / SUMMARY
    return read_json(path) if path.exists() else {}
