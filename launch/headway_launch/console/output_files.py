"""Output files of commands."""

import tempfile
from pathlib import Path
from typing import IO, TYPE_CHECKING

from headway.contracts.errors import HeadwayError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_figure(figure: "Figure", output: Path) -> None:
    """Write a figure to the file of `--output`.

    Raises HeadwayError if its suffix is not that of a picture format or it cannot be written.
    """
    if not output.suffix:
        raise HeadwayError(
            f"--output: {output} has no suffix for the picture's format; give a name such as "
            f"{output.name or 'picture'}.png or .svg"
        )
    try:
        save_figure(figure, output, output.suffix[1:])
    except (OSError, ValueError) as error:
        raise write_error("--output", output, error) from error


def save_figure(
    figure: "Figure", target: Path | IO[bytes], kind: str, dots_per_inch: float | None = None
) -> None:
    """Save a figure as `kind`, such as `png`, `svg` or `pdf`; equal figures give equal SVG and PDF files.

    PDF and EPS embed their fonts as TrueType, as publishers ask; SVG draws text as paths and needs no font.
    Raises ValueError for an unknown kind.
    """
    import matplotlib as mpl

    without_date = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind.lower())
    with mpl.rc_context({"svg.hashsalt": "headway", "pdf.fonttype": 42, "ps.fonttype": 42}):
        figure.savefig(target, format=kind, metadata=without_date, dpi=dots_per_inch or "figure")


def require_writable(option: str, path: Path, folder: Path) -> None:
    """Raise HeadwayError if the file of `option` cannot be written; called first, so that no work is lost.

    `folder` must exist and be writable: the file's folder, or the folder in which that will be created.
    """
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
        if path.exists():
            with path.open("ab"):
                pass
    except OSError as error:
        raise write_error(option, path, error) from error


def write_error(option: str, path: Path, error: Exception) -> HeadwayError:
    """Return the error for the file or folder of `option`, which could not be written because of `error`."""
    reason = (error.strerror if isinstance(error, OSError) else None) or " ".join(str(error).split())
    if isinstance(error, FileNotFoundError) and not path.parent.exists():
        reason = f"there is no folder {path.parent}; create it first"
    return HeadwayError(f"{option}: {path} cannot be written ({reason})")
