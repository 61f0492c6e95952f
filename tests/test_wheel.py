"""The wheel, installed outside a checkout: what it contains is enough to train and to export."""

import os
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SMALL = ("seed=0", "env_steps=256", "rollout.copies=4", "rollout.block=2", "rollout.steps=16", "energy=off")
Headway = Callable[..., str]


@pytest.fixture(scope="module")
def headway(tmp_path_factory: pytest.TempPathFactory) -> Headway:
    """The command `headway` of a virtual environment that has the wheel, run in an empty folder.

    All other packages are those of this environment, without its editable installation of the checkout.
    """
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
    # A line of a .pth file adds a folder without reading the .pth files in it.
    (packages / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    empty = folder / "empty"
    empty.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def command(*words: str) -> str:
        line = [str(python.with_name("headway")), *words]
        ended = subprocess.run(
            line, cwd=empty, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    where = subprocess.run(
        [python, "-c", "import headway_launch; print(headway_launch.__file__)"],
        cwd=empty, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert Path(where.stdout.strip()).is_relative_to(packages)
    return command


@pytest.mark.slow
def test_a_committed_experiment_is_trained_and_its_policy_exported(headway: Headway) -> None:
    assert "FINISHED" in headway("run", "experiment=toy_trivial", *SMALL)
    assert headway("export", "trivial").strip().endswith(".npz")
    assert "toy_trivial" in headway("list", "experiments")


@pytest.mark.slow
def test_a_folder_of_experiments_outside_the_checkout_is_used(headway: Headway, tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    mine = "defaults: [override /algo: ippo]\nstudy: mine\nenv: {id: tracking, args: {steps: 8}}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(mine)
    assert "FINISHED" in headway("run", "--config-dir", str(tmp_path), "experiment=mine", *SMALL)
    assert "mine" in headway("runs", "--study", "mine")
