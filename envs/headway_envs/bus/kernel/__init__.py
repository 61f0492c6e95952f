"""The compiled simulator: exact event times under a synchronous control clock.

layout: records; draws: keyed random numbers; curves: tables over time; passengers: queues; motion: events;
spacing, rewards, observe: what follows from the state; day: begin and end; tick: the two entries.
"""


def warm() -> None:
    """Load every compiled function, from the cache where it holds it, by two days of a tiny network."""
    from headway_envs.bus.warm_up import run_tiny

    run_tiny()
