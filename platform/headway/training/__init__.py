"""The training loop and its two modes."""
