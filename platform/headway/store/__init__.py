"""The experiment store: run folders that are the truth, MLflow and an index that follow them."""
