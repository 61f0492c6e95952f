"""One-hot index of the agent, appended to observations of agents that share a policy.

Without it, agents with equal observations act alike, even where the team needs them to differ.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from headway.contracts import EnvSpec, Trajectory
from headway_algos.config import LearnerConfig
from headway_algos.grouping import Grouping

MAX_AGENTS = 64
"""Maximum number of agents per policy for which `agent_id: null` appends the index.

With more agents, most inputs would be indices.
"""


def agent_ids(config: LearnerConfig, spec: EnvSpec) -> NDArray[np.float32]:
    """Return each agent's columns (N, G): its one-hot index among its policy's agents; G = 0 without one."""
    grouping = Grouping.of(config.policies, spec)
    if not _has_ids(config, spec, grouping.width):
        return np.zeros((spec.num_agents, 0), np.float32)
    ids = np.zeros((spec.num_agents, grouping.width), np.float32)
    policies, positions = np.nonzero(grouping.is_member)
    ids[grouping.members[policies, positions], positions] = 1
    return ids


def _has_ids(config: LearnerConfig, spec: EnvSpec, width: int) -> bool:
    if config.agent_id is not None:
        return config.agent_id
    return 2 <= width <= MAX_AGENTS and not spec.agents_come_and_go and not config.splits


def impossible_ids(config: LearnerConfig, spec: EnvSpec) -> str | None:
    """Return an error line if the config requests indices but no policy has several agents, else None."""
    if config.agent_id and Grouping.of(config.policies, spec).width == 1:
        return f"algo.agent_id=true needs a policy with several agents; use algo.agent_id=null on {spec.name}"
    return None


def with_ids(observations: NDArray[np.float32], ids: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return observations (..., N, D) with the columns of `agent_ids` appended, (..., N, D + G)."""
    if not ids.shape[1]:
        return observations
    return np.concatenate([observations, np.broadcast_to(ids, (*observations.shape[:-1], ids.shape[1]))], -1)


def trajectory_with_ids(trajectory: Trajectory, ids: NDArray[np.float32]) -> Trajectory:
    """Return the trajectory with the columns of `agent_ids` appended to all its observations."""
    return replace(
        trajectory,
        observations=with_ids(trajectory.observations, ids),
        final_observations=with_ids(trajectory.final_observations, ids),
    )
