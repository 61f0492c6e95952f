"""What crosses the seams of Headway. Environments and algorithms import nothing else of the engine.

Axes have one name each, here, in the engine and in the algorithms (an environment's kernel lists its own):
R replicas (seeds trained together), T steps, C copies of the environment over all replicas
(replica-major: the copies of replica r are rows r*E to (r+1)*E), E copies of one replica, N agents,
K policies of one replica, P = R x K stacked policies, G agents of the largest group, B = G x T x E rows of
one policy, W viewpoints of a critic, A actions, D observation size, S state size, M episode metrics or, of a
policy, numbers that an agent remembers.
"""

from headway.contracts.acting_policy import ActingPolicy, RecurrentPolicy
from headway.contracts.entries import AlgoEntry, EnvEntry, Renderer, Rule, RuleEntry
from headway.contracts.environment import BatchedEnv, EnvSpec, Observations, StepResult
from headway.contracts.errors import HeadwayError
from headway.contracts.lazy import Lazy
from headway.contracts.learner import (
    AsynchronousLearner,
    Contribution,
    Contributor,
    Learner,
    LearnerWithReplay,
)
from headway.contracts.random_rule import RANDOM, RandomRule
from headway.contracts.random_streams import child_seeds, generator
from headway.contracts.spaces import ActionSpace, Box, Discrete, MultiDiscrete
from headway.contracts.trajectory import Trajectory, TrajectoryLayout
from headway.contracts.wrapper import BatchedWrapper, ObservationBounds, WrapperEntry

__all__ = [
    "RANDOM",
    "ActingPolicy",
    "ActionSpace",
    "AlgoEntry",
    "AsynchronousLearner",
    "BatchedEnv",
    "BatchedWrapper",
    "Box",
    "Contribution",
    "Contributor",
    "Discrete",
    "EnvEntry",
    "EnvSpec",
    "HeadwayError",
    "Lazy",
    "Learner",
    "LearnerWithReplay",
    "MultiDiscrete",
    "ObservationBounds",
    "Observations",
    "RandomRule",
    "RecurrentPolicy",
    "Renderer",
    "Rule",
    "RuleEntry",
    "StepResult",
    "Trajectory",
    "TrajectoryLayout",
    "WrapperEntry",
    "child_seeds",
    "generator",
]
