"""Every notebook runs in an empty store, trains what it reads, and shows its pictures."""

from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
PICTURES = {
    "a_study_from_start_to_finish": 2,  # learning curves, performance profiles
    "where_does_the_energy_go": 2,  # footprint, reward against energy
    "how_real_are_the_buses": 4,  # map, time and space, loads, headways along the route
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shared, so that the second notebook finds what the first has trained."""
    return tmp_path_factory.mktemp("notebooks") / "runs"


def test_all_notebooks_are_named_here() -> None:
    assert {path.stem for path in (PROJECT / "notebooks").glob("*.ipynb")} == set(PICTURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_a_notebook_runs_and_shows_its_pictures(
    name: str, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
