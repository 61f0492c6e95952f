"""Which agents are part of what a critic values right after a stream was cut."""

import numpy as np

from headway.contracts import Discrete, EnvSpec, Trajectory, TrajectoryLayout
from headway_algos.batches.critic_batch import CriticBatch
from headway_algos.batches.stream_ends import Truncations

SPEC = EnvSpec("made", ("stays", "leaves", "left", "away", "joins"), 1, Discrete(2), agents_come_and_go=True)
STAYS, LEAVES, LEFT, AWAY, JOINS = range(5)


def _at_the_cut(whole_episode: bool) -> CriticBatch:
    """Two steps. `left` terminates with the first and `leaves` with the second one, at which `stays` is
    truncated and `away` is away; `joins` is there from then on. At an episode's end all are marked."""
    made = Trajectory.allocate(TrajectoryLayout(SPEC, 2, 1))
    made.alive[:, 0, STAYS] = made.alive[:2, 0, LEAVES] = made.alive[0, 0, [LEFT, AWAY]] = True
    made.terminated[0, 0, LEFT] = made.terminated[1, 0, LEAVES] = made.truncated[1, 0, STAYS] = True
    made.alive[2, 0, STAYS] = False
    made.alive[2, 0, JOINS] = True
    if whole_episode:
        made.terminated[1, 0, LEFT] = made.truncated[1, 0, [AWAY, JOINS]] = made.episode_ended[1, 0] = True
    made.observations[:], made.final_observations[:] = 1, 2
    return CriticBatch.after_truncations(made, Truncations.of(made, 1))


def test_agents_that_left_are_excluded_from_a_cut_episode() -> None:
    """The first agent of the next episode is excluded too."""
    scene = _at_the_cut(whole_episode=True)
    assert scene.in_joint[0, 0].tolist() == [True, False, False, False, False]


def test_agents_that_left_are_excluded_from_an_episode_that_continues() -> None:
    scene = _at_the_cut(whole_episode=False)
    assert scene.in_joint[0, 0].tolist() == [True, False, False, False, True]


def test_every_stream_that_ended_has_its_own_last_observation() -> None:
    scene = _at_the_cut(whole_episode=True)
    np.testing.assert_array_equal(scene.observations[0, 0, :, 0], [2, 2, 2, 2, 2])
    assert scene.present.all()
