"""Every notebook runs, on a store made by a real, small experiment."""

import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

PROJECT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((PROJECT / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("store")
    command = [sys.executable, "-m", "headway_launch", "run", "experiment=toy_tracking", "seed=0,1"]
    small = ["env_steps=4096", "energy.interval_s=1", f"store.root={root}", "backend=serial"]
    subprocess.run([*command, *small], check=True, cwd=PROJECT, capture_output=True, timeout=600)
    return root


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: str(path.stem))
def test_notebook_runs(path: Path, store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HEADWAY_STORE", str(store))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=240, resources={"metadata": {"path": path.parent}}).execute()
    assert all(
        not cell.outputs for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"
    )
