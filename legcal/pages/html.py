"""A page as one HTML file: template, style sheet, and the scripts that its blocks need."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from legcal.errors import printable
from legcal.files.folder import OutputFile
from legcal.pages.document import LandmarkEditor, OutlineEditor, Page, Picture, Row, Scene
from legcal.version import __version__

if TYPE_CHECKING:
    from jinja2 import Environment

MARK = "legcal-page"  # the name that identifies a page of legcal
PAGE = OutputFile(
    "the page", "page", "", "a new file or an earlier page of legcal", mark=MARK.encode()
)

_SCRIPTS = {Scene: "scene.js", OutlineEditor: "editor.js", LandmarkEditor: "landmarks.js"}


def time_of_page() -> str:
    """Return the time on a page: now, or ``SOURCE_DATE_EPOCH`` if it is set.

    The variable makes pages reproducible for comparison.
    """
    stated = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(stated), UTC) if stated.isdecimal() else datetime.now()
    return now.astimezone().strftime("%Y-%m-%d %H:%M %Z")


def page_html(page: Page) -> str:
    """Return a page as HTML."""
    blocks = [block for section in page.sections for block in section.blocks]
    blocks += [inner for block in blocks if isinstance(block, Row) for inner in block.blocks]
    return (
        _environment()
        .get_template("page.html")
        .render(
            page=page,
            mark=MARK,
            version=__version__,
            style=_asset("page.css"),
            scripts=[
                _asset("page.js"),
                *(
                    _asset(name)
                    for kind, name in _SCRIPTS.items()
                    if any(isinstance(block, kind) for block in blocks)
                ),
            ],
            served=any(isinstance(block, LandmarkEditor) and block.token for block in blocks),
            pictures=any(isinstance(block, Picture) and not block.is_inside for block in blocks),
        )
    )


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined  # most commands need none

    return Environment(
        loader=PackageLoader("legcal.pages", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
    )


def _shown(value: Any) -> Any:
    """Return a value for the page: texts without control characters."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return printable(value)
    return value


@cache
def _asset(name: str) -> Markup:
    return Markup((files("legcal.pages") / "assets" / name).read_text("utf-8"))
