"""MLflow client for the run folders: studies are experiments, cells parent runs, seeds child runs.

Every operation can be repeated: it queries what MLflow already has.
"""

import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

from headway.config.experiment import without_password
from headway.contracts import HeadwayError
from headway.store.atomic_files import locked, make_folder, sync_folder
from headway.store.run_folder import Status, milliseconds
from headway.store.tracking.thinning import Point

_Result = TypeVar("_Result")
_ANSWER_SECONDS = 5.0
_BATCH = 1000  # MLflow's limit of metrics in one request
_PARAMETERS = 100  # and of parameters
_MAX_TEXT = 5000  # longest tag; parameters take 6000
_DATABASE = "mlflow.db"
_CELL_TAG = "headway.cell"
_RUN_TAG = "headway.run_id"
RUNS_VIEW = "headway"
"""Key of the view of a study's runs in MLflow's UI, for `viewStateShareKey` in its address."""
_VIEW_COLUMNS = {
    "tags.`algorithm`": 120,
    "tags.`seed`": 70,
    "metrics.`summary/final_reward`": 200,
    "metrics.`summary/auc`": 130,
    "metrics.`summary/kwh`": 130,
}
"""Columns of that view with their widths, pixels."""
_VIEW_TAGS = {
    "mlflow.experimentKind": "custom_model_development",  # not for generative AI
    f"mlflow.sharedViewState.{RUNS_VIEW}": json.dumps(
        {
            "selectedColumns": list(_VIEW_COLUMNS),
            "columnOrder": list(_VIEW_COLUMNS),
            "columnWidths": _VIEW_COLUMNS,
            "orderByKey": "metrics.`summary/final_reward`",
            "orderByAsc": False,
        }
    ),
}
_QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "MLFLOW_DISABLE_SYSTEM_METRICS_LOGGING": "true",
    "MLFLOW_ENABLE_SYSTEM_METRICS_LOGGING": "false",
    "MLFLOW_LOGGING_LEVEL": "CRITICAL",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # stdout holds results only
    "GIT_PYTHON_REFRESH": "quiet",
    # Fail soon if the server is down; the tracking thread retries later.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "30",
}


class TrackingError(HeadwayError):
    """MLflow does not respond or fails; the run folders are not affected."""


class Tracker:
    """Connection to MLflow, for use from one thread.

    Every method raises TrackingError, with one line, if MLflow fails or its database stays locked for
    `wait_s` seconds (rounded up to MLflow's own waits of 20 s).
    """

    def __init__(self, root: Path, tracking_uri: str | None = None, wait_s: float = 60.0) -> None:
        self.root = root.resolve()
        self.local = tracking_uri is None
        """True for the SQLite database in the store's root."""
        self.uri = tracking_uri or database_uri(root)
        self._wait_s = wait_s
        make_folder(self.root)
        _import_quietly()
        if self.local:
            self._create_database()
        self._client = _retry_while_locked(wait_s, self.uri, lambda: _client(self.uri))
        self._ask("search_experiments", max_results=1)

    def cell(
        self,
        study: str,
        cell: str,
        parameters: Mapping[str, str],
        tags: Mapping[str, str],
        running: bool = True,
    ) -> tuple[str, str]:
        """Return (experiment, parent run) of a cell of a study; create them if missing.

        `running`: set the parent run's status to RUNNING.
        """
        with self._locked("a study was looked up"):
            experiment = self._experiment(study)
            query = f"tags.`{_CELL_TAG}` = '{cell}'"
            found = self._ask("search_runs", [experiment], filter_string=query, max_results=1)
            if found:
                parent = str(found[0].info.run_id)
                if running:
                    self._ask("update_run", parent, status="RUNNING")
            else:
                marked = {**_truncated(tags), _CELL_TAG: cell}
                parent = str(self._ask("create_run", experiment, tags=marked, run_name=cell).info.run_id)
        self._parameters(parent, parameters)
        return experiment, parent

    def child(
        self,
        experiment: str,
        parent: str,
        run_id: str,
        started: str,
        parameters: Mapping[str, str],
        tags: Mapping[str, str],
    ) -> str:
        """Return MLflow's ID of the stored run `run_id`; create MLflow's run under `parent` if missing."""
        query = f"tags.`{_RUN_TAG}` = '{run_id}'"
        found = self._ask("search_runs", [experiment], filter_string=query, max_results=1)
        if found:
            child = str(found[0].info.run_id)
            self._ask("update_run", child, status="RUNNING")
            for name, text in tags.items():
                if found[0].data.tags.get(name) != text[:_MAX_TEXT]:
                    self._ask("set_tag", child, name, text[:_MAX_TEXT])
        else:
            marked = {**_truncated(tags), "mlflow.parentRunId": parent, _RUN_TAG: run_id}
            moment = milliseconds(started)
            created = self._ask("create_run", experiment, start_time=moment, tags=marked, run_name=run_id)
            child = str(created.info.run_id)
        self._parameters(child, parameters)
        return child

    def add_view(self, experiment: str) -> None:
        """Add the view `RUNS_VIEW` to an experiment that lacks it."""
        known = self._ask("get_experiment", experiment).tags
        for name, text in _VIEW_TAGS.items():
            if known.get(name) != text:
                self._ask("set_experiment_tag", experiment, name, text)

    def points(self, child: str, started: str, points: Sequence[Point]) -> None:
        """Send points of the learning curve. MLflow only appends: send each point once."""
        from mlflow.entities import Metric

        zero = milliseconds(started)
        metrics = [
            Metric(point.metric, point.value, zero + round(1000 * point.wall_s), point.step)
            for point in points
        ]
        self._log(child, "metrics", metrics, _BATCH)

    def sent_steps(self, child: str) -> dict[str, frozenset[int]]:
        """Return, by metric, the steps that MLflow already has of the run `child`."""
        metrics = self._ask("get_run", child).data.metrics
        return {
            metric: frozenset(int(entry.step) for entry in self._ask("get_metric_history", child, metric))
            for metric in metrics
        }

    def finish(
        self, run: str, status: Status, ended: str, summary: Mapping[str, float], files: Sequence[Path]
    ) -> None:
        """Send the changed values of a run's summary and its files, then its status if anything changed."""
        from mlflow.entities import Metric

        moment = milliseconds(ended)
        found = self._ask("get_run", run)
        known = found.data.metrics
        metrics = [
            Metric(f"summary/{name}", value, moment, 0)
            for name, value in summary.items()
            if known.get(f"summary/{name}") != value
        ]
        self._log(run, "metrics", metrics, _BATCH)
        for file in files:
            self._ask("log_artifact", run, str(file))
        if metrics or files or found.info.status != status:
            self._ask("set_terminated", run, status, end_time=moment)

    def _create_database(self) -> None:
        """Create MLflow's database if missing, safely for processes that start together.

        It is created under a lock and a temporary name, so that a killed process leaves no partial tables.
        """
        path, draft = database_path(self.root), self.root / f".{_DATABASE}.partial"
        if path.exists():
            return
        with self._locked("MLflow's database was created"):
            if path.exists():
                return
            draft.unlink(missing_ok=True)
            uri = f"sqlite:///{draft}"
            _retry_while_locked(self._wait_s, uri, lambda: _client(uri).search_experiments(max_results=1))
            draft.replace(path)
            sync_folder(self.root)

    def _experiment(self, study: str) -> str:
        found = self._ask("get_experiment_by_name", study)
        if found is not None:
            if found.lifecycle_stage == "deleted":
                self._ask("restore_experiment", found.experiment_id)
            return str(found.experiment_id)
        location = (self.root / "mlflow-artifacts").as_uri() if self.local else None
        return str(self._ask("create_experiment", study, artifact_location=location, tags=_VIEW_TAGS))

    def _log(self, run: str, kind: str, entries: list[Any], most: int) -> None:
        for first in range(0, len(entries), most):
            self._ask("log_batch", run, **{kind: entries[first : first + most]})

    def _parameters(self, run: str, parameters: Mapping[str, str]) -> None:
        from mlflow.entities import Param

        params = [Param(name, value) for name, value in _truncated(parameters).items()]
        self._log(run, "params", params, _PARAMETERS)

    @contextmanager
    def _locked(self, purpose: str) -> Iterator[None]:
        with ExitStack() as held:
            try:
                held.enter_context(locked(self.root / ".mlflow.lock", self._wait_s, purpose))
            except HeadwayError as error:
                raise TrackingError(str(error)) from error
            yield

    def _ask(self, method: str, *arguments: Any, **named: Any) -> Any:  # noqa: ANN401 - MLflow is not typed
        bound = getattr(self._client, method)
        return _retry_while_locked(self._wait_s, self.uri, lambda: bound(*arguments, **named))


def database_path(root: Path) -> Path:
    """Return the path of the SQLite database in a store's root."""
    return root.resolve() / _DATABASE


def database_uri(root: Path) -> str:
    """Return the tracking URI of the SQLite database in a store's root."""
    return f"sqlite:///{database_path(root)}"


def require_answer(uri: str) -> None:
    """Raise TrackingError if the server of an `http` or `https` URI cannot be reached.

    Other URIs are not checked.
    """
    from urllib.error import HTTPError
    from urllib.parse import urlsplit
    from urllib.request import urlopen

    if urlsplit(uri).scheme not in ("http", "https"):
        return
    try:
        with urlopen(uri.rstrip("/") + "/health", timeout=_ANSWER_SECONDS):
            return
    except HTTPError:
        return  # the server responds; MLflow reports any further error
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise TrackingError(
            f"MLflow's server at {without_password(uri)} cannot be reached ({reason}): start it, set another"
            " URI, or leave out store.tracking_uri to use the store's own database"
        ) from error


def _import_quietly() -> None:
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    import mlflow.tracking  # noqa: F401 - a second or two, before any lock is held

    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _client(uri: str) -> Any:  # noqa: ANN401
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=uri)


def _retry_while_locked(seconds: float, uri: str, request: Callable[[], _Result]) -> _Result:
    """Return the result of `request`, retried while MLflow's database is locked. Raises TrackingError."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return request()
        except Exception as error:  # MLflow also raises exceptions of its libraries
            line = " ".join(str(error).split())[:300]
            if "database is locked" not in line:
                raise TrackingError(f"MLflow at {without_password(uri)} failed: {line}") from error
            if time.monotonic() >= deadline:
                raise TrackingError(
                    f"MLflow's database {without_password(uri)} stayed locked for {seconds:g} s: "
                    "close other programs that write to it"
                ) from error
            time.sleep(0.1)


def _truncated(texts: Mapping[str, str]) -> dict[str, str]:
    return {name: text[:_MAX_TEXT] for name, text in texts.items()}
