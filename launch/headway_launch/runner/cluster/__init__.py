"""Training on several machines: Ray and Slurm."""
