"""Contracts, configuration, rollouts, training, the store, energy, statistics."""
