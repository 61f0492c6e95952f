"""Long proofs, run by hand: `python -m headway_launch.trials.killed_study` or `merge_parity`."""
