"""Worker processes and Ray actors, and what they share with the training process."""
