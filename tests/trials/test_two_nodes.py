"""A study on two nodes equals that on one machine, even if one fails; small version of the trial."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest
from ray_processes import assert_gone, ray_processes

from headway.contracts import HeadwayError
from tests.trials import hosts, two_nodes
from tests.trials.hosts import two_hosts
from tests.trials.two_nodes import SMALL, STUDY, TURNS, trial

SWEEP = (
    *SMALL, f"study={STUDY}", "env_steps=6144", "backend.workers=2", "store.checkpoint_every=2",
    "evaluation.rules=[]", "evaluation.modes=[greedy]", "energy=off",
)  # fmt: skip


def _without_namespaces() -> str:
    """Return why namespaces cannot be created here; empty if they can."""
    try:
        with two_hosts():
            return ""
    except HeadwayError as error:
        return str(error)


def _list() -> str:
    return subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout


def _of_this_process() -> str:
    """Return how the names of this process's namespaces begin: other tests may have some at the same time."""
    return hosts._NAME.format(process=os.getpid(), place="")


@pytest.fixture
def namespaces() -> None:
    if reason := _without_namespaces():
        pytest.skip(reason)


@pytest.mark.cluster
@pytest.mark.skipif(find_spec("ray") is None, reason='Ray is not installed: pip install "headway[ray]"')
@pytest.mark.usefixtures("namespaces")
def test_a_study_with_a_node_cut_off_equals_that_on_one_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = ray_processes()
    assert trial(tmp_path, SWEEP, {"runs-cut-off": TURNS["runs-cut-off"]}) == []
    assert capsys.readouterr().out.count("the cut-off actors resumed") == 1
    assert_gone(before)
    assert _of_this_process() not in _list()


@pytest.mark.cluster
@pytest.mark.usefixtures("namespaces")
def test_processes_end_with_their_host_and_hosts_of_killed_processes_are_removed(tmp_path: Path) -> None:
    told = tmp_path / "told"
    with two_hosts() as (one, other):
        sleeping = other.start(["sleep", "600"], {}, told, told)
        assert one.start(["bash", "-c", f"exec 3<>/dev/tcp/{other.address}/1"], {}, told, told).wait(60)
        assert "refused" in told.read_text()
        # It begins as nsenter, which becomes the command.
        two_nodes.until(lambda: [process.name() for process in other.processes()] == ["sleep"])
        assert one.processes() == []
        other.cut_off()
        assert sleeping.poll() is None
    assert not psutil.pid_exists(sleeping.pid)
    left = hosts._NAME.format(process=2**22 + 1, place=1)  # no process has this number
    subprocess.run(["ip", "netns", "add", left], check=True)
    with two_hosts():
        assert left not in _list()
    assert _of_this_process() not in _list()


def test_missing_namespaces_are_one_error_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["two_nodes", "--root", str(tmp_path / "stores")])
    monkeypatch.setattr(two_nodes, "require_ray", lambda: None)
    with pytest.raises(SystemExit) as end:
        two_nodes.main()
    assert end.value.code == 2
    assert capsys.readouterr() == (
        "",
        "network namespaces need the program ip, which is not installed: apt-get install iproute2\n",
    )
    assert not (tmp_path / "stores").exists()
