"""Experiment store: run folders are the source of truth; MLflow and an index are derived from them.

A training process writes `RunLog` and checkpoints; the session process writes the rest through
`SessionStore`. `select` returns any runs as pandas frames.
"""
