"""Archived runs trained again, and their logs compared with the archived ones."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from headway.config.experiment import BackendConfig
from headway.contracts.errors import HeadwayError
from headway.events import Row
from headway.store.checkpoint import latest_iteration
from headway.store.index import RunRow
from headway.store.parquet_log import TABLES, read_curve, read_rows
from headway.store.run_folder import CHECKPOINTS, find_run, read_summary
from headway.store.session import EPISODES_RESTARTED
from headway.wording import counted
from headway_launch.console.output import print_line
from headway_launch.console.progress import duration
from headway_launch.experiments.compose import resolve
from headway_launch.experiments.experiment import PreparedEnv
from headway_launch.runner.cores import uses_gpu
from headway_launch.runner.jobs import CellPlan, PlannedJob, new_jobs
from headway_launch.runner.runner import EXIT_DONE, EXIT_STOPPED, Runner
from headway_launch.runner.stored_run import StoredRun, with_env_keys

CONFIDENCE = 0.99
"""Probability that a further seed of a cell lies in the interval with which a run is compared elsewhere."""
_CLOCKS = ("wall_s", "time/")
"""Columns of a curve that differ every time."""
_FEATURES = "hardware.cpu_features"
_MACHINE = ("hardware.cpu", _FEATURES, "hardware.gpu")
_SYSTEM = "hardware.system"
_NUMBA = "version.numba"
_NO_EFFECT = ("version.mlflow-skinny", "version.codecarbon")


@dataclass(frozen=True)
class Verdict:
    """The comparison of a retrained run with the archived one."""

    run_id: str
    env_steps: int
    """Steps that were compared, from the start."""
    values: int
    """Numbers that were compared."""
    equal: bool
    """Whether the run is what the archive says: equal bit for bit or, elsewhere, within the tolerance."""
    result: str


def drawn(rows: Sequence[RunRow], count: int, seed: int) -> list[RunRow]:
    """Return `count` runs, those with the lowest SHA-256 of `SEED:RUN`. Raises HeadwayError if there are
    fewer."""
    if count > len(rows):
        raise HeadwayError(f"--runs {count}: the archive holds {counted(len(rows), 'finished run')}")
    return sorted(rows, key=lambda row: sha256(f"{seed}:{row.run_id}".encode()).digest())[:count]


class Verification:
    """Runs of an unpacked archive that are trained again in its store."""

    def __init__(
        self, root: Path, tags: Mapping[str, str], overrides: Sequence[str] = (), env_steps: int | None = None
    ) -> None:
        """`tags`: of this machine, as `provenance` gives them. `overrides`: keys of `env` that say where
        files are here. `env_steps`: train and compare the first iterations only, up to this step."""
        self.root, self._tags, self._overrides, self._env_steps = root, tags, overrides, env_steps

    def plan(self, row: RunRow, rows: Sequence[RunRow]) -> "PlannedRun":
        """Plan to train a run again; `rows`: the finished runs of its study.

        Raises HeadwayError if it cannot be trained, or has too few other seeds or no evaluation for the
        tolerance it needs.
        """
        run = StoredRun.read(self.root, Path(row.directory))
        job = self._job(run)
        seeds = [other for other in rows if other.cell == row.cell]
        reasons = [*_reasons(run), *differences(run.record.tags, self._tags)]
        if reasons and len(seeds) < 2:
            raise HeadwayError(
                f"{row.run_id} may differ in its last digits ({'; '.join(reasons)}), and a tolerance needs "
                "two seeds of its cell: verify it on a machine like that of the archive"
            )
        planned = PlannedRun(run, job, seeds, reasons)
        # That of step 0 says nothing of the training.
        first = min(filter(None, read_curve(run.directory, planned.metric)), default=0)
        if reasons and planned.env_steps < first:
            raise HeadwayError(
                f"{row.run_id} may differ in its last digits ({'; '.join(reasons)}), and a tolerance needs "
                f"an evaluation: give at least --steps {first}"
            )
        return planned

    def verify(self, planned: "PlannedRun", debug: bool) -> Verdict | None:
        """Train a run again and compare it; None if it was stopped by Ctrl-C.

        Raises HeadwayError if training fails.
        """
        run, job, reasons, steps = planned.run, planned.job, planned.reasons, planned.env_steps
        run_id = run.record.run_id
        if reasons:
            print_line(f"headway: {run_id} may differ in its last digits: {'; '.join(reasons)}")
        print_line(f"headway: {planned.description}")
        runner = Runner([CellPlan(job.experiment, (job,), temporary=True)], debug)
        code = runner.run(report=False)
        if code == EXIT_STOPPED:
            return None
        if code != EXIT_DONE:
            raise HeadwayError(f"{run_id} could not be trained again: see above; --debug shows the traceback")
        rows = runner.selection().rows
        [again] = [Path(row.directory) for row in rows if row.seed == run.record.seed]
        values, first = _compared(run.directory, again, planned.iterations)
        if first is None:
            return Verdict(run_id, steps, values, True, "equal bit for bit")
        difference = f"differs {first}"
        revisions = [tags.get("git.revision", "unknown")[:12] for tags in (run.record.tags, self._tags)]
        if revisions[0] != revisions[1]:  # which says nothing of an installed package, so it is no reason
            difference = f"{difference}; git.revision {revisions[0]} there, {revisions[1]} here"
        if not reasons:
            return Verdict(run_id, steps, values, False, difference)
        equal, result = _within_spread(run.directory, again, planned.seeds, planned.metric, steps)
        return Verdict(run_id, steps, values, equal, f"{result}; {difference}")

    def _job(self, run: StoredRun) -> PlannedJob:
        """Return the job that trains a run again, alone unless its results may depend on its stack."""
        mapping, seed = self._mapping(run), run.record.seed
        alone = resolve({**mapping, "seed": [seed]})
        known: dict[str, PreparedEnv] = {}
        alone.prepare(known)
        [job] = new_jobs(alone, (seed,), known)
        stack = run.plan.stack
        replays = alone.algo.replay_bytes(alone.algo_config, job.training.spec, 1) > 0
        if len(stack) > 1 and (uses_gpu(job) or replays):
            backend = {**mapping["backend"], "stack": len(stack)}
            together = resolve({**mapping, "seed": list(stack), "backend": backend})
            [job] = new_jobs(together, stack, known)
        if self._env_steps is None:
            return job
        last = -(-self._env_steps // job.config.iteration_steps)
        if last >= job.config.iterations:
            return job
        return replace(job, training=replace(job.training, pause_after=last))

    def _mapping(self, run: StoredRun) -> dict[str, Any]:
        """Return a run's configuration for this machine. Raises HeadwayError if it starts from a run whose
        checkpoint the archive lacks."""
        mapping, _ = with_env_keys(run.mapping, self._overrides)
        if parent := (mapping.get("start") or {}).get("run"):
            folder = find_run(self.root, parent)
            if latest_iteration(folder / CHECKPOINTS) is None:
                raise HeadwayError(f"{run.record.run_id} starts from {parent}, whose checkpoint is missing")
        device = str(mapping.get("device", "auto"))
        on_gpu = "hardware.gpu" in run.record.tags and device != "cpu"
        backend = {**mapping["backend"], "workers": None, "parallel": None, "stack": 1, "learners": None}
        if backend["name"] == "ray":
            backend |= {"name": BackendConfig.name, "address": BackendConfig.address, "worker_cpus": None}
        return {
            **mapping,
            "device": "auto" if on_gpu else "cpu",
            "rollout": {**mapping["rollout"], "block": run.plan.block},
            "backend": backend,
            "evaluation": {**mapping["evaluation"], "rules": []},
            "energy": {**mapping.get("energy", {}), "enabled": False},
        }


@dataclass(frozen=True)
class PlannedRun:
    """An archived run with the job that trains it again."""

    run: StoredRun
    job: PlannedJob
    seeds: Sequence[RunRow]
    """The archived runs of its cell, itself among them."""
    reasons: Sequence[str]
    """Why it may not be reproduced bit for bit."""

    @property
    def iterations(self) -> int:
        """Iterations that are trained again."""
        return self.job.training.pause_after or self.job.config.iterations

    @property
    def metric(self) -> str:
        """Metric of the curve to which the tolerance applies."""
        return f"evaluation_{self.job.config.evaluation.modes[0]}/return"

    @property
    def env_steps(self) -> int:
        """Environment steps of these iterations."""
        return self.iterations * self.job.config.iteration_steps

    @property
    def description(self) -> str:
        """What is trained, and what the archived training took."""
        total, seeds = self.job.config.iterations * self.job.config.iteration_steps, len(self.job.seeds)
        stack = f", with the {seeds} seeds of its stack" if seeds > 1 else ""
        cpu_s = read_summary(self.run.directory).get("cpu_seconds")
        used = "" if cpu_s is None else f" and {float(cpu_s):,.0f} CPU s"
        return (
            f"training {self.run.record.run_id} again, {self.env_steps:,} of {total:,} steps{stack}; the "
            f"whole run took {duration(self.run.record.duration_s)}{used}"
        )


def differences(there: Mapping[str, str], here: Mapping[str, str]) -> Iterator[str]:
    """Yield the versions and parts of the machine on which the last bits of a curve depend and that differ.

    `there` and `here`: tags of runs. A package that only one of them has is not used.
    """
    common = there.keys() & here.keys()
    packages = [name for name in common if name.startswith("version.") and name not in _NO_EFFECT]
    for name in sorted({*packages, *_MACHINE, _NUMBA}):
        if there.get(name) != here.get(name):
            yield f"{name} {_shown(name, there, here)} there, {_shown(name, here, there)} here"
    # The rest of the description is the kernel, which computes nothing.
    library = [tags.get(_SYSTEM, "").rpartition("-with-")[2] for tags in (there, here)]
    if library[0] != library[1]:
        yield f"{_SYSTEM} {library[0]} there, {library[1]} here"


def _shown(name: str, tags: Mapping[str, str], others: Mapping[str, str]) -> str:
    """Return a tag's value; of a list of features, those that the others lack."""
    if name not in tags:
        return "unknown"
    if name != _FEATURES:
        return tags[name]
    return " ".join(sorted(set(tags[name].split()) - set(others.get(name, "").split()))) or "none more"


def _reasons(run: StoredRun) -> Iterator[str]:
    """Yield why training a run again may not reproduce it bit for bit, wherever that is done."""
    tags, algo, backend = run.record.tags, run.mapping["algo"], run.mapping["backend"]
    if EPISODES_RESTARTED in tags:
        yield "its episodes restarted when it was resumed"
    if algo.get("application") == "arrival" and backend["name"] != "serial":
        yield "it applies gradients in order of arrival"
    if "hardware.gpu" in tags and run.mapping.get("device") != "cpu":
        yield "it may have been trained on a GPU"


def _compared(archived: Path, again: Path, last: int) -> tuple[int, str | None]:
    """Compare all tables up to iteration `last`, bit for bit and without clocks.

    Returns how many values were compared, and the first difference in words, None if there is none. Columns
    that only the new run has are not compared.
    """
    values, found = 0, []
    for table in TABLES:
        pairs = [
            [row for row in read_rows(folder, table) if int(row["iteration"]) <= last]
            for folder in (archived, again)
        ]
        if len(pairs[0]) != len(pairs[1]):
            found.append((0, f"in {table}: {len(pairs[1])} rows, archived {len(pairs[0])}"))
        for row, other in zip(*pairs, strict=False):
            mine, theirs = _exact(row), _exact(other)
            values += len(mine)
            if unlike := [name for name in mine if mine[name] != theirs.get(name)]:
                name = unlike[0]
                text = f"{table} {name} {other.get(name)}, archived {row[name]}"
                found.append((int(row["iteration"]), f"from step {int(row['env_steps']):,} on: {text}"))
                break
    return values, min(found)[1] if found else None


def _exact(row: Row) -> dict[str, str]:
    """Return the values of a row without clocks, each number to its last bit."""
    return {
        name: value if isinstance(value, str) else float(value).hex()
        for name, value in row.items()
        if not name.startswith(_CLOCKS)
    }


def _within_spread(
    archived: Path, again: Path, others: Sequence[RunRow], metric: str, env_steps: int
) -> tuple[bool, str]:
    """Return whether a run's score lies where a further seed of its cell would, and that in words.

    Where numbers round differently training diverges, and the same seed is no more alike than another.
    """
    from headway.stats.curves import final_reward
    from headway.stats.intervals import prediction_interval

    def score(folder: Path) -> float:
        curve = {steps: value for steps, value in read_curve(folder, metric).items() if steps <= env_steps}
        return final_reward(list(curve), list(curve.values()))

    low, high = prediction_interval([score(Path(row.directory)) for row in others], CONFIDENCE)
    mine, theirs = score(again), score(archived)
    equal = low <= mine <= high
    return equal, (
        f"{'within' if equal else 'outside'} the tolerance: final reward {mine:.6g}, archived {theirs:.6g}; "
        f"{CONFIDENCE:.0%} of further seeds lie in {low:.6g} to {high:.6g}"
    )
