"""Match photographs to the rows of a table by name, time or order.

Names are compared in the strictest way that matches every row: the file name, the name without its
extension, the last number of the name. Their case only breaks ties, and among files of equal name
the folders decide. Without names, times are compared; without times, rows and photographs are
matched in order (numbers in names count as numbers).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path, PurePosixPath

from legcal.data.image_choice import DAY, seconds_in, seconds_of_column
from legcal.errors import Code, DatasetError, Problem
from legcal.files.schema import (
    FOREIGN_SUFFIXES,
    HEIC_SUFFIXES,
    MAX_IMAGE,
    NAME_NEEDED,
    closest,
    describe,
    few,
    is_name,
    natural_key,
    read_bytes,
)
from legcal.files.table import Table
from legcal.vision.image_file import (
    CONVERT,
    CONVERT_HEIC,
    image_suffixes,
    read_facts,
)

MAX_PHOTOGRAPHS = 50_000
ONE_VIEW = "c1"  # where neither names nor folders nor the table name views
MAX_VIEWS = 12  # maximum number of views guessed from names of photographs
_SEPARATORS = " _-."
_NUMBERS = re.compile(r"(\d+)", re.ASCII)


@dataclass(frozen=True)
class Photograph:
    """An image file and its place in the folder of photographs."""

    path: Path
    name: str  # relative to that folder, with "/"
    view: str = ""  # from a pattern of names, then that of its row
    label: str = ""  # rest of the name without the view

    @property
    def folder(self) -> str:
        """The group of photographs of one view: the view in the name, else the folder.

        The folder is relative to the folder of photographs, "." for that folder itself.
        """
        return self.view or PurePosixPath(self.name).parent.as_posix()


# Rows of the table, from 0, and their photographs; the method in words; and notes
Matched = tuple[Iterable[tuple[int, Photograph]], str, list[str]]


_PATTERNS = {  # of names, the likelier first
    "{view}_*": r"(?P<view>[^_]*)_(?P<label>.*)",
    "{view}-*": r"(?P<view>[^-]*)-(?P<label>.*)",
    "*_{view}": r"(?P<label>.*)_(?P<view>[^_]*)",
    "*-{view}": r"(?P<label>.*)-(?P<view>[^-]*)",
    "{view} *": r"(?P<view>[^ ]*) (?P<label>.*)",
    "* {view}": r"(?P<label>.*) (?P<view>[^ ]*)",
    "{view}*": r"(?P<view>[^\W\d_]+)(?P<label>\d+)",  # left012
}
_LEAST_OF_VIEW = 3  # photographs, where views have more and fewer


def _with_view(photograph: Photograph, pattern: str) -> Photograph:
    """Return a photograph with the view in its name, "" if it has another form."""
    stem = PurePosixPath(photograph.name).stem
    view, label = "", stem
    if found := re.fullmatch(_PATTERNS[pattern], stem):
        view, label = found["view"], found["label"]
    return replace(photograph, view=view, label=label.strip(_SEPARATORS))


def with_likely_views(photographs: Sequence[Photograph]) -> tuple[list[Photograph], str | None]:
    """Return photographs with the views in their names, and the pattern of names.

    They are unchanged and the pattern is None where names do not follow a pattern or where folders
    name the views. Numbers are not accepted as names of views.
    """
    pattern = likely_pattern(photographs)
    if pattern is None or any(photograph.folder != "." for photograph in photographs):
        return list(photographs), None
    with_views = [_with_view(photograph, pattern) for photograph in photographs]
    if all(photograph.view.isdecimal() for photograph in with_views):
        return list(photographs), None
    return with_views, pattern


def likely_pattern(photographs: Sequence[Photograph]) -> str | None:
    """Return a pattern that splits names in one folder into several views.

    Patterns with words as views are preferred to numbers, then views of equal size, which numbers
    need, and few views.
    """
    likely: list[tuple[bool, bool, int, int, str]] = []
    for k, pattern in enumerate(_PATTERNS):
        labels: dict[str, set[str]] = {}
        for photograph in photographs:
            named = _with_view(photograph, pattern)
            labels.setdefault(named.view, set()).add(named.label)
        sizes = [len(of_view) for of_view in labels.values()]
        if "" in labels or not 1 < len(labels) <= MAX_VIEWS:
            continue
        differ, are_numbers = len(set(sizes)) > 1, [view.isdecimal() for view in labels]
        if min(sizes) >= (_LEAST_OF_VIEW if differ else 2) and not (differ and any(are_numbers)):
            likely.append((all(are_numbers), differ, len(labels), k, pattern))
    return min(likely)[-1] if likely else None


def find_photographs(folder: Path) -> list[Photograph]:
    """Return the images in a folder and in the folders in it, in the order of their names."""
    if not os.path.isdir(folder):
        actual = "a file" if os.path.exists(folder) else "no such folder"
        raise DatasetError(
            f"{folder}: the photographs could not be found: found {actual}, needed the folder that "
            "holds them; check the path."
        )
    suffixes = image_suffixes()
    photographs: list[Photograph] = []
    foreign: list[str] = []
    for above, inside, files in os.walk(folder):
        inside[:] = sorted(name for name in inside if not name.startswith("."))
        relative_folder = Path(above).relative_to(folder)
        for name in (name for name in files if not name.startswith(".")):
            suffix = Path(name).suffix.lower()
            file = Photograph(Path(above) / name, (relative_folder / name).as_posix())
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
        actual, remedy = "none", "check the path"
        if foreign:
            actual = f"{len(foreign)} of another format ({few(foreign)})"
            are_heic = any(name.lower().endswith(HEIC_SUFFIXES) for name in foreign)
            remedy = CONVERT_HEIC if are_heic else CONVERT
        raise DatasetError(
            f"{folder}: the photographs could not be found: found {actual}, needed PNG, JPEG or "
            f"TIFF files there or in folders in it; {remedy}."
        )
    return sorted(photographs, key=lambda photograph: natural_key(photograph.name))


def match(
    table: Table, photographs: Sequence[Photograph]
) -> tuple[list[tuple[int, Photograph]], str, list[str]]:
    """Match photographs to rows: by name, else by time, else in order.

    *photographs* are in the order of their names. A column that counts the photographs of each view
    tells their order. Returns the pairs, with the views of rows, in the order of views and rows;
    the method in words; and notes.
    """
    if any(table.text("image")) and not _are_counted(table, photographs):
        matches, how, notes = _by_name(table, photographs)
    elif any(table.text("time")):
        matches, how, notes = _by_time(table, photographs)
    else:
        matches, how, notes = _in_order(table, photographs)
    views, pairs = table.text("view"), list[tuple[int, Photograph]]()
    for k, photograph in matches:
        folder = photograph.folder if photograph.folder != "." else ONE_VIEW
        pairs.append((k, replace(photograph, view=views[k] or folder)))
    order = list(dict.fromkeys(photograph.view for _, photograph in pairs))
    pairs.sort(key=lambda pair: (order.index(pair[1].view), pair[0]))
    used = {photograph.name for _, photograph in pairs}
    bad = sorted(name for name in used if not is_name(name))
    if bad:
        raise DatasetError(
            f"{table.path}: the photograph {describe(bad[0])} could not be used: found a name that "
            f"tables cannot show, needed {NAME_NEEDED}; rename the file."
        )
    spare = [photograph.name for photograph in photographs if photograph.name not in used]
    if spare:
        is_single = len(spare) == 1
        notes.append(
            f"{len(spare)} photograph{'' if is_single else 's'} {'has' if is_single else 'have'} "
            f"no row and {'is' if is_single else 'are'} left out: {few(spare)}."
        )
    return pairs, how, notes


def _are_counted(table: Table, photographs: Sequence[Photograph]) -> bool:
    """Return whether images are counted, 1, 2, 3 in each view, and files not named by that."""
    counts: dict[str, list[str]] = {}
    for view, image in zip(table.text("view"), table.text("image"), strict=True):
        counts.setdefault(view, []).append(image.lstrip("0"))
    if any(of_view != [str(k + 1) for k in range(len(of_view))] for of_view in counts.values()):
        return False
    if len(counts) > 1 and not any(_in_folder(p, view) for p in photographs for view in counts):
        return True  # a number stands for several files
    numbers = {image for of_view in counts.values() for image in of_view}
    return 2 * len(numbers & {_number(p.name) for p in photographs}) <= len(numbers)


def _path(text: str) -> str:
    return text.replace("\\", "/").removeprefix("./")


def _tail(text: str) -> str:
    return _path(text).rsplit("/", 1)[-1].casefold()


def _stem(text: str) -> str:
    tail = _tail(text)
    stem, dot, suffix = tail.rpartition(".")
    return stem if dot and not suffix.isdigit() else tail


def _number(text: str) -> str:
    numbers = _NUMBERS.findall(_stem(text))
    return str(int(numbers[-1])) if numbers else ""


_KEYS: tuple[tuple[str, Callable[[str], str]], ...] = (
    ("by name", _tail),
    ("by name, whatever its extension", _stem),
    ("by the last number of the name", _number),
)


def _alike(photograph: Photograph, text: str) -> tuple[int, bool]:
    """Return the number of equal folders above the file, and whether the case is equal."""
    folders, folders_in_table = (
        _path(name).casefold().split("/")[-2::-1] for name in (photograph.name, text)
    )
    are_equal = [a == b for a, b in zip(folders, folders_in_table, strict=False)]
    return [*are_equal, False].index(False), photograph.name.endswith(_path(text))


def _in_folder(photograph: Photograph, view: str) -> bool:
    folder = photograph.folder.casefold()
    return folder == view.casefold() or folder.endswith("/" + view.casefold())


def _by_name(table: Table, photographs: Sequence[Photograph]) -> Matched:
    """Compare names, the strictest way first."""
    images, views = table.text("image"), table.text("view")
    named = [k for k, image in enumerate(images) if image]
    best, how = dict[int, list[Photograph]](), ""
    for method, key in _KEYS:
        if key is _number and not all(images[k].isdigit() for k in named):
            continue
        by_key: dict[str, list[Photograph]] = {}
        for photograph in photographs:
            for text in {key(photograph.name), *([key(photograph.label)] * bool(photograph.view))}:
                by_key.setdefault(text, []).append(photograph)
        matches = {}
        for k in named:
            same_key = by_key.get(key(images[k]), [])
            if same_key and views[k]:
                inside = [p for p in same_key if _in_folder(p, views[k])]
                same_key = inside or same_key
            if same_key and key(images[k]):
                most = max(_alike(photograph, images[k]) for photograph in same_key)
                matches[k] = [p for p in same_key if _alike(p, images[k]) == most]
        if len(matches) > len(best):
            best, how = matches, method
        if len(best) == len(named):
            break
    _refuse_names(table, best, photographs)
    n_blank, more = len(images) - len(named), len(images) - len(named) > 1
    blank = (
        f"{n_blank} row{'s' * more} of {table.path} without the name of a photograph "
        f"{'are' if more else 'is'} left out."
    )
    return _named_once(table, best), how, [blank] * (n_blank > 0)


def _refuse_names(
    table: Table, best: Mapping[int, Sequence[Photograph]], photographs: Sequence[Photograph]
) -> None:
    """Refuse names of photographs that are not there; *best* has those that are, by row."""
    images = table.text("image")
    named = [k for k, image in enumerate(images) if image]
    if len(best) == 0 and len(named) > 1:
        raise DatasetError(
            Problem(
                "the photographs could not be matched by name",
                f"none that is named like {describe(images[named[0]])}",
                f"the names of files such as {describe(photographs[0].name)}",
                f"correct the column {table.heading('image')}, or remove it to match rows and "
                "photographs in order",
                str(table.path),
                code=Code.MISSING_FILE,
            )
        )
    taken = {photograph.name for same_key in best.values() for photograph in same_key}
    spare, needed = [p.name for p in photographs if p.name not in taken], len(photographs)
    for k in (k for k in named if k not in best):
        found = f"no {describe(images[k])}"
        near = closest(images[k], spare) if spare else "add the file, or remove the row"
        table.refuse(
            k, found, f"one of the {needed} photographs", "image",
            remedy=near, what="photograph", code=Code.MISSING_FILE,
        )  # fmt: skip
    table.check()


def _named_once(table: Table, matches: dict[int, list[Photograph]]) -> list[tuple[int, Photograph]]:
    """Return the pairs if each photograph has one row, and each row one photograph a view."""
    row_of: dict[str, int] = {}
    images, views, what = table.text("image"), table.text("view"), "photograph"
    for k, photographs in matches.items():
        folders = [photograph.folder for photograph in photographs]
        if len(set(folders)) < len(folders) or (views[k] and len(photographs) > 1):
            found = f"{describe(images[k])} for {few([p.name for p in photographs])}"
            remedy = "write the name with its folder and extension"
            table.refuse(k, found, "one", "image", remedy=remedy, what=what)
        for photograph in photographs:
            if (other_row := row_of.setdefault(photograph.name, k)) != k:
                found = f"{describe(photograph.name)} also in {table.places[other_row]}"
                remedy = "add a column view, or write names with folders"
                table.refuse(
                    k, found, "one row a photograph", "image",
                    remedy=remedy, what=what, code=Code.REPEATED_ROW,
                )  # fmt: skip
    table.check()
    return [(k, photograph) for k, photographs in matches.items() for photograph in photographs]


def _in_order(table: Table, photographs: Sequence[Photograph]) -> Matched:
    """Take rows and photographs one by one: in each view, in all, or all rows in each folder."""
    folders: dict[str, list[Photograph]] = {}
    for photograph in photographs:
        folders.setdefault(photograph.folder, []).append(photograph)
    views: dict[str, list[int]] = {}
    for k, view in enumerate(table.text("view")):
        views.setdefault(view, []).append(k)
    rows = list(range(len(table)))
    if "" not in views and all(any(_in_folder(p, view) for p in photographs) for view in views):
        groups = [
            (f"view {view}", members, [p for p in photographs if _in_folder(p, view)])
            for view, members in views.items()
        ]
        method = "in the order of rows and of names, view by view"
    elif len(photographs) == len(rows):
        counted, method = _counted(photographs), "in the order of rows and of names"
        if counted != list(photographs):
            method = "in the order of rows and of the numbers in names, through all folders"
        groups = [("all folders", rows, counted)]
    elif _lacking(len(photographs), rows) < min(_lacking(len(p), rows) for p in folders.values()):
        groups, method = [("all folders together", rows, list(photographs))], ""
    else:
        groups = [(f"folder {folder}", rows, inside) for folder, inside in folders.items()]
        method = "in the order of rows and of names: every view shows the poses of all rows"
    problems = [
        f"{table.path}: the photographs of {name} could not be matched in order: found "
        f"{len(inside)} photographs for {len(members)} rows, needed as many; remove what has no "
        "partner, or add a column image with their names."
        for name, members, inside in groups
        if len(members) != len(inside)
    ]
    if problems:
        raise DatasetError(problems)
    notes = []
    pairs: list[tuple[int, Photograph]] = []
    for name, members, inside in groups:
        times = [photograph_time(photograph) for photograph in inside]
        known_times = [when for when in times if when is not None]
        if len(known_times) == len(times) and known_times != sorted(known_times):
            notes.append(
                f"The photographs of {name} were not taken in the order of their names, as their "
                "EXIF times say; see that the rows are in the order of the names, or add a column "
                "image or time."
            )
        pairs += zip(members, inside, strict=True)
    return pairs, method, notes


def _lacking(n_photographs: int, rows: Sequence[int]) -> int:
    return abs(n_photographs - len(rows))


def _counted(photographs: Sequence[Photograph]) -> list[Photograph]:
    """Return photographs in the order of their numbers where one camera counted all of them.

    Folders then follow each other. Otherwise they stay in the order of folders and names.
    """
    names = [PurePosixPath(photograph.name).name for photograph in photographs]
    of_one_camera = len({_NUMBERS.sub("0", name) for name in names}) == 1
    if not of_one_camera or len(set(names)) < len(names):
        return list(photographs)
    counted = sorted(photographs, key=lambda one: natural_key(PurePosixPath(one.name).name))
    n_folders = len({photograph.folder for photograph in photographs})
    blocks = [folder for folder, _ in groupby(counted, key=lambda one: one.folder)]
    return counted if len(blocks) == n_folders else list(photographs)


def photograph_time(photograph: Photograph) -> float | None:
    """Return the time of a photograph in its metadata [s], None if there is none."""
    try:
        return seconds_in(read_facts(read_bytes(photograph.path, MAX_IMAGE)).taken_at)
    except OSError:
        return None


def _by_time(table: Table, photographs: Sequence[Photograph]) -> Matched:
    """Give each row the photograph taken nearest to its time.

    Clocks may differ by a constant where there are as many photographs as rows.
    """
    taken = {p.name: when for p in photographs if (when := photograph_time(p)) is not None}
    dated = sorted((p for p in photographs if p.name in taken), key=lambda p: taken[p.name])
    texts, n = table.text("time"), len(table)
    if len(dated) < n:
        raise DatasetError(
            f"{table.path}: the photographs could not be matched by time: found {len(dated)} "
            f"photographs with a time in their EXIF data for {n} rows, needed as many or "
            "more; copy the files from the camera as they are, add a column image, or remove the "
            f"column {table.heading('time')} to match rows and photographs in order."
        )
    times = seconds_of_column(texts, taken[dated[0].name])
    for k, when in enumerate(times):
        if when is None:
            found, needed = describe(texts[k]), "one such as 2026-11-23 10:15:00"
            table.refuse(k, found, needed, "time", remedy="correct the cell", what="time")
    table.check()
    moments = [when for when in times if when is not None]
    order = sorted(range(n), key=lambda k: moments[k])
    gaps = [moments[b] - moments[a] for a, b in pairwise(order)]
    least, shift = min(gaps, default=DAY), 0.0
    if len(dated) == n:
        apart = [taken[p.name] - moments[k] for k, p in zip(order, dated, strict=True)]
        shift = sorted(apart)[len(apart) // 2]
        pairs = dict(zip(order, dated, strict=True))
    else:
        pairs = {k: min(dated, key=lambda p: abs(taken[p.name] - moments[k])) for k in order}
    worst = max(abs(taken[p.name] - moments[k] - shift) for k, p in pairs.items())
    if len({p.name for p in pairs.values()}) < n or 2 * worst >= least:
        raise DatasetError(
            f"{table.path}: the photographs could not be matched by time: found times up to "
            f"{worst:.0f} s apart and rows {least:.0f} s apart, "
            "needed less than half of that; leave out photographs without a row, so that a "
            "difference of the clocks shows, or add a column image."
        )
    about = f", clocks {shift:+.0f} s apart" if shift else ""
    return sorted(pairs.items()), f"by time, within {worst:.0f} s{about}", []
