"""MLflow's UI over the database of a store, read-only."""

import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from werkzeug.wrappers import Request, Response

from headway.store.tracking.client import RUNS_VIEW, database_path

if TYPE_CHECKING:
    from _typeshed.wsgi import StartResponse, WSGIApplication, WSGIEnvironment

PREFIX = "/mlflow"
_READS = {
    "/ajax-api/2.0/mlflow/" + name
    for name in (
        "artifacts/list",
        "experiments/get",
        "experiments/get-by-name",
        "experiments/search",
        "experiments/search-datasets",
        "gateway-proxy",
        "logged-models/search",
        "metrics/get-history",
        "metrics/get-history-bulk",
        "metrics/get-history-bulk-interval",
        "model-versions/search",
        "registered-models/search",
        "runs/get",
        "runs/search",
    )
} | {"", "/", "/get-artifact", "/graphql", "/ajax-api/3.0/mlflow/server-info"}
_STATIC = "/static-files/"


class ReadOnlyUI:
    """WSGI application with MLflow's UI under `PREFIX`, for one store per process.

    SQLite opens the database read-only, requests that are not known to read are refused, and artifacts are
    served only from within the store.
    """

    def __init__(self, root: Path) -> None:
        self._database = database_path(root)
        self._application = _mlflow_application(root.resolve())

    def __call__(self, environ: "WSGIEnvironment", start_response: "StartResponse") -> Iterable[bytes]:
        """Answer a request."""
        if not self._database.exists():
            reason = "the store has no MLflow database, and none can be written there; see the terminal\n"
            return Response(reason, 503, mimetype="text/plain")(environ, start_response)
        request = Request(environ)
        path = request.path.removeprefix(PREFIX)
        if path in _READS or (path.startswith(_STATIC) and request.method in ("GET", "HEAD")):
            return self._application(environ, start_response)
        message = '{"error_code": "PERMISSION_DENIED", "message": "headway browse shows runs, read-only"}'
        return Response(message, 403, mimetype="application/json")(environ, start_response)


def runs_page(experiment: str, has_view: bool) -> str:
    """Return the path of the page with a study's runs. `has_view`: whether the experiment has `RUNS_VIEW`."""
    view = f"&viewStateShareKey={RUNS_VIEW}" if has_view else ""
    return f"{PREFIX}/#/experiments/{experiment}/runs?workflowType=machine_learning{view}"


def read_only_uri(database: Path) -> str:
    """Return the tracking URI with which SQLite refuses all changes of a database."""
    path = quote(quote(str(database)))  # SQLAlchemy and SQLite each undo one
    return f"sqlite:///file:{path}?mode=ro&uri=true"


def _mlflow_application(root: Path) -> "WSGIApplication":
    # MLflow's server reads these when it is imported.
    os.environ["_MLFLOW_SERVER_FILE_STORE"] = read_only_uri(database_path(root))
    os.environ["_MLFLOW_STATIC_PREFIX"] = PREFIX
    # Without it, the gateway-proxy answers that there is no gateway.
    os.environ.pop("MLFLOW_DEPLOYMENTS_TARGET", None)
    warnings.filterwarnings("ignore", module=r"mlflow\.")  # it imports deprecated modules of its libraries
    from mlflow.server import app
    from mlflow.store.db import utils

    # MLflow would make a folder "file:..." below the current one: it takes the URI of SQLite for a path.
    utils._make_parent_dirs_if_sqlite = lambda _: None
    _confine_artifacts(root)
    application: WSGIApplication = app
    return application


def _confine_artifacts(root: Path) -> None:
    """Let MLflow's server read artifacts only from files within the store, links resolved."""
    from mlflow.exceptions import MlflowException
    from mlflow.protos.databricks_pb2 import PERMISSION_DENIED
    from mlflow.store.artifact.artifact_repository_registry import get_registered_artifact_repositories
    from mlflow.store.artifact.local_artifact_repo import LocalArtifactRepository

    def require_inside(path: Path) -> None:
        if not path.resolve().is_relative_to(root):
            raise MlflowException(f"{path} is outside the store", error_code=PERMISSION_DENIED)

    class StoreArtifacts(LocalArtifactRepository):  # type: ignore[misc] # MLflow comes without types
        def get_local_path(self, artifact_path: str) -> str:
            path = str(super().get_local_path(artifact_path))
            require_inside(Path(path))
            return path

        def list_artifacts(self, path: str | None = None) -> list[Any]:
            require_inside(Path(self.artifact_dir, path or ""))
            return list(super().list_artifacts(path))

    registered = get_registered_artifact_repositories()
    registered.clear()
    registered.update({"": StoreArtifacts, "file": StoreArtifacts})
