"""A real MLflow server."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

from headway.store.tracking.client import Tracker, database_uri

_PATIENCE_S = 300.0
_QUIET = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}


def free_port() -> int:
    """Return a port of this machine that nothing listens on."""
    with contextlib.closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def start_server(folder: Path, port: int) -> subprocess.Popen[bytes]:
    """Start a server of the database `folder`/mlflow.db in its own process group; wait until it listens."""
    Tracker(folder)  # makes the database
    command = [sys.executable, "-m", "mlflow", "server", "--host", "127.0.0.1", "--port", str(port)]
    command += ["--backend-store-uri", database_uri(folder), "--workers", "1"]
    command += ["--artifacts-destination", str(folder / "artifacts")]
    process = subprocess.Popen(
        command, cwd=folder, start_new_session=True, env={**os.environ, **_QUIET}, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    deadline = time.monotonic() + _PATIENCE_S
    while not _listens(port):
        assert process.poll() is None, "MLflow's server ended"
        assert time.monotonic() < deadline, "MLflow's server did not start"
        time.sleep(0.2)
    return process


def _listens(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
        return True
    return False
