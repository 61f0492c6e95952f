"""Headway's algorithms. They import only torch, numpy, numba and the contracts; this module no torch."""
