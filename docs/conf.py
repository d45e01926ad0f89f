"""Sphinx: pages in MyST, the tutorial executed, no network, warnings are errors (-W)."""

import re
from pathlib import Path
from typing import Any

from legcal.version import __version__

project = "legcal"
author = "The legcal developers"
copyright = "the legcal developers, BSD-2-Clause"
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build"]
suppress_warnings = ["mystnb.unknown_mime_type"]

myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 4
nb_execution_mode = "cache"  # a page is executed again only where its code has changed
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_output_stderr = "remove"  # progress

autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = True

html_theme = "furo"
html_title = f"legcal {release}"
html_static_path: list[str] = []
html_copy_source = False
html_show_sphinx = False


def notebook_of(page: Path) -> Any:
    """Return the notebook (nbformat) of a page with code cells; links to other pages are text."""
    from myst_nb.core.read import read_myst_markdown_notebook

    notebook = read_myst_markdown_notebook(page.read_text(encoding="utf-8"))
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = re.sub(r"\[([^]]+)\]\((?!http)[^)]+\)", r"\1", cell.source)
    return notebook


def _write_notebook(app: Any, failure: Exception | None) -> None:
    """Put the tutorial beside its page, to be downloaded."""
    import nbformat

    if failure is None and app.builder.format == "html":
        notebook = notebook_of(Path(app.srcdir) / "tutorial.md")
        nbformat.write(notebook, Path(app.outdir) / "tutorial.ipynb")


def _joined(outputs: list[Any]) -> list[Any]:
    """Join the parts of a stream: MyST-NB ends a line after each, wherever it is cut."""
    found: list[Any] = []
    streams: dict[str, Any] = {}
    for output in outputs:
        if output["output_type"] == "stream" and output["name"] in streams:
            streams[output["name"]]["text"] += output["text"]
            continue
        if output["output_type"] == "stream":
            streams[output["name"]] = output
        found.append(output)
    return found


def setup(app: Any) -> None:
    """Connect what is done when the site is built."""
    from myst_nb.core import render

    render.coalesce_streams = _joined
    app.connect("build-finished", _write_notebook)
