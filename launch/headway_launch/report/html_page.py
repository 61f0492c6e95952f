"""A report as one self-contained HTML page."""

import base64
import io
from importlib.resources import files

from headway_launch.console.output_files import save_figure
from headway_launch.report.elements import Listing, Picture, Report, Table, text_and_code


def html(report: Report) -> str:
    """Render the page; all names and texts are escaped."""
    from jinja2 import Environment

    source = files("headway_launch.report").joinpath("page.html").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["code"] = _with_code
    environment.filters["breakable"] = _breakable
    environment.tests["table"] = lambda part: isinstance(part, Table)
    environment.tests["picture"] = lambda part: isinstance(part, Picture)
    environment.tests["listing"] = lambda part: isinstance(part, Listing)
    return environment.from_string(source).render(report=report, picture_data=_inline)


def _inline(picture: Picture) -> str:
    """Return a picture as a data URL of an SVG."""
    content = io.BytesIO()
    save_figure(picture.figure, content, "svg")
    return "data:image/svg+xml;base64," + base64.b64encode(content.getvalue()).decode()


def _breakable(heading: str) -> object:
    """Let a heading break after underscores, because names of rules are long."""
    from markupsafe import Markup

    return Markup("_<wbr>").join(heading.split("_"))


def _with_code(text: str) -> object:
    """Set text between backquotes as code."""
    from markupsafe import Markup, escape

    pieces = (
        Markup("<code>{}</code>").format(piece) if is_code else escape(piece)
        for piece, is_code in text_and_code(text)
    )
    return Markup("").join(pieces)
