"""Sweeps as Slurm jobs: the script for sbatch, of a Ray cluster in the allocation or of seeds as an array."""

import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from headway.contracts.errors import HeadwayError
from headway.store.atomic_files import make_folder, write_text
from headway.store.run_folder import plans_folder
from headway_launch.console.output import print_line
from headway_launch.experiments.compose import Experiment
from headway_launch.experiments.sweep import compose_sweep

_TIME = re.compile(r"(\d+-)?\d+(:\d{1,2}){0,2}")
_WORD = re.compile(r"[\w.,-]+")
_PLAIN = re.compile(r"[\w/.,:=@%+-]+")
"""What sbatch reads in a script as it stands."""
_MANGLED = ("packjob", "hetjob")
"""Words that sbatch cuts out of a line, wherever they stand."""
_OURS = {
    "time": "give --time",
    "nodes": "give --nodes",
    "cpus-per-task": "give --cpus",
    "partition": "give --partition",
    "array": "give --array",
    "job-name": "it is named after the study",
    "output": "it lies beside the script",
    "signal": "it stops a job with a checkpoint",
    "ntasks-per-node": "a node has one task",
    "ntasks": "a node has one task",
}
"""Options of sbatch that a script has already, and what to do instead of giving them."""
_LETTERS = {
    "t": "time",
    "N": "nodes",
    "c": "cpus-per-task",
    "p": "partition",
    "a": "array",
    "J": "job-name",
    "o": "output",
    "n": "ntasks",
}
_GRACE_S = 300
"""Before its time is over a job is told to stop, so that it ends with a checkpoint."""

_BEGINNING = """\
# A job that is told to end tells its session, which stops with a checkpoint: sbatch this again to go on.
set -euo pipefail
stop() {
    [ -n "${session:-}" ] || exit 143
    kill -TERM "$session" 2> /dev/null || true
}
trap stop TERM INT
finish() {
    local code=0
    wait "$session" || code=$?
    # A signal ends `wait`, not what it waits for.
    while kill -0 "$session" 2> /dev/null; do code=0; wait "$session" || code=$?; done
    return "$code"
}
"""

_CLUSTER = """
# One Ray cluster in the allocation: the head here, on its first node, and a daemon on each of the others. Who
# does not know the token, which goes to them with srun's environment, cannot use it.
port=$((20000 + SLURM_JOB_ID % 20000))
address=${HEADWAY_HEAD_ADDRESS:-$(hostname -I | cut -d ' ' -f 1)}
RAY_AUTH_TOKEN=$("$python" -c 'import secrets; print(secrets.token_hex(32))')
export RAY_AUTH_TOKEN RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0
folder=$(mktemp -d "${HEADWAY_RAY_TMP:-/tmp}/headway-ray-XXXXXX")
ray=("$python" -m ray.scripts.scripts start "--num-cpus=$SLURM_CPUS_PER_TASK" --block)
others=$((SLURM_JOB_NUM_NODES - 1))
on_nodes=(srun "--cpus-per-task=$SLURM_CPUS_PER_TASK" --ntasks-per-node=1 --kill-on-bad-exit=0)
on_others=("${on_nodes[@]}" "--nodes=$others" "--ntasks=$others" "--exclude=$SLURMD_NODENAME")
# Each node has a folder of Ray's. Where the job is cancelled no step can begin that would remove it, but all
# that runs is told to end; where the job ends by itself the daemons may be killed, and a step removes it.
and_tidy=(bash -c '"$@" & ray=$!; trap : TERM INT
    while kill -0 "$ray" 2> /dev/null; do wait "$ray" || true; done; rm -rf "$0"' "$folder")
end_ray() {
    kill $(jobs -p) 2> /dev/null || true
    wait || true
    [ "$others" -eq 0 ] || timeout 60 "${on_others[@]}" rm -rf "$folder" || true
    rm -rf "$folder"
}
trap end_ray EXIT

"${on_nodes[@]}" --nodes=1 --ntasks=1 "--nodelist=$SLURMD_NODENAME" "${and_tidy[@]}" \\
    "${ray[@]}" --head "--node-ip-address=$address" "--port=$port" "--temp-dir=$folder" \\
    --include-dashboard=false > "$logs/$SLURM_JOB_ID-head.out" 2>&1 &
"$python" -m headway_launch.runner.cluster.ray_nodes "$address:$port" 1
if [ "$others" -gt 0 ]; then
    "${on_others[@]}" "${and_tidy[@]}" "${ray[@]}" "--address=$address:$port" \\
        > "$logs/$SLURM_JOB_ID-nodes.out" 2>&1 &
fi
"$python" -m headway_launch.runner.cluster.ray_nodes "$address:$port" "$SLURM_JOB_NUM_NODES"
"$python" -m headway_launch sweep "${overrides[@]}" "backend.address=$address:$port" &
session=$!
finish
"""

_ARRAY = """
# Each task of the array trains one seed, all cells of it, in a session of its own.
"$python" -m headway_launch sweep "${overrides[@]}" "seed=${seeds[$SLURM_ARRAY_TASK_ID]}" &
session=$!
finish
"""


@dataclass(frozen=True)
class Allocation:
    """What is asked of Slurm."""

    nodes: int = 1
    cpus: int = 1
    """Of each node."""
    time: str | None = None
    """As Slurm has it: minutes, HH:MM:SS, DAYS-HH and so on; None: the partition's."""
    partition: str | None = None
    """None: the one that jobs go to by themselves."""
    further: tuple[str, ...] = field(default=())
    """Further options of sbatch, as they are."""

    def __post_init__(self) -> None:
        for name, number in (("nodes", self.nodes), ("cpus", self.cpus)):
            if number < 1:
                raise HeadwayError(f"--{name} must be at least 1, not {number}")
        if self.time is not None and not _TIME.fullmatch(self.time):
            raise HeadwayError(f"--time must be as Slurm's, such as 90, 12:00:00 or 2-00, not {self.time!r}")
        if self.partition is not None and not _WORD.fullmatch(self.partition):
            raise HeadwayError(f"--partition must be the name of one, not {self.partition!r}")
        _require_unmangled("--partition", self.partition or "")
        for option in self.further:
            _require_further(option)
            _require_unmangled("--sbatch", option)

    def lines(self, name: str, logs: Path, log: str) -> list[str]:
        """The lines that sbatch reads; `log` names a job's output in a folder."""
        asked = [
            f"--job-name={name}",
            f"--nodes={self.nodes}",
            "--ntasks-per-node=1",
            f"--cpus-per-task={self.cpus}",
            f"--output={_as_pattern(logs)}/{log}",
            f"--signal=B:TERM@{_GRACE_S}",
        ]
        asked += [f"--time={self.time}"] if self.time else []
        asked += [f"--partition={self.partition}"] if self.partition else []
        given = [" ".join(map(_quoted, shlex.split(option))) for option in self.further]
        return [f"#SBATCH {option}" for option in (*map(_quoted, asked), *given)]


def _require_further(option: str) -> None:
    """Raises HeadwayError for what is no option of sbatch, or one that the script has already."""
    try:
        words = shlex.split(option)
    except ValueError:
        words = []
    is_one = len(words) == 1 or (len(words) == 2 and "=" not in words[0])
    if not is_one or not re.match("-+[^-]", words[0]) or "\n" in option:
        raise HeadwayError(
            f"--sbatch takes an option of sbatch, such as --mem=8G or '--comment=\"a b\"', not {option!r}"
        )
    name = words[0].lstrip("-").partition("=")[0]
    if words[0].startswith("--"):
        # sbatch takes a name's beginning for the name.
        ours = [long for long in _OURS if name and long.startswith(name)]
    else:
        ours = [_LETTERS[name[0]]] if name[:1] in _LETTERS else []
    if ours:
        raise HeadwayError(f"--sbatch={option}: --{ours[0]} is the script's ({_OURS[ours[0]]})")


def _require_unmangled(ours: str, value: str) -> None:
    """Raises HeadwayError for a value of an option of ours that sbatch would not read as it stands."""
    for word in _MANGLED:
        if word in value.lower():
            raise HeadwayError(
                f"{ours}={value}: sbatch cuts {word!r} out of a script; leave it out here, and give it to "
                "sbatch itself"
            )


def _quoted(word: str) -> str:
    """A word as sbatch reads it in a script: quotes hold it together, a backslash takes the next character as
    it is, and a bare `#` begins a comment."""
    return word if _PLAIN.fullmatch(word) else '"' + re.sub(r'(["\\])', r"\\\1", word) + '"'


def _as_pattern(folder: Path) -> str:
    """A folder in the pattern of a job's output, where `%` begins what is replaced. Raises HeadwayError for
    one that sbatch cannot be told."""
    text = str(folder)
    for unwanted in ("\\", "\n", *_MANGLED):
        if unwanted in text.lower():
            raise HeadwayError(
                f"sbatch cannot write to a folder with {unwanted!r} in its name: give store.root or study "
                f"another than in {text!r}"
            )
    return text.replace("%", "%%")


def write_cluster_script(overrides: Sequence[str], allocation: Allocation) -> Path:
    """The script of a sweep on one Ray cluster in the allocation. Raises HeadwayError as the sweep would, and
    for overrides of what the script sets."""
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+~")
        if key in ("backend", "backend.name") and value.strip("'\"") != "ray":
            raise HeadwayError(
                f"{override}: the script starts a Ray cluster; leave it out, or give --array, which has none"
            )
        if key == "backend.address":
            raise HeadwayError(f"{override}: the script starts a Ray cluster of its own; leave it out")
    on_it = [*overrides, "backend=ray"]
    experiments = compose_sweep([*on_it, "backend.address=HOST:1"])
    variables = {"overrides": on_it}
    return _write("cluster", experiments, allocation, (), "%j.out", variables, _CLUSTER)


def write_array_script(overrides: Sequence[str], allocation: Allocation) -> Path:
    """The script of a sweep as an array of a task a seed, each on one node. Raises HeadwayError as the sweep
    would."""
    if allocation.nodes > 1:
        raise HeadwayError("with --array each seed has one node: leave --nodes out, or --array")
    experiments = compose_sweep(overrides)
    if len({frozenset(experiment.config.seed) for experiment in experiments}) > 1:
        raise HeadwayError("with --array all cells have the same seeds: give seed=..., or leave --array out")
    seeds = [str(seed) for seed in experiments[0].config.seed]
    others = [word for word in overrides if word.partition("=")[0].lstrip("+") != "seed"]
    array = [f"#SBATCH --array=0-{len(seeds) - 1}"]
    variables = {"overrides": others, "seeds": seeds}
    return _write("array", experiments, allocation, array, "%A-%a.out", variables, _ARRAY)


def _write(
    kind: str,
    experiments: Sequence[Experiment],
    allocation: Allocation,
    further: Sequence[str],
    log: str,
    variables: dict[str, list[str]],
    body: str,
) -> Path:
    config = experiments[0].config
    folder = plans_folder(Path(config.store.root).resolve(), config.study).parent / "slurm"
    name = re.sub(r"[^\w.-]", "-", f"headway-{config.study}")
    lines = [
        "#!/bin/bash",
        *allocation.lines(name, folder, log),
        *further,
        f"python={shlex.quote(sys.executable)}",
        f"logs={shlex.quote(str(folder))}",
        *(f"{key}=({shlex.join(values)})" for key, values in variables.items()),
        f"cd {shlex.quote(str(Path.cwd()))}",
        "",
    ]
    make_folder(folder)
    path = folder / f"{kind}.sbatch"
    script = "\n".join(lines) + _BEGINNING + body
    if path.exists() and path.read_text(encoding="utf-8") != script:
        print_line(f"replaces a script of {config.study} that was not the same: {path}")
    write_text(path, script)
    return path
