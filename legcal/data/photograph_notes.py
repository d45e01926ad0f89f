"""Whether one camera calibration can hold for some photographs, by their metadata.

A calibration holds for one camera with one lens, focal length, focus and size of image, and for one
way of processing. Facts that cannot move an edge in the image (exposure, the quality of a JPEG) are
not compared, and neither are missing values. Every note names the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from legcal.data.measurements import Measurements, few_views
from legcal.files.schema import few
from legcal.vision.image_file import ImageFacts, Move, size_change

_T = TypeVar("_T")

GOOD_QUALITY = 95  # JPEG quality from which the loss is far below the noise of a camera
_TURNS = {1: "not to be turned", 3: "to be turned by 180 deg", 6: "to be turned by 90 deg",
          8: "to be turned by 270 deg"}  # fmt: skip
_ROUNDING, _ROUNDING_35MM = 0.005, 0.04  # relative: of focal length and zoom; of whole millimetres
_BREATHING = 1e-3  # minimum relative change of the focal length by another focus
_MOST_RECORDED = 20  # maximum number of values of a fact


@dataclass(frozen=True)
class Fact:
    """A fact that must be equal in all photographs for one calibration to hold."""

    key: str  # in camera files
    name: str  # of the attribute of ImageFacts
    what: str  # name of the fact in a sentence
    words: str  # of images with a value
    differ: Callable[[Any, Any, ImageFacts], bool]  # value, another value, the image of the first

    def described(self, value: Any, size: tuple[int, int]) -> str:
        """Return in words images of a size with a value."""
        if self.name != "taken_size":
            return self.words.format(value)
        if value == size:
            return "of the size that they were taken with"
        change = size_change(value, size)
        return self.words.format(*value) + (f" and {change}" if change else "")


def _not_equal(a: object, b: object, _: ImageFacts) -> bool:
    return a != b


def _far(rounding: float) -> Callable[[float, float, ImageFacts], bool]:
    return lambda a, b, _: abs(a - b) > rounding * max(a, b)


def _refocused(a: float, b: float, facts: ImageFacts) -> bool:
    """Return whether another focus changes the focal length, according to a thin lens."""
    parts = [1e-3 * (facts.focal_length or 0.0) / distance for distance in (a, b)]
    return max(parts) < 0.5 and abs(parts[0] - parts[1]) > _BREATHING


def _other_program(a: str, b: str, _: ImageFacts) -> bool:
    """Return whether programs differ by more than their versions."""
    first, second = (
        next((k for k, c in enumerate(name) if c.isdigit()), len(name)) for name in (a, b)
    )
    return a[:first].strip(" vV.").casefold() != b[:second].strip(" vV.").casefold()


FACTS = (
    Fact("device", "device", "camera", "taken by '{}'", _not_equal),
    Fact("serial", "serial", "camera", "taken by the camera of number '{}'", _not_equal),
    Fact("lens", "lens", "lens", "taken through '{}'", _not_equal),
    Fact("focal_length_mm", "focal_length", "focal length",
         "taken with a focal length of {:.4g} mm", _far(_ROUNDING)),
    Fact("focal_length_35mm", "focal_length_35mm", "field of view",
         "taken with the field of view of {:.4g} mm on 35 mm film", _far(_ROUNDING_35MM)),
    Fact("digital_zoom", "digital_zoom", "digital zoom", "taken with a digital zoom of {:.3g}",
         _far(_ROUNDING)),
    Fact("focus_distance_m", "focus_distance", "focus", "taken with the focus at {:.3g} m",
         _refocused),
    Fact("taken_size", "taken_size", "way of processing", "taken with {} x {} px", _not_equal),
    Fact("software", "software", "way of processing", "written by '{}'", _other_program),
)  # fmt: skip


def recorded(facts: Sequence[ImageFacts]) -> dict[str, list[Any]]:
    """Return the record of photographs in the camera file of their calibration."""
    record = {}
    for fact in FACTS:
        values = {getattr(image, fact.name) for image in facts} - {None, ""}
        if values:
            plain = [list(x) if isinstance(x, tuple) else x for x in sorted(values)]
            record[fact.key] = plain[:_MOST_RECORDED]
    return record


class Difference(NamedTuple):
    """Photographs that differ in a fact for which a calibration allows only one value."""

    fact: Fact
    images: Mapping[str, Sequence[str]]  # by value in words
    needed: str  # value at the calibration of the camera in words, "" if not recorded

    @property
    def groups(self) -> str:
        """The images with their values, in words."""
        return " and ".join(
            f"images {value} ({few(names)})" for value, names in self.images.items()
        )


def differences(
    named: Sequence[tuple[str, ImageFacts]],
    size: tuple[int, int],  # of all of them [px]
    record: Mapping[str, Sequence[Any]],  # of the photographs of the calibration, see recorded
) -> list[Difference]:
    """Return the differences among photographs, or of them from those of the calibration."""
    result: list[Difference] = []
    for fact in FACTS:
        at_calibration = [tuple(x) if isinstance(x, list) else x for x in record.get(fact.key, ())]
        values = {name: getattr(facts, fact.name) for name, facts in named}
        groups: list[tuple[Any, list[str]]] = []  # photographs with one value
        for name, facts in named:
            if (value := values[name]) in (None, ""):
                continue
            if any(not fact.differ(value, other, facts) for other in at_calibration):
                continue
            like = next((names for v, names in groups if not fact.differ(value, v, facts)), None)
            if like is None:
                groups.append((value, like := []))
            like.append(name)
        groups.sort(key=lambda group: len(group[1]))
        images = {fact.described(value, size): names for value, names in groups}
        is_new = all([*images.values()] != [*earlier.images.values()] for earlier in result)
        if is_new and len(groups) > (0 if at_calibration else 1):
            needed = fact.described(at_calibration[0], size) if at_calibration else ""
            result.append(Difference(fact, images, needed))
    return result


class PhotographNote(NamedTuple):
    """A contradiction between the metadata of photographs and their camera, in one sentence."""

    what: str
    is_certain: bool  # whether one calibration cannot hold for all these photographs


def notes_on_photographs(
    measurements: Measurements, camera_paths: Sequence[Path], facts: Mapping[str, ImageFacts]
) -> list[PhotographNote]:
    """Return one note for each contradiction between photographs and their camera.

    *camera_paths* has the camera file of each view, *facts* the metadata of files by the names of
    images. Views that share a camera file share its calibration, whose photographs it records.
    """
    views_of: dict[Path, list[int]] = {}
    for v, path in enumerate(camera_paths):
        views_of.setdefault(path, []).append(v)
    notes: list[PhotographNote] = []
    photographs = _by_view(measurements, facts)
    for path, views in views_of.items():
        images = {v: photographs[v] for v in views}
        notes += [PhotographNote(x, True) for x in _against_camera(measurements, path, images)]
        for v in views:
            notes += [PhotographNote(x, False) for x in _of_view(measurements, v, images[v])]
    return notes


def _by_view(measurements: Measurements, known: Mapping[str, _T]) -> list[list[tuple[str, _T]]]:
    """Return the images of each view of which something is known, by their names, with that."""
    images: list[list[tuple[str, _T]]] = [[] for _ in measurements.views]
    for v, image in zip(measurements.view.tolist(), measurements.image, strict=True):
        if image in known:
            images[v].append((image, known[image]))
    return images


def _against_camera(
    measurements: Measurements, path: Path, images: Mapping[int, list[tuple[str, ImageFacts]]]
) -> Iterator[str]:
    """Yield contradictions between a camera file and its photographs, and among these."""
    named = [photograph for of_view in images.values() for photograph in of_view]
    camera = measurements.views[next(iter(images))].camera
    view_of = {name: v for v, of_view in images.items() for name, _ in of_view}
    for difference in differences(named, (camera.width, camera.height), camera.photographs):
        shown = sorted({view_of[name] for names in difference.images.values() for name in names})
        views = few_views([measurements.views[v].name for v in shown])
        remedy = (
            f"needed one {difference.fact.what}; leave out those that differ, or give them a view "
            "of their own with the camera file of a calibration for them."
        )
        if difference.needed:
            remedy = (
                f"needed images {difference.needed}, as those of the board were; calibrate the "
                "camera from photographs that are taken and processed like these, or take these "
                "again."
            )
        start = f"{path} may not hold for all images of {views}: found {difference.groups}"
        yield f"{start}, {remedy}"


def _of_view(
    measurements: Measurements, view: int, images: Sequence[tuple[str, ImageFacts]]
) -> Iterator[str]:
    """Yield a note on a camera that was turned between the images of a view."""
    name = measurements.views[view].name
    turns: dict[int, list[str]] = {}
    for image, facts in images:
        if facts.orientation in _TURNS:
            turns.setdefault(facts.orientation, []).append(image)
    if len(turns) > 1 and not measurements.views[view].hand_held:
        orientations = " and ".join(
            f"images marked {_TURNS[turn]} ({few(names)})" for turn, names in turns.items()
        )
        yield (
            f"The camera of view {name} may have been turned between its images: found "
            f"{orientations}, needed a camera that stands still; leave out those that differ, or "
            "give them a view of their own."
        )


def compression_notes(measurements: Measurements, facts: Mapping[str, ImageFacts]) -> list[str]:
    """Return a note on photographs that were compressed with much loss, if there are any."""
    qualities = dict[str, int]()  # the least of each view
    for view, images in zip(measurements.view_names, _by_view(measurements, facts), strict=True):
        of_view = [x.jpeg_quality for _, x in images if x.jpeg_quality is not None]
        if min(of_view, default=GOOD_QUALITY) < GOOD_QUALITY:
            qualities[view] = min(of_view)
    if not qualities:
        return []
    return [
        f"Lossy compression moves outlines: found JPEGs of quality {min(qualities.values())} or so "
        f"in photographs of {few_views(list(qualities))}, needed {GOOD_QUALITY} or more, PNG or "
        "TIFF; the stated uncertainty includes it."
    ]


def notes_on_moves(measurements: Measurements, moves: Mapping[str, Move]) -> list[str]:
    """Return a note on cameras that did not stand still, if there are any."""
    most = {
        view.name: max(move.farthest(view.camera.width, view.camera.height) for _, move in moved)
        for view, moved in zip(measurements.views, _by_view(measurements, moves), strict=True)
        if moved
    }
    if not most:
        return []
    return [
        f"The camera of {few_views(list(most))} did not stand still: its background moves by up to "
        f"{max(most.values()):.1f} px from image to image. They were aligned by it. For the next "
        "session, release the shutter without touching the camera, and turn stabilisation and "
        "autofocus off."
    ]
