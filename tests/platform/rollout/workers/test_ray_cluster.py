"""Addresses of Ray clusters: one that cannot be used is refused in one line."""

import base64
import os
import socket
import subprocess
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from headway.config.experiment import BackendConfig
from headway.contracts import HeadwayError
from headway.rollout.workers import ray_cluster


def _refusal(address: str) -> str:
    with pytest.raises(HeadwayError) as refusal:
        ray_cluster.connect(address)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_an_address_without_a_cluster_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert f"the server at backend.address=127.0.0.1:{port} is not a Ray cluster" in _answered(
            server, port
        )
    assert f"no Ray cluster answers at backend.address=127.0.0.1:{port}" in _refusal(f"127.0.0.1:{port}")
    assert "no Ray cluster answers at backend.address=nowhere.invalid:1" in _refusal("nowhere.invalid:1")
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{port}")
    assert "no Ray cluster answers" in _refusal("auto")
    monkeypatch.setenv("RAY_ADDRESS", "head:port")
    assert "no Ray cluster answers at backend.address=head:port (invalid literal for int()" in _refusal(
        "auto"
    )


@pytest.mark.cluster
@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_a_cluster_that_requires_a_token_is_refused_with_the_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The head's server checks it, before any other daemon is asked."""
    from ray._private import ray_constants, services

    monkeypatch.setattr(ray_constants, "NUM_REDIS_GET_RETRIES", 2)
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    host = services.get_node_ip_address()
    with socket.create_server((host, 0)) as server:
        port = server.getsockname()[1]
    head = [services.GCS_SERVER_EXECUTABLE, f"--gcs_server_port={port}", f"--node-ip-address={host}"]
    head += ["--session-name=session", f"--session-dir={tmp_path}", f"--node-id={'0' * 56}"]
    head += [f"--log_dir={tmp_path}", f"--config_list={base64.b64encode(b'{}').decode()}"]
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}
    with subprocess.Popen(head, env={**os.environ, **token}, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and "no Ray cluster answers" in (
            refusal := _refusal(f"{host}:{port}")
        ):
            time.sleep(0.1)
        process.kill()
    assert f"the Ray cluster at {host}:{port} requires a token: set RAY_AUTH_MODE=token" in refusal


def _answered(server: socket.socket, port: int) -> str:
    """The refusal of a server that answers in HTTP/1.1, not HTTP/2 as Ray's head does."""

    def answer() -> None:
        channel, _ = server.accept()
        with channel:
            channel.recv(100)
            channel.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    threading.Thread(target=answer, daemon=True).start()
    return _refusal(f"127.0.0.1:{port}")


@pytest.mark.parametrize("address", ["nonsense", "", "host:", "host:123456"])
def test_a_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match="must be auto, local or HOST:PORT"):
        BackendConfig("ray", address=address)


def test_without_ray_one_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "find_spec", lambda name: None)
    assert 'backend=ray needs Ray, which is an extra: pip install "headway[ray]"' in _refusal("local")
