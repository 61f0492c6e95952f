"""A session: its jobs, the processes that train them, and what is recorded of them."""
