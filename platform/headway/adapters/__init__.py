"""Environments of other libraries as batches of copies, and checks of the environment contract."""
