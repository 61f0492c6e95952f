"""Headway's algorithms. They import only torch, numpy and the contracts; this module imports no torch."""
