"""Imported for its effect: loads the kernels of the algorithms, for the processes forked from this one."""

from headway_algos import kernels

kernels.warm()
