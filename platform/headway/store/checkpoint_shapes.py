"""Check that the parameters of a checkpoint have the shapes of the current policy."""

from pathlib import Path

import numpy as np

from headway.contracts.acting_policy import ActingPolicy, Parameters
from headway.contracts.errors import HeadwayError


def require_same_shapes(
    parameters: Parameters, policy: ActingPolicy, replicas: int, environment: str, run: Path
) -> None:
    """Raise HeadwayError if a checkpoint's arrays do not have the shapes of `policy`.

    `parameters` are those of `replicas` replicas, from the run folder `run`.
    """
    # A run is loaded with its stored configuration, so shapes differ only if the environment has changed.
    for name, (shape, _) in policy.parameter_shapes(replicas).items():
        if name not in parameters or np.shape(parameters[name]) != shape:
            raise HeadwayError(
                f"run {run.name} was trained on a version of {environment} with other observations, actions "
                "or agents; train it again"
            )
