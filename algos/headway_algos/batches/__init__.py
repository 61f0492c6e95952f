"""Trajectories rearranged for learning: rows by policy, minibatches, sequences, inputs of critics."""
