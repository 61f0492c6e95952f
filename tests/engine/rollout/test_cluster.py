"""Addresses of Ray clusters: what cannot be used is told in one line."""

import importlib
import socket
import threading
from importlib.util import find_spec
from pathlib import Path

import pytest

from headway.config import BackendConfig
from headway.contracts import HeadwayError
from headway.rollout import cluster


def _refusal(address: str) -> str:
    with pytest.raises(HeadwayError) as refusal:
        cluster.connect(address)
    assert "\n" not in str(refusal.value)
    return str(refusal.value)


@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_an_address_without_a_cluster_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert f"what answers at backend.address=127.0.0.1:{port} is no Ray cluster" in _answered(
            server, port
        )
    assert f"no Ray cluster answers at backend.address=127.0.0.1:{port}" in _refusal(f"127.0.0.1:{port}")
    assert "no Ray cluster answers at backend.address=nowhere.invalid:1" in _refusal("nowhere.invalid:1")
    monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{port}")
    assert "no Ray cluster answers" in _refusal("auto")


@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_workers_find_the_modules_that_are_found_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two of a name, as where another checkout is installed, the same one."""
    for place in ("installed", "first"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "crossroads.py").write_text(f"PLACE = {place!r}")
        monkeypatch.syspath_prepend(tmp_path / place)
    cluster.connect("local")
    try:
        import ray

        def place() -> str:
            return str(importlib.import_module("crossroads").PLACE)

        assert ray.get(ray.remote(num_cpus=0)(place).remote()) == "first"
    finally:
        cluster.disconnect()


def _answered(server: socket.socket, port: int) -> str:
    """The refusal of a server that speaks HTTP as it did before Ray's head."""

    def answer() -> None:
        channel, _ = server.accept()
        with channel:
            channel.recv(100)
            channel.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

    threading.Thread(target=answer, daemon=True).start()
    return _refusal(f"127.0.0.1:{port}")


@pytest.mark.parametrize("address", ["nonsense", "", "host:", "host:123456"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match="must be auto, local or HOST:PORT"):
        BackendConfig("ray", address=address)


def test_without_ray_one_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "find_spec", lambda name: None)
    assert 'backend=ray needs Ray, which is an extra: pip install "headway[ray]"' in _refusal("local")
