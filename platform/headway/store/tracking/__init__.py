"""MLflow tracking, derived from the run folders."""
