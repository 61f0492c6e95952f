"""Environments of other libraries as batches of copies, and the check that no live number is NaN."""
