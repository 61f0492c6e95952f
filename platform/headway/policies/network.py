"""Evaluation of a `PolicyNetwork` in numpy or, for export, in torch: one definition for both."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from headway.contracts import Discrete
from headway.policies.description import PolicyDescription

# The arguments are arrays of numpy or tensors of torch, whose common functions are used.
Array = Any
Library = Any


class Evaluation(NamedTuple):
    """Results for B observations of all N agents."""

    actions: Array
    """Greedy actions in the units of the environment: (B, N) for Discrete, (B, N, choices) for MultiDiscrete,
    (B, N, A), clipped to the bounds, for Box."""
    outputs: Array
    """Parameters of the distribution: logits or values (B, N, A), not masked; means followed by log standard
    deviations (B, N, 2 A); for `tanh` the outputs before it (B, N, A)."""
    state: Array | None
    """(B, N, M): next hidden states; None without recurrent units."""


def evaluate(
    library: Library,
    description: PolicyDescription,
    arrays: Mapping[str, Array],
    observations: Array,
    masks: Array | None,
    state: Array | None,
) -> Evaluation:
    """Evaluate observations (B, N, D) with action masks (B, N, A) and hidden states (B, N, M).

    `library` is the module numpy or torch; `arrays` are those of the network and `description.constants`, all
    real numbers in one dtype. See `PolicyNetwork` for the equations.
    """
    xp, network = library, description.network
    policies = arrays["policy_of_agent"]
    in_order = network.policy_of_agent == tuple(range(len(network.policy_of_agent)))

    def own(name: str) -> Array:
        """Return each agent's array (N, ...), or that of the only policy (1, ...)."""
        stacked = arrays[name]
        return stacked if in_order or len(stacked) == 1 else stacked[policies]

    def layer(weight: str, bias: str, inputs: Array) -> Array:
        return inputs @ own(weight).swapaxes(1, 2) + own(bias).swapaxes(1, 2)

    def sigmoid(inputs: Array) -> Array:
        return 0.5 * (xp.tanh(0.5 * inputs) + 1)

    x = observations.swapaxes(0, 1)  # (N, B, D)
    agents, copies = x.shape[0], x.shape[1]
    if network.num_indices:
        indices = xp.broadcast_to(arrays["indices"], (agents, copies, network.num_indices))
        x = xp.concatenate([x, indices], -1)
    if network.observation_clip:
        x = (x - own("observation_mean")) * own("observation_scale")
        x = xp.clip(x, -network.observation_clip, network.observation_clip)
    for i in range(network.hidden_layers):
        x = layer(f"weight_{i}", f"bias_{i}", x)
        x = xp.tanh(x) if network.activation == "tanh" else xp.clip(x, 0, None)
    if network.hidden_size and state is not None:
        size, h = network.hidden_size, state.swapaxes(0, 1)
        g = layer("gru_weight_input", "gru_bias_input", x)
        u = h @ own("gru_weight_hidden").swapaxes(1, 2)
        reset = sigmoid(g[..., :size] + u[..., :size])
        update = sigmoid(g[..., size : 2 * size] + u[..., size : 2 * size])
        bias = own("gru_bias_hidden").swapaxes(1, 2)
        candidate = xp.tanh(reset * (u[..., 2 * size :] + bias) + g[..., 2 * size :])
        x = candidate + update * (h - candidate)
        state = x.swapaxes(0, 1)
    outputs = layer(f"weight_{network.hidden_layers}", f"bias_{network.hidden_layers}", x).swapaxes(0, 1)
    if description.action_space.options:
        return Evaluation(greedy_actions(xp, description, outputs, masks), outputs, state)
    chosen = xp.tanh(outputs) if network.output == "tanh" else outputs
    actions = in_environment_units(xp, arrays, chosen)
    if network.output == "mean":
        spread = own("log_std")[..., 0] + xp.zeros_like(outputs)
        outputs = xp.concatenate([outputs, spread], -1)
    return Evaluation(actions, outputs, state)


def in_environment_units(library: Library, arrays: Mapping[str, Array], chosen: Array) -> Array:
    """Return Box actions (..., A) of the network scaled to the environment's units and clipped to its bounds.

    For `tanh` networks they are in [-1, 1].
    """
    actions = chosen * arrays["action_scale"] + arrays["action_offset"]
    return library.clip(actions, arrays["action_low"], arrays["action_high"])


def greedy_actions(
    library: Library, description: PolicyDescription, outputs: Array, masks: Array | None
) -> Array:
    """Return actions (B, N) or (B, N, choices): the allowed option with the largest output of each choice."""
    xp = library
    allowed = outputs if masks is None else xp.where(masks, outputs, -float("inf"))
    best, first = [], 0
    for count in description.action_space.options:
        best.append(allowed[..., first : first + count].argmax(-1))
        first += count
    return best[0] if isinstance(description.action_space, Discrete) else xp.stack(best, -1)
