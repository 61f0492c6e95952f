"""What to say of a file that a command was asked for and that cannot be written."""

from pathlib import Path

from headway.contracts.errors import HeadwayError


def unwritten(option: str, path: Path, error: Exception) -> HeadwayError:
    """The line for a file or folder given by `option`; `error` is what writing it raised."""
    reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    if isinstance(error, FileNotFoundError) and not path.parent.exists():
        reason = f"there is no folder {path.parent}; make it first"
    return HeadwayError(f"{option}: {path} cannot be written ({reason})")
