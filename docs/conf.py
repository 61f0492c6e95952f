"""Configuration of the documentation site, for Sphinx."""

import re
import sys
from dataclasses import is_dataclass
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import reference_pages  # noqa: E402 - stands beside this file

project = "Headway"
version = release = installed_version("headway")
language = "en"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
nitpicky = True

myst_enable_extensions = ["deflist", "attrs_block"]
myst_heading_anchors = 3
highlight_language = "bash"  # of indented blocks, which are commands

default_role = "literal"  # docstrings put code between single backticks
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints = "signature"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = "Headway"
html_static_path = ["static"]
html_css_files = ["headway.css"]
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False

_ARRAY = re.compile(r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[([^\]]+)\]\]")
"""What autodoc makes of `NDArray[...]`."""
_NAMED_BLOCK = re.compile(r"^```(\w+) (\S+)$", re.MULTILINE)
"""Opening line of a code block that names its file, such as "python crossing/envs.py"."""


def _show_file_names(app: Sphinx, name: str, source: list[str]) -> None:
    """Show the file's name above a code block."""
    source[0] = _NAMED_BLOCK.sub(r"```{code-block} \1\n:caption: \2\n", source[0])


def _resolve_type(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, text: nodes.TextElement
) -> nodes.Node | None:
    """Resolve a Python name in a signature: link a public class, whichever module defines it, and show any
    other name, such as one of numpy, as plain text."""
    if node.get("refdomain") != "py":
        return None
    public = reference_pages.public_name(node["reftarget"])
    objects: dict[str, Any] = env.domaindata["py"]["objects"]
    if public not in objects:
        return text
    return env.domains["py"].resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, text)


def _shorten_signature(
    app: Sphinx,
    what: str,
    name: str,
    thing: object,
    options: object,
    arguments: str | None,
    returned: str | None,
) -> tuple[str | None, str | None]:
    """Return a signature with arrays as `NDArray`; none for a record, whose fields stand below it, and for a
    protocol, which is not called."""
    if what == "class" and (
        hasattr(thing, "_fields") or is_dataclass(thing) or arguments == "(*args, **kwargs)"
    ):
        return "", ""
    arguments, returned = (
        text and _ARRAY.sub(r"~numpy.typing.NDArray[\1]", text) for text in (arguments, returned)
    )
    return arguments, returned


def setup(app: Sphinx) -> None:
    """Write the generated pages, and connect to Sphinx's events."""
    reference_pages.write(HERE / "reference")
    app.connect("autodoc-process-signature", _shorten_signature)
    app.connect("source-read", _show_file_names)
    app.connect("missing-reference", _resolve_type)
