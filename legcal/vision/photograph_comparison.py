"""Check by the metadata of photographs whether one camera calibration can hold for all of them.

A calibration holds for one camera with one lens, focal length, focus and size of image, and for one
way of processing. Facts that cannot move an edge in the image (exposure, the quality of a JPEG, the
orientation of the camera) are not compared, and neither are missing values, except for facts that
are only written if a picture was processed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from legcal.vision.image_facts import ImageFacts

Recorded = Mapping[str, Sequence[Any]]  # distinct values by their keys in camera files

Size = tuple[int, int]  # width and height [px]

_FOCAL = 0.005  # minimum relative difference of a focal length or zoom: less is rounding
_BREATHING = 1e-3  # minimum relative change of the focal length by another focus
_MOST_RECORDED = 20  # maximum number of values of a fact


@dataclass(frozen=True)
class Fact:
    """A fact that must be equal in all photographs for one calibration to hold."""

    key: str  # in camera files
    name: str  # of the attribute of ImageFacts
    what: str  # name of the fact in a sentence
    words: Callable[[Any, Size], str]  # description of images of a size with a value
    differ: Callable[[Any, Any, ImageFacts], bool]  # value, another value, the image of the first
    plain: object = None  # value that needs no separate calibration
    where_so: bool = False  # whether cameras and programs write it only where it is not plain


def _not_equal(a: object, b: object, _: ImageFacts) -> bool:
    return a != b


def _far(a: float, b: float, _: ImageFacts) -> bool:
    return abs(a - b) > _FOCAL * max(a, b)


def _far_35mm(a: float, b: float, _: ImageFacts) -> bool:
    return abs(a - b) > max(1.0, 0.02 * max(a, b))  # whole millimetres


def _refocused(a: float, b: float, facts: ImageFacts) -> bool:
    """Return whether another focus changes the focal length, according to a thin lens."""
    if facts.focal_length is None:
        return False
    parts = [1e-3 * facts.focal_length / distance for distance in (a, b)]
    return max(parts) < 0.5 and abs(parts[0] - parts[1]) > _BREATHING


def _other_program(a: str, b: str, _: ImageFacts) -> bool:
    """Return whether programs differ by more than their versions."""
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
    """Return in words the processing from the size a camera took to the size of an image."""
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
    """Return the record of photographs in the camera file of their calibration."""
    record = {}
    for fact in FACTS:
        values = sorted(
            {x for image_facts in facts if (x := getattr(image_facts, fact.name)) not in (None, "")}
        )
        if values:
            plain = [list(x) if isinstance(x, tuple) else x for x in values]
            record[fact.key] = plain[:_MOST_RECORDED]
    return record


@dataclass(frozen=True)
class Difference:
    """Photographs that differ in a fact for which a calibration allows only one value."""

    fact: Fact
    # images by value in words; several values where images differ among themselves
    images: Mapping[str, Sequence[str]]
    needed: str  # needed value in words, "" if unknown


def differences(
    named: Sequence[tuple[str, ImageFacts]], size: Size, board: Recorded | None
) -> list[Difference]:
    """Return the differences between photographs that share a calibration.

    Parameters
    ----------
    named : sequence of (str, ImageFacts)
        The photographs, all of one size.
    size : tuple of int
        Width and height [px].
    board : mapping or None
        The record of the photographs of the calibration; None if these are the photographs
        themselves. Facts without a record that hold for few calibrations are differences too.
    """
    result: list[Difference] = []
    for fact in FACTS:
        with_value = [
            (name, image_facts, getattr(image_facts, fact.name)) for name, image_facts in named
        ]
        with_value = [
            (name, image_facts, value)
            for name, image_facts, value in with_value
            if value not in (None, "")
        ]
        of_board = [] if board is None else _comparable(board.get(fact.key, ()))
        plain = fact.plain if fact.key != "taken_size" else size
        by_words: dict[str, list[str]] = {}
        if of_board:
            needed = fact.words(of_board[0], size)
            for name, image_facts, value in with_value:
                if all(fact.differ(value, board_value, image_facts) for board_value in of_board):
                    by_words.setdefault(fact.words(value, size), []).append(name)
            if by_words and not _is_listed(result, by_words):
                result.append(Difference(fact, by_words, needed))
            continue
        groups: list[tuple[Any, list[str]]] = []
        for name, image_facts, value in with_value:
            like = next((g for v, g in groups if not fact.differ(value, v, image_facts)), None)
            if like is None:
                groups.append((value, like := []))
            like.append(name)
        is_odd, silent = any(v != plain for v, _ in groups), list[str]()
        if is_odd and fact.where_so:
            silent = [
                name
                for name, image_facts in named
                if image_facts.device and getattr(image_facts, fact.name) in (None, "")
            ]
        if len(groups) > 1 or silent or (is_odd and plain is not None and board is not None):
            by_words = {fact.words(value, size): names for value, names in groups}
            if silent:
                by_words["that say nothing of it"] = silent
            by_words = dict(sorted(by_words.items(), key=lambda item: len(item[1])))
            if not _is_listed(result, by_words):
                result.append(Difference(fact, by_words, ""))
    return result


def _comparable(values: Sequence[Any]) -> list[Any]:
    """Return recorded values in the types of photographs: lists as tuples."""
    return [tuple(x) if isinstance(x, list) else x for x in values]


def _is_listed(
    known_differences: Sequence[Difference], by_words: Mapping[str, Sequence[str]]
) -> bool:
    """Return whether there is a difference between the same images already: one is enough."""
    parts = sorted(map(tuple, by_words.values()))
    return any(
        sorted(map(tuple, earlier.images.values())) == parts for earlier in known_differences
    )
