"""Fixtures: a browser page and a small study of trained runs."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import chromium
import pytest
from warm_training import WarmContext


@pytest.fixture(autouse=True)
def _warm_training_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions in the test process start their training processes warm."""
    monkeypatch.setattr("headway_launch.runner.training_process.get_context", lambda method: WarmContext())


@pytest.fixture(scope="session")
def browser_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[chromium.Page]:
    """Page of a Chromium browser."""
    program = chromium.found()
    if program is None:
        pytest.skip("there is no Chromium; .ci/install_browser installs it (Debian, as root)")
    with chromium.chromium(program, tmp_path_factory.mktemp("chromium")) as page:
        yield page


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Store with a study `pair` of trained runs: two seeds and two rules, with energy."""
    root = tmp_path_factory.mktemp("trained")
    words = ["experiment=toy_tracking", "study=pair", "seed=0,1", "env_steps=3000", "evaluation.every=1"]
    words += ["energy.interval_s=1", f"store.root={root}"]
    command = [sys.executable, "-m", "headway_launch", "run", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    return root
