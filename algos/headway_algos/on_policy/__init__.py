"""On-policy learning from one iteration's trajectory: advantages, critics, updates, orders."""
