"""The connection of this process to a Ray cluster.

Ray is an optional extra and is imported only when needed. Its log is kept out of the terminal and its usage
statistics are switched off.
"""

import logging
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from headway.contracts import HeadwayError
from headway.contracts.errors import WorkersLostError

_REACHED_S = 5.0
_FOLDER = "headway-ray-"
_FIX = "start one with `ray start --head`, or set backend.address=HOST:PORT or local"
_NO_TOKEN = "InvalidAuthToken"
"""Part of Ray's error message for a missing or different token."""
_HTTP2_SETTINGS = b"\x04"
_HTTP2_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0" + _HTTP2_SETTINGS + b"\0\0\0\0\0"
"""Connection preface of an HTTP/2 client (RFC 9113, 3.4), as Ray's head speaks gRPC. A server answers with a
settings frame."""
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",
    "RAY_prestart_worker_first_driver": "0",
}
"""Environment variables for Ray, unless the user has set them.

No usage statistics are sent. Workers without a GPU keep CUDA_VISIBLE_DEVICES as it is. Workers of a cluster
started here run at normal priority instead of Ray's niceness of 15, and Ray starts no idle worker per CPU
beforehand: training needs workers with environment variables of their own.
"""


@dataclass
class _Connection:
    users: int = 0
    opened_here: bool = False
    """`connect` opened it; a connection that existed before is left open."""
    folder: str | None = None
    """Folder of Ray's temporary files, for a cluster started here."""
    print_function: Any = None
    """Ray's function that prints to stdout, replaced while connected."""


_connection = _Connection()


def require_ray() -> None:
    """Raise HeadwayError if Ray is not installed."""
    if find_spec("ray") is None:
        raise HeadwayError('backend=ray needs Ray, which is an extra: pip install "headway[ray]"')


def connect(address: str) -> str:
    """Connect this process to a cluster, unless it is connected already; return the cluster's HOST:PORT.

    `address` is that of `BackendConfig`. Every call needs a matching `disconnect`. Raises HeadwayError if Ray
    is not installed, if no cluster answers, or if the cluster's version of Ray or Python differs.
    """
    require_ray()
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    import ray

    logging.getLogger("ray").setLevel(logging.ERROR)
    if not ray.is_initialized():
        _open_connection(ray, address)
    _connection.users += 1
    return str(ray.get_runtime_context().gcs_address)


def disconnect() -> None:
    """Close the connection when its last user disconnects, and end a cluster started by `connect`."""
    import ray

    _connection.users -= 1
    if _connection.users == 0 and _connection.opened_here:
        _connection.opened_here = False
        with _keep_sigterm_handler():
            ray.shutdown()
        ray._private.worker.print_to_stdstream = _connection.print_function
        if _connection.folder is not None:
            shutil.rmtree(_connection.folder, ignore_errors=True)
        _connection.folder = None


def _open_connection(ray: Any, address: str) -> None:  # noqa: ANN401 - a module without types
    settings: dict[str, Any] = {
        "configure_logging": False,
        "log_to_driver": False,
        # Workers import from the same paths as this process. Ray prepends the paths one by one.
        "job_config": ray.job_config.JobConfig(_py_driver_sys_path=[path for path in sys.path[::-1] if path]),
    }
    if address == "local":
        _remove_stale_folders()
        _connection.folder = tempfile.mkdtemp(prefix=f"{_FOLDER}{os.getpid()}-")
        settings |= {"include_dashboard": False, "_temp_dir": _connection.folder}
    else:
        address = require_answer(address)
    _connection.opened_here = True
    # Even without `log_to_driver` Ray prints the death of a worker to stdout, which is kept for tables.
    _connection.print_function = ray._private.worker.print_to_stdstream
    ray._private.worker.print_to_stdstream = lambda *_, **__: None
    try:
        with _keep_sigterm_handler(), _without_unused_daemons():
            ray.init(address, **settings)
    except Exception as error:
        _connection.users += 1
        disconnect()
        if address == "auto" and isinstance(error, ConnectionError):
            raise HeadwayError(
                f"backend.address=auto finds no Ray cluster on this machine; {_FIX}"
            ) from error
        where = "" if address == "local" else f" at {address}"
        if _NO_TOKEN in f"{error} {error.__cause__}":
            raise HeadwayError(
                f"the Ray cluster{where} requires a token: set RAY_AUTH_MODE=token, here and where nodes are "
                "started, and RAY_AUTH_TOKEN unless ~/.ray/auth_token holds the head's token"
            ) from error
        raise WorkersLostError(f"the Ray cluster{where} cannot be used: {_one_line(error)}") from error


@contextmanager
def _without_unused_daemons() -> Iterator[None]:
    """Let Ray start a cluster here without its dashboard's server, autoscaler and log monitor.

    A session uses none of them, and each takes two seconds of a processor. Ray has no setting for it.
    """
    from ray._private.node import Node

    names = ("start_api_server", "start_monitor", "start_log_monitor")
    starts = {name: getattr(Node, name) for name in names if hasattr(Node, name)}
    for name in starts:
        setattr(Node, name, lambda *_, **__: None)
    try:
        yield
    finally:
        for name, start in starts.items():
            setattr(Node, name, start)


def _remove_stale_folders() -> None:
    """Remove the temporary files of clusters whose session was killed."""
    import psutil

    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*"):
        process_id = folder.name.removeprefix(_FOLDER).partition("-")[0]
        if process_id.isdigit() and not psutil.pid_exists(int(process_id)):
            shutil.rmtree(folder, ignore_errors=True)


def require_answer(address: str) -> str:
    """Return the address if a cluster answers there within seconds, and raise HeadwayError otherwise.

    Ray itself would retry for minutes. With `auto` the address is that in RAY_ADDRESS, if any.
    """
    if address == "auto":
        from_environment = os.environ.get("RAY_ADDRESS", "")
        return address if ":" not in from_environment else require_answer(from_environment)
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host, int(port)), _REACHED_S) as channel:
            channel.settimeout(_REACHED_S)
            channel.sendall(_HTTP2_PREFACE)
            frame_header = channel.recv(9)
    except (OSError, OverflowError, ValueError) as error:  # ValueError: RAY_ADDRESS has no port
        reason = getattr(error, "strerror", None) or error
        raise WorkersLostError(
            f"no Ray cluster answers at backend.address={address} ({reason}); {_FIX}"
        ) from error
    if frame_header[3:4] != _HTTP2_SETTINGS:
        raise HeadwayError(f"the server at backend.address={address} is not a Ray cluster; {_FIX}")
    return address


@contextmanager
def _keep_sigterm_handler() -> Iterator[None]:
    """Restore this process's SIGTERM handler, which Ray replaces."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _one_line(error: Exception) -> str:
    """Return the error's message as one line of at most some 300 characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 300 else f"{text[:300]}..."
