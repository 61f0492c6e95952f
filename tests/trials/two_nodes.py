"""Trial: a study on a Ray cluster of two nodes gives the curves and tables of one machine, even if a node
fails.

    python -m tests.trials.two_nodes --root FOLDER
    python -m tests.trials.two_nodes --root FOLDER --experiment bus_mappo --turn runs

The nodes are network namespaces joined by a virtual link only; they share this machine's files, as a cluster
shares a file system. A study is trained with worker processes, and then once per turn on a new cluster.
Prints the differences and exits with code 1 if there are any, or 2 if namespaces cannot be created (they need
root and `ip`).
"""

import argparse
import re
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Literal, NoReturn

import psutil

from headway.contracts import HeadwayError
from headway.rollout.workers.ray_cluster import require_ray
from headway.store.checkpoint import latest_iteration
from headway.store.index import RunIndex
from headway.store.run_folder import CHECKPOINTS, RunRecord
from headway.store.tracking.sync import sync_each
from tests.trials.hosts import Host, two_hosts
from tests.trials.processes import children_of, words_of, workers_of
from tests.trials.same_study import differences, results_of

STUDY = "two_nodes"
SMALL = (
    "env=visitors", "algo=ippo", "rollout.copies=4", "rollout.block=2", "rollout.steps=32",
    "evaluation.episodes=1", "evaluation.final_episodes=2", "store.checkpoint_every=10", "seed=0,1",
)  # fmt: skip
_PORT = 6379
_HEALTH = {
    "RAY_health_check_initial_delay_ms": "10000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "2000",
    "RAY_health_check_failure_threshold": "3",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "3600",
}
"""A silent node is given up after some seconds (Ray's default: up to a minute), and a node without contact to
the head stays alive (Ray's default: it ends after a minute)."""
_LOST = re.compile(r"seed (?P<seed>\d+): its training process was lost")
_TAKEN_OVER = "another training process has taken over"
"""Part of the message of a training process that may no longer write to its run."""
_TIMEOUT_S = 3600.0
_REPORT_S = 60.0
_POLL_S = 0.1
_MAX_RAY_STARTS = 3
"""Maximum number of starts of Ray, whose limit of half a minute can be too short on a busy machine."""


@dataclass(frozen=True)
class Turn:
    """A way to train the study on the cluster."""

    learners: Literal["here", "cluster"]
    """Value of `backend.learners`: the cluster runs workers only (`here`) or whole runs (`cluster`)."""
    failure: Literal["", "killed", "cut off"] = ""
    """Failure of the second node in mid-study."""

    @property
    def actor(self) -> str:
        """Process title of the Ray actors that do the work."""
        return "ray::TrainingHost" if self.learners == "cluster" else "ray::RayRolloutWorker"

    @property
    def loss_message(self) -> str:
        """Part of the line that a session prints when it has lost an actor."""
        return "restarted from its last checkpoint" if self.learners == "cluster" else "replaced, "


TURNS = {
    "workers": Turn("here"), "workers-killed": Turn("here", "killed"), "runs": Turn("cluster"),
    "runs-killed": Turn("cluster", "killed"), "runs-cut-off": Turn("cluster", "cut off"),
}  # fmt: skip


def main() -> None:
    """Run the trial; see the module."""
    parser = argparse.ArgumentParser(
        description="Train on two nodes in namespaces, and compare with one machine."
    )
    parser.add_argument("--root", type=Path, required=True, help="an empty folder for the stores")
    parser.add_argument("--experiment", help="a named experiment instead of a small one")
    parser.add_argument("--turn", action="append", choices=TURNS, help="may be repeated; default: all")
    parser.add_argument("--steps", default="40000", help="environment steps of each seed")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="further overrides of the sweep")
    arguments = parser.parse_args()
    base = SMALL if arguments.experiment is None else (f"experiment={arguments.experiment}",)
    sweep = [
        *base, f"study={STUDY}", f"env_steps={arguments.steps}", "backend.workers=2", *arguments.overrides,
    ]  # fmt: skip
    signal.signal(signal.SIGTERM, end_by_signal)  # so that everything is cleaned up
    try:
        found = trial(arguments.root, sweep, {name: TURNS[name] for name in arguments.turn or TURNS})
    except HeadwayError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(
        "\n".join(found)
        or "the study on two nodes equals that on one machine: curves, tables, store and MLflow"
    )
    sys.exit(1 if found else 0)


def trial(root: Path, sweep: Sequence[str], turns: dict[str, Turn]) -> list[str]:
    """Return the differences between a study on one machine and on the cluster in each turn.

    Raises HeadwayError if namespaces or Ray are missing, a session fails, or a turn tested nothing.
    """
    require_ray()
    with two_hosts():
        pass  # fail before the training, which takes long
    alone = root / "alone"
    table = train_here(alone, sweep)
    sync_each(alone)
    found: list[str] = []
    for name, turn in turns.items():
        began = time.monotonic()
        after, differ = _on_two_nodes(root / name, sweep, turn)
        sync_each(root / name)
        differ += differences(alone, root / name)
        if results_of(after) != results_of(table):
            differ.append(f"tables differ:\n{table}\n{after}")
        found += [f"{name}: {line}" for line in differ]
        print(f"{name}: {time.monotonic() - began:.0f} s, {len(differ)} differences", flush=True)
    return found


def train_here(root: Path, sweep: Sequence[str]) -> str:
    """Train on this machine and return the printed table."""
    command = headway(sweep, root)
    done = subprocess.run(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, check=False)
    if done.returncode:
        raise HeadwayError(f"{' '.join(command)} ends with code {done.returncode}")
    return done.stdout


def _on_two_nodes(root: Path, sweep: Sequence[str], turn: Turn) -> tuple[str, list[str]]:
    """Train on a cluster whose second node fails as `turn` sets; return the table and the errors found."""
    output, errors = root.with_suffix(".out"), root.with_suffix(".err")
    root.parent.mkdir(parents=True, exist_ok=True)
    with cluster() as nodes:
        address = f"backend.address={nodes.head.address}:{_PORT}"
        command = headway([*sweep, "backend=ray", address, f"backend.learners={turn.learners}"], root)
        session = nodes.head.start(command, nodes.environment, output, errors)
        there = _wait_until_working(session, root, nodes.node, turn, errors)
        found: list[str] = []
        if turn.failure == "killed":
            print(f"{nodes.node.kill()} processes of the second node are killed", flush=True)
        elif turn.failure == "cut off":
            found = _cut_off(session, root, nodes, turn, there, errors)
        session.wait(_TIMEOUT_S)
    if session.returncode:
        raise HeadwayError(f"the session ends with code {session.returncode}: {_last_line(errors)}")
    if turn.failure and turn.loss_message not in errors.read_text():
        raise HeadwayError("the session has not detected the loss of a node")
    return output.read_text(), found


@dataclass(frozen=True)
class Nodes:
    """A Ray cluster of two nodes."""

    head: Host
    node: Host
    environment: dict[str, str]
    """Environment variables of Ray on every node and in every driver."""
    folder: Path
    """Folder of Ray's temporary files, of both nodes."""

    def stderr_of(self, process: psutil.Process) -> str:
        """Return the stderr of a Ray process, from Ray's logs."""
        logs = self.folder.glob(f"session_*/logs/worker-*-{process.pid}.err")
        return "".join(log.read_text(errors="replace") for log in logs)


@contextmanager
def cluster() -> Iterator[Nodes]:
    """Start a Ray cluster: a head with room for everything, and a node with room for one run of two
    workers."""
    with (
        two_hosts() as (head, node),
        tempfile.TemporaryDirectory(prefix="headway-ray-nodes-", ignore_cleanup_errors=True) as folder,
    ):
        # A token is advisable for any cluster reachable over a network.
        environment = {
            "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_prestart_worker_first_driver": "0", **_HEALTH,
        }  # fmt: skip
        nodes = Nodes(head, node, environment, Path(folder))
        address = f"{head.address}:{_PORT}"
        told = Path(folder, "ray.out")
        as_head = ["--head", f"--port={_PORT}", f"--temp-dir={folder}"]
        _start_ray(
            head, environment, told, [*as_head, "--num-cpus=4", "--include-dashboard=false", "--no-monitor"]
        )
        _start_ray(node, environment, told, [f"--address={address}", "--num-cpus=2"])
        yield nodes


def _start_ray(host: Host, environment: dict[str, str], told: Path, words: Sequence[str]) -> None:
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", f"--node-ip-address={host.address}"]
    command += [f"--object-store-memory={10**8}", "--include-log-monitor=false", *words]
    for _ in range(_MAX_RAY_STARTS):
        code = host.start(command, environment, told, told).wait(_TIMEOUT_S)
        if not code:
            return
        host.kill()
    raise HeadwayError(f"ray start in {host.name} ends with code {code}: {_last_line(told)}")


def _wait_until_working(
    session: "subprocess.Popen[bytes]", root: Path, node: Host, turn: Turn, errors: Path
) -> list[psutil.Process]:
    """Wait until the node works and each run has a checkpoint; return the node's actors. They are suspended
    if the node is to fail, so that this happens in mid-study, however short the study is."""
    actors: list[psutil.Process] = []

    def at_work() -> bool:
        actors[:] = [process for process in node.processes() if _is_working(process, turn)]
        if session.poll() is not None:
            raise HeadwayError(f"the session ended before the second node had any work: {_last_line(errors)}")
        return bool(actors) and _has_started(root)

    until(at_work)
    if turn.failure:
        suspend_all(actors)
    done = sum(row.iterations for row in RunIndex(root).rows(STUDY))
    print(f"{len(actors)} actors on the second node, {done} iterations done", flush=True)
    return actors


def _cut_off(
    session: "subprocess.Popen[bytes]",
    root: Path,
    nodes: Nodes,
    turn: Turn,
    actors: Sequence[psutil.Process],
    errors: Path,
) -> list[str]:
    """Cut the link of suspended actors, and resume them once their run is trained elsewhere, while all other
    training is suspended: any change in the store is then theirs. Return a line for each wrong action."""
    folders = {row.seed: Path(row.directory) for row in RunIndex(root).rows(STUDY)}
    done = {seed: latest_iteration(folder / CHECKPOINTS) or 0 for seed, folder in folders.items()}
    nodes.node.cut_off()
    until(lambda: turn.loss_message in errors.read_text() or session.poll() is not None)
    lost = _LOST.search(errors.read_text())
    if lost is None:
        raise HeadwayError("the session has not detected that a node was cut off, so nothing was tested")
    seed = int(lost["seed"])
    kept = folders[seed] / CHECKPOINTS
    if done[seed] == RunRecord.read(folders[seed]).iterations:
        raise HeadwayError(
            "the run that was cut off had ended before, so nothing was tested: set --steps higher"
        )
    until(lambda: (latest_iteration(kept) or 0) > done[seed] or session.poll() is not None)
    others = [process for process in nodes.head.processes() if turn.actor in words_of(process)]
    if session.poll() is None:
        others.append(psutil.Process(session.pid))
    others += [child for process in others for child in children_of(process, recursive=True)]
    suspend_all(others)
    there = _contents(root)
    at = latest_iteration(kept)
    resume_all(actors)
    until(lambda: not any(workers_of(actor) for actor in actors))
    found = _errors_of_cut_off(nodes, actors)
    if changed := sorted({path for path, _ in there ^ _contents(root)}):
        found.append(f"the cut-off actors changed {len(changed)} files, including {changed[-1]}")
    resume_all(others)
    print(
        f"the cut-off actors resumed at {done[seed]} iterations, when their replacement was at {at}",
        flush=True,
    )
    return found


def _errors_of_cut_off(nodes: Nodes, actors: Sequence[psutil.Process]) -> list[str]:
    """Return the errors of actors that no longer train; empty if they live and have reported the takeover."""
    deadline = time.monotonic() + _REPORT_S
    while not all(_TAKEN_OVER in nodes.stderr_of(actor) for actor in actors):
        if not all(actor.is_running() for actor in actors):
            raise HeadwayError("a cut-off actor has died, so nothing was tested")
        if time.monotonic() > deadline:
            return ["a cut-off actor has not detected that its run was taken over"]
        time.sleep(_POLL_S)
    return []


def suspend_all(processes: Sequence[psutil.Process]) -> None:
    """Suspend processes, and wait until all are stopped."""

    def still(process: psutil.Process) -> bool:
        try:
            return process.status() in (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return True

    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.suspend()
    until(lambda: all(map(still, processes)))


def resume_all(processes: Sequence[psutil.Process]) -> None:
    """Resume suspended processes."""
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.resume()


def until(condition: Callable[[], bool], poll_s: float = _POLL_S) -> None:
    """Wait until a condition holds. Raises HeadwayError after `_TIMEOUT_S`."""
    deadline = time.monotonic() + _TIMEOUT_S
    while not condition():
        if time.monotonic() > deadline:
            raise HeadwayError("the study makes no progress")
        time.sleep(poll_s)


def _is_working(process: psutil.Process, turn: Turn) -> bool:
    return turn.actor in words_of(process) and (turn.learners == "here" or bool(workers_of(process)))


def _contents(root: Path) -> set[tuple[str, tuple[int, int, int]]]:
    """Return path, inode, size and modification time of every file and folder."""
    found = set()
    for path in root.rglob("*"):
        kept = path.stat()
        found.add((str(path.relative_to(root)), (kept.st_ino, kept.st_size, kept.st_mtime_ns)))
    return found


def headway(sweep: Sequence[str], root: Path) -> list[str]:
    return [sys.executable, "-m", "headway_launch", "sweep", *sweep, f"store.root='{root}'"]


def _has_started(root: Path) -> bool:
    """Return whether each run has a checkpoint or one run is half done, since it does not wait for others."""
    rows = RunIndex(root).rows(STUDY) if root.exists() else []
    halves = [2 * row.iterations >= RunRecord.read(Path(row.directory)).iterations for row in rows]
    return any(halves) or min((row.iterations for row in rows), default=0) > 0


def _last_line(told: Path) -> str:
    lines = [line for line in told.read_text().splitlines() if line.strip()]
    return lines[-1] if lines else "no output"


def end_by_signal(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    main()
