"""The Ray cluster that this process is connected to. Ray itself is imported only when it is needed.

Ray is an extra, and talks much: its log stays out of the terminal, its usage statistics are off.
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

_REACHED_S = 5.0
_FOLDER = "headway-ray-"
_FIX = "start one with `ray start --head`, or set backend.address=HOST:PORT or local"
_NO_TOKEN = "InvalidAuthToken"
"""In what Ray says where a token is missing or another one."""
_HTTP2_SETTINGS = b"\x04"
_HTTP2_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0" + _HTTP2_SETTINGS + b"\0\0\0\0\0"
"""How a client of gRPC, which Ray's head speaks, begins (RFC 9113, 3.4); the answer begins with settings."""
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",
}
"""Of Ray, by environment variables, where the user has not set them. No statistics of use are sent; actors
without a GPU see the machine as it is; workers of a cluster that is started here are as eager as processes,
where Ray would have them stand back behind all else (niceness 15)."""


@dataclass
class _Connection:
    users: int = 0
    ours: bool = False
    """It was made here: what was connected before is left so."""
    folder: str | None = None
    """Ray's temporary files of a cluster that was started here."""
    printing: Any = None
    """Ray's function that prints to stdout, put aside while connected."""


_connection = _Connection()


def require_ray() -> None:
    """Raise HeadwayError where Ray is not installed."""
    if find_spec("ray") is None:
        raise HeadwayError('backend=ray needs Ray, which is an extra: pip install "headway[ray]"')


def connect(address: str) -> str:
    """Connect this process to the cluster of an address (see `BackendConfig`), unless it is connected
    already; each call wants a `disconnect`. Returns HOST:PORT of the cluster.

    Raises HeadwayError where there is no Ray, no cluster, or one of another version of Ray or Python.
    """
    require_ray()
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    import ray

    logging.getLogger("ray").setLevel(logging.ERROR)
    if not ray.is_initialized():
        _connect_anew(ray, address)
    _connection.users += 1
    return str(ray.get_runtime_context().gcs_address)


def disconnect() -> None:
    """End the connection with its last user; a cluster that `connect` has started ends with it."""
    import ray

    _connection.users -= 1
    if _connection.users == 0 and _connection.ours:
        _connection.ours = False
        with _own_signals():
            ray.shutdown()
        ray._private.worker.print_to_stdstream = _connection.printing
        if _connection.folder is not None:
            shutil.rmtree(_connection.folder, ignore_errors=True)
        _connection.folder = None


def _connect_anew(ray: Any, address: str) -> None:  # noqa: ANN401 - a module without types
    settings: dict[str, Any] = {
        "configure_logging": False,
        "log_to_driver": False,
        # Workers find the modules that are found here, as processes do. Ray puts one path before the other.
        "job_config": ray.job_config.JobConfig(_py_driver_sys_path=[path for path in sys.path[::-1] if path]),
    }
    if address == "local":
        _remove_left_folders()
        _connection.folder = tempfile.mkdtemp(prefix=f"{_FOLDER}{os.getpid()}-")
        settings |= {"include_dashboard": False, "_temp_dir": _connection.folder}
    else:
        address = _reachable(address)
    _connection.ours = True
    # Whatever `log_to_driver` says, Ray prints to stdout, where tables go, that a worker died: we say so.
    _connection.printing = ray._private.worker.print_to_stdstream
    ray._private.worker.print_to_stdstream = lambda *_, **__: None
    try:
        with _own_signals():
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
                f"the Ray cluster{where} asks for a token: set RAY_AUTH_MODE=token, here and where nodes are "
                "started, and RAY_AUTH_TOKEN unless ~/.ray/auth_token is the head's"
            ) from error
        raise HeadwayError(f"the Ray cluster{where} cannot be used: {_one_line(error)}") from error


def _remove_left_folders() -> None:
    """Remove temporary files of clusters whose session was killed."""
    import psutil

    for folder in Path(tempfile.gettempdir()).glob(f"{_FOLDER}*"):
        process_id = folder.name.removeprefix(_FOLDER).partition("-")[0]
        if process_id.isdigit() and not psutil.pid_exists(int(process_id)):
            shutil.rmtree(folder, ignore_errors=True)


def _reachable(address: str) -> str:
    """The address of a cluster that answers. Ray itself tries for minutes. Raises HeadwayError."""
    if address == "auto":
        named = os.environ.get("RAY_ADDRESS", "")
        return address if ":" not in named else _reachable(named)
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host, int(port)), _REACHED_S) as channel:
            channel.settimeout(_REACHED_S)
            channel.sendall(_HTTP2_GREETING)
            greeting = channel.recv(9)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise HeadwayError(
            f"no Ray cluster answers at backend.address={address} ({reason}); {_FIX}"
        ) from error
    if greeting[3:4] != _HTTP2_SETTINGS:
        raise HeadwayError(f"what answers at backend.address={address} is no Ray cluster; {_FIX}")
    return address


@contextmanager
def _own_signals() -> Iterator[None]:
    """Ray sets a handler of its own for SIGTERM; ours stays."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _one_line(error: Exception) -> str:
    """What Ray says, as one line of bearable length."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 300 else f"{text[:300]}..."
