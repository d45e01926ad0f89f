"""A page: sections of blocks with plain texts, and the one HTML file that they become.

The template has one macro for each class of blocks and escapes every text; the file has the style
sheet, and the scripts that its blocks need.
"""

from __future__ import annotations

import base64
import gzip
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property
from importlib.resources import files
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

from markupsafe import Markup

from legcal.errors import printable
from legcal.files.folder import OutputFile
from legcal.version import __version__

if TYPE_CHECKING:
    from jinja2 import Environment

MAX_ROWS = 2000  # maximum number of rows shown of a table
Light = Literal["good", "doubtful", "bad"]
MARK = "legcal-page"  # the name that identifies a page of legcal
PAGE = OutputFile(
    "the page", "page", "", "a new file or an earlier page of legcal", mark=MARK.encode()
)


class Block:
    """A block of a section: the template has a macro for each class."""

    script: ClassVar[str] = ""  # that the page needs for it
    token = ""  # identifies the page to the server of the block

    @property
    def kind(self) -> str:
        """The name of the macro."""
        return type(self).__name__


@dataclass(frozen=True)
class Number:
    """A number of a table."""

    value: float | None  # in the unit of the column; None for an empty cell
    text: str


@dataclass(frozen=True)
class Link:
    """A text that leads to a place in the page or to a file beside it."""

    text: str
    to: str


Cell = str | Number | Link


@dataclass(frozen=True)
class Text(Block):
    """Paragraphs."""

    paragraphs: Sequence[str]
    dim: bool = False


class Step(Protocol):
    """A thing to do, with a command to copy."""

    what: str
    command: str


@dataclass(frozen=True)
class Items(Block):
    """A list."""

    items: Sequence[str | Step]
    ordered: bool = False
    title: str = ""


@dataclass(frozen=True)
class Facts(Block):
    """Names and values, a line each."""

    facts: Mapping[str, str]


@dataclass(frozen=True)
class Table(Block):
    """A table, sortable by its columns or not; the first :data:`MAX_ROWS` rows are shown."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    note: str = ""
    sortable: bool = True
    least: Mapping[int, int] = field(default_factory=dict)  # widths of columns of a narrow terminal

    @property
    def shown(self) -> Sequence[Sequence[Cell]]:
        """The rows that are shown."""
        return self.rows[:MAX_ROWS]

    @property
    def left_out(self) -> str:
        """The note on rows that are left out."""
        n = len(self.rows)
        return f"The first {MAX_ROWS} of {n} rows are shown." if n > MAX_ROWS else ""


@dataclass(frozen=True)
class Drawing(Block):
    """A drawing (SVG)."""

    svg: Markup
    caption: str = ""
    title: str = ""


@dataclass(frozen=True)
class Row(Block):
    """Blocks side by side where there is room."""

    blocks: Sequence[Block]


@dataclass(frozen=True)
class Charts(Block):
    """Drawings side by side whose points stand for things with a label, and maybe a link.

    The paths of their points have the numbers of these things in ``data-points``.
    """

    charts: Sequence[Drawing]
    labels: Mapping[int, str]  # by number
    links: Mapping[int, str]


@dataclass(frozen=True)
class Scene(Block):
    """A scene in space on a canvas; its content is described in ``scene.js``."""

    script: ClassVar = "scene.js"
    name: str
    content: Mapping[str, Any]
    height: int
    caption: str = ""


@dataclass(frozen=True)
class Sliders(Block):
    """Sliders that move the machine of a scene by its server, and photographs of its poses.

    A slider has ``name``, ``label``, ``low``, ``high`` and ``step``, or is a ``button``; posts of
    its value are answered by a state: ``values`` of sliders, ``problems``, the content of the
    ``scene``, and ``photographs`` with ``file``, ``size``, ``caption`` and ``lines``.
    """

    script: ClassVar = "sliders.js"
    scene: str  # the name of the scene
    sliders: Sequence[Mapping[str, Any]]
    state: Mapping[str, Any]
    token: str  # identifies the page to its server


@dataclass(frozen=True)
class Crop:
    """A piece of an image with lines over it."""

    name: str  # its anchor
    picture: str  # :func:`data_url`
    width: int  # [px] of the image
    height: int
    lines: Sequence[tuple[str, str]]  # class, and points "x,y x,y"
    caption: str
    detail: str
    link: str = ""


@dataclass(frozen=True)
class Gallery(Block):
    """Pieces of images; a click enlarges one."""

    crops: Sequence[Crop]
    title: str = ""


@dataclass(frozen=True)
class Picture(Block):
    """An image, beside the page or in it."""

    file: str  # its place, relative to the page; or :func:`data_url`
    caption: str
    warning: str = ""  # text in red
    edit: int | None = None  # its place in the editor of outlines of the page
    place: int | None = None  # its place in the editor of landmarks, if it is offered there

    @property
    def is_inside(self) -> bool:
        """Whether the page holds it."""
        return self.file.startswith("data:")


def data_url(jpeg: bytes) -> Markup:
    """Return a JPEG as an address that holds it."""
    return Markup("data:image/jpeg;base64," + base64.b64encode(jpeg).decode())


@dataclass(frozen=True)
class OutlineEditor(Block):
    """A table of outlines that people correct over their photographs and download.

    An image has ``view`` and ``image`` as in the table, a ``label``, its ``photograph`` relative to
    the page, ``width`` and ``height`` [px], the number of its ``camera``, and ``expected``: both
    ends [px] of outlines that were not detected, by leg, part and edge. A camera
    has ``K``, ``distortion`` and ``model``. ``reasons`` has the words of each code of a rejection,
    without a detail and with one in place of ``{}``.
    """

    script: ClassVar = "editor.js"
    file: str  # the name of the table
    table: str  # its text
    images: Sequence[Mapping[str, Any]]
    cameras: Sequence[Mapping[str, Any]]
    sigma: float  # default standard deviation of ends placed by hand [px]
    reasons: Mapping[str, tuple[str, str]]

    @cached_property
    def packed(self) -> Markup:
        """The table, compressed, as a text."""
        data = gzip.compress(self.table.encode(), mtime=0)
        return Markup(base64.b64encode(data).decode())


@dataclass(frozen=True)
class LandmarkEditor(Block):
    """Joints that people click in photographs, and a table of them to download.

    An image has ``view`` and ``image`` as in the table, a ``label``, its ``photograph`` relative to
    the page, ``width`` and ``height`` [px]. A joint has its ``name`` in the table and its ``label``
    in the drawing, whose discs have the name in ``data-joint``. Clicks are numbers of image and
    joint, u and v [px], and sigma as in the table.
    """

    script: ClassVar = "landmarks.js"
    file: str  # the name of the table
    images: Sequence[Mapping[str, Any]]
    joints: Sequence[Mapping[str, str]]
    clicks: Sequence[tuple[int, int, float, float, str]]
    drawing: Markup  # of the machine
    sigma: float  # default standard deviation of a click [px]
    first: int = 0  # the image that is shown first
    token: str = ""  # identifies the page to its server; "" if the page is a file


@dataclass(frozen=True)
class Dialogue(Block):
    """What a running command asks and says, with a field for answers; the page is served."""

    script: ClassVar = "dialogue.js"
    token: str  # identifies the page to its server


@dataclass(frozen=True)
class Section:
    """A section."""

    name: str  # its anchor
    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Verdict:
    """The verdict on a result."""

    light: Light
    word: str
    sentence: str
    reasons: Sequence[str]


@dataclass(frozen=True)
class Page:
    """A page."""

    title: str
    subtitle: str
    verdict: Verdict | None
    sections: Sequence[Section]


def number(value: float | None, digits: int) -> Number:
    """Return a number with some digits behind the point."""
    if value is None:
        return Number(None, "")
    return Number(float(value), f"{value:z.{digits}f}")


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
    scripts = dict.fromkeys(["page.js", *(block.script for block in blocks if block.script)])
    pictures = any(isinstance(block, Picture) and not block.is_inside for block in blocks)
    return (
        _environment()
        .get_template("page.html")
        .render(
            page=page,
            mark=MARK,
            version=__version__,
            style=_asset("page.css"),
            scripts=map(_asset, scripts),
            served=any(block.token for block in blocks),
            pictures=pictures,
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
