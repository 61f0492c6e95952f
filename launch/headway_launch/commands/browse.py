"""`headway browse`: serve the MLflow UI of the store on this machine."""

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryFile

from headway.contracts.errors import HeadwayError
from headway_launch.commands.runs import add_store_argument, existing_store
from headway_launch.runner.scheduler import StopRequests

EXAMPLES = """\
examples:
  headway browse
  headway browse --port 5050 --store runs
"""

_HOST = "127.0.0.1"
_READY_S = 180.0  # importing MLflow is slow on a busy machine; a server that exits ends the wait at once
_END_S = 5.0
_MOST_STUDIES = 10
"""Studies printed with their addresses."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the port and the store."""
    parser.add_argument("--port", type=int, default=5000, help="port on 127.0.0.1 (default: 5000)")
    add_store_argument(parser)


def execute(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from headway.store.tracking.client import database_uri
    from headway.store.tracking.sync import sync

    root = existing_store(arguments.store).resolve()
    _require_free(arguments.port)
    for line in sync(root):
        print(f"headway: {line}", file=sys.stderr)
    command = [sys.executable, "-m", "mlflow", "ui", "--backend-store-uri", database_uri(root)]
    command += ["--host", _HOST, "--port", str(arguments.port), "--workers", "1"]
    with StopRequests() as requests, TemporaryFile("w+") as log:
        # MLflow's job runner (scoring of traces) is unused here and would start seven slow processes.
        without_jobs = os.environ | {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
        server = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True, env=without_jobs)
        try:
            ready = _wait_until_ready(server, arguments.port, requests)
            if ready:
                print("\n".join(_pages(root, f"http://{_HOST}:{arguments.port}")), flush=True)
            while ready and not requests.count and server.poll() is None:
                time.sleep(0.2)
            silent = not ready and server.poll() is None
        finally:
            _end(server)
        if not requests.count:
            log.seek(0)
            last = (log.read().strip().splitlines() or ["no output"])[-1]
            how = f"did not answer within {_READY_S:g} s" if silent else "exited"
            raise HeadwayError(f"MLflow's server {how}: {last}")
    return 0


def _pages(root: Path, address: str) -> list[str]:
    """Return the lines that list the addresses of the studies, newest first."""
    from headway.store.index import RunIndex
    from headway.store.tracking.sync import local_experiment

    experiments: dict[str, str] = {}
    for row in reversed(RunIndex(root).rows()):
        if row.study not in experiments and (found := local_experiment(Path(row.directory))):
            experiments[row.study] = f"{address}/#/experiments/{found}/runs?workflowType=machine_learning"
    if not experiments:
        return [f"{address}/#/experiments (Ctrl-C stops); no run of this store is in its own MLflow database"]
    shown = dict(list(experiments.items())[:_MOST_STUDIES])
    width = max(map(len, shown))
    lines = ["studies in the MLflow UI, newest first (Ctrl-C stops):"]
    lines += [f"  {study:<{width}}  {page}" for study, page in shown.items()]
    if len(experiments) > len(shown):
        lines.append(f"  and {len(experiments) - len(shown)} more: {address}/#/experiments")
    return lines


def _require_free(port: int) -> None:
    if not 1 <= port < 2**16:
        raise HeadwayError(f"{port} is not a valid port; give one from 1 to 65535, such as --port 5000")
    with contextlib.closing(socket.socket()) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_HOST, port))
        except OSError as error:
            raise HeadwayError(f"port {port} cannot be used ({error}); give another with --port") from error


def _wait_until_ready(server: "subprocess.Popen[bytes]", port: int, requests: StopRequests) -> bool:
    """Return whether the server accepts connections, waiting until it exits, a stop request or `_READY_S`."""
    deadline = time.monotonic() + _READY_S
    while server.poll() is None and not requests.count and time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection((_HOST, port), timeout=1):
            return True
        time.sleep(0.2)
    return False


def _end(server: "subprocess.Popen[bytes]") -> None:
    """End the server and its workers, which form their own process group."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            server.wait(_END_S)
