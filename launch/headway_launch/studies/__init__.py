"""A study in the store: its plan, its runs, their comparison."""
