"""Headway's engine: contracts, configuration, rollouts, training, the store, energy, statistics."""
