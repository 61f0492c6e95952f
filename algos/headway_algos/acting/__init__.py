"""Acting policies for rollout workers, in numpy; nothing here imports torch."""
