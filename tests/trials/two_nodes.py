"""A study on a Ray cluster of two nodes is the study of one machine: the same curves, the same tables,
whatever happens to a node.

    python -m tests.trials.two_nodes --root FOLDER
    python -m tests.trials.two_nodes --root FOLDER --experiment bus_mappo --turn runs

The nodes are network namespaces joined by a wire, so that nothing goes from one to the other but over it;
they share this machine's files, as a cluster shares a file system. A study is trained with worker processes,
and then again on the cluster in each of some turns, with a cluster of its own. Prints what differs, and ends
with exit code 1 if anything does, with 2 where namespaces cannot be had (that takes root and `ip`).
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
from headway.store import CHECKPOINTS, RunIndex, sync_each
from headway.store.checkpoint import latest_iteration
from headway.store.run_folder import RunRecord
from tests.trials.hosts import Host, two_hosts
from tests.trials.same_study import differences

STUDY = "two_nodes"
SMALL = (
    "env=visitors",
    "algo=ippo",
    "rollout.copies=4",
    "rollout.block=2",
    "rollout.steps=32",
    "evaluation.episodes=1",
    "evaluation.final_episodes=2",
    "store.checkpoint_every=10",
    "seed=0,1",
)
_PORT = 6379
_HEALTH = {
    "RAY_health_check_initial_delay_ms": "10000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "2000",
    "RAY_health_check_failure_threshold": "3",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "3600",
}
"""A node that is silent is given up after some seconds, where Ray by itself takes up to a minute; one that
hears nothing of the head lives on, where Ray by itself ends it after a minute."""
_LOST = re.compile(r"seed (?P<seed>\d+): its training process was lost")
_TAKEN_OVER = "another training process has taken over"
"""In what a training process says that may write to its run no more."""
_PATIENCE_S = 3600.0
_LAST_WORD_S = 60.0
_POLL_S = 0.1
_RAY_STARTS = 3
"""Ray gives its own daemons half a minute to start, which on a busy machine may be too short."""


@dataclass(frozen=True)
class Turn:
    """One way to train a study on the cluster."""

    learners: Literal["here", "cluster"]
    """As `backend.learners`: workers alone are on both nodes, or whole runs."""
    mishap: Literal["", "killed", "cut off"] = ""
    """What happens to the second node in mid-study."""

    @property
    def actor(self) -> str:
        """What an actor that does its work calls itself."""
        return "ray::TrainingHost" if self.learners == "cluster" else "ray::RayRolloutWorker"

    @property
    def noticed(self) -> str:
        """A part of the line in which a session says that it has lost one."""
        return "it continues elsewhere" if self.learners == "cluster" else "replaced, "


TURNS = {
    "workers": Turn("here"),
    "workers-killed": Turn("here", "killed"),
    "runs": Turn("cluster"),
    "runs-killed": Turn("cluster", "killed"),
    "runs-cut-off": Turn("cluster", "cut off"),
}


def main() -> None:
    """Run the trial; see the module."""
    parser = argparse.ArgumentParser(
        description="Train on two nodes in namespaces, and compare with one machine."
    )
    parser.add_argument("--root", type=Path, required=True, help="an empty folder for the stores")
    parser.add_argument("--experiment", help="a named experiment instead of a small one")
    parser.add_argument("--turn", action="append", choices=TURNS, help="may be repeated; all, if left out")
    parser.add_argument("--steps", default="40000", help="environment steps of each seed")
    parser.add_argument("overrides", metavar="KEY=VALUE", nargs="*", help="further overrides of the sweep")
    arguments = parser.parse_args()
    base = SMALL if arguments.experiment is None else (f"experiment={arguments.experiment}",)
    sweep = [
        *base,
        f"study={STUDY}",
        f"env_steps={arguments.steps}",
        "backend.workers=2",
        *arguments.overrides,
    ]
    signal.signal(signal.SIGTERM, end_by_signal)  # so that everything is cleaned up then, too
    try:
        found = trial(arguments.root, sweep, {name: TURNS[name] for name in arguments.turn or TURNS})
    except HeadwayError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    print(
        "\n".join(found) or "the study on two nodes is that of one machine: curves, tables, store and MLflow"
    )
    sys.exit(1 if found else 0)


def trial(root: Path, sweep: Sequence[str], turns: dict[str, Turn]) -> list[str]:
    """What differs between a study on one machine and the same in each turn; empty if nothing does.

    Raises HeadwayError where there can be no namespaces or no Ray, a session fails, or a turn tried nothing.
    """
    require_ray()
    with two_hosts():
        pass  # before an hour's work
    alone = root / "alone"
    table = to_the_end(alone, sweep)
    found: list[str] = []
    for name, turn in turns.items():
        began = time.monotonic()
        after, differ = _on_two_nodes(root / name, sweep, turn)
        sync_each(root / name)
        differ += differences(alone, root / name)
        if _figures(after) != _figures(table):
            differ.append(f"tables differ:\n{table}\n{after}")
        found += [f"{name}: {line}" for line in differ]
        print(f"{name}: {time.monotonic() - began:.0f} s, {len(differ)} differences", flush=True)
    return found


def to_the_end(root: Path, sweep: Sequence[str]) -> str:
    """Train on this machine; the table."""
    command = headway(sweep, root)
    done = subprocess.run(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, check=False)
    if done.returncode:
        raise HeadwayError(f"{' '.join(command)} ends with code {done.returncode}")
    return done.stdout


def _on_two_nodes(root: Path, sweep: Sequence[str], turn: Turn) -> tuple[str, list[str]]:
    """Train on a cluster of two nodes, of which the second meets with its mishap; the table, and what went
    wrong with that."""
    output, errors = root.with_suffix(".out"), root.with_suffix(".err")
    root.parent.mkdir(parents=True, exist_ok=True)
    with cluster() as nodes:
        address = f"backend.address={nodes.head.address}:{_PORT}"
        command = headway([*sweep, "backend=ray", address, f"backend.learners={turn.learners}"], root)
        session = nodes.head.start(command, nodes.environment, output, errors)
        there = _until_at_work(session, root, nodes.node, turn, errors)
        found: list[str] = []
        if turn.mishap == "killed":
            print(f"{nodes.node.kill()} processes of the second node are killed", flush=True)
        elif turn.mishap == "cut off":
            found = _cut_off(session, root, nodes, turn, there, errors)
        session.wait(_PATIENCE_S)
    if session.returncode:
        raise HeadwayError(f"the session ends with code {session.returncode}: {_last_line(errors)}")
    if turn.mishap and turn.noticed not in errors.read_text():
        raise HeadwayError("the session has not noticed that a node was lost")
    return output.read_text(), found


@dataclass(frozen=True)
class Nodes:
    """A Ray cluster of two nodes."""

    head: Host
    node: Host
    environment: dict[str, str]
    """What Ray needs to be told, on every node and in every driver."""
    folder: Path
    """Ray's temporary files, of both."""

    def told_by(self, process: psutil.Process) -> str:
        """What a process of Ray has printed on stderr, which Ray keeps."""
        logs = self.folder.glob(f"session_*/logs/worker-*-{process.pid}.err")
        return "".join(log.read_text(errors="replace") for log in logs)


@contextmanager
def cluster() -> Iterator[Nodes]:
    """A Ray cluster of a head, with room for all, and a node, with room for one run of two workers."""
    with (
        two_hosts() as (head, node),
        tempfile.TemporaryDirectory(prefix="headway-ray-nodes-", ignore_cleanup_errors=True) as folder,
    ):
        # A cluster that anybody may reach should ask for a token, so this one does.
        environment = {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            "RAY_USAGE_STATS_ENABLED": "0",
            **_HEALTH,
        }
        nodes = Nodes(head, node, environment, Path(folder))
        address = f"{head.address}:{_PORT}"
        told = Path(folder, "ray.out")
        as_head = ["--head", f"--port={_PORT}", f"--temp-dir={folder}"]
        _start_ray(head, environment, told, [*as_head, "--num-cpus=4", "--include-dashboard=false"])
        _start_ray(node, environment, told, [f"--address={address}", "--num-cpus=2"])
        yield nodes


def _start_ray(host: Host, environment: dict[str, str], told: Path, words: Sequence[str]) -> None:
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", f"--node-ip-address={host.address}"]
    command += [f"--object-store-memory={10**8}", *words]
    for _ in range(_RAY_STARTS):
        code = host.start(command, environment, told, told).wait(_PATIENCE_S)
        if not code:
            return
        host.kill()
    raise HeadwayError(f"ray start in {host.name} ends with code {code}: {_last_line(told)}")


def _until_at_work(
    session: "subprocess.Popen[bytes]", root: Path, node: Host, turn: Turn, errors: Path
) -> list[psutil.Process]:
    """Wait until the node has its part of the work and something of each run is durable; its actors. They
    stand still if something is to happen to them, so that it happens in mid-study, however short that is."""
    actors: list[psutil.Process] = []

    def at_work() -> bool:
        actors[:] = [process for process in node.processes() if _works(process, turn)]
        if session.poll() is not None:
            raise HeadwayError(f"the session ended before the second node had any work: {_last_line(errors)}")
        return bool(actors) and _begun(root)

    until(at_work)
    if turn.mishap:
        stand_still(actors)
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
    """Cut the wire of actors that stand still, and wake them when their run is trained elsewhere: then all
    else that trains stands still, and whatever changes in the store is theirs. A line for each thing that
    they should not have done."""
    folders = {row.seed: Path(row.directory) for row in RunIndex(root).rows(STUDY)}
    done = {seed: latest_iteration(folder / CHECKPOINTS) or 0 for seed, folder in folders.items()}
    nodes.node.cut_off()
    until(lambda: turn.noticed in errors.read_text() or session.poll() is not None)
    lost = _LOST.search(errors.read_text())
    if lost is None:
        raise HeadwayError("the session has not noticed that a node was cut off, so nothing was tried")
    seed = int(lost["seed"])
    kept = folders[seed] / CHECKPOINTS
    if done[seed] == RunRecord.read(folders[seed]).iterations:
        raise HeadwayError("what was cut off had ended before, so nothing was tried: give more --steps")
    until(lambda: (latest_iteration(kept) or 0) > done[seed] or session.poll() is not None)
    others = [process for process in nodes.head.processes() if _calls_itself(process, turn.actor)]
    if session.poll() is None:
        others.append(psutil.Process(session.pid))
    others += [child for process in others for child in _descendants(process)]
    stand_still(others)
    there = _contents(root)
    at = latest_iteration(kept)
    wake(actors)
    until(lambda: not any(_workers(actor) for actor in actors))
    found = _wrongs_of_the_cut_off(nodes, actors)
    if changed := sorted({path for path, _ in there ^ _contents(root)}):
        found.append(f"what was cut off has changed {len(changed)} files, {changed[-1]} among them")
    wake(others)
    print(f"what was cut off woke, at {done[seed]} iterations, when its replacement was at {at}", flush=True)
    return found


def _wrongs_of_the_cut_off(nodes: Nodes, actors: Sequence[psutil.Process]) -> list[str]:
    """Of actors that train no more: empty if they live and have said why."""
    deadline = time.monotonic() + _LAST_WORD_S
    while not all(_TAKEN_OVER in nodes.told_by(actor) for actor in actors):
        if not all(actor.is_running() for actor in actors):
            raise HeadwayError("what was cut off has died of it, so nothing was tried")
        if time.monotonic() > deadline:
            return ["what was cut off has not noticed that its run had been taken over"]
        time.sleep(_POLL_S)
    return []


def stand_still(processes: Sequence[psutil.Process]) -> None:
    """Stop processes as they are, and wait until none does anything more."""

    def still(process: psutil.Process) -> bool:
        try:
            return process.status() in (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return True

    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.suspend()
    until(lambda: all(map(still, processes)))


def wake(processes: Sequence[psutil.Process]) -> None:
    """Let processes that stand still go on."""
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            process.resume()


def until(happens: Callable[[], bool]) -> None:
    deadline = time.monotonic() + _PATIENCE_S
    while not happens():
        if time.monotonic() > deadline:
            raise HeadwayError("the study does not come on")
        time.sleep(_POLL_S)


def _works(process: psutil.Process, turn: Turn) -> bool:
    return _calls_itself(process, turn.actor) and (turn.learners == "here" or bool(_workers(process)))


def _workers(actor: psutil.Process) -> list[psutil.Process]:
    """Its rollout workers, which are children of its fork server."""
    try:
        return [worker for server in actor.children() for worker in server.children()]
    except psutil.NoSuchProcess:
        return []


def _descendants(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _contents(root: Path) -> set[tuple[str, tuple[int, int, int]]]:
    """Every file and folder, as it is."""
    found = set()
    for path in root.rglob("*"):
        kept = path.stat()
        found.add((str(path.relative_to(root)), (kept.st_ino, kept.st_size, kept.st_mtime_ns)))
    return found


def headway(sweep: Sequence[str], root: Path) -> list[str]:
    return [sys.executable, "-m", "headway_launch", "sweep", *sweep, f"store.root='{root}'"]


def _calls_itself(process: psutil.Process, name: str) -> bool:
    try:
        return name in " ".join(process.cmdline())
    except psutil.Error:
        return False


def _begun(root: Path) -> bool:
    """Whether something of each run is durable, or one is half through, which waits for no other."""
    rows = RunIndex(root).rows(STUDY) if root.exists() else []
    halves = [2 * row.iterations >= RunRecord.read(Path(row.directory)).iterations for row in rows]
    return any(halves) or min((row.iterations for row in rows), default=0) > 0


def _figures(table: str) -> list[list[str]]:
    """Of each seed or cell what was learned, not what it cost."""
    return [line.split("\t")[:5] for line in table.splitlines()]


def _last_line(told: Path) -> str:
    lines = [line for line in told.read_text().splitlines() if line.strip()]
    return lines[-1] if lines else "it said nothing"


def end_by_signal(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    main()
