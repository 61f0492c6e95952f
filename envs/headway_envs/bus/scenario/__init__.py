"""Scenarios: eight tables and `meta.json`, from a generator or a folder, and the network built of them."""
