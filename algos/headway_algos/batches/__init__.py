"""Experience laid out by policy for learning."""
