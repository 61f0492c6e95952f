"""Wrappers by name: SuperSuit's for any PettingZoo environment, and twins of some for batches of copies."""
