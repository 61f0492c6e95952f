"""Scenarios of the bus environment: their tables, where they come from, and the network built from them."""
