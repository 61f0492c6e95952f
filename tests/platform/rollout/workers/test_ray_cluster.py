"""Addresses of Ray clusters: one that cannot be used is refused in one line."""

import os
import socket
import subprocess
import sys
import threading
from importlib.util import find_spec

import pytest
from ray_processes import assert_gone, ray_processes

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


@pytest.mark.cluster
@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_a_cluster_that_requires_a_token_is_refused_with_the_setting(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ray._private import ray_constants

    monkeypatch.setattr(ray_constants, "NUM_REDIS_GET_RETRIES", 2)
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    before = ray_processes()
    head = [sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--node-ip-address=127.0.0.1"]
    head += [f"--port={port}", "--num-cpus=0", "--include-dashboard=false", "--include-log-monitor=false"]
    head += [f"--temp-dir={tmp_path_factory.mktemp('ray')}", f"--object-store-memory={10**8}"]
    token = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64, "RAY_USAGE_STATS_ENABLED": "0"}
    try:
        subprocess.run(head, env={**os.environ, **token}, check=True, capture_output=True, timeout=120)
        refusal = _refusal(f"127.0.0.1:{port}")
    finally:
        for process in ray_processes() - before:
            process.kill()
    assert_gone(before)
    assert f"the Ray cluster at 127.0.0.1:{port} requires a token: set RAY_AUTH_MODE=token" in refusal


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
