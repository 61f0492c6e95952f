"""`headway sweep --slurm` writes a script that bash reads, of what was asked, and trains nothing."""

import shlex
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest

from headway.contracts import HeadwayError
from headway_launch.commands.main import run
from headway_launch.runner.cluster.ray_nodes import wait_for_nodes

SWEEP = ("sweep", "env=visitors", "algo=ippo,ia2c", "study=a study", "seed=3,5..6")


@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_nodes_that_do_not_come_are_told_of() -> None:
    with pytest.raises(HeadwayError, match=r"^after 0.1 s: .*127.0.0.1:1 \(Connection refused\)"):
        wait_for_nodes("127.0.0.1:1", 2, patience_s=0.1)


def test_without_ray_nodes_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway.rollout.workers.ray_cluster.find_spec", lambda name: None)
    monkeypatch.setattr("time.sleep", lambda _: pytest.fail("it waited"))
    with pytest.raises(HeadwayError, match=r"^backend=ray needs Ray, which is an extra"):
        wait_for_nodes("127.0.0.1:1", 2)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def _written(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[Path, list[str]]:
    assert run([*SWEEP, "--slurm", *words]) == 0
    told = capsys.readouterr()
    path = Path(told.out.strip())
    assert told.err.endswith(f"with: sbatch {path}\n")
    subprocess.run(["bash", "-n", path], check=True)
    return path, path.read_text().splitlines()


def _asked(lines: list[str]) -> list[str]:
    return [line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH ")]


def _variable(lines: list[str], name: str) -> list[str]:
    """As bash reads it."""
    [line] = [line for line in lines if line.startswith(f"{name}=(")]
    return shlex.split(line.removeprefix(f"{name}=(").removesuffix(")"))


def test_a_cluster_in_the_allocation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    further = ("--time", "2-00", "--partition", "short,long", "--sbatch=--mem=8G", "--sbatch=--gpus=1")
    path, lines = _written(capsys, "--nodes", "4", "--cpus", "32", *further)
    assert path == tmp_path / "runs" / "a-study" / "slurm" / "cluster.sbatch"
    assert _asked(lines) == [
        "--job-name=headway-a-study",
        "--nodes=4",
        "--ntasks-per-node=1",
        "--cpus-per-task=32",
        f"--output={path.parent}/%j.out",
        "--signal=B:TERM@300",
        "--time=2-00",
        "--partition=short,long",
        "--mem=8G",
        "--gpus=1",
    ]
    assert _variable(lines, "overrides") == [*SWEEP[1:], "backend=ray"]
    assert not list((tmp_path / "runs").rglob("run.json"))


def test_an_array_of_seeds(capsys: pytest.CaptureFixture[str]) -> None:
    _, lines = _written(capsys, "--array", "--cpus", "8")
    assert "--array=0-2" in _asked(lines)
    assert _variable(lines, "seeds") == ["3", "5", "6"]
    assert _variable(lines, "overrides") == ["env=visitors", "algo=ippo,ia2c", "study=a study"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--nodes", "2"), "--nodes is for Slurm: give --slurm with it"),
        (("--array",), "--array is for Slurm: give --slurm with it"),
        (("--slurm", "--nodes", "0"), "--nodes must be at least 1, not 0"),
        (
            ("--slurm", "--time", "soon"),
            "--time must be as Slurm's, such as 90, 12:00:00 or 2-00, not 'soon'",
        ),
        (("--slurm", "--partition", "a b"), "--partition must be the name of one, not 'a b'"),
        (
            ("--slurm", "--sbatch", "x"),
            "--sbatch takes an option of sbatch, such as --mem=8G or '--comment=\"a b\"', not 'x'",
        ),
        (
            ("--slurm", "--sbatch=--mem=8G --gpus=1"),
            "--sbatch takes an option of sbatch, such as --mem=8G or '--comment=\"a b\"', "
            "not '--mem=8G --gpus=1'",
        ),
        (
            ("--slurm", "--sbatch=--time=5", "--time", "9"),
            "--sbatch=--time=5: --time is the script's (give --time)",
        ),
        (("--slurm", "--sbatch=--tim=5"), "--sbatch=--tim=5: --time is the script's (give --time)"),
        (("--slurm", "--sbatch=-N4"), "--sbatch=-N4: --nodes is the script's (give --nodes)"),
        (
            ("--slurm", "--sbatch=-o here"),
            "--sbatch=-o here: --output is the script's (it lies beside the script)",
        ),
        (
            ("--slurm", "--array", "--sbatch=--array=0-9%2"),
            "--sbatch=--array=0-9%2: --array is the script's (give --array)",
        ),
        (
            ("--slurm", "--sbatch=--comment=HetJobs"),
            "--sbatch=--comment=HetJobs: sbatch cuts 'hetjob' out of a script; leave it out here, and give "
            "it to sbatch itself",
        ),
        (
            ("--slurm", "--partition=packjobs"),
            "--partition=packjobs: sbatch cuts 'packjob' out of a script; leave it out here, and give it to "
            "sbatch itself",
        ),
        (
            ("--slurm", "backend=process"),
            "backend=process: the script starts a Ray cluster; leave it out, or give --array, which has none",
        ),
        (
            ("--slurm", "++backend.name=serial"),
            "++backend.name=serial: the script starts a Ray cluster; leave it out, or give --array, "
            "which has none",
        ),
        (
            ("--slurm", "backend=ray", "backend.address=head:6379"),
            "backend.address=head:6379: the script starts a Ray cluster of its own; leave it out",
        ),
        (
            ("--slurm", "--array", "--nodes", "2"),
            "with --array each seed has one node: leave --nodes out, or --array",
        ),
        (
            ("--slurm", "--dry-run"),
            "--slurm goes on where the store stops: leave --dry-run and --fresh out",
        ),
    ],
)
def test_what_cannot_be_is_one_line(
    words: tuple[str, ...], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*SWEEP, *words]) == 2
    assert capsys.readouterr().err == f"headway: {line}\n"
    assert not list(tmp_path.iterdir())


def test_what_sbatch_reads_is_held_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its way of reading a line is the shell's, but that `%` is replaced in the name of the output."""
    words = ('--sbatch=--comment="a #1"', "--sbatch=-A ours", "store.root='a store, 50%/b\"c'")
    assert run([*SWEEP, "--slurm", "--array", "backend=process", *words]) == 0
    told = capsys.readouterr()
    path = Path(told.out.strip())
    assert path == tmp_path / "a store, 50%" / 'b"c' / "a-study" / "slurm" / "array.sbatch"
    subprocess.run(["bash", "-n", path], check=True)
    [*_, submitted] = shlex.split(told.err)
    assert submitted == str(path)
    asked = [shlex.split(line, comments=True) for line in _asked(path.read_text().splitlines())]
    output = str(path.parent).replace("%", "%%")
    assert [f"--output={output}/%A-%a.out"] in asked
    assert ["--comment=a #1"] in asked
    assert ["-A", "ours"] in asked


@pytest.mark.parametrize("name", ["a\\\\b", "Packjobs"])
def test_a_folder_that_sbatch_cannot_be_told_is_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*SWEEP, "--slurm", f"store.root='{name}'"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("headway: sbatch cannot write to a folder with ")
    assert told.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_an_array_of_cells_of_different_seeds_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cells = ("sweep", "experiment=toy_trivial,matrix_nine", "study=both", "--slurm", "--array")
    assert run(cells) == 2
    line = "with --array all cells have the same seeds: give seed=..., or leave --array out"
    assert capsys.readouterr().err == f"headway: {line}\n"
    assert not list(tmp_path.iterdir())
    assert run([*cells, "seed=0..2"]) == 0


def test_a_sweep_that_cannot_be_is_refused_now_and_not_by_the_job(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*SWEEP, "algo.learning=1", "--slurm"]) == 2
    assert "learning" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
