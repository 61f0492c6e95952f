"""Fixtures: a browser page, a small study of trained runs, and an empty folder."""

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any

import chromium
import pytest
from warm_training import WarmContext

from headway.config.experiment import EnergyConfig
from headway.energy.meter import EnergyMeter
from headway_launch.commands.main import run
from headway_launch.experiments import compose as compose_module

Composition = tuple[dict[str, Any], Mapping[str, str]]


@pytest.fixture(autouse=True, scope="session")
def _kept_compositions() -> Iterator[None]:
    """Compose the same overrides of the project's files once: Hydra takes a tenth of a second for each."""
    compose, configs = compose_module._compose_mapping, compose_module.configs_folder()
    kept: dict[tuple[str, ...], Composition] = {}

    def compose_once(overrides: Sequence[str]) -> Composition:
        if compose_module.configs_folder() != configs:
            return compose(overrides)
        if tuple(overrides) not in kept:
            kept[tuple(overrides)] = compose(overrides)
        return deepcopy(kept[tuple(overrides)])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compose_module, "_compose_mapping", compose_once)
        yield


@pytest.fixture(autouse=True, scope="session")
def _warm_training_processes() -> Iterator[None]:
    """Sessions in the test process start their training processes warm."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("headway_launch.runner.training_process.get_context", lambda method: WarmContext())
        yield


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of the test, with nothing in it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


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
    """Store with a study `pair` of trained runs: two seeds and two rules, with energy.

    CodeCarbon takes longer to start than these runs take to train, so the session waits for it.
    """
    root = tmp_path_factory.mktemp("trained")
    start = EnergyMeter.start

    def start_and_wait(config: EnergyConfig) -> EnergyMeter:
        meter = start(config)
        meter.wait()
        return meter

    words = ["experiment=toy_tracking", "study=pair", "seed=0,1", "env_steps=3000", "evaluation.every=1"]
    words += ["energy.interval_s=1", f"store.root={root}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EnergyMeter, "start", start_and_wait)
        assert run(["run", *words]) == 0
    return root
