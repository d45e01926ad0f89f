"""Whether one calibration can hold for photographs, by what their files say of how they were made.

A calibration holds for one camera with one lens, focal length, focus and size of image, and for one
way of processing. What cannot move an edge in the image (exposure, the quality of a JPEG, how the
camera was held) is not compared, and neither is what a file does not say, but for what is only
written where something was done to the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from legcal.vision.image_facts import ImageFacts

Recorded = Mapping[str, Sequence[Any]]  # distinct values by their keys in camera files

Size = tuple[int, int]  # width and height [px]

_FOCAL = 0.005  # part of a focal length, a zoom: less is rounding
_BREATHING = 1e-3  # part of the focal length that another focus changes
_MOST_RECORDED = 20  # values of a fact


@dataclass(frozen=True)
class Fact:
    """A fact that must be the same in all photographs that one calibration holds for."""

    key: str  # in camera files
    name: str  # of the attribute of ImageFacts
    what: str  # how a sentence calls what must be one
    words: Callable[[Any, Size], str]  # of a value: how images of a size are that have it
    differ: Callable[[Any, Any, ImageFacts], bool]  # value, another value, the image of the first
    plain: object = None  # value that needs no calibration of its own
    where_so: bool = False  # whether cameras and programs write it only where it is not plain


def _not_equal(a: object, b: object, _: ImageFacts) -> bool:
    return a != b


def _far(a: float, b: float, _: ImageFacts) -> bool:
    return abs(a - b) > _FOCAL * max(a, b)


def _far_35mm(a: float, b: float, _: ImageFacts) -> bool:
    return abs(a - b) > max(1.0, 0.02 * max(a, b))  # whole millimetres


def _refocused(a: float, b: float, facts: ImageFacts) -> bool:
    """Say whether another focus changes the focal length, as the one of a thin lens."""
    if facts.focal_length is None:
        return False
    parts = [1e-3 * facts.focal_length / distance for distance in (a, b)]
    return max(parts) < 0.5 and abs(parts[0] - parts[1]) > _BREATHING


def _other_program(a: str, b: str, _: ImageFacts) -> bool:
    """Say whether programs differ by more than their versions."""
    first, second = (
        next((k for k, c in enumerate(name) if c.isdigit()), len(name)) for name in (a, b)
    )
    return a[:first].strip(" vV.").casefold() != b[:second].strip(" vV.").casefold()


def _plainly(template: str) -> Callable[[Any, Size], str]:
    """Return words that do not depend on the size of the image."""

    def words(value: Any, _: Size) -> str:
        return template.format(value)

    return words


def _zoom(value: float, _: Size) -> str:
    return f"taken with a digital zoom of {value:.3g}" if value != 1.0 else "taken without zoom"


def _processed(taken: Size, size: Size) -> str:
    """Return how images of a size came from those that a camera took."""
    if taken == size:
        return "of the size that they were taken with"
    factor = size[0] / taken[0]
    start = f"taken with {taken[0]} x {taken[1]} px"
    if abs(size[1] - factor * taken[1]) <= max(1.0, factor):
        return f"{start} and rescaled by {factor:.4g}"
    if size == taken[::-1]:
        return f"{start} and turned by a quarter turn"
    return f"{start}{' and cropped' * (size[0] <= taken[0] and size[1] <= taken[1])}"


_PROCESSING = "way of processing"
FACTS = (
    Fact("device", "device", "camera", _plainly("taken by '{}'"), _not_equal),
    Fact("serial", "serial", "camera", _plainly("taken by the camera of number '{}'"), _not_equal),
    Fact("lens", "lens", "lens", _plainly("taken through '{}'"), _not_equal),
    Fact("focal_length_mm", "focal_length", "focal length",
         _plainly("taken with a focal length of {:.4g} mm"), _far),
    Fact("focal_length_35mm", "focal_length_35mm", "field of view",
         _plainly("taken with the field of view of {:.4g} mm on 35 mm film"), _far_35mm),
    Fact("digital_zoom", "digital_zoom", "digital zoom", _zoom, _far, 1.0, True),
    Fact("focus_distance_m", "focus_distance", "focus",
         _plainly("taken with the focus at {:.3g} m"), _refocused),
    Fact("taken_size", "taken_size", _PROCESSING, _processed, _not_equal),
    Fact("software", "software", _PROCESSING, _plainly("written by '{}'"), _other_program,
         where_so=True),
)  # fmt: skip


def recorded(facts: Sequence[ImageFacts]) -> dict[str, list[Any]]:
    """Return what a camera file records of the photographs that it comes from."""
    found = {}
    for fact in FACTS:
        values = sorted({x for one in facts if (x := getattr(one, fact.name)) not in (None, "")})
        if values:
            plain = [list(x) if isinstance(x, tuple) else x for x in values]
            found[fact.key] = plain[:_MOST_RECORDED]
    return found


@dataclass(frozen=True)
class Difference:
    """Photographs that differ from others where one calibration allows only one value."""

    fact: Fact
    # what is found, in words, and the images of each; more than one where they differ among
    # themselves
    images: Mapping[str, Sequence[str]]
    needed: str  # in words, "" where nobody says


def differences(
    named: Sequence[tuple[str, ImageFacts]], size: Size, board: Recorded | None
) -> list[Difference]:
    """Return in what photographs that share a calibration differ.

    Parameters
    ----------
    named : sequence of (str, ImageFacts)
        The photographs, all of one size.
    size : tuple of int
        Width and height [px].
    board : mapping or None
        What is recorded of the photographs that the calibration comes from; None if these are the
        photographs themselves. Facts that are not in it, but that few calibrations hold for, are
        differences too.
    """
    found: list[Difference] = []
    for fact in FACTS:
        known = [(name, one, getattr(one, fact.name)) for name, one in named]
        known = [(name, one, value) for name, one, value in known if value not in (None, "")]
        of_board = [] if board is None else _comparable(board.get(fact.key, ()))
        plain = fact.plain if fact.key != "taken_size" else size
        by_words: dict[str, list[str]] = {}
        if of_board:
            needed = fact.words(of_board[0], size)
            for name, one, value in known:
                if all(fact.differ(value, other, one) for other in of_board):
                    by_words.setdefault(fact.words(value, size), []).append(name)
            if by_words and not _said(found, by_words):
                found.append(Difference(fact, by_words, needed))
            continue
        groups: list[tuple[Any, list[str]]] = []
        for name, one, value in known:
            like = next((g for v, g in groups if not fact.differ(value, v, one)), None)
            if like is None:
                groups.append((value, like := []))
            like.append(name)
        is_odd, silent = any(v != plain for v, _ in groups), list[str]()
        if is_odd and fact.where_so:
            silent = [
                name for name, one in named if one.device and getattr(one, fact.name) in (None, "")
            ]
        if len(groups) > 1 or silent or (is_odd and plain is not None and board is not None):
            by_words = {fact.words(value, size): names for value, names in groups}
            if silent:
                by_words["that say nothing of it"] = silent
            by_words = dict(sorted(by_words.items(), key=lambda one: len(one[1])))
            if not _said(found, by_words):
                found.append(Difference(fact, by_words, ""))
    return found


def _comparable(values: Sequence[Any]) -> list[Any]:
    """Return recorded values as photographs have them."""
    return [tuple(x) if isinstance(x, list) else x for x in values]


def _said(found: Sequence[Difference], by_words: Mapping[str, Sequence[str]]) -> bool:
    """Say whether a difference between the same images is found already: one reason is enough."""
    parts = sorted(map(tuple, by_words.values()))
    return any(sorted(map(tuple, other.images.values())) == parts for other in found)
