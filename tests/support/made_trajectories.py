"""Random trajectories that obey the contract, and GAE by its definition as a loop."""

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from headway.contracts import Box, Discrete, EnvSpec, Trajectory, TrajectoryLayout

DISCRETE = EnvSpec(
    "made", tuple("abcd"), 3, Discrete(3), groups=tuple("xyxx"), has_action_mask=True, agents_come_and_go=True
)
STATE = replace(DISCRETE, state_size=5)
TEAM = replace(STATE, shared_reward=True)
BOX = replace(DISCRETE, action_space=Box((-1.0, -1.0), (1.0, 1.0)), has_action_mask=False)


def fabricate(
    spec: EnvSpec,
    steps: int,
    copies: int,
    seed: int,
    absent: float = 0.0,
    idle: float = 0.0,
    ends: float = 0.1,
    leaves: float = 0.0,
    hidden_size: int = 0,
) -> Trajectory:
    """Return a random trajectory. Probabilities per step: `absent`, `idle` (not acting) of an agent, `ends`
    of an episode, `leaves` of one agent's stream ending before its episode."""
    draw = np.random.default_rng(seed)
    made = Trajectory.allocate(TrajectoryLayout(spec, steps, copies, hidden_size))
    by_agent = made.rewards.shape
    for array in (made.observations, made.states, made.final_observations, made.final_states):
        array[:] = 1 + 2 * draw.standard_normal(array.shape)
    made.alive[:] = draw.random(made.alive.shape) >= absent
    made.acting[:] = made.alive[:-1] & (draw.random(by_agent) >= idle)
    made.rewards[:] = draw.standard_normal((*by_agent[:2], 1) if spec.shared_reward else by_agent)
    ended = (draw.random((*by_agent[:2], 1)) < ends) | (draw.random(by_agent) < leaves)
    natural = draw.random(by_agent) < 0.4
    made.terminated[:] = ended & natural
    made.truncated[:] = ended & ~natural
    end_episodes(made)
    if isinstance(spec.action_space, Discrete):
        allowed = np.ones((*by_agent, spec.action_space.n), np.bool_)
        if spec.has_action_mask:
            made.action_masks[:] = draw.random(made.action_masks.shape) < 0.6
            made.action_masks[..., 0] |= ~made.action_masks.any(axis=-1)
            allowed = made.action_masks[:-1]
        made.actions[:] = np.where(allowed, draw.random(allowed.shape), -1).argmax(axis=-1)
        made.log_probs[:] = -np.log(allowed.sum(axis=-1)) + 0.2 * draw.standard_normal(by_agent)
    if isinstance(spec.action_space, Box):
        made.actions[:] = 0.6 * draw.standard_normal(made.actions.shape)
        density = -0.5 * (made.actions / np.exp(-0.5)) ** 2 + 0.5 - 0.5 * np.log(2 * np.pi)
        made.log_probs[:] = density.sum(axis=-1) + 0.2 * draw.standard_normal(by_agent)
    if hidden_size:
        made.begins[:] = draw.random(made.begins.shape) < 0.3
        made.episode_begins[:] = made.begins.all(axis=2)
        made.hidden_states[:] = np.where(
            made.begins[..., None], 0, draw.uniform(-1, 1, made.hidden_states.shape)
        )
    return made


def end_episodes(made: Trajectory) -> None:
    """Let the episode end wherever all streams of a copy end."""
    made.episode_ended[:] = (made.terminated | made.truncated).all(axis=2)


def poisoned(clean: Trajectory) -> Trajectory:
    """Return a copy with NaN, or an impossible action, wherever the contract allows anything."""
    bad = Trajectory(*(getattr(clean, field.name).copy() for field in fields(clean)))
    dead, unused = ~bad.alive, ~(bad.alive[:-1] & bad.acting)
    over = bad.terminated | bad.truncated
    bad.observations[dead] = np.nan
    bad.final_observations[~over] = np.nan
    bad.final_states[~bad.episode_ended] = np.nan
    bad.log_probs[unused] = np.nan
    bad.actions[dead[:-1]] = 10**6 if bad.actions.dtype == np.int64 else np.nan
    if len(bad.action_masks):
        bad.action_masks[dead] = False
    return bad


def naive_advantages(
    rewards: NDArray[np.float64],
    values: NDArray[np.float64],
    final_values: NDArray[np.float64],
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    present: NDArray[np.bool_],
    gamma: float,
    gae_lambda: float,
) -> NDArray[np.float64]:
    """Return advantages (T,) of one agent, given rewards (T,) and values (T + 1,).

    sum_l (product of gamma^gap lambda) delta_{t+l} over the steps at which the agent is present; rewards in a
    gap belong to the step before.
    """
    steps = len(rewards)

    def transition(t: int) -> tuple[float, int | None, float]:
        """(what V(t) should have been, the next step present if the stream reaches it, gamma^gap)."""
        total, discount = 0.0, 1.0
        for s in range(t, steps):
            total += discount * (0.0 if np.isnan(rewards[s]) else float(rewards[s]))
            discount *= gamma
            if terminated[s]:
                return total, None, discount
            if truncated[s]:
                return total + discount * float(final_values[s]), None, discount
            if s + 1 < steps and present[s + 1]:
                return total + discount * float(values[s + 1]), s + 1, discount
        return total + (discount * float(values[steps]) if present[steps] else 0.0), None, discount

    result = np.zeros(steps)
    for t in np.flatnonzero(present[:-1]):
        place: int | None = int(t)
        weight = 1.0
        while place is not None:
            target, after, discount = transition(place)
            result[t] += weight * (target - values[place])
            weight *= discount * gae_lambda
            place = after
    return result
