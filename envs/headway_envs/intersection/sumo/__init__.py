"""SUMO: the simulation, its vehicles, and their slots."""
