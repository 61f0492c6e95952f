"""Names, units and scales of the numbers that the kernel observes."""

from headway.contracts import ObservationFeature
from headway_envs import platoons
from headway_envs.intersection.config import CLEAR_S, GREEN_S
from headway_envs.intersection.layout import NEIGHBOURS, NUM_LANES
from headway_envs.intersection.network import ROAD_M, SPEED_LIMIT
from headway_envs.intersection.prepared import Prepared

_NEAR_M = 50.0


def features(prepared: Prepared) -> tuple[ObservationFeature, ...]:
    """Return the features of the configured observation, in order."""
    config, paper = prepared.config, _paper(prepared.network.total_length)
    of_kind = {
        "paper": paper,
        "extended": (*paper, *_path(), *_near(), *_conflicts()),
        "platoons": platoons.features(NUM_LANES, ROAD_M, SPEED_LIMIT),
    }
    return (*of_kind[config.observation], *(_clock() if config.clock else ()))


def _clock() -> tuple[ObservationFeature, ...]:
    since = f"of the time since the own road's green began, in a cycle of {2 * (GREEN_S + CLEAR_S):.0f} s"
    return tuple(ObservationFeature(f"clock_{wave}", f"{wave} {since}") for wave in ("sine", "cosine"))


def _paper(length: float) -> tuple[ObservationFeature, ...]:
    return (
        ObservationFeature("position", "position of the front on the present road or junction", "m", length),
        ObservationFeature("speed", "speed", "m/s", SPEED_LIMIT),
        ObservationFeature(
            "leader_speed", "speed of the leader (none: the speed limit) minus own", "m/s", SPEED_LIMIT
        ),
        ObservationFeature("leader_distance", "gap to the leader plus 2.5 m; 1: none", "m", length),
        ObservationFeature("follower_speed", "own speed minus the follower's (none: 0)", "m/s", SPEED_LIMIT),
        ObservationFeature("follower_distance", "gap to the follower plus 2.5 m; 1: none", "m", length),
    )


def _path() -> tuple[ObservationFeature, ...]:
    return (
        ObservationFeature("before_line", "1: before the stop line"),
        ObservationFeature("in_junction", "1: inside the junction"),
        ObservationFeature("beyond_junction", "1: beyond the junction"),
        ObservationFeature("line_distance", "distance to the stop line; 0 beyond it", "m", ROAD_M),
        ObservationFeature(
            "line_time", "line_distance at the present speed, at least 0.1 m/s; at most 1", "s", 20.0
        ),
        *(
            ObservationFeature(f"turn_{turn}", f"1: the vehicle's path through the junction, {turn}")
            for turn in ("right", "straight", "left")
        ),
    )


def _near() -> tuple[ObservationFeature, ...]:
    return (
        ObservationFeature("near_line_distance", "line_distance; at most 1", "m", _NEAR_M),
        ObservationFeature("near_leader_distance", "leader_distance; at most 1", "m", _NEAR_M),
        ObservationFeature(
            "leader_headway",
            "leader_distance at the present speed, at least 0.1 m/s; at most 1, 1: none",
            "s",
            5.0,
        ),
        ObservationFeature("near_follower_distance", "follower_distance; at most 1", "m", _NEAR_M),
    )


def _conflicts() -> tuple[ObservationFeature, ...]:
    """Return the features of vehicles on conflicting paths, in order of arrival; 0 where there are fewer, and
    for a vehicle beyond the junction."""
    return tuple(
        feature
        for number in range(1, NEIGHBOURS + 1)
        for feature in (
            ObservationFeature(f"conflict_{number}_present", "1: there is a vehicle on a conflicting path"),
            ObservationFeature(
                f"conflict_{number}_line_distance",
                "its distance to the stop line, below 0 beyond it",
                "m",
                _NEAR_M,
            ),
            ObservationFeature(f"conflict_{number}_speed", "its speed", "m/s", SPEED_LIMIT),
            ObservationFeature(
                f"conflict_{number}_line_time", "its time to the stop line, 0 to 20 s, minus own", "s", 20.0
            ),
            ObservationFeature(f"conflict_{number}_automated", "1: it is automated"),
            ObservationFeature(f"conflict_{number}_has_priority", "1: the observer must yield to it"),
        )
    )
