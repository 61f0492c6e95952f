"""Steps of Adam (Kingma and Ba 2015, arXiv:1412.6980) for a stack of networks."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from headway_algos.kernels.compiled import Floats, compiled


class Adam(NamedTuple):
    """State and settings of an optimiser of P networks with V parameters each."""

    means: Floats
    """(P, V): first moments."""
    squares: Floats
    """(P, V): second moments."""
    counts: NDArray[np.int64]
    """(P,): steps so far."""
    lr: float
    bound: float
    """Norm to which longer gradients are clipped; infinity: no clipping."""
    decays: tuple[float, float]
    epsilon: float


@compiled
def step_network(values: Floats, gradient: Floats, adam: Adam, p: int) -> float:
    """Take a step of network p, with its `values` and `gradient` (V,); return the gradient's norm."""
    v, g, m, s = values, gradient, adam.means[p], adam.squares[p]
    one = v.dtype.type(1)
    first, second = v.dtype.type(adam.decays[0]), v.dtype.type(adam.decays[1])
    least = v.dtype.type(adam.epsilon)
    total = g[0] * g[0]
    for i in range(1, len(g)):
        total += g[i] * g[i]
    norm = math.sqrt(total)
    # Written so that a NaN norm makes the share NaN, as in torch.
    limit = adam.bound / (norm + 1e-6) if adam.bound < math.inf else 1.0
    share = v.dtype.type(1.0 if limit >= 1 else limit)
    adam.counts[p] += 1
    # The bias corrections of both moments are applied to the step, as in torch.
    step = v.dtype.type(adam.lr / (1 - adam.decays[0] ** adam.counts[p]))
    scale = v.dtype.type(1 / math.sqrt(1 - adam.decays[1] ** adam.counts[p]))
    for i in range(len(v)):
        clipped = g[i] * share
        m[i] = first * m[i] + (one - first) * clipped
        s[i] = second * s[i] + (one - second) * clipped * clipped
        v[i] -= step * m[i] / (math.sqrt(s[i]) * scale + least)
    return norm


@compiled
def step_networks(
    values: Floats, gradient: Floats, adam: Adam, active: NDArray[np.bool_], norms: Floats
) -> None:
    """Take a step of the `active` (P,) networks; write the gradients' norms to `norms` (P,), 0 for others."""
    for p in range(len(values)):
        norms[p] = step_network(values[p], gradient[p], adam, p) if active[p] else 0
