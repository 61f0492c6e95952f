"""Trial: a study as Slurm jobs equals that on one machine: `headway sweep --slurm` on a Slurm of two nodes.

    python -m tests.trials.slurm_jobs --root FOLDER

starts munge, a controller and two nodes, each in its own network namespace, with all files in a temporary
folder. It runs the scripts that the command writes for a Ray cluster over both nodes and for an array of
seeds, then one whose trainings fail and one that is cancelled; `--turn` chooses some of these. Prints the
differences from the study trained here with worker processes, and anything of Ray left on a node; exits with
code 1 if there is either, or 2 without Slurm (Debian: slurmctld slurmd slurm-client munge) or namespaces.
"""

import argparse
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from headway.contracts import HeadwayError
from headway.rollout.workers.ray_cluster import require_ray
from headway.store.index import RunIndex
from headway.store.tracking.sync import sync_each
from tests.trials.hosts import Host, two_hosts
from tests.trials.processes import words_of
from tests.trials.same_study import differences
from tests.trials.two_nodes import SMALL, end_by_signal, headway, train_here, until

STUDY = "slurm_jobs"
_PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
_CONFIGURATION = """\
ClusterName=trial
SlurmctldHost={host}({one.address})
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
SlurmUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool.%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
KillWait=60
NodeName=node1 NodeHostname={host} NodeAddr={one.address} CPUs=2
NodeName=node2 NodeHostname={host} NodeAddr={other.address} CPUs=2
PartitionName=trial Nodes=ALL Default=YES State=UP
"""
_READY_S = 60.0
_POLL_S = 0.5
"""Time between questions about a job, each of which starts a program of Slurm."""
_ENDED = ("COMPLETED", "FAILED", "CANCELLED", "TIMEOUT", "NODE_FAIL", "BOOT_FAIL", "OUT_OF_MEMORY")


@dataclass(frozen=True)
class Slurm:
    """A Slurm of two nodes, with commands run on the first."""

    hosts: tuple[Host, Host]
    environment: dict[str, str]
    folders: tuple[Path, Path]
    """Folder of Ray's temporary files on each node."""

    def ask(self, *command: str) -> str:
        """Return the output of a Slurm program. Raises HeadwayError if it fails."""
        with tempfile.TemporaryDirectory() as folder:
            told, errors = Path(folder, "out"), Path(folder, "err")
            code = self.hosts[0].start(command, self.environment, told, errors).wait(_READY_S)
            if code:
                raise HeadwayError(f"{command[0]} ends with code {code}: {errors.read_text().strip()}")
            return told.read_text()

    def submit(self, script: Path) -> str:
        """Submit a script and return its job id."""
        return self.ask("sbatch", "--parsable", str(script)).strip()

    def states(self, job: str) -> list[str]:
        """Return the states of a job's tasks, or of the job."""
        words = self.ask("scontrol", "--oneliner", "show", "job", job).split()
        return [word.removeprefix("JobState=") for word in words if word.startswith("JobState=")]

    def end(self, job: str) -> str:
        """Wait for the end of a job and return its final states."""
        until(lambda: all(state in _ENDED for state in self.states(job)), _POLL_S)
        return " ".join(sorted(set(self.states(job))))

    def nodes_with_ray(self) -> int:
        """Return the number of nodes on which Ray has session files now."""
        return sum(any(folder.glob("headway-ray-*/session_*")) for folder in self.folders)

    def left(self) -> list[str]:
        """Return a line per file that Ray has left on a node, and per process of Ray or Python."""
        files = [path.name for folder in self.folders for path in folder.iterdir()]
        running = [words_of(process) for host in self.hosts for process in host.processes()]
        # Match whole words, because a random folder name may contain "ray".
        processes = [words for words in running if re.search(r"\bray\b|python", words)]
        return [f"left on a node: {thing}" for thing in (*files, *processes)]


def main() -> None:
    """Run the trial; see the module."""
    parser = argparse.ArgumentParser(description="Train as Slurm jobs, and compare with one machine.")
    parser.add_argument("--root", type=Path, required=True, help="an empty folder for the stores")
    parser.add_argument("--steps", default="2000", help="environment steps of each seed")
    parser.add_argument("--turn", action="append", choices=TURNS, help="may be repeated; default: all")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="further overrides of the sweep")
    arguments = parser.parse_args()
    sweep = [*SMALL, f"study={STUDY}", f"env_steps={arguments.steps}", *arguments.overrides]
    signal.signal(signal.SIGTERM, end_by_signal)
    try:
        with slurm() as jobs:
            found = trial(jobs, arguments.root, sweep, arguments.turn or tuple(TURNS))
    except HeadwayError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print("\n".join(found) or "the study as Slurm jobs equals that on one machine: curves, store and MLflow")
    sys.exit(1 if found else 0)


def trial(jobs: Slurm, root: Path, sweep: Sequence[str], turns: Sequence[str]) -> list[str]:
    """Return the differences between a study trained here and as Slurm jobs in each of `turns`.

    Raises HeadwayError if Ray is missing, or a job cannot be submitted.
    """
    require_ray()
    train_here(root / "alone", sweep)
    sync_each(root / "alone")
    return [f"{name}: {line}" for name in turns for line in TURNS[name](jobs, root / name, sweep)]


def _cluster(jobs: Slurm, root: Path, sweep: Sequence[str]) -> list[str]:
    """Train on a Ray cluster over both nodes; return the differences and what is left on the nodes."""
    return _complete(jobs, root, sweep, ["--nodes=2", "--cpus=2"])


def _array(jobs: Slurm, root: Path, sweep: Sequence[str]) -> list[str]:
    """Train each seed as a task of an array; return the differences and what is left on the nodes."""
    return _complete(jobs, root, sweep, ["--array", "--cpus=2"])


def _complete(jobs: Slurm, root: Path, sweep: Sequence[str], options: Sequence[str]) -> list[str]:
    script = _written(root, sweep, options)
    state = jobs.end(jobs.submit(script))
    print(f"{root.name}: {state}", flush=True)
    if state != "COMPLETED":
        return [*jobs.left(), state, *_told(script)]
    sync_each(root)
    return [*jobs.left(), *differences(root.parent / "alone", root)]


def _written(root: Path, sweep: Sequence[str], options: Sequence[str]) -> Path:
    """Write the script of a sweep and return its path."""
    command = [*headway(sweep, root), "--slurm", *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return Path(done.stdout.rstrip("\n"))


def _told(script: Path) -> list[str]:
    """Return the last lines of the logs of a script's jobs."""
    logs = sorted(script.parent.glob("*.out"))
    return [f"{log.name}: {line}" for log in logs for line in log.read_text().splitlines()[-5:]]


def _fail(jobs: Slurm, root: Path, sweep: Sequence[str]) -> list[str]:
    """Run a job on one node whose trainings diverge; return what it leaves there."""
    script = _written(root, [*sweep, "seed=0", "algo.lr=1e30"], ["--nodes=1", "--cpus=2"])
    job = jobs.submit(script)
    there: list[int] = []

    def ended() -> bool:
        there.append(jobs.nodes_with_ray())
        return jobs.states(job)[0] in _ENDED

    until(ended, _POLL_S)
    [state] = jobs.states(job)
    print(f"failed: {state}", flush=True)
    failed = state == "FAILED" and {row.status for row in RunIndex(root).rows()} == {"FAILED"}
    if not failed or max(there) != 1:
        return [f"it ended as {state}, not by trainings that failed on one node", *_told(script)]
    return jobs.left()


def _cancel(jobs: Slurm, root: Path, sweep: Sequence[str]) -> list[str]:
    """Cancel a job that trains on both nodes; return what it leaves on them."""
    script = _written(root, [*sweep, "seed=0", "env_steps=1e8"], ["--nodes=2", "--cpus=2"])
    job = jobs.submit(script)
    until(lambda: bool(RunIndex(root).rows()) or jobs.states(job)[0] in _ENDED)
    there = jobs.nodes_with_ray()
    jobs.ask("scancel", job)
    state = jobs.end(job)
    print(f"cancelled: {state}", flush=True)
    if there < len(jobs.folders) or state != "CANCELLED":
        return [f"it ended as {state} before both nodes had files of Ray's", *_told(script)]
    statuses = {row.status for row in RunIndex(root).rows()}
    if statuses != {"KILLED"}:
        return [f"its runs are {' and '.join(sorted(statuses))}, not KILLED", *_told(script)]
    return jobs.left()


TURNS: dict[str, Callable[[Slurm, Path, Sequence[str]], list[str]]] = {
    "cluster": _cluster, "array": _array, "failed": _fail, "cancelled": _cancel,
}  # fmt: skip


@contextmanager
def slurm() -> Iterator[Slurm]:
    """Start a Slurm of two nodes with two CPUs each, and end it with all its jobs. Raises HeadwayError if it
    cannot be started."""
    missing = [program for program in _PROGRAMS if shutil.which(program) is None]
    if missing:
        raise HeadwayError(
            f"{missing[0]} is not installed: apt-get install slurmctld slurmd slurm-client munge"
        )
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="headway-slurm-")))
        one, other = stack.enter_context(two_hosts())
        for name in ("munge", "state"):
            (folder / name).mkdir(mode=0o700)
        key = folder / "munge" / "key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o400)
        places = {"folder": folder, "host": socket.gethostname(), "one": one, "other": other}
        (folder / "slurm.conf").write_text(_CONFIGURATION.format(**places))
        # Ray puts sockets there, whose paths must be short.
        rays = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ray-", dir="/tmp")))
        folders = folder / "ray-of-the-first", folder / "ray-of-the-second"
        for place in folders:
            place.mkdir()
        environment = {"SLURM_CONF": str(folder / "slurm.conf"), "HEADWAY_RAY_TMP": str(rays)}
        munge = [
            f"--{name}={folder}/munge/{name}" for name in ("socket", "pid-file", "log-file", "seed-file")
        ]
        told = folder / "told.out"
        for host, command in (
            (one, ["munged", "--foreground", "--force", f"--key-file={key}", *munge]),
            (one, ["slurmctld", "-D"]),
            (one, [*_with(folders[0], rays), "slurmd", "-D", "-N", "node1"]),
            (other, [*_with(folders[1], rays), "slurmd", "-D", "-N", "node2"]),
        ):
            host.start(command, environment, told, told)
        found = Slurm((one, other), environment, folders)
        _until_idle(found, told)
        yield found


def _with(folder: Path, place: Path) -> list[str]:
    """Return a command prefix that mounts `folder` at `place` for the command only."""
    return [
        "unshare", "--mount", "sh", "-c", 'mount --bind "$0" "$1" && shift && exec "$@"', str(folder),
        str(place),
    ]  # fmt: skip


def _until_idle(found: Slurm, told: Path) -> None:
    deadline = time.monotonic() + _READY_S
    while True:
        try:
            if found.ask("sinfo", "--noheader", "--format=%T %D").split() == ["idle", "2"]:
                return
            reason = "its nodes do not answer"
        except HeadwayError as error:
            reason = str(error)
        if time.monotonic() > deadline:
            last = told.read_text().splitlines()[-1:]
            raise HeadwayError(f"Slurm cannot be started here: {reason} {' '.join(last)}".strip())
        time.sleep(0.5)


if __name__ == "__main__":
    main()
