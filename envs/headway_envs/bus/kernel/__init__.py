"""The compiled simulator: exact event times under a synchronous control clock.

layout: records; draws: keyed random numbers; curves: tables over time; passengers: queues; motion: events;
spacing, rewards, observe: what follows from the state; day: begin and end; tick: the two entries.
"""
