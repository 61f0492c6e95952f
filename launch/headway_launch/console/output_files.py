"""Files that a command was asked to write."""

from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_figure(figure: "Figure", output: Path) -> None:
    """Write the file that `--output` names. Raises HeadwayError where its name does not end in a kind of
    picture, or it cannot be written."""
    if not output.suffix:
        raise HeadwayError(
            f"--output: {output} does not say which kind of picture; give a name that ends so, as "
            f"{output.name or 'picture'}.png or .svg"
        )
    try:
        figure.savefig(output)
    except (OSError, ValueError) as error:
        raise unwritten("--output", output, error) from error


def unwritten(option: str, path: Path, error: Exception) -> HeadwayError:
    """Return the error line for a file or folder, given by `option`, that cannot be written.

    `error` is what writing it raised.
    """
    reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
    if isinstance(error, FileNotFoundError) and not path.parent.exists():
        reason = f"there is no folder {path.parent}; make it first"
    return HeadwayError(f"{option}: {path} cannot be written ({reason})")
