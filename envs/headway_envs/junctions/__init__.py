"""Junctions of any SUMO network, where automated vehicles among human drivers decide when to go."""
