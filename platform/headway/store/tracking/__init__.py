"""MLflow as a follower of the run folders."""
