"""Collecting experience: samplers, worker processes and the shared memory between them."""
