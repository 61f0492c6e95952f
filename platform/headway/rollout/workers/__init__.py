"""Worker processes and Ray workers, and their exchange of data with the training process."""
