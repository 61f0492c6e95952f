"""The wheel, installed outside a checkout, is enough with the packages that it requires for all commands but
`headway browse`, which names its extra."""

import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Callable
from pathlib import Path

import pytest
from linked_packages import SOURCES, link_packages, requirements

ROOT = Path(__file__).resolve().parents[1]
SMALL = ("seed=0", "env_steps=256", "rollout.copies=4", "rollout.block=2", "rollout.steps=16")
Headway = Callable[..., subprocess.CompletedProcess[str]]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def headway(tmp_path_factory: pytest.TempPathFactory) -> Headway:
    """The command `headway` of an environment with the wheel and what it requires, run in an empty folder."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", folder, ROOT], check=True)
    [wheel] = folder.glob("headway-*.whl")
    venv.create(folder / "venv", symlinks=True)
    python = folder / "venv" / "bin" / "python"
    install = [*pip, "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel]
    subprocess.run(install, check=True)
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    packages = folder / "venv" / "lib" / version / "site-packages"
    (folder / "required").mkdir()
    link_packages(folder / "required", requirements("headway"))
    # A line of a .pth file adds a folder without reading the .pth files in it.
    (packages / "required.pth").write_text(f"{folder / 'required'}\n")
    _take_compiled_kernels(packages)
    empty = folder / "empty"
    empty.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def command(*words: str) -> subprocess.CompletedProcess[str]:
        line = [str(python.with_name("headway")), *words]
        return subprocess.run(
            line, cwd=empty, env=environment, capture_output=True, text=True, timeout=300, check=False
        )

    where = subprocess.run(
        [python, "-c", "import headway_launch; print(headway_launch.__file__)"],
        cwd=empty, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(where.stdout.strip()).is_relative_to(packages)
    return command


def _take_compiled_kernels(packages: Path) -> None:
    """Copy the checkout's compiled kernels, which Numba takes if the source has the same size and time."""
    for source in (Path(folder) for folder in SOURCES):
        for compiled in (*source.rglob("*.nb[ci]"), *source.rglob("kernel.stamp")):
            place = packages / compiled.relative_to(source)
            place.parent.mkdir(exist_ok=True)
            shutil.copy2(compiled, place)
        for module in source.rglob("*.py"):
            if (installed := packages / module.relative_to(source)).exists():
                shutil.copystat(module, installed)


def _shown(ended: subprocess.CompletedProcess[str]) -> str:
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_the_requirements_of_the_wheel_suffice_for_all_but_browse(headway: Headway, tmp_path: Path) -> None:
    """The experiment is from a folder outside the checkout."""
    (tmp_path / "experiment").mkdir()
    mine = "defaults: [override /algo: ippo]\nstudy: mine\nenv: {id: trivial}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(mine)
    assert "FINISHED" in _shown(headway("run", "--config-dir", str(tmp_path), "experiment=mine", *SMALL))
    assert "FINISHED" in _shown(headway("runs", "--study", "mine"))
    assert "optimal" in _shown(headway("compare", "mine"))
    assert "optimal" in _shown(headway("evaluate", "trivial", "--episodes", "2"))
    assert _shown(headway("report", "mine")).strip().endswith(".html")
    assert _shown(headway("export", "trivial")).strip().endswith(".npz")
    assert "toy_trivial" in _shown(headway("list", "experiments"))
    _shown(headway("sync"))
    refused = headway("browse")
    assert refused.returncode == 2
    assert refused.stderr.strip().endswith('pip install "headway[browse]"')
