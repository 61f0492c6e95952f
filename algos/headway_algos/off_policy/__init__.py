"""Learning from remembered experience: transitions, a replay memory, target networks, exploration.

This module imports no torch: workers need the acting policies in it.
"""
