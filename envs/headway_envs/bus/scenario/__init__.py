"""Scenarios of the bus environment: tables, importers and generators, and the network built from them."""
