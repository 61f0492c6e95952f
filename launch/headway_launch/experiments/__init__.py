"""From names and overrides to validated experiments, sweeps and searches; stored runs."""
