"""Automated vehicles among human drivers at a crossing without signals, simulated by SUMO."""
