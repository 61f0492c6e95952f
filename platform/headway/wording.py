"""Wording shared by all printed output."""


def counted(count: int, what: str) -> str:
    """Return a count with its noun: `1 run`, `3 runs`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def environment_name(env_id: str) -> str:
    """Return an environment's id, or the name of its file: `shuttle.py` for `/lab/shuttle.py`."""
    return env_id.rpartition("/")[2] if env_id.endswith(".py") else env_id
