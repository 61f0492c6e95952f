"""Sampling of experience: collectors, samplers, worker processes and the memory that they share."""
