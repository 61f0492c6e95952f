"""Stacked networks, action distributions and running normalisers."""
