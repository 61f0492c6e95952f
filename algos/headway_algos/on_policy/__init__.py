"""Learners from the experience of one iteration: advantages, critics, updates, orders."""
