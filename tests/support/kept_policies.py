"""Run folders with policies of random parameters, as trained runs leave them in the store."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stored_runs import keep, write_plan

from headway.config.schema import plain
from headway.contracts import ActingPolicy, EnvSpec
from headway.policies.stored_spec import spec_json
from headway.store.checkpoint import save_checkpoint
from headway.store.run_folder import CHECKPOINTS
from headway_algos.registry import ENTRIES, configure
from headway_launch.experiments.compose import compose
from headway_launch.experiments.parameters import full_mapping

SEEDS = (4, 7)
"""Seeds of the stack; the run is that of the last."""


def random_parameters(acting: ActingPolicy, replicas: int) -> dict[str, NDArray[Any]]:
    """Return parameters of policies far from uniform, with a used normaliser."""
    draw = np.random.default_rng(1)
    parameters = {}
    for name, (shape, dtype) in acting.parameter_shapes(replicas).items():
        if name == "observation_scale":
            values = draw.uniform(0.5, 2.0, shape)
        elif name == "exploration":
            values = np.full(shape, 0.1)
        else:
            values = draw.standard_normal(shape) * (1.5 / shape[-1] ** 0.5 if "weight" in name else 0.5)
        parameters[name] = values.astype(dtype)
    return parameters


def keep_policy(
    root: Path,
    algorithm: str,
    spec: EnvSpec,
    config: object,
    env: Mapping[str, Any],
    rest: Mapping[str, Any] | None = None,
) -> tuple[Path, ActingPolicy, dict[str, NDArray[Any]]]:
    """Store a run; return its folder, its acting policy and the parameters of its seed.

    `env` and `rest` are the configuration's keys `env` and all others.
    """
    tags = {"version.headway": "0.1.0", "git.revision": "abc"}
    mapping = {**(rest or {}), "algo": {**plain(config), "name": algorithm}, "env": dict(env)}
    cell = f"{spec.name}-{algorithm}"
    folder = keep(
        root, "kept", SEEDS[-1], spec.name, algorithm, cell, config=mapping, iterations=5, tags=tags
    )
    write_plan(folder, SEEDS, spec_json(spec))
    acting = ENTRIES[algorithm].acting_policy(config, spec.for_policies)
    parameters = random_parameters(acting, len(SEEDS))
    (folder / CHECKPOINTS).mkdir()
    save_checkpoint(folder / CHECKPOINTS, 5, {"acting": parameters})
    return folder, acting, {name: np.split(array, len(SEEDS))[-1] for name, array in parameters.items()}


def keep_made(
    root: Path,
    algorithm: str,
    spec: EnvSpec,
    **settings: Any,  # noqa: ANN401 - hyper-parameters
) -> tuple[Path, ActingPolicy, dict[str, NDArray[Any]]]:
    """Store a run on an environment that exists only as a specification."""
    return keep_policy(root, algorithm, spec, configure(algorithm, **settings), {"id": "made"})


def keep_run_on(root: Path, words: Sequence[str]) -> Path:
    """Store a run of the experiment that the overrides `words` describe; return its folder."""
    experiment = compose([*words, "preset=none", f"store.root={root}"])
    entry = experiment.env
    with closing(entry.make(entry.prepare(experiment.env_config), 1)) as env:
        spec = env.spec
    mapping = full_mapping(experiment, SEEDS[-1:])
    return keep_policy(root, experiment.algo_name, spec, experiment.algo_config, mapping.pop("env"), mapping)[
        0
    ]
