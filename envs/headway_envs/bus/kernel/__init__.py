"""Compiled bus simulator: events at exact times, actions once per control interval.

- `layout`: records; `allocation`: their arrays
- `draws`: keyed random numbers; `curves`: values over time of day
- `passengers`: queues at stops; `motion`: the events of a bus, and the loop over them
- `spacing`, `upkeep`, `rewards`, `observe`: values derived from the state
- `day`: start and end of a service day
- `future`: another future of the same present
- `tick`: the functions that the environment calls
"""


def warm() -> None:
    """Load every compiled function, from the cache where possible, by simulating a tiny network."""
    from headway_envs.bus.warm_up import run_tiny

    run_tiny()
