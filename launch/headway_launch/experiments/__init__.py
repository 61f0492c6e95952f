"""Composition of validated experiments, sweeps and searches from names and overrides."""
