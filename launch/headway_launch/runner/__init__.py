"""A session: its jobs, the processes that train them, and the recording of their results."""
