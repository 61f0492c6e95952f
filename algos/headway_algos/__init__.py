"""Headway's algorithms. They depend on torch, numpy, numba and `headway.contracts` only."""
