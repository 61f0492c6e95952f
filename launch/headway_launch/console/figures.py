"""Matplotlib's figures as files."""

from pathlib import Path
from typing import TYPE_CHECKING

from headway.contracts.errors import HeadwayError
from headway_launch.console.unwritten import unwritten

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
