"""Runs as sessions leave them in the store: any, and those of `trivial` in the study `toys`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from headway.events import Row
from headway.store.atomic_files import write_json, write_text
from headway.store.parquet_log import RunLog, Table
from headway.store.run_folder import Process, RunRecord, Status, cell_name, create_run_folder, now
from headway_launch.experiments.experiment import Experiment
from headway_launch.experiments.parameters import cell_parameters, full_mapping

ELSEWHERE = Process("elsewhere", 1, 0.0)
"""A session on another host, which counts as running."""
RESULTS: Mapping[str, Any] = {
    "config": {"env": {}, "evaluation": {"episodes": 2, "modes": ["greedy"]}, "energy": {}},
    "logs": {"curve": [{"iteration": 1, "env_steps": 8, "evaluation_greedy/return": 1.0}]},
}
"""Arguments of `keep` without which a finished run counts as damaged."""


def keep(
    root: Path,
    study: str,
    seed: int,
    env: str = "bus",
    algorithm: str = "ippo",
    cell: str = "cell",
    summary: Mapping[str, Any] | None = None,
    config: Mapping[str, Any] | None = None,
    logs: Mapping[Table, Sequence[Row]] | None = None,
    **changes: Any,  # noqa: ANN401 - of the record
) -> Path:
    """Store a run, finished by default, with its logs, and return its folder."""
    run_id, folder = create_run_folder(root, study, cell, seed)
    of_session = {"iterations": 10, "started": now(), "session": Process.current(), "status": "FINISHED"}
    record = RunRecord(run_id, study, env, algorithm, seed, **{**of_session, **changes})  # type: ignore[arg-type]
    record.write(folder)
    if config is not None:
        write_text(folder / "config.yaml", yaml.safe_dump(config, sort_keys=False))
    if summary is not None:
        write_json(folder / "summary.json", summary)
    log = RunLog(folder)
    for table, rows in (logs or {}).items():
        log.append(table, rows)
        log.commit(max(row["iteration"] for row in rows))  # type: ignore[type-var]  # numbers
    return folder


def keep_run(
    root: Path,
    experiment: Experiment,
    seed: int,
    status: Status,
    iteration: int = 0,
    stack: tuple[int, ...] = (),
    session: Process = ELSEWHERE,
    **summary: Any,  # noqa: ANN401 - JSON
) -> str:
    """Store a run with its configuration, plan and, if given, `summary`; return its ID. It took ten seconds
    per seed number and ten more."""
    parameters = {name: str(value) for name, value in cell_parameters(experiment).items()}
    algorithm = experiment.algo_name
    directory = keep(
        root, "toys", seed, "trivial", algorithm, cell_name("trivial", algorithm, parameters),
        summary or None, full_mapping(experiment, [seed]),
        iterations=1, session=session, status=status, parameters=parameters, durable_iteration=iteration,
        duration_s=10.0 * (seed + 1),
    )  # fmt: skip
    write_plan(directory, stack or (seed,))
    return directory.name


def write_plan(directory: Path, stack: Sequence[int], spec: Mapping[str, Any] | None = None) -> None:
    """Write the plan of a run with one worker; `spec`: its environment's specification as JSON."""
    plan = {"stack": list(stack), "workers": 1, "rollout": {"block": 1}, "spec": spec or {}}
    write_json(directory / "plan.json", plan)
