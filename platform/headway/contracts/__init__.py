"""The interfaces between environments, algorithms and the platform.

Environments and algorithms import nothing else of `headway`; other packages import these names from
`headway.api`. Array axes have one letter each, used in every docstring of the platform and of the algorithms
(an environment's kernel lists its own):

- R: replicas, the seeds trained together
- T: steps of an iteration
- E: environment copies per replica
- C: environment copies of all replicas, C = R x E, replica-major: rows r*E to (r+1)*E - 1 are replica r's
- N: agents of a copy
- K: policies per replica
- P: stacked policies of all replicas, P = R x K, replica-major
- G: agents of the largest group of agents that share a policy
- B: rows of one policy, B = G x T x E
- W: inputs of a critic per copy, N for a critic per agent and 1 for a critic per team
- A: actions of a Discrete space, or the options of all choices of a MultiDiscrete space
- D: length of an agent's observation
- S: length of the global state
- M: episode metrics or, in a policy, components of an agent's hidden state
"""

from headway.contracts.acting_policy import ActingPolicy, RecurrentPolicy
from headway.contracts.checks import require_value
from headway.contracts.entries import AlgoEntry, EnvEntry, Renderer, Rule, RuleEntry
from headway.contracts.environment import (
    BatchedEnv,
    BranchingEnv,
    EnvSpec,
    ObservationFeature,
    Observations,
    StepResult,
)
from headway.contracts.errors import EnvironmentRaisedError, HeadwayError
from headway.contracts.lazy import Lazy
from headway.contracts.learner import (
    AnchoredLearner,
    AsynchronousLearner,
    ContinuingLearner,
    Contribution,
    Contributor,
    Learner,
    LearnerWithReplay,
    StartingLearner,
)
from headway.contracts.policy_network import DescribedPolicy, PolicyNetwork
from headway.contracts.published import PublishedResult, PublishedResults
from headway.contracts.random_rule import RANDOM, RandomRule
from headway.contracts.random_streams import child_seeds, generator
from headway.contracts.spaces import ActionSpace, Box, Discrete, MultiDiscrete
from headway.contracts.trajectory import Trajectory, TrajectoryLayout
from headway.contracts.wrapper import BatchedWrapper, BatchWrapper, ObservationBounds, WrapperEntry

__all__ = [
    "RANDOM",
    "ActingPolicy",
    "ActionSpace",
    "AlgoEntry",
    "AnchoredLearner",
    "AsynchronousLearner",
    "BatchWrapper",
    "BatchedEnv",
    "BatchedWrapper",
    "Box",
    "BranchingEnv",
    "ContinuingLearner",
    "Contribution",
    "Contributor",
    "DescribedPolicy",
    "Discrete",
    "EnvEntry",
    "EnvSpec",
    "EnvironmentRaisedError",
    "HeadwayError",
    "Lazy",
    "Learner",
    "LearnerWithReplay",
    "MultiDiscrete",
    "ObservationBounds",
    "ObservationFeature",
    "Observations",
    "PolicyNetwork",
    "PublishedResult",
    "PublishedResults",
    "RandomRule",
    "RecurrentPolicy",
    "Renderer",
    "Rule",
    "RuleEntry",
    "StartingLearner",
    "StepResult",
    "Trajectory",
    "TrajectoryLayout",
    "WrapperEntry",
    "child_seeds",
    "generator",
    "require_value",
]
