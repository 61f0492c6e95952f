"""SUMO: the simulation, its traffic, its vehicles by slot."""
