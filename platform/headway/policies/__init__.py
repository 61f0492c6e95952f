"""Trained policies taken out of the platform: their description, evaluation in numpy, and files."""
