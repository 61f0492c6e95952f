"""Environments of other libraries as batches of copies, and what every environment must keep to."""
