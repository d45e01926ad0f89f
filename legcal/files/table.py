"""Tables in CSV, which people edit: the single reader and writer of them.

A table is declared by its columns. Reading is strict (exactly these columns, complete rows, cells
of the declared kind) and refuses a file with all of its problems at once: :func:`read_table`
collects the problems of single cells, the reader of a particular table adds the problems across
rows with :meth:`Table.refuse`, and :meth:`Table.check` raises them in the order of the lines.
"""

from __future__ import annotations

import codecs
import csv
import io
import math
import re
import unicodedata
import zipfile
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from decimal import Decimal
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Literal

import numpy as np

from legcal.errors import HEADER, Code, DatasetError, Place, Problem
from legcal.files.quantity import ANGLE, LENGTH
from legcal.files.schema import (
    FOREIGN_SUFFIXES,
    NAME_NEEDED,
    SUFFIXES,
    closest,
    content_of,
    describe,
    few,
    is_name,
    nearest,
)
from legcal.geometry.types import Array, BoolArray, IntArray

_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_MAX_NAMED = 10  # maximum number of columns named in a sentence
_TEXT = re.compile(rb"[\t\n\r\x20-\x7e\xa0-\xff]*")  # Windows-1252, without rare characters
_COMMENTS = re.compile(r"\A(?:\s*#[^\n]*\n)+")  # above the headings
_UNITS_BELOW = (*LENGTH, *ANGLE, "us", "s")  # units of a row below the headings
_BLANK = "\u00a0\u2009\u202f"  # that does not break a line, or is thin
_WITH_UNIT = re.compile(rf"([-+]?\d*\.?\d+)[\s{_BLANK}]*({'|'.join(_UNITS_BELOW)})", re.ASCII)
_SEPARATOR = re.compile(r"\Asep=.\r?\n")
_WHOLE = re.compile(r"\d{1,15}", re.ASCII)
_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?(\s*[a-z]+)?", re.ASCII)
# Thousands: beside blanks and apostrophes also commas before a point, and points before a comma;
# only a unit may follow (001.002.003.jpg is a photograph)
_GROUPED = re.compile(
    rf"([-+−–]?[1-9]\d{{0,2}})((?:[{_BLANK}'’]\d{{3}})+|(?:,\d{{3}})+(?=\.)|(?:\.\d{{3}})+(?=,)"
    rf"|(?:\.\d{{3}}){{2,}})([.,]\d+)?(?:\s*(?:{'|'.join(_UNITS_BELOW)}|[µμ]m|[\"″°]))?"
)
_WITH_POINT = re.compile(r"[-+]?\d*(\.\d*)+", re.ASCII)
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2}(\.\d{3})+", re.ASCII)
_RULE = re.compile(r"[:-]*-{3}[:-]*")
_MARKED = re.compile(r"(?:[øØ⌀]\s*)?([−–+-]?)([.,]?\d[^\"″']*)([\"″]?)")
_BAD_WORKBOOK = (zipfile.BadZipFile, KeyError, ValueError, OSError)
_WORKBOOKS = {b"PK\x03\x04": "an XLSX or ODS workbook", b"\xd0\xcf\x11\xe0": "an XLS workbook"}

Lines = list[tuple[int, list[str]]]  # lines that are not blank: number from 1, stripped cells


@dataclass(frozen=True)
class Column:
    """The declaration of a column: its header and its cells."""

    name: str
    kind: Literal["text", "number", "whole"] = "number"
    what: str = ""  # noun for a number in messages; "" for the noun of the row
    unit: str = ""  # in words, for messages
    least: float = -math.inf  # limits of a number
    most: float = math.inf
    needed: str = ""  # the range in words
    remedy: str = "correct it or remove the row"
    choices: tuple[str, ...] = ()  # the only texts
    required: bool = True  # in the header
    blank: bool = False  # a cell may be empty; a number is then NaN
    group: str = ""  # columns of a group are complete or absent, in the header and in each row

    def problem(self, text: str) -> str:
        """Return the needed content of an invalid cell in words, or "" if it is valid."""
        if not text and self.blank:
            return ""
        if self.kind == "text":
            if self.choices:
                return " or ".join(self.choices) if text not in self.choices else ""
            return NAME_NEEDED if text and not is_name(text) else ""
        value = _number_in(text)
        if self.kind == "whole" and not _WHOLE.fullmatch(text):
            value = math.nan
        if self.least <= value <= self.most and math.isfinite(value):
            return ""
        unit = f" in {self.unit}" if self.unit else ""
        needed = "a whole number" if self.kind == "whole" else f"a finite number{unit}"
        if self.needed and (math.isfinite(value) or self.kind == "whole"):
            needed = self.needed
        return needed + ", or an empty cell" * self.blank


class Table:
    """The complete rows of a CSV file with stripped cells, and their problems.

    ``name in table`` is true if there is such a column.
    """

    def __init__(self, path: Path, thing: str, columns: Sequence[Column]) -> None:
        self.path = path
        self.thing = thing  # noun for a row in messages
        self.columns = {column.name: column for column in columns}  # in the order of the header
        self.headings: Mapping[str, str] = {}  # as their owner has them, of renamed columns
        self.where: list[Place] = []  # of each row, with its file
        self._cells: list[list[str]] = []
        self._numbers: dict[str, Array] = {}  # of the columns of numbers
        self._problems: list[Problem] = []

    def __len__(self) -> int:
        return len(self._cells)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    @property
    def places(self) -> list[str]:
        """The place of each row in the file."""
        return [f"row {place.row} (line {place.line})" for place in self.where]

    def heading(self, name: str) -> str:
        """Return the heading of a column in the file."""
        return self.headings.get(name, name)

    def text(self, name: str) -> tuple[str, ...]:
        """Return the cells of a column; empty cells for an absent column."""
        if name not in self.columns:
            return ("",) * len(self)
        place = self._place(name)
        return tuple(cells[place] for cells in self._cells)

    def _place(self, name: str) -> int:
        return list(self.columns).index(name)

    def number(self, name: str) -> Array:
        """Return the numbers of a column, (n_rows,); NaN where there is none."""
        if name in self._numbers:
            return self._numbers[name].copy()
        return np.array([_number_in(text) for text in self.text(name)], dtype=np.float64)

    def numbers(self, names: Iterable[str]) -> Array:
        """Return the numbers of some columns, (n_rows, n_names); NaN where there is none."""
        columns = [self.number(name) for name in names]
        return np.column_stack(columns) if columns else np.zeros((len(self), 0))

    def refuse(
        self,
        row: int,
        found: str,
        needed: str,
        *columns: str,
        remedy: str = "",
        what: str = "",
        code: Code | None = None,
    ) -> None:
        """Refuse a row, cells of some columns or all of it."""
        self._problems.append(
            Problem(
                f"the {what or self.thing} could not be used",
                found,
                needed,
                remedy,
                *self.where[row],
                columns,
                code=code or (Code.BAD_CELL if columns else Code.BAD_ROW),
            )
        )

    def refuse_cell(self, row: int, name: str, needed: str) -> None:
        """Refuse a cell with content that is invalid in its column."""
        text, column = self._cells[row][self._place(name)], self.columns[name]
        actual = describe(text) if text else "an empty cell"
        self.refuse(row, actual, needed, name, remedy=column.remedy, what=column.what)

    def refuse_file(self, problem: Problem) -> None:
        """Refuse several rows with one problem."""
        self._problems.append(problem)

    def need(self, names: Iterable[str], rows: BoolArray) -> None:
        """Refuse cells that are empty, in some of the rows, though their column allows it."""
        chosen = np.flatnonzero(rows).tolist()
        for name in names:
            texts = self.text(name)
            for row in chosen:
                if not texts[row]:
                    self.refuse_cell(row, name, "a finite number")

    def positions(
        self, column: str, names: Sequence[str], needed: str, *, refuse: bool = True
    ) -> IntArray:
        """Return for each row the position of its cell among names, -1 where it is not there.

        Unknown names are refused, unless said otherwise.
        """
        index = {name: i for i, name in enumerate(names)}
        texts = self.text(column)
        found = np.array([index.get(text, -1) for text in texts], dtype=np.intp)
        for row in np.flatnonzero(found < 0).tolist() if refuse else ():
            unknown, remedy = (
                f"the unknown {column} {describe(texts[row])}",
                closest(texts[row], names),
            )
            self.refuse(row, unknown, needed, column, remedy=remedy)
        return found

    def once(self, keys: Sequence[Hashable], repeated: str) -> None:
        """Refuse rows with the key of an earlier row; a key of None is ignored."""
        first: dict[Hashable, int] = {}
        for row, key in enumerate(keys):
            if key is not None and first.setdefault(key, row) != row:
                earlier = self.places[first[key]]
                actual, remedy = f"{repeated} in {earlier}", "remove one of them"
                self.refuse(row, actual, "it once", remedy=remedy, code=Code.REPEATED_ROW)

    def keep(self, rows: BoolArray) -> None:
        """Keep some rows only, and discard the problems of the others."""
        gone = {place.line for place, kept in zip(self.where, rows, strict=True) if not kept}
        kept_rows = np.flatnonzero(rows).tolist()
        self.where = [self.where[row] for row in kept_rows]
        self._cells = [self._cells[row] for row in kept_rows]
        self._numbers = {name: values[kept_rows] for name, values in self._numbers.items()}
        self._problems = [problem for problem in self._problems if problem.line not in gone]

    def forgive(self, names: Container[str]) -> None:
        """Discard the problems of cells of some columns."""
        self._problems = [p for p in self._problems if not any(name in names for name in p.columns)]

    def check(self) -> None:
        """Raise DatasetError with everything that is wrong, by line."""
        if self._problems:
            self._problems.sort(key=lambda problem: problem.line or 0)
            headings = [tuple(map(self.heading, problem.columns)) for problem in self._problems]
            pairs = zip(self._problems, headings, strict=True)
            raise DatasetError([replace(problem, columns=columns) for problem, columns in pairs])

    def _add(self, lines: Iterable[tuple[int, list[str]]], header: Sequence[str]) -> None:
        """Add the lines below the header; incomplete lines are refused."""
        columns, n = list(self.columns.values()), len(header)
        order = [header.index(column.name) for column in columns]
        for row, (line, cells) in enumerate(lines, start=1):
            self.where.append(Place(str(self.path), row, line))
            self._cells.append([cells[i] for i in order] if len(cells) == n else [])
            if len(cells) != n:
                remedy = "complete or remove the row"
                if len(cells) > n:
                    remedy = "remove what is too much, and write decimals with points"
                actual = f"{len(cells)} cell{'s' * (len(cells) != 1)}"
                needed = f"{n} as in the header"
                self.refuse(len(self) - 1, actual, needed, remedy=remedy, what="row")
        problems = self._problems
        self.keep(np.array([bool(cells) for cells in self._cells], dtype=np.bool_))
        self._problems = problems
        for column in columns:
            texts = self.text(column.name)
            doubtful: Sequence[int] = range(len(texts))
            if column.kind == "number":
                values = self._numbers[column.name] = self.number(column.name)
                good = (values >= column.least) & (values <= column.most)
                doubtful = np.flatnonzero(~good).tolist()
            faults = {text: column.problem(text) for text in {texts[row] for row in doubtful}}
            for row in doubtful:
                if faults[texts[row]]:
                    self.refuse_cell(row, column.name, faults[texts[row]])
        for group in dict.fromkeys(column.group for column in columns if column.group):
            names = [column.name for column in columns if column.group == group]
            filled = np.array(
                [[bool(text) for text in self.text(name)] for name in names], dtype=bool
            )
            for i, row in np.argwhere(~filled & filled.any(axis=0)).tolist():
                needed = f"a finite number beside {' and '.join(names[:i] + names[i + 1 :])}"
                self.refuse_cell(row, names[i], needed)


def read_table(
    path: Path,
    noun: str,
    thing: str,
    columns: Sequence[Column],
    *,
    needed: str = "",
    remedy: str = "",
    unknown: Callable[[str], Problem | None] = lambda name: None,
    reshape: Callable[[Lines], Lines] | None = None,
) -> Table:
    """Return a CSV file as a table, with the problems of its cells still to be raised.

    ``reshape`` converts free-form tables into the declared columns; such tables may be separated by
    semicolons, tabs or bars, with decimal commas, below comments and a title, above a row of units.
    """
    lines = _read_lines(path, noun, loose=reshape is not None)
    if reshape is not None or (lines and "" in lines[0][1]):  # as spreadsheets leave them
        lines = _without_empty(lines)
    if reshape is not None:
        lines = _with_units(_without_title(_one_block(lines)))
        lines = reshape(lines) if lines else lines
    if needed and len(lines) < 2:
        actual = f"{'a' if lines else 'no'} header and no row"
        raise DatasetError(
            Problem(
                f"the {noun} could not be used", actual, needed, file=str(path), code=Code.NO_ROW
            )
        )
    header = lines[0][1] if lines else []
    separator = re.search(r"[;\t]", header[0]) if len(header) == 1 else None
    if separator:
        actual, needed = f"{separator[0]!r} between columns", "',' there and '.' in numbers"
        again = "save it again with commas (CSV)"
        raise DatasetError(header_problem(path, actual, needed, again, Code.BAD_SYNTAX))
    column_of_name = {column.name: column for column in columns}
    if problems := list(_of_header(path, header, column_of_name, noun, remedy, unknown)):
        raise DatasetError(problems)
    table = Table(path, thing, [column_of_name[name] for name in header])
    table._add(lines[1:], header)
    return table


def header_problem(path: Path, found: str, needed: str, remedy: str, code: Code) -> Problem:
    """Return a problem of the header of a table."""
    sentence = "the columns could not be used"
    return Problem(sentence, found, needed, remedy, str(path), HEADER, code=code)


def _of_header(
    path: Path,
    header: Sequence[str],
    columns: dict[str, Column],
    noun: str,
    remedy: str,
    unknown: Callable[[str], Problem | None],
) -> Iterator[Problem]:
    """Yield the problems of the names of columns, one for each cause."""
    strange = [name for name in dict.fromkeys(header) if name not in columns]
    yield from (problem for name in strange if (problem := unknown(name)))
    if unknown_names := [name for name in strange if not unknown(name)]:
        near = dict.fromkeys(
            near_name for name in unknown_names if (near_name := nearest(name, columns))
        )
        hint = f"did you mean {_names(near)}?" if near else closest(unknown_names[0], columns)
        actual = f"the unknown column{'s' * (len(unknown_names) > 1)} {_names(unknown_names)}"
        yield header_problem(path, actual, f"those of a {noun}", hint, Code.UNKNOWN_COLUMN)
    for name in columns:
        if header.count(name) > 1:
            actual = f"the column '{name}' {header.count(name)} times"
            yield header_problem(path, actual, "it once", "remove one", Code.REPEATED_COLUMN)
    groups = {columns[name].group for name in header if name in columns} - {""}
    missing: dict[str, list[str]] = {}  # names by description
    for name, column in columns.items():
        if name not in header and (column.required or column.group in groups):
            description = ", ".join(
                filter(None, (column.what, column.unit and f"in {column.unit}"))
            )
            missing.setdefault(f" ({description})" if description else "", []).append(name)
    for description, names in missing.items():
        s, it = ("s", "them") if len(names) > 1 else ("", "it")
        add = f"add the column{s}{f', or {remedy}' if remedy else ''}"
        actual = f"no column{s} {_names(names)}"
        yield header_problem(path, actual, f"{it}{description}", add, Code.MISSING_COLUMN)


def _names(names: Iterable[str]) -> str:
    """Return names of columns in a sentence, a few of them."""
    return few(list(map(describe, names)), _MAX_NAMED)


def format_table(header: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Return the text of a CSV file; numbers are read back as they are, NaN is an empty cell."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow(
            "" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row
        )
    return text.getvalue()


def is_number(text: str) -> bool:
    """Return whether a cell holds a number."""
    return math.isfinite(_number_in(text))


def _number_in(text: str) -> float:
    """Return the number in a cell, NaN if it holds no finite number."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else math.nan


# Headings

# Words of headings and of names of joints, as _folded writes them: English, German, French
WORDS: dict[str, str] = {
    "base": "base bottom fixed ground lower basis boden bodenplatte grundplatte gestell sockel "
    "unten fest fuss socle embase bas fixe sol bati inferieur",
    "platform": "platform plat top moving mobile upper effector plattform oben kopf beweglich "
    "nacelle plateforme plateau haut superieur",
    "joint": "joint joints point points pt gelenk gelenke gelenkpunkt punkt kugelgelenk kardan "
    "ball balls kugel hinge pivot anchor articulation rotule liaison centre center mitte",
    "leg": "leg legs strut struts cylinder cylinders actuator limb axis drive motor stepper bein "
    "strebe stab zylinder aktuator aktor antrieb achse spindel jambe verin axe actionneur "
    "moteur",
    "rail": "rail tower carriage column slide slider turm schiene saule schlitten wagen colonne "
    "chariot glissiere",
    "home": "home grundstellung ruhelage nullstellung referenzlage repos",
    "name": "name label id bezeichnung nom designation",
    "number": "number nr no num nummer numero index i #",
    "side": "side seite cote",
    "type": "type typ",
    "unit": "unit units einheit einheiten unite",
    "length": "length len lengths l lange langen laenge longueur",
    "min": "min minimum minimal minimale lowest low kleinste mini retracted "
    "eingefahren rentre rentree",
    "max": "max maximum maximal maximale highest high grosste maxi extended ausgefahren "
    "sorti sortie",
    "short": "shortest kurzeste kuerzeste",
    "long": "longest langste laengste",
    "reading": "reading readings q travel lesung wert lecture",
    "stroke": "stroke hub verfahrweg course",
    "zero": "zero null nulle",
    "radius": "radius radien rayon",
    "diameter": "diameter diam dia durchmesser diametre ø d od",
    "tube": "tube barrel rohr hulse corps fut",
    "rod": "rod stange stangen kolbenstange kolben tige piston",
    "tool": "tool tcp werkzeug outil",
    "note": "note notes remark remarks comment comments bemerkung bemerkungen kommentar remarque "
    "remarques commentaire",
    "view": "view camera cam viewpoint station setup place tripod kamera ansicht stativ standort "
    "ort platz vue lieu",
    "image": "image img file filename photo photograph picture pic frame shot bild foto datei "
    "dateiname aufnahme cliche fichier",
    "pose": "pose poseid poselabel position pos stellung lage",
    "time": "time timestamp datetime date clock elapsed elapsedtime takenat zeit uhrzeit "
    "zeitstempel datum heure temps horodatage",
    "": "of the at in der die das des von bei am de du la le au",
    **{letter: letter for letter in ("x", "y", "z", "a", "b", "p", "t")},
}
_NAMES = {"name", "number", "view", "image", "pose"}  # concepts of columns of names
_CONCEPTS = {word: concept for concept, words in WORDS.items() for word in words.split()}
_TOKEN = re.compile(r"\d+|[^\W\d_]+|#")
_IN_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\])]+)[\])]")


def concepts(text: str) -> tuple[str, ...]:
    """Return the concepts of a heading or a name, keys of WORDS, and its numbers.

    Compounds are divided (``Bodengelenk 1`` is base, joint, 1). Words that are not known give
    nothing in brackets, and no concept at all elsewhere.
    """
    found = list[str]()
    name = match[1] if (match := _heading_with(tuple(LENGTH)).fullmatch(text.strip())) else text
    for k, part in enumerate(re.split(r"[\[(]([^\])]*)[\])]", _folded(name))):
        for token in _TOKEN.findall(part):
            known = (token.lstrip("0") or "0",) if token.isdigit() else _divided(token)
            if known is None and k % 2 == 0:
                return ()
            found += known or ()
    return tuple(filter(None, found))


@cache
def _divided(token: str) -> tuple[str, ...] | None:
    """Return the concepts of a word, or of the known words that it is made of, each once."""
    if token in _CONCEPTS:
        return (_CONCEPTS[token],)
    for end in range(len(token) - 1, 0, -1):
        first, rest = _CONCEPTS.get(token[:end]), _divided(token[end:])
        if first is not None and rest is not None and first not in rest:
            return (first, *rest)
    return None


def _folded(text: str) -> str:
    """Return a text in small letters without accents, words at a hyphen joined."""
    decomposed = unicodedata.normalize("NFKD", text.replace("⌀", "ø").casefold())
    plain = "".join(letter for letter in decomposed if not unicodedata.combining(letter))
    return re.sub(r"(?<=[^\W\d_])-(?=[^\W\d_])", "", plain)


# Other words for units; the letters before m are the sign of micro and the Greek mu
_UNIT_WORDS = {
    **dict.fromkeys(("µm", "μm"), "um"),
    **dict.fromkeys(("millimeter", "millimetre", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("inch", "inches", "zoll"), "in"),
}


@cache
def _heading_with(units: tuple[str, ...]) -> re.Pattern[str]:
    """Return the pattern of headings that end with one of some units."""
    large = [unit.upper() for unit in units if len(unit) > 1]
    words = [f"(?i:{word})" for word, unit in _UNIT_WORDS.items() if unit in units]
    unit_pattern = "|".join([*map(re.escape, (*units, *large)), *words])
    return re.compile(rf"(.*?)(?:\s*[\[(]\s*({unit_pattern})\s*[\])]|[\s_/]({unit_pattern}))?")


def split_heading(
    text: str, units: Iterable[str] = LENGTH, *, others: bool = False
) -> tuple[str, str]:
    """Return a heading in small letters and digits alone, and its unit (of length) or "".

    ``Leg 1 [mm]``, ``leg1_mm`` and ``LEG-1 (mm)`` are all ``leg1`` in ``mm``. With *others* any
    word in brackets is a unit, whether it is known or not; several words are a remark.
    """
    match = _heading_with(tuple(units)).fullmatch(text.strip())
    name, unit = (match[1], match[2] or match[3] or "") if match else (text, "")
    if others and not unit and (stated := _IN_BRACKETS.fullmatch(text.strip())):
        name, unit = stated[1], stated[2].strip()
        unit = "" if re.fullmatch(r"\w+( [^\W\d_]+)+", unit) else unit
    letters = "".join(letter for letter in _folded(name) if letter.isalnum())
    unit = unit.lower() if unit.lower() in units else unit
    return letters, _UNIT_WORDS.get(unit.lower(), unit)


def in_unit(cell: str, size: Decimal) -> str:
    """Return a number times a size, as decimal as it was written; other cells unchanged."""
    return str(Decimal(cell) * size) if is_number(cell) else cell


# Files


def _read_lines(path: Path, noun: str, *, loose: bool = False) -> Lines:
    """Return the lines that are not blank, numbered from 1, their cells stripped.

    A byte-order mark and either kind of line end are accepted; if ``loose``, also the encodings and
    separators of spreadsheet programs in other locales.
    """
    content = content_of(path, noun)
    workbook = _WORKBOOKS.get(content[:4])
    if loose and workbook:
        return _with_numbers(_sheet(path, noun, content, workbook))
    try:
        text = _decoded(content, loose=loose)
        delimiter = _delimiter(text) if loose else ","
        if delimiter == " ":  # several may be between columns, or at the end
            text = "\n".join(map(str.strip, text.splitlines()))
        reader = csv.reader(
            io.StringIO(text, newline=""),
            delimiter=delimiter,
            skipinitialspace=delimiter == " ",
            strict=True,
        )
        lines: Lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
        if loose:
            lines = _with_numbers(lines)
        if delimiter != ",":
            lines = _with_points(lines)
    except (UnicodeDecodeError, csv.Error) as error:
        actual = (
            f"the byte 0x{error.object[error.start]:02x} at place {error.start}, which is no text"
            if isinstance(error, UnicodeDecodeError)
            else f"'{error}'"
        )
        raise DatasetError(
            f"{path}: the {noun} could not be read: found {actual}, needed comma-separated text "
            "in UTF-8; save it again as CSV."
        ) from error
    return [(number, cells) for number, cells in lines if any(cells)]


def _sheet(path: Path, noun: str, content: bytes, workbook: str) -> Lines:
    """Return the lines of the first sheet of a workbook that has a table (``legcal[excel]``)."""
    try:
        import openpyxl
    except ImportError:
        openpyxl = None
    remedy = "save the sheet as CSV (comma-separated)"
    if openpyxl is None:
        remedy += ", or install legcal[excel] to read XLSX"
    else:
        try:
            book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
            for sheet in book.worksheets:
                rows = [list(map(_cell_text, cells)) for cells in sheet.iter_rows(values_only=True)]
                filled = [max((i + 1 for i, x in enumerate(row) if x), default=0) for row in rows]
                lines = [(n, row[: max(filled)]) for n, row in enumerate(rows, 1) if any(row)]
                if len(lines) > 1:
                    return lines
            workbook = "an XLSX workbook without a table"
        except _BAD_WORKBOOK:
            pass
    raise DatasetError(
        f"{path}: the {noun} could not be read: found {workbook}, needed CSV; {remedy}."
    )


def _cell_text(value: object) -> str:
    """Return the text of a cell of a workbook, numbers with as many digits as they need."""
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return "" if value is None else str(value).strip()


def _without_empty(lines: Lines) -> Lines:
    """Return lines without columns that are empty in all, and without rules (``|---|---|``)."""
    lines = [(n, cells) for n, cells in lines if not _RULE.fullmatch("".join(cells))]
    kept = {i for _, cells in lines for i, cell in enumerate(cells) if cell}
    return [(n, [x for i, x in enumerate(cells) if i in kept]) for n, cells in lines]


def _one_block(lines: Lines) -> Lines:
    """Return tables of the joints of each side, below its name alone, as one table."""
    sides = ({"base"}, {"platform"})
    at = [
        k
        for k, (_, cells) in enumerate(lines[:-1])
        if sum(map(bool, cells)) == 1 and set(concepts("".join(cells))) - {"joint"} in sides
    ]
    if len(at) != 2 or lines[at[0] + 1][1] != lines[at[1] + 1][1]:
        return lines
    rows = [
        (n, [f"{''.join(lines[k][1])} {cells[0]}", *cells[1:]])
        for k, end in zip(at, (at[1], len(lines)), strict=True)
        for n, cells in lines[k + 2 : end]
    ]
    return [lines[at[0] + 1], *rows]


def _without_title(lines: Lines) -> Lines:
    """Return the headings and what is below, without titles above and remarks below.

    These fill few cells. A line above headings that repeat (``X Y Z X Y Z``) names their groups,
    and columns of its own where nothing is below.
    """
    widths = [sum(map(bool, cells)) for _, cells in lines]
    if max(widths, default=0) < 3:
        return lines
    start = next(k for k, n in enumerate(widths) if 2 * n > max(widths))
    end, names = len(lines), SUFFIXES + FOREIGN_SUFFIXES
    while end > start + 1 and widths[end - 1] == 1:
        cell = "".join(lines[end - 1][1])
        if is_number(cell) or cell.lower().endswith(names):  # of a photograph
            break
        end -= 1
    for k in (start + 1, start):
        if not 0 < k < end or widths[k - 1] < 2:
            continue
        (_, above), (number, header) = lines[k - 1 : k + 1]
        repeated = {name for name in header if header.count(name) > 1} - {"", *_UNITS_BELOW}
        if not repeated or any(map(is_number, header)):
            continue
        joined, group, before = list[str](), "", ""
        for name, over in zip_longest(header, above, fillvalue=""):
            is_inside = name and (name in repeated) is (before in repeated)
            group, before = over or (group if is_inside else ""), name
            joined.append(f"{group} {name}".strip())
        return [(number, joined), *lines[k + 1 : end]]
    return lines[start:end]


def _with_units(lines: Lines) -> Lines:
    """Return lines with a row of units below the headings written into these."""
    if len(lines) < 2 or len(lines[0][1]) != len(lines[1][1]):
        return lines
    (number, header), (_, below) = lines[:2]
    units = [cell.strip("[]() ") for cell in below]
    if not any(units) or not all(unit in ("", *_UNITS_BELOW) for unit in units):
        return _with_units_of_cells(lines)
    pairs = zip(header, units, strict=True)
    return [(number, [f"{name} [{unit}]" if unit else name for name, unit in pairs]), *lines[2:]]


def _with_units_of_cells(lines: Lines) -> Lines:
    """Return lines with the unit of the numbers of a column (``380 mm``) in its heading."""
    (number, header), below = lines[0], [cells for _, cells in lines[1:]]
    if any(len(cells) != len(header) for cells in below):
        return lines
    for i in range(len(header)):
        parts = [_WITH_UNIT.fullmatch(cells[i]) for cells in below if not is_number(cells[i])]
        units = {part[2] if part else "" for part in parts}
        if len(units) == 1 and (unit := units.pop()):
            header = [*header[:i], f"{header[i]} [{unit}]", *header[i + 1 :]]
            below = [[*row[:i], row[i].removesuffix(unit).strip(), *row[i + 1 :]] for row in below]
    numbers = (line for line, _ in lines[1:])
    return [(number, header), *((n, row) for n, row in zip(numbers, below, strict=True))]


def _decoded(content: bytes, *, loose: bool) -> str:
    """Return the text of a file in UTF-8.

    If ``loose`` also in UTF-16, and as Excel writes it in western Europe, without the
    line that names its delimiter.
    """
    if not loose:
        return content.decode("utf-8-sig")
    is_wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    bare = {0: "utf-16-be", 1: "utf-16-le"}.get(content[:2].find(b"\0"))  # without its mark
    try:
        text = content.decode("utf-16" if is_wide else bare or "utf-8-sig")
    except UnicodeDecodeError:
        if is_wide or not _TEXT.fullmatch(content):
            raise
        text = content.decode("cp1252")
    text = _SEPARATOR.sub("\n", text, count=1)  # lines keep their numbers
    return _COMMENTS.sub(lambda match: "\n" * match[0].count("\n"), text)


def _delimiter(text: str) -> str:
    """Return the separator of cells, the first that is in most of the lines that are not blank."""
    lines = [line for line in map(str.strip, text.splitlines()) if line]
    counts = {mark: sum(mark in line for line in lines) for mark in ";\t|, "}
    counts[","] -= sum(map(_has_decimal_commas, lines))
    return next((mark for mark, n in counts.items() if 2 * n > len(lines)), ",")


def _has_decimal_commas(line: str) -> bool:
    """Return whether all commas of a line are in numbers between blanks (``a.jpg 0,12 0,34``)."""
    words = line.split()
    with_comma = [word for word in words if "," in word]
    return len(words) > 1 and bool(with_comma) and all(map(_COMMA.fullmatch, with_comma))


def _with_numbers(lines: Lines) -> Lines:
    """Return lines with numbers as computers write them, but for columns of names.

    The headings are taken to be the first line of which more than half is filled.
    """
    widest = max((sum(map(bool, cells)) for _, cells in lines), default=0)
    headings = next((cells for _, cells in lines if 2 * sum(map(bool, cells)) > widest), [])
    found = [set(concepts(heading)) for heading in headings]
    texts = {i for i, words in enumerate(found) if words and words <= _NAMES}
    return [
        (n, [x if i in texts else _number_of_people(x) for i, x in enumerate(cells)])
        for n, cells in lines
    ]


def _number_of_people(cell: str) -> str:
    """Return a number as computers write it: minus, diameter and inch marks, without thousands.

    Other cells are unchanged.
    """
    if grouped := _GROUPED.fullmatch(cell):
        cell = cell.replace(grouped[2], re.sub(r"\D", "", grouped[2]), 1)
    match = _MARKED.fullmatch(cell)
    if match is None:
        return cell
    sign = "-" if match[1] not in ("", "+") else ""
    return f"{sign}{match[2].replace('−', '-')}{' in' * bool(match[3])}"


def _range_of_sizes(column: Sequence[str]) -> float:
    """Return the largest number of a column, written with decimal commas, over the smallest."""
    sizes = [abs(_number_in(cell.replace(",", "."))) for cell in column]
    sizes = [size for size in sizes if size > 0.0]
    return max(sizes, default=1.0) / min(sizes, default=1.0)


def _with_points(lines: Lines) -> Lines:
    """Return lines with points for decimal commas, also of numbers with a unit.

    In a column with decimal commas, points are between thousands if all of them can be, and its
    numbers are of more similar size then.
    """
    changed = list[list[str]]()
    for cells_of in zip_longest(*(cells for _, cells in lines), fillvalue=""):
        column = list(cells_of)
        has_commas = any(map(_COMMA.fullmatch, column))
        pointed = {cell for cell in column if _WITH_POINT.fullmatch(cell)}
        if has_commas and all(map(_THOUSANDS.fullmatch, pointed)):
            joined = [cell.replace(".", "") if cell in pointed else cell for cell in column]
            column = min(joined, column, key=_range_of_sizes)
        changed.append([x.replace(",", ".") if _COMMA.fullmatch(x) else x for x in column])
    rows = zip(lines, zip(*changed, strict=True), strict=True)
    return [(number, list(row[: len(cells)])) for (number, cells), row in rows]
