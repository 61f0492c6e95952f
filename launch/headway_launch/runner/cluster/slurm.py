"""Sweeps as Slurm jobs: sbatch scripts for a Ray cluster in the allocation or for an array job over seeds."""

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
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.options import own_folder
from headway_launch.experiments.sweep import compose_sweep

_TIME = re.compile(r"(\d+-)?\d+(:\d{1,2}){0,2}")
_WORD = re.compile(r"[\w.,-]+")
_PLAIN = re.compile(r"[\w/.,:=@%+-]+")
"""Words that need no quotes on an #SBATCH line."""
_REMOVED_WORDS = ("packjob", "hetjob")
"""Words that sbatch removes from any line of a script."""
_RESERVED = {
    "time": "give --time",
    "nodes": "give --nodes",
    "cpus-per-task": "give --cpus",
    "partition": "give --partition",
    "array": "give --array",
    "job-name": "the job is named after the study",
    "output": "the log lies beside the script",
    "signal": "it requests the last checkpoint",
    "ntasks-per-node": "each node runs one task",
    "ntasks": "each node runs one task",
}
"""sbatch options that the script sets itself -> the option of `headway sweep` to use, or the reason."""
_SHORT_NAMES = {
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
"""Seconds before the time limit at which a job receives SIGTERM, so that it ends with a checkpoint."""

_BEGINNING = """\
# SIGTERM is passed on to the session, which stops with a checkpoint; submit this script again to continue.
set -euo pipefail
stop() {
    [ -n "${session:-}" ] || exit 143
    kill -TERM "$session" 2> /dev/null || true
}
trap stop TERM INT
finish() {
    local code=0
    wait "$session" || code=$?
    # `wait` returns when a signal arrives, although the session is still running.
    while kill -0 "$session" 2> /dev/null; do code=0; wait "$session" || code=$?; done
    return "$code"
}
"""

_CLUSTER = """
# One Ray cluster in the allocation: the head on this node, the first, and a daemon on each other node. Access
# needs the token, which srun passes to the nodes in the environment.
port=$((20000 + SLURM_JOB_ID % 20000))
address=${HEADWAY_HEAD_ADDRESS:-$(hostname -I | cut -d ' ' -f 1)}
RAY_AUTH_TOKEN=$("$python" -c 'import secrets; print(secrets.token_hex(32))')
export RAY_AUTH_TOKEN RAY_AUTH_MODE=token RAY_USAGE_STATS_ENABLED=0 RAY_prestart_worker_first_driver=0
# A cancelled job ends at once: Ray would wait for a head that has ended, until Slurm kills the step.
export RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S=0
folder=$(mktemp -d "${HEADWAY_RAY_TMP:-/tmp}/headway-ray-XXXXXX")
ray=("$python" -m ray.scripts.scripts start "--num-cpus=$SLURM_CPUS_PER_TASK" --include-log-monitor=false)
ray+=(--block)
others=$((SLURM_JOB_NUM_NODES - 1))
on_nodes=(srun "--cpus-per-task=$SLURM_CPUS_PER_TASK" --ntasks-per-node=1 --kill-on-bad-exit=0)
on_others=("${on_nodes[@]}" "--nodes=$others" "--ntasks=$others" "--exclude=$SLURMD_NODENAME")
# Ray has a temporary folder on each node. Once a job is cancelled no new step can start, so each daemon's
# step removes the folder on SIGTERM. If the job ends normally, the daemons may be killed; a step removes it.
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
    --include-dashboard=false --no-monitor > "$logs/$SLURM_JOB_ID-head.out" 2>&1 &
"$python" -m headway_launch.runner.cluster.ray_nodes "$address:$port"
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
# Each array task trains one seed of all cells in its own session.
"$python" -m headway_launch sweep "${overrides[@]}" "seed=${seeds[$SLURM_ARRAY_TASK_ID]}" &
session=$!
finish
"""


@dataclass(frozen=True)
class Allocation:
    """Resources and options requested from Slurm."""

    nodes: int = 1
    cpus: int = 1
    """CPUs per node."""
    time: str | None = None
    """Time limit in Slurm's format: minutes, HH:MM:SS, DAYS-HH and so on; None: the partition's default."""
    partition: str | None = None
    """Partition to run in; None: the default one."""
    further: tuple[str, ...] = field(default=())
    """Further options of sbatch, passed on unchanged."""

    def __post_init__(self) -> None:
        for name, number in (("nodes", self.nodes), ("cpus", self.cpus)):
            if number < 1:
                raise HeadwayError(f"--{name} must be at least 1, not {number}")
        if self.time is not None and not _TIME.fullmatch(self.time):
            raise HeadwayError(
                f"--time must be in Slurm's format, such as 90, 12:00:00 or 2-00, not {self.time!r}"
            )
        if self.partition is not None and not _WORD.fullmatch(self.partition):
            raise HeadwayError(f"--partition must be the name of a partition, not {self.partition!r}")
        _require_kept("--partition", self.partition or "")
        for option in self.further:
            _require_further(option)
            _require_kept("--sbatch", option)

    def lines(self, name: str, logs: Path, log: str) -> list[str]:
        """Return the #SBATCH lines; the job's output goes to the file `log` in the folder `logs`."""
        options = [
            f"--job-name={name}",
            f"--nodes={self.nodes}",
            "--ntasks-per-node=1",
            f"--cpus-per-task={self.cpus}",
            f"--output={_as_pattern(logs)}/{log}",
            f"--signal=B:TERM@{_GRACE_S}",
        ]
        options += [f"--time={self.time}"] if self.time else []
        options += [f"--partition={self.partition}"] if self.partition else []
        further = [" ".join(map(_quoted, shlex.split(option))) for option in self.further]
        return [f"#SBATCH {option}" for option in (*map(_quoted, options), *further)]


def _require_further(option: str) -> None:
    """Raise HeadwayError unless `option` is a single option of sbatch that the script does not set itself."""
    try:
        words = shlex.split(option)
    except ValueError:
        words = []
    is_one = len(words) == 1 or (len(words) == 2 and "=" not in words[0])
    if not is_one or not re.match("-+[^-]", words[0]) or "\n" in option:
        raise HeadwayError(
            f"--sbatch takes one option of sbatch, such as --mem=8G or '--comment=\"a b\"', not {option!r}"
        )
    name = words[0].lstrip("-").partition("=")[0]
    if words[0].startswith("--"):
        # sbatch accepts abbreviated option names.
        reserved = [long for long in _RESERVED if name and long.startswith(name)]
    else:
        reserved = [_SHORT_NAMES[name[0]]] if name[:1] in _SHORT_NAMES else []
    if reserved:
        raise HeadwayError(
            f"--sbatch={option}: the script sets --{reserved[0]} itself; {_RESERVED[reserved[0]]}"
        )


def _require_kept(option: str, value: str) -> None:
    """Raise HeadwayError if sbatch would remove a part of the value of an option."""
    for word in _REMOVED_WORDS:
        if word in value.lower():
            raise HeadwayError(
                f"{option}={value}: sbatch removes {word!r} from scripts; leave it out here and pass the "
                "option to sbatch directly"
            )


def _quoted(word: str) -> str:
    """Return a word quoted for an #SBATCH line.

    There sbatch reads double quotes and backslashes as the shell does, and a bare `#` as the start of a
    comment.
    """
    return word if _PLAIN.fullmatch(word) else '"' + re.sub(r'(["\\])', r"\\\1", word) + '"'


def _as_pattern(folder: Path) -> str:
    """Return a folder for the pattern of --output, in which `%` starts a placeholder.

    Raises HeadwayError if sbatch cannot represent its name.
    """
    text = str(folder)
    for unwanted in ("\\", "\n", *_REMOVED_WORDS):
        if unwanted in text.lower():
            raise HeadwayError(
                f"sbatch cannot write to a folder with {unwanted!r} in its name ({text!r}): change "
                "store.root or study"
            )
    return text.replace("%", "%%")


def write_cluster_script(overrides: Sequence[str], allocation: Allocation) -> Path:
    """Write the script that runs a sweep on one Ray cluster in the allocation, and return its path.

    Raises HeadwayError if the sweep is invalid, and for overrides of the keys that the script sets.
    """
    for override in overrides:
        key, _, value = override.partition("=")
        key = key.lstrip("+~")
        if key in ("backend", "backend.name") and value.strip("'\"") != "ray":
            raise HeadwayError(
                f"{override}: the script starts a Ray cluster; leave the override out, or add --array"
            )
        if key == "backend.address":
            raise HeadwayError(f"{override}: the script starts its own Ray cluster; leave the override out")
    on_ray = [*overrides, "backend=ray"]
    experiments = compose_sweep([*on_ray, "backend.address=HOST:1"])
    variables = {"overrides": [*_config_dir_words(), *on_ray]}
    return _write("cluster", experiments, allocation, (), "%j.out", variables, _CLUSTER)


def write_array_script(overrides: Sequence[str], allocation: Allocation) -> Path:
    """Write the script that runs a sweep as an array job, with one task per seed, and return its path.

    Each task runs on one node. Raises HeadwayError if the sweep is invalid, or if its cells have different
    seeds.
    """
    if allocation.nodes > 1:
        raise HeadwayError("with --array each seed runs on one node: leave out --nodes or --array")
    experiments = compose_sweep(overrides)
    if len({frozenset(experiment.config.seed) for experiment in experiments}) > 1:
        raise HeadwayError(
            "with --array all cells must have the same seeds: give seed=..., or leave out --array"
        )
    seeds = [str(seed) for seed in experiments[0].config.seed]
    others = [word for word in overrides if word.partition("=")[0].lstrip("+") != "seed"]
    array = [f"#SBATCH --array=0-{len(seeds) - 1}"]
    variables = {"overrides": [*_config_dir_words(), *others], "seeds": seeds}
    return _write("array", experiments, allocation, array, "%A-%a.out", variables, _ARRAY)


def _config_dir_words() -> list[str]:
    folder = own_folder()
    return [f"--config-dir={folder}"] if folder else []


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
        print_line(f"overwriting a different script of study {config.study}: {path}")
    write_text(path, script)
    return path
