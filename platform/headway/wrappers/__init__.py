"""Wrappers by name: SuperSuit's for any PettingZoo environment, some also in batched form for native ones."""
