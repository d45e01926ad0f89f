"""The metadata of a photograph: compression, camera, lens, zoom, time; HEIC, where it can be read.

Pillow reads the headers; no pixel is decoded. Damaged or absent metadata are ignored.

HEIC is read by the package pi-heif where it is installed (``legcal[heic]``). Its wheels hold the
decoders libheif and libde265 (LGPL-3); the wheels of pillow-heif, of which it is a part, hold the
encoder x265 too (GPL-2). Pixels are rotated according to the file.
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL.ExifTags import IFD, Base
from PIL.Image import Exif
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from legcal.vision.camera import Camera, intrinsic_names

JPEG_SIGNATURE = b"\xff\xd8\xff"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
PILLOW_ERRORS = (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError,
                 AttributeError, EOFError, struct.error)  # fmt: skip
"""The exceptions of Pillow for damaged files."""

Size = tuple[int, int]  # width and height [px]

_MOST_TEXT = 60  # maximum number of characters shown
# Sum of the steps of table K.1 of ITU-T T.81, which is quality 50 on the scale of the IJG
_STEPS_AT_50 = 3688.0


HEIC_SUFFIXES = (".heic", ".heif", ".hif")
_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"mif1", b"msf1")
_REFUSALS = (ValueError, RuntimeError, EOFError, OSError, SyntaxError)  # errors of the package
FILM_DIAGONAL = np.hypot(36.0, 24.0)  # [mm]: fields of view are compared along diagonals
# Standard deviations, relative to the focal length: of f (whole millimetres, cropping, focus), and
# of the difference between fx and fy (pixels are square)
FOCAL_SIGMA, ASPECT_SIGMA = 0.04, 0.002
CENTRE_SIGMA = 0.02  # standard deviation of the principal point, in units of the longer side
DISTORTION_SIGMA = {"k1": 0.1, "k2": 0.1}  # standard deviations of the distortion of usual lenses


class UnreadableError(ValueError):
    """A HEIC file that is damaged, or that the package cannot read."""


@dataclass(frozen=True)
class ImageFacts:
    """The metadata of an image file; "" and None for missing values."""

    jpeg_quality: int | None = None  # about, on the scale of the IJG, 1 to 100
    device: str = ""  # make and model of the camera
    serial: str = ""  # its number
    lens: str = ""
    software: str = ""  # the program that wrote the file
    focal_length: float | None = None  # [mm]
    focal_length_35mm: float | None = None  # with the same field of view on 35 mm film [mm]
    focus_distance: float | None = None  # distance in focus [m]
    digital_zoom: float | None = None  # magnification of the middle of the image
    orientation: int | None = None  # EXIF orientation for display, 1 to 8; 1 is unrotated
    taken_size: Size | None = None  # original width and height [px]
    taken_at: str = ""  # time by the clock of the camera, ``2026:11:23 10:15:00``


@contextmanager
def quiet_pillow() -> Iterator[None]:
    """Silence Pillow's warnings of damaged files inside the block."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def read_facts(content: bytes) -> ImageFacts:
    """Return the metadata in the bytes of an image file."""
    with quiet_pillow():
        try:
            if content.startswith(JPEG_SIGNATURE):
                jpeg = JpegImageFile(BytesIO(content))
                tags = exif_tags(jpeg.info.get("exif", b""))
                return _facts(tags, _quality(jpeg.quantization))
            if content.startswith(PNG_SIGNATURE):
                info = PngImageFile(BytesIO(content)).info
                software = {Base.Software: info.get("Software", "")}
                return _facts(software | exif_tags(info.get("exif", b"")))
            if content.startswith(TIFF_SIGNATURES):
                return _facts(exif_tags(content))
            if is_heic(content):  # its pixels are decoded upright
                return _facts(exif_tags(heic_exif(content)) | {Base.Orientation: None})
        except PILLOW_ERRORS:
            pass
    return ImageFacts()


def exif_tags(block: bytes) -> dict[int, Any]:
    """Return the tags of a block of EXIF, or of a TIFF, by their numbers: all that can be read."""
    exif = Exif()
    tags: dict[int, Any] = {}
    with suppress(*PILLOW_ERRORS):
        exif.load(block)
        tags |= exif
        tags |= exif.get_ifd(IFD.Exif)
    return tags


def _facts(tags: Mapping[int, Any], jpeg_quality: int | None = None) -> ImageFacts:
    """Return the facts of a file from its tags."""
    make, model = _text(tags, Base.Make), _text(tags, Base.Model)
    names_make = model.casefold().startswith(make.casefold())
    width, height = (
        _number(tags, tag, 1.0, 65_535.0) for tag in (Base.ExifImageWidth, Base.ExifImageHeight)
    )
    orientation = _number(tags, Base.Orientation, 1.0, 8.0)
    zoom = _number(tags, Base.DigitalZoomRatio, 0.0, 100.0)
    return ImageFacts(
        jpeg_quality=jpeg_quality,
        device=(model if names_make else f"{make} {model}").strip(),
        serial=_text(tags, Base.BodySerialNumber),
        lens=_text(tags, Base.LensModel),
        software=_text(tags, Base.Software),
        focal_length=_number(tags, Base.FocalLength, 1e-3, 1e5),
        focal_length_35mm=_number(tags, Base.FocalLengthIn35mmFilm, 1e-3, 1e5),
        focus_distance=_number(tags, Base.SubjectDistance, 1e-3, 1e5),
        digital_zoom=1.0 if zoom == 0.0 else zoom,  # 0 means no zoom
        orientation=None if orientation is None else int(orientation),
        taken_size=None if width is None or height is None else (int(width), int(height)),
        taken_at=_text(tags, Base.DateTimeOriginal),
    )


def _number(tags: Mapping[int, Any], tag: int, least: float, most: float) -> float | None:
    """Return the number of a tag, None if there is none between limits."""
    try:
        number = float(tags[tag])
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    return number if least <= number <= most else None


def _text(tags: Mapping[int, Any], tag: int) -> str:
    """Return the printable beginning of the text of a tag, on one line."""
    value = tags.get(tag)
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    words = text.partition("\0")[0].split() if isinstance(text, str) else []
    return "".join(c for c in " ".join(words) if c.isprintable())[:_MOST_TEXT].strip()


def _quality(tables: Mapping[int, list[int]]) -> int | None:
    """Return the quality of a JPEG by the sum of the steps of its table of luminance."""
    if not tables:
        return None
    scale = max(sum(tables[min(tables)]) / _STEPS_AT_50, 1e-3)
    return round(min(max(100.0 - 50.0 * scale if scale < 1.0 else 50.0 / scale, 1.0), 100.0))


def size_change(before: Size, after: Size) -> str:
    """Return in words how an image may have come from one size to another, "" if unknown."""
    if after == before[::-1]:
        return "turned by a quarter turn"
    for (width, height), word in ((after, ""), (after[::-1], "turned and ")):
        factor = width / before[0]
        if abs(height - factor * before[1]) <= max(1.0, factor):
            return f"{word}rescaled by {factor:.4g}"
    return "cropped" if after[0] <= before[0] and after[1] <= before[1] else ""


def camera_of_photographs(facts: Sequence[ImageFacts], width: int, height: int) -> Camera | None:
    """Return the camera of photographs of one size by their focal length on 35 mm film.

    Its covariance states the uncertainty. None if they state no focal length, or several.
    """
    stated = {(photograph.device, photograph.focal_length_35mm) for photograph in facts}
    focal = next(iter(stated))[1] if len(stated) == 1 else None
    if focal is None:
        return None
    f = focal * float(np.hypot(width, height)) / float(FILM_DIAGONAL)
    K = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    camera = Camera(K, width, height)
    names = intrinsic_names(camera)
    centre = CENTRE_SIGMA * max(width, height)
    sigma = {"cx": centre, "cy": centre, **DISTORTION_SIGMA}
    C = np.diag([sigma.get(name, 0.0) ** 2 for name in names])
    focals = [names.index("fx"), names.index("fy")]
    C[np.ix_(focals, focals)] = (FOCAL_SIGMA * f) ** 2 + np.diag([(ASPECT_SIGMA * f) ** 2] * 2)
    return Camera(K, width, height, covariance=C)


def is_heic(content: bytes) -> bool:
    """Return whether the bytes of a file look like HEIC."""
    return content[4:8] == b"ftyp" and content[8:12] in _BRANDS


def can_read_heic() -> bool:
    """Return whether the package is installed."""
    return _package() is not None


def heic_size(content: bytes) -> tuple[int, int]:
    """Return width and height of the picture [px]."""
    width, height = _opened(content).size
    return int(width), int(height)


def heic_pixels(content: bytes) -> NDArray[np.generic]:
    """Return the pixels (height, width, 3) of 8 or 16 bits, blue first, or grey (height, width)."""
    try:
        pixels = np.asarray(_opened(content))
    except _REFUSALS as error:
        raise UnreadableError(str(error)) from error
    return pixels[..., :3] if pixels.ndim == 3 else pixels  # without the alpha channel


def heic_exif(content: bytes) -> bytes:
    """Return the block of EXIF, b"" where there is none, or no package."""
    try:
        return bytes(_opened(content).info.get("exif") or b"")
    except UnreadableError:
        return b""


def _package() -> ModuleType | None:
    try:
        import pi_heif
    except ImportError:
        return None
    module: ModuleType = pi_heif
    return module


def _opened(content: bytes) -> Any:
    """Return the picture of a file, its pixels not yet decoded."""
    package = _package()
    if package is None:
        raise UnreadableError("no package that reads it")
    try:
        return package.open_heif(content, convert_hdr_to_8bit=False, bgr_mode=True)
    except _REFUSALS as error:
        raise UnreadableError(str(error)) from error
