"""The best policies of a training so far."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from headway.contracts.acting_policy import Parameters


class BestPolicies:
    """Each seed's acting parameters at the evaluation with its highest mean return.

    Among equal returns the earliest counts.
    """

    def __init__(self, replicas: int) -> None:
        self.returns = np.full(replicas, -np.inf)
        self.iterations = np.full(replicas, -1)
        self.parameters: dict[str, NDArray[Any]] = {}

    def offer(self, returns: ArrayLike, iteration: int, parameters: Parameters) -> None:
        """Keep the policies of the seeds whose return (R,) is above all earlier ones.

        `parameters`: arrays (R K, ...), the K policies of each seed together. NaN is never kept.
        """
        returns = np.asarray(returns, np.float64)
        better = returns > self.returns
        self.returns[better], self.iterations[better] = returns[better], iteration
        for name, array in parameters.items():
            if name not in self.parameters:
                self.parameters[name] = np.array(array)
            kept, offered = (
                each.reshape(len(better), -1, *each.shape[1:])
                for each in (self.parameters[name], np.asarray(array))
            )
            kept[better] = offered[better]

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint holds of it."""
        return {"returns": self.returns, "iterations": self.iterations, "acting": self.parameters}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.returns, self.iterations = np.array(state["returns"]), np.array(state["iterations"])
        self.parameters = {name: np.array(array) for name, array in state["acting"].items()}
