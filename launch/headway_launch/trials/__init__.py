"""Long proofs, run by hand: `python -m headway_launch.trials.killed_study`, `two_nodes` or `merge_parity`."""
