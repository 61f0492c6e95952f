"""Wording shared by all printed output."""


def counted(count: int, what: str) -> str:
    """Return a count with its noun: `1 run`, `3 runs`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"
