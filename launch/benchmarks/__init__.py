"""Measurements of speed and weight, as ratios within one run: `make benchmarks`."""
