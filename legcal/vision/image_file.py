"""Image files: checked without decoding, their metadata, grey levels, and scaled images.

Pillow reads the headers: compression, camera, lens, zoom, time. Damaged or absent metadata are
ignored. OpenCV decodes the pixels.

HEIC is read by the package pi-heif where it is installed (``legcal[heic]``). Its wheels hold the
decoders libheif and libde265 (LGPL-3); the wheels of pillow-heif, of which it is a part, hold the
encoder x265 too (GPL-2). Pixels are rotated according to the file.
"""

from __future__ import annotations

import os
import struct
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.ExifTags import IFD, Base
from PIL.Image import Exif
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from legcal.errors import BadValue, Cause, Code, DatasetError, Place, Problem
from legcal.files.schema import HEIC_SUFFIXES, MAX_IMAGE, SUFFIXES, read_bytes
from legcal.geometry.types import Array
from legcal.vision.camera import Camera, intrinsic_names

JPEG_SIGNATURE = b"\xff\xd8\xff"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
PILLOW_ERRORS = (OSError, SyntaxError, ValueError, TypeError, LookupError, ArithmeticError,
                 AttributeError, EOFError, struct.error)  # fmt: skip
"""The exceptions of Pillow for damaged files."""

_MOST_TEXT = 60  # maximum number of characters shown
# Sum of the steps of table K.1 of ITU-T T.81, which is quality 50 on the scale of the IJG
_STEPS_AT_50 = 3688.0


_HEIC_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"mif1", b"msf1")
_REFUSALS = (ValueError, RuntimeError, EOFError, OSError, SyntaxError)  # errors of the package
FILM_DIAGONAL = np.hypot(36.0, 24.0)  # [mm]: fields of view are compared along diagonals
# Standard deviations, relative to the focal length: of f (some makers count by the diagonal of
# film, others by its width, which differ by 4 % at 4:3; lenses are nominal), and of the difference
# between fx and fy (pixels are square)
FOCAL_SIGMA, ASPECT_SIGMA = 0.04, 0.002
_ROUNDING_35MM = 1.0 / np.sqrt(12.0)  # standard deviation of whole millimetres [mm]
_LEAST_M = 0.1  # distance in focus that EXIF may say
_NEAR_M = 0.7  # distance of machines: a focused lens stands out by the focal length over that
_FORMATS, _SAME_FORMAT = (4.0 / 3.0, 3.0 / 2.0), 0.02  # of whole sensors: longer over shorter side
_MOST_CROP = 20.0  # of film over a sensor, the smallest having 13; some programs write nonsense
CENTRE_SIGMA = 0.02  # standard deviation of the principal point, in units of the longer side
DISTORTION_SIGMA = {"k1": 0.1, "k2": 0.1}  # standard deviations of the distortion of usual lenses


class ImageSize(NamedTuple):
    """Size of an image [px]."""

    width: int
    height: int


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
    taken_size: tuple[int, int] | None = None  # original width and height [px]
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


def size_change(before: tuple[int, int], after: tuple[int, int]) -> str:
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

    Its covariance states the uncertainty. Some phones count a digital zoom in that focal length,
    or the cut to another format such as 16:9, others do not: f is between both, and its standard
    deviation reaches to either. None if they state no focal length, several, or nonsense.
    """
    sizes = {photo.taken_size for photo in facts if photo.taken_size is not None}
    stated = {(photo.device, photo.focal_length_35mm, photo.digital_zoom or 1.0) for photo in facts}
    first = max(facts, key=lambda photo: photo.taken_size is not None)
    focal, zoom = first.focal_length_35mm, max(first.digital_zoom or 1.0, 1.0)
    if len(stated) != 1 or len(sizes) > 1 or focal is None:
        return None
    if first.focal_length and focal > _MOST_CROP * zoom * first.focal_length:
        return None
    longer, shorter = max(width, height), min(width, height)
    diagonal = whole = float(np.hypot(width, height))
    if min(abs(longer / shorter - usual) for usual in _FORMATS) > _SAME_FORMAT:
        whole = max(longer / 0.8, shorter / 0.6)  # diagonal of the 4:3 that it was cut from
    margin = np.zeros(2)
    if first.taken_size and size_change(first.taken_size, (width, height)) == "cropped":
        margin = np.array(first.taken_size) - [width, height]
        whole = max(whole, float(np.hypot(*first.taken_size)))
    most = zoom * whole / diagonal  # by which f may be longer
    f = focal * diagonal / float(FILM_DIAGONAL) * float(np.sqrt(most))
    near = 1e-3 * (first.focal_length or 0.0) / max(first.focus_distance or _NEAR_M, _LEAST_M)
    parts = FOCAL_SIGMA, _ROUNDING_35MM / focal, near, float(np.sqrt(most)) - 1.0
    sigma_f = f * float(np.linalg.norm(parts))
    K = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    camera = Camera(K, width, height)
    names = intrinsic_names(camera)
    cx, cy = np.hypot(CENTRE_SIGMA * longer, margin / np.sqrt(12.0)).tolist()
    sigma = {"cx": cx, "cy": cy, **DISTORTION_SIGMA}
    C = np.diag([sigma.get(name, 0.0) ** 2 for name in names])
    focals = [names.index("fx"), names.index("fy")]
    C[np.ix_(focals, focals)] = sigma_f**2 + np.diag([(ASPECT_SIGMA * f) ** 2] * 2)
    return Camera(K, width, height, covariance=C)


def is_heic(content: bytes) -> bool:
    """Return whether the bytes of a file look like HEIC."""
    return content[4:8] == b"ftyp" and content[8:12] in _HEIC_BRANDS


def can_read_heic() -> bool:
    """Return whether the package is installed."""
    return _package() is not None


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


_Level = TypeVar("_Level", np.uint8, np.float32)
Grey = NDArray[np.float32]  # (height, width) grey levels, 0 to 255

_lock = threading.Lock()
_state = {"depth": 0, "level": 0}


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log inside the block; the last thread to leave restores its level."""
    with _lock:
        if _state["depth"] == 0:
            _state["level"] = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _state["depth"] += 1
    try:
        yield
    finally:
        with _lock:
            _state["depth"] -= 1
            if _state["depth"] == 0:
                cv2.utils.logging.setLogLevel(_state["level"])


_FLAGS = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
_DEEP, _FULL = 12, 16  # possible bit depths of the data in files of 16 bits
_END_OF_IMAGE = b"\xff\xd9"  # of a JPEG
_CHECKSUM = 4  # bytes of the checksum of a chunk in a PNG


MAX_SIDE, MAX_AREA = 30_000, 100_000_000  # [px] of an image or a camera; the largest sensors
_SIDEWAYS = 5  # smallest EXIF orientation with exchanged width and height
_STRIP = 256  # rows of an image converted to grey levels at a time

CONVERT = (
    "write them as JPEG of quality 95 or more, or PNG, without turning or scaling them "
    "(magick mogrify -format jpg -quality 98 *.HEIC), or set the phone to the most compatible "
    "format"
)
CONVERT_HEIC = f"install what reads HEIC (pip install 'legcal[heic]'), or {CONVERT}"
_FOREIGN_BRANDS = {b"avif": "AVIF", b"avis": "AVIF", b"crx ": "CR3"}

_COMPLETE = "a complete PNG, JPEG or TIFF file"
COPY_AGAIN = "copy it again or remove the row"  # the remedy of a file that may be incomplete
_LEVELS = "8 or 16 bit grey levels or colours"
NOWHERE = Place()


class BadImage(BadValue):
    """A problem with the bytes of an image file."""

    def __init__(
        self, found: str | Cause, needed: str = _COMPLETE, remedy: str = COPY_AGAIN
    ) -> None:
        super().__init__(found, needed, remedy)


def read_image(path: Path, camera: Camera) -> Grey:
    """Read an image of 8 or 16 bits, grey or in colour, as grey levels."""
    return np.asarray(decode_image(path, camera), dtype=np.float32)


def decode_image(path: Path, camera: Camera, named: Place = NOWHERE) -> NDArray[np.uint8] | Grey:
    """Read an image as grey levels; 8-bit levels stay 8-bit, which takes the least memory."""
    content, problem = _complete_content(path, camera, named)
    if problem:
        raise DatasetError(problem)
    pixels: NDArray[np.generic] | None
    try:
        if is_heic(content):
            pixels = heic_pixels(content)
        else:
            with quiet_opencv():
                pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), _FLAGS)
    except (cv2.error, UnreadableError):
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        actual = "data that cannot be decoded" if pixels is None else f"{pixels.dtype} pixels"
        raise DatasetError(_problem(path, named, actual, _LEVELS))
    if pixels.dtype == np.uint8 and pixels.ndim == 2:
        return np.asarray(pixels, dtype=np.uint8)
    scale = 255.0 / (2 ** _depth(pixels) - 1) if pixels.dtype == np.uint16 else 1.0
    grey = np.empty(pixels.shape[:2], dtype=np.float32)
    for top in range(0, len(grey), _STRIP):  # colours in 32 bits take more than there may be
        levels = pixels[top : top + _STRIP].astype(np.float32)
        if pixels.dtype == np.uint16:
            levels *= np.float32(scale)
        if levels.ndim == 3:
            levels = np.asarray(cv2.cvtColor(levels, cv2.COLOR_BGR2GRAY))
        grey[top : top + _STRIP] = levels
    return grey


def _depth(pixels: NDArray[np.generic]) -> int:
    """Return the bit depth of the data in a file of 16 bits.

    Data shifted to the upper bits leave the lower bits empty and count as 16. A true 16-bit image
    with all levels below 2^12 would be nearly black.
    """
    used = int(np.bitwise_or.reduce(pixels, axis=None))
    is_moved = used % 2 ** (_FULL - _DEEP) == 0
    return _FULL if is_moved or used >= 2**_DEEP else _DEEP


def inspect_image(
    path: Path, camera: Camera, named: Place = NOWHERE
) -> tuple[ImageFacts, Problem | None]:
    """Return the metadata of an image file, and the problem that prevents its use, if any.

    The pixels are not decoded.
    """
    content, problem = _complete_content(path, camera, named)
    return read_facts(content), problem


def image_size(content: bytes) -> ImageSize:
    """Return the size of an image from the bytes of its file; refuse a truncated file."""
    if not content:
        raise BadImage("an empty file")
    if is_heic(content):
        size = _heic_size(content)
    elif content.startswith(JPEG_SIGNATURE):
        size = _size_read("JPEG", _jpeg_size, content)
    elif content.startswith(PNG_SIGNATURE):
        size = _size_read("PNG", _png_size, content)
    elif content.startswith(TIFF_SIGNATURES):
        size = _size_read("TIFF", _tiff_size, content)
    elif content[4:8] == b"ftyp" and content[8:12] in _FOREIGN_BRANDS:
        raise BadImage(
            f"a {_FOREIGN_BRANDS[content[8:12]]} file, which cannot be read here", remedy=CONVERT
        )
    elif content.startswith(b"\0"):  # room that a program reserved before it copies
        raise BadImage("a file that is none of these")
    else:
        remedy = "save the photograph as PNG or JPEG, or remove the file"
        raise BadImage("a file that is none of these, whatever its name", remedy=remedy)
    if problem := size_problem(size.width, size.height):
        raise BadImage(*problem)
    return size


def _size_read(form: str, read: Callable[[bytes], tuple[int, int]], content: bytes) -> ImageSize:
    """Return the size of an image, read by Pillow."""
    try:
        with quiet_pillow():
            return ImageSize(*read(content))
    except BadImage:
        raise
    except (*PILLOW_ERRORS, UserWarning) as error:
        cause = Cause("a {} file of {} bytes, damaged or cut off", (form, len(content)))
        raise BadImage(cause) from error


def _jpeg_size(content: bytes) -> tuple[int, int]:
    """Return the size of a JPEG; refuse data without an end marker."""
    file = BytesIO(content)
    picture = JpegImageFile(file)
    if content.find(_END_OF_IMAGE, file.tell()) < 0:  # behind the header of the first scan
        raise EOFError
    return picture.size


def _png_size(content: bytes) -> tuple[int, int]:
    """Return the size of a PNG; refuse wrong checksums."""
    file = BytesIO(content)
    picture = PngImageFile(file)
    picture.verify()
    if file.tell() + _CHECKSUM > len(content):  # behind the name of the last chunk
        raise EOFError
    return picture.size


def _tiff_size(content: bytes) -> tuple[int, int]:
    """Return the size of a TIFF; refuse missing tags, strips or tiles."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # of tags that are cut off
        tags = exif_tags(content)
    is_tiled = Base.TileOffsets in tags
    starts = tags[Base.TileOffsets if is_tiled else Base.StripOffsets]
    lengths = tags[Base.TileByteCounts if is_tiled else Base.StripByteCounts]
    if np.max(np.add(starts, lengths)) > len(content):
        raise EOFError
    bits = int(np.max(tags.get(Base.BitsPerSample, 1)))
    if bits > _FULL:
        raise BadImage(f"a TIFF of {bits} bit pixels", _LEVELS)
    return int(tags[Base.ImageWidth]), int(tags[Base.ImageLength])


def _heic_size(content: bytes) -> ImageSize:
    """Return the size of a HEIC photograph, if its package is there."""
    if not can_read_heic():
        raise BadImage("a HEIC file, which cannot be read here", remedy=CONVERT_HEIC)
    try:
        return ImageSize(*map(int, _opened(content).size))
    except UnreadableError as error:
        raise BadImage(f"a HEIC file that cannot be read ({error})") from error


def image_suffixes() -> tuple[str, ...]:
    """Return the endings of image files that can be read here."""
    return SUFFIXES + HEIC_SUFFIXES if can_read_heic() else SUFFIXES


def size_problem(width: int, height: int) -> tuple[str, str] | None:
    """Return the actual and the needed size in words if no image can have it, else None."""
    if min(width, height) > 0 and max(width, height) <= MAX_SIDE and width * height <= MAX_AREA:
        return None
    needed = f"at most {MAX_SIDE} px a side and {MAX_AREA} px in all"
    return f"{width} x {height} px", needed


def likely_cause(size: ImageSize, needed: ImageSize, facts: ImageFacts) -> str:
    """Return in brackets the likely cause of an image size unlike the camera's, "" if unknown."""
    change = size_change(needed, size)
    causes = [change] if change else []
    if change == "cropped":
        causes = ["cropped, or taken in another mode of the camera"]
    elif change.startswith("turned by") and (facts.orientation or 1) >= _SIDEWAYS:
        causes[0] += (
            f", as programs show it by its EXIF orientation {facts.orientation}; pixels are taken "
            "as they are stored"
        )
    if facts.taken_size not in (None, size):
        width, height = facts.taken_size
        causes.append(f"taken with {width} x {height} px, as its EXIF data say")
    return f" ({', '.join(causes)})" if causes else ""


def _complete_content(path: Path, camera: Camera, named: Place) -> tuple[bytes, Problem | None]:
    """Return the bytes of an image file, and their problem if any."""
    if not os.path.isfile(path):
        actual = "something that is not a file" if os.path.exists(path) else "no such file"
        remedy = "correct the path or remove the row"
        return b"", _problem(path, named, actual, _COMPLETE, remedy, Code.MISSING_FILE)
    try:
        content = read_bytes(path, MAX_IMAGE)
        size = image_size(content)
    except OSError as error:
        return b"", _problem(path, named, f"'{error.strerror}'", "a readable file")
    except BadImage as error:
        return b"", _problem(path, named, error.found, error.needed, error.remedy)
    needed = ImageSize(camera.width, camera.height)
    if size != needed:
        return b"", _problem(
            path,
            named,
            f"{size.width} x {size.height} px{likely_cause(size, needed, read_facts(content))}",
            f"{camera.width} x {camera.height} px as in its camera file",
            "use the original image, neither scaled, cropped nor rotated, or the calibration of "
            "its size",
            Code.WRONG_IMAGE_SIZE,
        )
    return content, None


def _problem(
    path: Path,
    named: Place,
    found: str | Cause,
    needed: str,
    remedy: str = COPY_AGAIN,
    code: Code = Code.UNREADABLE_FILE,
) -> Problem:
    """Return the problem of an image that cannot be read."""
    sentence = f"image {path} could not be read"
    return Problem(sentence, found, needed, remedy, *named, name=str(path), code=code)


def possible_scale(image: NDArray[np.generic], wanted: float, max_pixels: int) -> float:
    """Return the scale of an image with at most *max_pixels* pixels, at most *wanted*."""
    return min(wanted, float(np.sqrt(max_pixels / image.size)))


def rescaled(image: NDArray[_Level], scale: float) -> NDArray[_Level]:
    """Return an image made larger or smaller by a factor, for a search."""
    if scale == 1:
        return image
    height, width = image.shape
    size = (max(round(scale * width), 1), max(round(scale * height), 1))
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=image.dtype)


def small_jpeg(image: NDArray[_Level], side: int, quality: int) -> bytes:
    """Return a grey image as a JPEG of a quality [percent], at most *side* pixels long and wide."""
    small = rescaled(image, min(1.0, side / max(image.shape)))
    levels = np.clip(np.rint(small), 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def reduced(px: Array, scale: float) -> Array:
    """Return the coordinates in the image of pixels of a rescaled image; centres are integers."""
    return np.asarray((px + 0.5) / scale - 0.5)


class Move(NamedTuple):
    """How an image was moved beside the others of its view: by a camera that did not stand still.

    From the middle of the image, what is at p in the others is at (p + shift + zoom p + turn J p) /
    (1 - slant . p), with J a quarter turn from x to y. A lens that is shifted has no slant; a
    camera that turns has one of the shift over the square of the focal length.
    """

    x: float  # shift [px]
    y: float
    zoom: float
    turn: float  # [rad]
    slant_x: float  # [1/px]
    slant_y: float

    @property
    def homography(self) -> Array:
        """The matrix (3, 3) from the middle of the other images to that of this one."""
        return np.array(
            [
                [1.0 + self.zoom, -self.turn, self.x],
                [self.turn, 1.0 + self.zoom, self.y],
                [-self.slant_x, -self.slant_y, 1.0],
            ]
        )

    def farthest(self, width: int, height: int) -> float:
        """Return by how much the corner of an image that moves most is moved [px]."""
        corners = 0.5 * np.array([[x, y, 2.0] for x in (-width, width) for y in (-height, height)])
        there = corners @ self.homography.T
        return float(np.linalg.norm((there / there[:, 2:] - corners)[:, :2], axis=1).max())

    def undone(self, grey: Grey) -> Grey:
        """Return an image as if the camera had stood still."""
        height, width = grey.shape
        from_middle = np.eye(3)
        from_middle[:2, 2] = 0.5 * (width - 1), 0.5 * (height - 1)
        H = from_middle @ self.homography @ np.linalg.inv(from_middle)
        flags = cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP
        still = cv2.warpPerspective(
            grey, H, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(still, dtype=np.float32)


def shrink(grey: Grey, factor: int) -> Grey:
    """Return an image made smaller by a whole factor, each pixel the mean of a square."""
    if factor == 1:
        return grey
    height, width = (factor * (size // factor) for size in grey.shape)
    size = (width // factor, height // factor)
    small = cv2.resize(grey[:height, :width], size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.float32)
