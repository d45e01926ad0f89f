"""Notes on photographs whose metadata contradict the calibration of their camera.

Views that share a camera file share its calibration. Every note names the images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from legcal.data.measurements import Measurements, few, few_views
from legcal.vision.image_facts import ImageFacts
from legcal.vision.photograph_comparison import Difference, differences

GOOD_QUALITY = 95  # JPEG quality from which the loss is far below the noise of a camera
_TURNS = {1: "not to be turned", 3: "to be turned by 180 deg", 6: "to be turned by 90 deg",
          8: "to be turned by 270 deg"}  # fmt: skip
_MOST = 3  # minimum ratio of photographs of a view that name their camera to those that do not


class PhotographNote(NamedTuple):
    """A contradiction between the metadata of photographs and their camera, in one sentence."""

    what: str
    is_certain: bool  # whether one calibration cannot hold for all these photographs


def notes_on_photographs(
    measurements: Measurements, camera_paths: Sequence[Path], facts: Mapping[str, ImageFacts]
) -> list[PhotographNote]:
    """Return one note for each contradiction between photographs and their camera.

    Parameters
    ----------
    measurements : Measurements
        Their cameras hold the metadata of the photographs used for their calibration.
    camera_paths : sequence of Path
        The camera file of each view.
    facts : mapping
        The metadata of image files, by the names of the images.
    """
    views_of: dict[Path, list[int]] = {}
    for v, path in enumerate(camera_paths):
        views_of.setdefault(path, []).append(v)
    notes: list[PhotographNote] = []
    for path, views in views_of.items():
        images = {v: _images(measurements, v, facts) for v in views}
        notes += _against_camera(measurements, path, images)
        for v in views:
            notes += [
                PhotographNote(sentence, False) for sentence in _of_view(measurements, v, images[v])
            ]
    return notes


def _images(
    measurements: Measurements, view: int, facts: Mapping[str, ImageFacts]
) -> list[tuple[str, ImageFacts]]:
    """Return the photographs of a view with their metadata."""
    rows = zip(measurements.view.tolist(), measurements.image, strict=True)
    names = dict.fromkeys(image for v, image in rows if v == view and image in facts)
    return [(name, facts[name]) for name in names]


def _against_camera(
    measurements: Measurements, path: Path, images: Mapping[int, list[tuple[str, ImageFacts]]]
) -> Iterator[PhotographNote]:
    """Yield contradictions between a camera file and its photographs, and among these."""
    named = [photograph for of_view in images.values() for photograph in of_view]
    camera = measurements.views[next(iter(images))].camera
    view_of = {name: v for v, of_view in images.items() for name, _ in of_view}
    for difference in differences(named, (camera.width, camera.height), camera.photographs):
        shown = sorted({view_of[name] for names in difference.images.values() for name in names})
        views = few_views([measurements.views[v].name for v in shown])
        start = f"{path} may not hold for all images of {views}: found {_in_words(difference)}, "
        if len(difference.images) > 1 and not difference.needed:
            remedy = (
                f"needed one {difference.fact.what}; leave out those that differ, or give them a "
                "view of their own with the camera file of a calibration for them."
            )
        elif difference.needed:
            remedy = (
                f"needed images {difference.needed}, as those of the board were; calibrate the "
                "camera from photographs that are taken and processed like these, or take these "
                "again."
            )
        else:
            remedy = (
                "and no record of the photographs of the board, needed the same in these; see "
                "that it was so, or calibrate the camera with legcal camera, which records it."
            )
        yield PhotographNote(start + remedy, len(difference.images) > 1 or bool(difference.needed))


def _in_words(difference: Difference) -> str:
    """Return the images of a difference with their states, in words."""
    return " and ".join(
        f"images {state} ({few(names)})" for state, names in difference.images.items()
    )


def _of_view(
    measurements: Measurements, view: int, images: Sequence[tuple[str, ImageFacts]]
) -> Iterator[str]:
    """Yield oddities of single photographs of a view."""
    name = measurements.views[view].name
    nameless = [image for image, facts in images if not facts.device]
    devices = [facts.device for _, facts in images if facts.device]
    if nameless and len(devices) >= _MOST * len(nameless):
        yield (
            f"Images {few(nameless)} of view {name} may be cropped or rescaled: found no camera "
            f"named in them, '{devices[0]}' in {len(devices)} others, as after editing, a "
            "screenshot or a messenger, needed the files that the camera wrote; copy them from the "
            "camera."
        )
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
    """Return a note on photographs that were compressed with much loss, if there are any.

    Parameters
    ----------
    measurements : Measurements
        The rows of the photographs.
    facts : mapping
        The metadata of image files, by the names of the images.
    """
    qualities: dict[str, int] = {}  # the least of each view
    for v, image in zip(measurements.view.tolist(), measurements.image, strict=True):
        quality = facts[image].jpeg_quality if image in facts else None
        if quality is not None and quality < GOOD_QUALITY:
            view = measurements.views[v].name
            qualities[view] = min(quality, qualities.get(view, quality))
    if not qualities:
        return []
    return [
        f"Lossy compression moves outlines: found JPEGs of quality {min(qualities.values())} or so "
        f"in photographs of {few_views(list(qualities))}, needed {GOOD_QUALITY} or more, PNG or "
        "TIFF; the stated uncertainty includes it."
    ]
