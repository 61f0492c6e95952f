"""`headway sweep --slurm` writes a valid bash script with the requested options and trains nothing."""

import shlex
import subprocess
from importlib.util import find_spec
from pathlib import Path

import pytest
from command_lines import output, refused

from headway.contracts import HeadwayError
from headway_launch.commands.main import run
from headway_launch.runner.cluster import ray_nodes
from headway_launch.runner.cluster.ray_nodes import wait_for_nodes

pytestmark = pytest.mark.usefixtures("empty_folder")
SWEEP = ("sweep", "env=visitors", "algo=ippo,ia2c", "study=a study", "seed=3,5..6")


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
def test_missing_nodes_are_an_error_after_the_timeout() -> None:
    refused = r"^after 0.1 s: .*127.0.0.1:1 \(Connection refused\)"
    with pytest.raises(HeadwayError, match=refused):
        wait_for_nodes("127.0.0.1:1", 2, patience_s=0.1)
    with pytest.raises(HeadwayError, match=refused):
        wait_for_nodes("127.0.0.1:1", patience_s=0.1)


@pytest.mark.parametrize(("words", "waited"), [([], ["head"]), (["3"], ["head", "nodes"] * 3)])
def test_the_command_waits_for_the_head_or_for_nodes(
    words: list[str], waited: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cluster here answers at once and has one more node at each poll."""
    steps: list[str] = []

    def nodes_of(address: str) -> int:
        steps.append("nodes")
        return steps.count("nodes")

    monkeypatch.setattr(ray_nodes, "require_ray", lambda: None)
    monkeypatch.setattr(ray_nodes, "require_answer", lambda address: steps.append("head"))
    monkeypatch.setattr(ray_nodes, "_nodes_of", nodes_of)
    monkeypatch.setattr("time.sleep", lambda _: None)
    monkeypatch.setattr("sys.argv", ["ray_nodes", "host:1", *words])
    ray_nodes.main()
    assert steps == waited


def test_without_ray_waiting_for_nodes_fails_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("headway.rollout.workers.ray_cluster.find_spec", lambda name: None)
    monkeypatch.setattr("time.sleep", lambda _: pytest.fail("it waited"))
    with pytest.raises(HeadwayError, match=r"^backend=ray needs Ray, which is an extra"):
        wait_for_nodes("127.0.0.1:1", 2)


def _written(*words: str) -> tuple[Path, list[str]]:
    shown = output(*SWEEP, "--slurm", *words)
    path = Path(shown.out.strip())
    assert shown.err.endswith(f"with: sbatch {path}\n")
    subprocess.run(["bash", "-n", path], check=True)
    return path, path.read_text().splitlines()


def _options(lines: list[str]) -> list[str]:
    return [line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH ")]


def _variable(lines: list[str], name: str) -> list[str]:
    """Return the elements of an array variable as bash reads them."""
    [line] = [line for line in lines if line.startswith(f"{name}=(")]
    return shlex.split(line.removeprefix(f"{name}=(").removesuffix(")"))


def test_a_cluster_in_the_allocation(tmp_path: Path) -> None:
    further = ("--time", "2-00", "--partition", "short,long", "--sbatch=--mem=8G", "--sbatch=--gpus=1")
    path, lines = _written("--nodes", "4", "--cpus", "32", *further)
    assert path == tmp_path / "runs" / "a-study" / "slurm" / "cluster.sbatch"
    assert _options(lines) == [
        "--job-name=headway-a-study", "--nodes=4", "--ntasks-per-node=1", "--cpus-per-task=32",
        f"--output={path.parent}/%j.out", "--signal=B:TERM@300", "--time=2-00", "--partition=short,long",
        "--mem=8G", "--gpus=1",
    ]  # fmt: skip
    assert _variable(lines, "overrides") == [*SWEEP[1:], "backend=ray"]
    assert not list((tmp_path / "runs").rglob("run.json"))


def test_an_array_of_seeds() -> None:
    _, lines = _written("--array", "--cpus", "8")
    assert "--array=0-2" in _options(lines)
    assert _variable(lines, "seeds") == ["3", "5", "6"]
    assert _variable(lines, "overrides") == ["env=visitors", "algo=ippo,ia2c", "study=a study"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--nodes", "2"), "--nodes needs --slurm"),
        (("--array",), "--array needs --slurm"),
        (("--slurm", "--nodes", "0"), "--nodes must be at least 1, not 0"),
        (
            ("--slurm", "--time", "soon"),
            "--time must be in Slurm's format, such as 90, 12:00:00 or 2-00, not",
        ),
        (("--slurm", "--partition", "a b"), "--partition must be the name of a partition, not 'a b'"),
        (("--slurm", "--sbatch", "x"), "--sbatch takes one option of sbatch, such as --mem=8G or"),
        (("--slurm", "--sbatch=--mem=8G --gpus=1"), "--sbatch takes one option of sbatch, such as --mem=8G"),
        (("--slurm", "--sbatch=--tim=5"), "--sbatch=--tim=5: the script sets --time itself; give --time"),
        (("--slurm", "--sbatch=-N4"), "--sbatch=-N4: the script sets --nodes itself; give --nodes"),
        (("--slurm", "--sbatch=-o x"), "--sbatch=-o x: the script sets --output itself; the log lies beside"),
        (("--slurm", "--array", "--sbatch=--array=0-9%2"), "--sbatch=--array=0-9%2: the script sets --array"),
        (
            ("--slurm", "--sbatch=--comment=HetJobs"),
            "HetJobs: sbatch removes 'hetjob' from scripts; leave it",
        ),
        (("--slurm", "--partition=packjobs"), "--partition=packjobs: sbatch removes 'packjob' from scripts;"),
        (
            ("--slurm", "backend=process"),
            "backend=process: the script starts a Ray cluster; leave the override",
        ),
        (
            ("--slurm", "++backend.name=serial"),
            "++backend.name=serial: the script starts a Ray cluster; leave",
        ),
        (("--slurm", "backend=ray", "backend.address=head:6379"), "the script starts its own Ray cluster;"),
        (
            ("--slurm", "--array", "--nodes", "2"),
            "with --array each seed runs on one node: leave out --nodes",
        ),
        (("--slurm", "algo.learning=1"), "learning"),
        (("--slurm", "--dry-run"), "--slurm cannot be combined with --dry-run or --fresh"),
    ],
)
def test_invalid_options_print_one_line(words: tuple[str, ...], line: str, tmp_path: Path) -> None:
    assert line in refused(*SWEEP, *words)
    assert not list(tmp_path.iterdir())


def test_option_values_are_quoted_for_sbatch(tmp_path: Path) -> None:
    """sbatch splits a line as the shell does; in the name of the output `%` starts a placeholder."""
    words = ('--sbatch=--comment="a #1"', "--sbatch=-A ours", "store.root='a store, 50%/b\"c'")
    shown = output(*SWEEP, "--slurm", "--array", "backend=process", *words)
    path = Path(shown.out.strip())
    assert path == tmp_path / "a store, 50%" / 'b"c' / "a-study" / "slurm" / "array.sbatch"
    subprocess.run(["bash", "-n", path], check=True)
    [*_, submitted] = shlex.split(shown.err)
    assert submitted == str(path)
    options = [shlex.split(line, comments=True) for line in _options(path.read_text().splitlines())]
    escaped = str(path.parent).replace("%", "%%")
    assert [f"--output={escaped}/%A-%a.out"] in options
    assert ["--comment=a #1"] in options
    assert ["-A", "ours"] in options


@pytest.mark.parametrize("name", ["a\\\\b", "Packjobs"])
def test_a_folder_name_that_sbatch_cannot_represent_prints_one_line(name: str, tmp_path: Path) -> None:
    line = refused(*SWEEP, "--slurm", f"store.root='{name}'")
    assert line.startswith("headway: sbatch cannot write to a folder with ")
    assert not list(tmp_path.iterdir())


def test_an_array_of_cells_of_different_seeds_is_refused(tmp_path: Path) -> None:
    cells = ("sweep", "experiment=toy_trivial,matrix_nine", "study=both", "--slurm", "--array")
    line = "with --array all cells must have the same seeds: give seed=..., or leave out --array"
    assert refused(*cells) == f"headway: {line}\n"
    assert not list(tmp_path.iterdir())
    assert run([*cells, "seed=0..2"]) == 0
