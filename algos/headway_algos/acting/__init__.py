"""Policies at play in workers, in numpy: nothing here imports torch."""
