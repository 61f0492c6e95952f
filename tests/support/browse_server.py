"""A running `headway browse`."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import urlsplit

from mlflow_server import free_port


@contextmanager
def browse_server(store: Path) -> Iterator[str]:
    """Serve a store and yield the address that the command printed.

    Checks that Ctrl-C ends it and that it writes nothing to the current folder.
    """
    command = [sys.executable, "-m", "headway_launch", "browse", "--port", str(free_port())]
    command += ["--store", str(store)]
    with TemporaryDirectory() as current:
        server = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, start_new_session=True, cwd=current
        )
        try:
            assert server.stdout is not None
            yield server.stdout.readline().strip()
            server.send_signal(signal.SIGINT)
            assert server.wait(30) == 0
        finally:
            if server.poll() is None:
                os.killpg(server.pid, signal.SIGKILL)
                server.wait()
        assert not list(Path(current).iterdir())


def answer(
    address: str, path: str, method: str = "GET", body: str | None = None, **headers: str
) -> tuple[int, str]:
    """Send a request; return the status and the text of the answer."""
    connection = HTTPConnection(urlsplit(address).netloc, timeout=60)
    try:
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        return response.status, response.read().decode(errors="replace")
    finally:
        connection.close()


def cookie_of(address: str) -> str:
    """Open the printed address as a browser does; return its cookie."""
    connection = HTTPConnection(urlsplit(address).netloc, timeout=60)
    try:
        connection.request("GET", address.partition(urlsplit(address).netloc)[2])
        cookie, *attributes = str(connection.getresponse().headers["Set-Cookie"]).split("; ")
    finally:
        connection.close()
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} == set(attributes)
    return cookie
