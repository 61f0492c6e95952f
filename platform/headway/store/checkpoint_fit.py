"""Whether parameters of a checkpoint are those of a policy as it would be made now."""

from pathlib import Path

import numpy as np

from headway.contracts.acting_policy import ActingPolicy, Parameters
from headway.contracts.errors import HeadwayError


def require_fitting(
    parameters: Parameters, policy: ActingPolicy, replicas: int, environment: str, run: Path
) -> None:
    """Raise HeadwayError where arrays of the `replicas` of a checkpoint, in the folder of a run, have other
    shapes than the policy's. The configuration of a run is kept whole, so it is the environment that has
    changed since."""
    for name, (shape, _) in policy.parameter_shapes(replicas).items():
        if name not in parameters or np.shape(parameters[name]) != shape:
            raise HeadwayError(
                f"run {run.name} was made by a version of {environment} with other observations, actions or "
                "agents; train it again"
            )
