"""Every notebook runs in an empty store, trains what it reads, and shows its pictures."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
PICTURES = {
    "first_steps": 1,  # learning curves
    "a_study_from_start_to_finish": 2,  # learning curves, performance profiles
    "where_does_the_energy_go": 2,  # footprint, reward against energy
    "how_real_are_the_buses": 4,  # map, time and space, loads, headways along the route
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shared, so that the second notebook finds what the first has trained."""
    return tmp_path_factory.mktemp("notebooks") / "runs"


def test_the_first_cell_installs_what_lies_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = json.loads((PROJECT / "notebooks" / "first_steps.ipynb").read_text(encoding="utf-8"))
    source = "".join(next(cell["source"] for cell in notebook["cells"] if cell["cell_type"] == "code"))
    commands: list[list[str]] = []
    monkeypatch.setattr(subprocess, "run", lambda command, check: commands.append(command))
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    exec(source, {})
    assert commands == []  # Headway is installed here
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match="upload its wheel beside this notebook, or set `source`"):
        exec(source, {})
    (tmp_path / "pyproject.toml").touch()
    exec(source, {})
    Path("headway-0.1.0-py3-none-any.whl").touch()
    exec(source, {})
    assert [command[-1] for command in commands] == ["..", "headway-0.1.0-py3-none-any.whl"]
    assert all(command[:4] == [sys.executable, "-m", "pip", "install"] for command in commands)


def test_all_notebooks_are_named_here() -> None:
    assert {path.stem for path in (PROJECT / "notebooks").glob("*.ipynb")} == set(PICTURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_a_notebook_runs_and_shows_pictures(name: str, store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import nbformat  # takes as long as torch, and every test process collects this file
    from nbclient import NotebookClient

    monkeypatch.setenv("HEADWAY_STORE", str(store))
    monkeypatch.setenv("HEADWAY_ENV_STEPS", "6_000")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    path = PROJECT / "notebooks" / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(not cell.outputs for cell in cells), "committed with outputs"
    NotebookClient(notebook, timeout=400, resources={"metadata": {"path": path.parent}}).execute()
    shown = [output for cell in cells for output in cell.outputs if "image/png" in output.get("data", {})]
    assert len(shown) == PICTURES[name]
