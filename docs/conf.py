"""Configuration of the documentation: python -m sphinx -W --keep-going -b html docs docs/_build/html."""

import re
from importlib.metadata import version as installed_version

project = "kinefit"
author = "the kinefit authors"
release = version = installed_version("kinefit")

extensions = [
    "myst_parser", "sphinx_click", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.autosummary",
    "sphinx.ext.napoleon", "sphinx.ext.mathjax",
]
exclude_patterns = ["_build", "_templates"]
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme = "furo"
html_title = f"kinefit {release}"

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 4

default_role = "literal"  # `name` in a docstring is code
suppress_warnings = ["ref.python"]  # "(K,) names" in a docstring are words: several classes have one of that name
autosummary_generate = True
autosummary_ignore_module_all = False
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"  # docstrings give shapes and units, which say more
autodoc_preserve_defaults = True
napoleon_google_docstring = False


def plain_text(app, what, name, obj, options, lines):
    """Take stars, bars and trailing underscores outside of `code` as they stand: docstrings are prose, not markup."""
    for index, line in enumerate(lines):
        parts = re.split(r"(``?[^`]+``?)", line)
        parts[::2] = [re.sub(r"([*|]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
        lines[index] = "".join(parts)


def branch_of_the_page(app, pagename, templatename, context, doctree):
    """Open the sidebar's tree along the way to the page alone: the whole tree, in each of 500 pages, takes minutes."""
    if whole := context.get("toctree"):
        context["toctree"] = lambda **options: whole(**{**options, "collapse": True})


def plain_help(app, ctx, lines):
    """The same for what commands say of themselves; a default that is a path stands as it is typed."""
    lines[:] = [re.sub(r"(?:Posix|Windows)Path\('([^']*)'\)", r"\1", line).replace("*", r"\*") for line in lines]


def examples(app, ctx, lines):
    """Let examples stand as they are printed."""
    text = [line.removeprefix("|").removeprefix(" ") for line in lines]
    lines[:] = ["::", "", *(f"   {line}".rstrip() for line in text), ""] if any(text) else lines


def setup(app):
    """Run before napoleon and the theme, which have the default priority of 500."""
    app.connect("autodoc-process-docstring", plain_text, priority=400)
    app.connect("html-page-context", branch_of_the_page, priority=400)
    for part in ("description", "options", "arguments"):
        app.connect(f"sphinx-click-process-{part}", plain_help)
    app.connect("sphinx-click-process-epilog", examples)
