"""The photographs that somebody names: files, folders and patterns, all of one size."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from pathlib import Path

from legcal.errors import DatasetError
from legcal.files.schema import describe
from legcal.vision.image_file import ImageSize, image_size

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_MOST_NAMED = 5


def listed_images(named: Sequence[str | Path]) -> list[Path]:
    """Return the image files that are named, each once, those of a folder or pattern by name.

    Parameters
    ----------
    named : sequence of str or Path
        Files, folders (what is in them, not below) or patterns of the shell's kind.

    Raises
    ------
    DatasetError
        With one sentence for each that names no image.
    """
    found: dict[Path, None] = {}
    problems = []
    for name in named:
        paths = _matching(str(name))
        if not paths:
            problems.append(
                f"The images {describe(str(name))} could not be read: found no such file, folder "
                f"with images or pattern that matches one, needed {', '.join(SUFFIXES)}; check the "
                "path."
            )
        found |= dict.fromkeys(paths)
    if problems or not found:
        raise DatasetError(problems or "The images could not be read: found none, needed some.")
    return list(found)


def _matching(name: str) -> list[Path]:
    """Return the images that one name stands for."""
    if not name:
        return []
    path = Path(name)
    if path.is_dir():
        return [p for p in sorted(path.iterdir()) if p.suffix.lower() in SUFFIXES and p.is_file()]
    if os.path.lexists(path):
        return [path]
    hits = [Path(hit) for hit in sorted(glob.glob(name, recursive=True))]
    return [hit for hit in hits if hit.suffix.lower() in SUFFIXES and hit.is_file()]


def common_size(paths: Sequence[Path]) -> ImageSize:
    """Return the size that all images have.

    Raises
    ------
    DatasetError
        With one sentence for each that is no complete image, or if they differ in size.
    """
    sizes: dict[ImageSize, list[Path]] = {}
    problems = []
    for path in paths:
        found = ""
        try:
            sizes.setdefault(image_size(path.read_bytes()), []).append(path)
        except OSError as error:
            found = f"'{error.strerror}'"
        except ValueError as error:
            found = str(error)
        if found:
            problems.append(
                f"{path}: the image could not be read: found {found}, needed a complete PNG, JPEG "
                "or TIFF file; copy it again or leave it out."
            )
    if problems:
        raise DatasetError(problems)
    if len(sizes) > 1:
        by_count = sorted(sizes.items(), key=lambda item: -len(item[1]))
        told = "; ".join(
            f"{size.width} x {size.height} px in {_named(some)}" for size, some in by_count
        )
        raise DatasetError(
            f"The camera could not be calibrated: found images of different sizes, {told}, needed "
            "one size; leave out those that another camera took, or that were scaled, cropped or "
            "turned."
        )
    return next(iter(sizes))


def _named(paths: Sequence[Path]) -> str:
    """Return some of the names of files."""
    if len(paths) <= _MOST_NAMED:
        return ", ".join(path.name for path in paths)
    return f"{len(paths)} images ({paths[0].name}, ...)"
