"""Which photograph belongs to which row of a table, as people name, order or time them.

Names are compared the strictest way that finds every row: the file name, the name without its
extension, the last number of the name; their case does not count unless it decides, and of files
named alike those count whose folders are named alike too. Without names the times are compared, or
the rows are those of the photographs in order (numbers in names count as numbers).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, time, timedelta
from itertools import pairwise
from pathlib import Path, PurePosixPath

from legcal.data.measurements import few
from legcal.errors import Code, DatasetError, Place, Problem
from legcal.files.reading import MAX_IMAGE, read_bytes
from legcal.files.schema import NAME_NEEDED, closest, describe, is_name
from legcal.vision.heic import HEIC_SUFFIXES
from legcal.vision.image_facts import read_facts
from legcal.vision.image_file import CONVERT, CONVERT_HEIC, FOREIGN_SUFFIXES, image_suffixes

MAX_PHOTOGRAPHS = 50_000
MAX_VIEWS = 12  # that names of photographs are taken for
_SEPARATORS = " _-."
_NUMBERS = re.compile(r"(\d+)", re.ASCII)
_EXIF_DATE = re.compile(r"(\d{4}):(\d\d):(\d\d)")


@dataclass(frozen=True)
class Photograph:
    """An image file, and where it stands in the folder that was given."""

    path: Path
    name: str  # relative to that folder, with "/"
    view: str = ""  # by a pattern of names
    label: str = ""  # what the pattern leaves of the name without the view

    @property
    def folder(self) -> str:
        """What has the photographs of a view: the view by a pattern of names, else the folder.

        That folder is relative to the given one; "." for it.
        """
        return self.view or PurePosixPath(self.name).parent.as_posix()


@dataclass(frozen=True)
class Row:
    """What a row of the table says of its photograph; "" for nothing."""

    where: Place
    image: str
    view: str
    time: str


@dataclass(frozen=True)
class Matching:
    """The photographs of rows: a row has one in each view, or one in all."""

    pairs: tuple[tuple[int, Photograph], ...]  # in the order of views and rows
    how: str  # in words
    notes: tuple[str, ...] = ()


class ViewPattern:
    """Which part of a file name is the view: ``{view}_*`` of ``left_012.jpg``."""

    def __init__(self, pattern: str) -> None:
        before, after = (
            ".*?".join(map(re.escape, part.split("*"))) for part in pattern.split("{view}")
        )
        self._form = re.compile(f"(?P<before>{before})(?P<view>.+?)(?P<after>{after})", re.DOTALL)

    def of(self, photograph: Photograph) -> Photograph | None:
        """Return a photograph with its view, or None if its name has another form."""
        found = self._form.fullmatch(PurePosixPath(photograph.name).stem)
        if found is None:
            return None
        label = found["before"] + found["after"]
        return replace(photograph, view=found["view"], label=label.strip(_SEPARATORS))


def with_likely_views(photographs: Sequence[Photograph]) -> tuple[list[Photograph], str | None]:
    """Return photographs with the views that their names have, and the pattern of these.

    They are as given and the pattern is None where names do not look so, or where folders name the
    views. Numbers may be anything and name no views here.
    """
    pattern = likely_pattern(photographs)
    if pattern is None or any(one.folder != "." for one in photographs):
        return list(photographs), None
    form = ViewPattern(pattern)
    found = [one for photograph in photographs if (one := form.of(photograph)) is not None]
    if all(one.view.isdecimal() for one in found):
        return list(photographs), None
    return found, pattern


def columns_by_content(
    photographs: Sequence[Photograph],
) -> dict[str, Callable[[Sequence[str]], bool]]:
    """Return what tells by the cells of a column that it names photographs, or their views."""
    stems = {_stem(text) for one in photographs for text in (one.name, one.label) if text}
    views = {one.folder.casefold() for one in photographs} - {"."}

    def are_photographs(cells: Sequence[str]) -> bool:
        named = [_stem(cell) for cell in cells if cell]
        return bool(named) and not all(map(str.isdecimal, named)) and stems.issuperset(named)

    def are_views(cells: Sequence[str]) -> bool:
        named = [cell.casefold() for cell in cells]
        return len(views) > 1 and len(named) > len(views) and set(named) == views

    return {"image": are_photographs, "view": are_views}


def likely_pattern(photographs: Sequence[Photograph]) -> str | None:
    """Return a pattern by which names in one folder are those of several views, as many of each.

    Names of views are words rather than numbers, and few.
    """
    likely: list[tuple[bool, int, int, str]] = []
    for pattern in ("{view}_*", "{view}-*", "*_{view}", "*-{view}"):
        form, labels = ViewPattern(pattern), dict[str, set[str]]()
        named = [one for photograph in photographs if (one := form.of(photograph)) is not None]
        for one in named:
            labels.setdefault(one.view, set()).add(one.label)
        sizes = {len(of_view) for of_view in labels.values()}
        if len(named) == len(photographs) and 1 < len(labels) <= MAX_VIEWS and len(sizes) == 1:
            are_numbers = all(view.isdecimal() for view in labels)
            if max(sizes) > 1:
                likely.append((are_numbers, len(labels), len(likely), pattern))
    return min(likely)[-1] if likely else None


def find_photographs(folder: Path) -> list[Photograph]:
    """Return the images in a folder and in the folders in it, in the order of their names."""
    if not os.path.isdir(folder):
        found = "a file" if os.path.exists(folder) else "no such folder"
        raise DatasetError(
            f"{folder}: the photographs could not be found: found {found}, needed the folder that "
            "holds them; check the path."
        )
    suffixes = image_suffixes()
    photographs: list[Photograph] = []
    foreign: list[str] = []
    for above, inside, files in os.walk(folder):
        inside[:] = sorted(name for name in inside if not name.startswith("."))
        here = Path(above).relative_to(folder)
        for name in (name for name in files if not name.startswith(".")):
            suffix = Path(name).suffix.lower()
            file = Photograph(Path(above) / name, (here / name).as_posix())
            if suffix in suffixes:
                photographs.append(file)
            elif suffix in FOREIGN_SUFFIXES:
                foreign.append(file.name)
        if len(photographs) > MAX_PHOTOGRAPHS:
            raise DatasetError(
                f"{folder}: the photographs could not be used: found more than {MAX_PHOTOGRAPHS}, "
                "needed fewer; give the folder of one calibration."
            )
    if not photographs:
        found, remedy = "none", "check the path"
        if foreign:
            found = f"{len(foreign)} of another format ({few(foreign)})"
            are_heic = any(name.lower().endswith(HEIC_SUFFIXES) for name in foreign)
            remedy = CONVERT_HEIC if are_heic else CONVERT
        raise DatasetError(
            f"{folder}: the photographs could not be found: found {found}, needed PNG, JPEG or "
            f"TIFF files there or in folders in it; {remedy}."
        )
    return sorted(photographs, key=lambda photograph: in_order(photograph.name))


def in_order(name: str) -> tuple[object, ...]:
    """Return a key by which numbers in names are in order: ``img2`` before ``img10``."""
    parts = PurePosixPath(name.casefold()).parts
    split = [_NUMBERS.split(part) for part in parts]
    keys = [tuple((int(x), "") if x.isdecimal() else (-1, x) for x in words) for words in split]
    return (len(parts), *keys, name)


def match(rows: Sequence[Row], photographs: Sequence[Photograph], table: str) -> Matching:
    """Return which photograph belongs to which row: by name, else by time, else in order.

    Parameters
    ----------
    rows : sequence of Row
    photographs : sequence of Photograph
        In the order of their names.
    table : str
        The table, for messages.

    Raises
    ------
    DatasetError
        If rows have no photograph, or more than one in a view.
    """
    if any(row.image for row in rows):
        found = _by_name(rows, photographs, table)
    elif any(row.time for row in rows):
        found = _by_time(rows, photographs, table)
    else:
        found = _in_order(rows, photographs, table)
    used = {photograph.name for _, photograph in found.pairs}
    bad = sorted(name for name in used if not is_name(name))
    if bad:
        raise DatasetError(
            f"{table}: the photograph {describe(bad[0])} could not be used: found a name that "
            f"tables cannot show, needed {NAME_NEEDED}; rename the file."
        )
    spare = [photograph.name for photograph in photographs if photograph.name not in used]
    notes = found.notes
    if spare:
        one = len(spare) == 1
        notes += (
            f"{len(spare)} photograph{'' if one else 's'} {'has' if one else 'have'} no row and "
            f"{'is' if one else 'are'} left out: {few(spare)}.",
        )
    return Matching(found.pairs, found.how, notes)


def _path(text: str) -> str:
    return text.replace("\\", "/").removeprefix("./")


def _tail(text: str) -> str:
    return _path(text).rsplit("/", 1)[-1].casefold()


def _stem(text: str) -> str:
    tail = _tail(text)
    stem, dot, suffix = tail.rpartition(".")
    return stem if dot and not suffix.isdigit() else tail


def _number(text: str) -> str:
    found = _NUMBERS.findall(_stem(text))
    return str(int(found[-1])) if found else ""


_KEYS: tuple[tuple[str, Callable[[str], str]], ...] = (
    ("by name", _tail),
    ("by name, whatever its extension", _stem),
    ("by the last number of the name", _number),
)


def _alike(photograph: Photograph, text: str) -> tuple[int, bool]:
    """Return how many folders above the file are named alike, and whether the case is too."""
    one, two = (_path(name).casefold().split("/")[-2::-1] for name in (photograph.name, text))
    same = [a == b for a, b in zip(one, two, strict=False)]
    return [*same, False].index(False), photograph.name.endswith(_path(text))


def _candidates(row: Row, photographs: Sequence[Photograph]) -> list[Photograph]:
    """Return the photographs in the folder of the view of a row, all if there is no such folder."""
    of_view = [p for p in photographs if row.view and _in_folder(p, row.view)]
    return of_view or list(photographs)


def _in_folder(photograph: Photograph, view: str) -> bool:
    folder = photograph.folder.casefold()
    return folder == view.casefold() or folder.endswith("/" + view.casefold())


def _by_name(rows: Sequence[Row], photographs: Sequence[Photograph], table: str) -> Matching:
    """Compare names, the strictest way first."""
    named = [k for k, row in enumerate(rows) if row.image]
    best: dict[int, list[Photograph]] = {}
    for how, key in _KEYS:
        if key is _number and not all(rows[k].image.isdigit() for k in named):
            continue
        by_key: dict[str, list[Photograph]] = {}
        for photograph in photographs:
            for text in {key(photograph.name), *([key(photograph.label)] * bool(photograph.view))}:
                by_key.setdefault(text, []).append(photograph)
        found = {}
        for k in named:
            same = by_key.get(key(rows[k].image), [])
            if same and rows[k].view:
                same = _candidates(rows[k], same)
            if same and key(rows[k].image):
                most = max(_alike(photograph, rows[k].image) for photograph in same)
                found[k] = [p for p in same if _alike(p, rows[k].image) == most]
        if len(found) == len(named):
            return _named_once(rows, found, how, table)
        if len(found) > len(best):
            best = found
    problems = []
    taken = {photograph.name for same in best.values() for photograph in same}
    for k in named:
        if k not in best:
            near = closest(rows[k].image, [p.name for p in photographs if p.name not in taken])
            problems.append(
                Problem(
                    "the photograph could not be found",
                    f"no {describe(rows[k].image)}",
                    f"one of the {len(photographs)} photographs",
                    near,
                    *rows[k].where,
                    columns=("image",),
                    code=Code.MISSING_FILE,
                )
            )
    if len(best) == 0 and len(problems) > 1:
        problems = [
            Problem(
                "the photographs could not be matched by name",
                f"none that is named like {describe(rows[named[0]].image)}",
                f"the names of files such as {describe(photographs[0].name)}",
                "correct the column image, or remove it to match rows and photographs in order",
                table,
                code=Code.MISSING_FILE,
            )
        ]
    raise DatasetError(problems)


def _named_once(
    rows: Sequence[Row], found: dict[int, list[Photograph]], how: str, table: str
) -> Matching:
    """Return the pairs if every photograph has one row, and every row one photograph a view."""
    row_of: dict[str, int] = {}
    problems, undecided = [], "the photograph could not be decided"
    for k, same in found.items():
        folders = [photograph.folder for photograph in same]
        if len(set(folders)) < len(folders) or (rows[k].view and len(same) > 1):
            problems.append(
                Problem(
                    undecided,
                    f"{describe(rows[k].image)} for {few([p.name for p in same])}",
                    "one",
                    "write the name with its folder and extension",
                    *rows[k].where,
                    columns=("image",),
                    code=Code.BAD_CELL,
                )
            )
        for photograph in same:
            if (other := row_of.setdefault(photograph.name, k)) != k:
                problems.append(
                    Problem(
                        undecided,
                        f"{describe(photograph.name)} also for {rows[other].where}",
                        "one row a photograph",
                        "add a column view, or write names with folders",
                        *rows[k].where,
                        columns=("image",),
                        code=Code.REPEATED_ROW,
                    )
                )
    if problems:
        raise DatasetError(problems)
    blank = [row.where for k, row in enumerate(rows) if k not in found]
    notes = (
        f"{len(blank)} row{'s' * (len(blank) > 1)} of {table} without the name of a photograph "
        f"{'are' if len(blank) > 1 else 'is'} left out.",
    )
    return Matching(_sorted(rows, found.items()), how, notes if blank else ())


def _sorted(
    rows: Sequence[Row], found: Iterable[tuple[int, Sequence[Photograph]]]
) -> tuple[tuple[int, Photograph], ...]:
    """Return pairs in the order of views and, in each, of rows."""
    pairs = [(k, photograph) for k, same in found for photograph in same]
    folders: dict[str, int] = {}
    for k, photograph in pairs:
        folders.setdefault(rows[k].view or photograph.folder, len(folders))
    pairs.sort(key=lambda pair: (folders[rows[pair[0]].view or pair[1].folder], pair[0]))
    return tuple(pairs)


def _in_order(rows: Sequence[Row], photographs: Sequence[Photograph], table: str) -> Matching:
    """Take rows and photographs one by one: in each view, in all, or all rows in each folder."""
    folders: dict[str, list[Photograph]] = {}
    for photograph in photographs:
        folders.setdefault(photograph.folder, []).append(photograph)
    views: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        views.setdefault(row.view, []).append(k)
    if "" not in views and all(any(_in_folder(p, view) for p in photographs) for view in views):
        groups = [
            (f"view {view}", members, [p for p in photographs if _in_folder(p, view)])
            for view, members in views.items()
        ]
        how = "in the order of rows and of names, view by view"
    elif len(photographs) == len(rows):
        groups = [("all folders", list(range(len(rows))), list(photographs))]
        how = "in the order of rows and of names"
    else:
        groups = [
            (f"folder {folder}", list(range(len(rows))), inside)
            for folder, inside in folders.items()
        ]
        how = "in the order of rows and of names: every view shows the poses of all rows"
    problems = [
        f"{table}: the photographs of {name} could not be matched in order: found {len(inside)} "
        f"photographs for {len(members)} rows, needed as many; remove what has no partner, or add "
        "a column image with their names."
        for name, members, inside in groups
        if len(members) != len(inside)
    ]
    if problems:
        raise DatasetError(problems)
    notes = []
    pairs: list[tuple[int, Photograph]] = []
    for name, members, inside in groups:
        times = [photograph_time(photograph) for photograph in inside]
        known = [when for when in times if when is not None]
        if len(known) == len(times) and known != sorted(known):
            notes.append(
                f"The photographs of {name} were not taken in the order of their names, as their "
                "EXIF times say; see that the rows are in the order of the names, or add a column "
                "image or time."
            )
        pairs += zip(members, inside, strict=True)
    return Matching(tuple(pairs), how, tuple(notes))


def photograph_time(photograph: Photograph) -> datetime | None:
    """Return when a photograph was taken, as its file says."""
    try:
        return _moment(read_facts(read_bytes(photograph.path, MAX_IMAGE)).taken_at)
    except OSError:
        return None


def _moment(text: str, day: date | None = None) -> datetime | None:
    """Return the time in a text: ISO 8601, as EXIF writes it, or of the day alone."""
    text = _EXIF_DATE.sub(r"\1-\2-\3", text.strip(), count=1)
    try:
        return datetime.fromisoformat(text).replace(tzinfo=None)
    except ValueError:
        pass
    try:
        return None if day is None else datetime.combine(day, time.fromisoformat(text))
    except ValueError:
        return None


def _by_time(rows: Sequence[Row], photographs: Sequence[Photograph], table: str) -> Matching:
    """Give each row the photograph taken nearest to its time.

    Clocks may differ by a constant where there are as many photographs as rows.
    """
    taken = {p.name: when for p in photographs if (when := photograph_time(p)) is not None}
    dated = sorted((p for p in photographs if p.name in taken), key=lambda p: taken[p.name])
    if len(dated) < len(rows):
        raise DatasetError(
            f"{table}: the photographs could not be matched by time: found {len(dated)} "
            f"photographs with a time in their EXIF data for {len(rows)} rows, needed as many or "
            "more; copy the files from the camera as they are, add a column image, or remove the "
            "column time to match rows and photographs in order."
        )
    day = taken[dated[0].name].date()
    times = [_moment(row.time, day) for row in rows]
    bad = [
        f"{row.where}, column time: the time could not be read: found {describe(row.time)}, needed "
        "one such as 2026-11-23 10:15:00; correct the cell."
        for row, when in zip(rows, times, strict=True)
        if when is None
    ]
    if bad:
        raise DatasetError(bad)
    moments = [when for when in times if when is not None]
    order = sorted(range(len(rows)), key=lambda k: moments[k])
    gaps = [moments[b] - moments[a] for a, b in pairwise(order)]
    least = min(gaps, default=timedelta(days=1))
    shift = timedelta()
    if len(dated) == len(rows):
        apart = [taken[p.name] - moments[k] for k, p in zip(order, dated, strict=True)]
        shift = sorted(apart)[len(apart) // 2]
        pairs = dict(zip(order, dated, strict=True))
    else:
        pairs = {k: min(dated, key=lambda p: abs(taken[p.name] - moments[k])) for k in order}
    worst = max(abs(taken[p.name] - moments[k] - shift) for k, p in pairs.items())
    if len({p.name for p in pairs.values()}) < len(rows) or 2 * worst >= least:
        raise DatasetError(
            f"{table}: the photographs could not be matched by time: found times up to "
            f"{worst.total_seconds():.0f} s apart and rows {least.total_seconds():.0f} s apart, "
            "needed less than half of that; leave out photographs without a row, so that a "
            "difference of the clocks shows, or add a column image."
        )
    about = f", clocks {shift.total_seconds():+.0f} s apart" if shift else ""
    found = [(k, [p]) for k, p in sorted(pairs.items())]
    return Matching(_sorted(rows, found), f"by time, within {worst.total_seconds():.0f} s{about}")
