"""Runs of the environment `trivial` in the study `toys`, as sessions leave them in the store."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from headway.store.run_folder import Process, RunRecord, Status, cell_name, create_run_folder, now
from headway_launch.experiments.compose import Experiment
from headway_launch.experiments.parameters import cell_parameters, full_mapping

ELSEWHERE = Process("elsewhere", 1, 0.0)
"""A session on another host, which counts as running."""


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
    run_id, directory = create_run_folder(root, "toys", cell_name("trivial", algorithm, parameters), seed)
    record = RunRecord(run_id, "toys", "trivial", algorithm, seed, 1, now(), session, status)
    duration = 10.0 * (seed + 1)
    replace(record, parameters=parameters, durable_iteration=iteration, duration_s=duration).write(directory)
    (directory / "config.yaml").write_text(yaml.safe_dump(full_mapping(experiment, [seed])))
    (directory / "plan.json").write_text(json.dumps({"stack": list(stack or (seed,)), "workers": 1}))
    if summary:
        (directory / "summary.json").write_text(json.dumps(summary))
    return run_id
