"""What the file of a photograph says of how it was made: compression, camera, lens, processing.

Read from the segments of a JPEG before its first scan, the chunks of a PNG, the first directory of
a TIFF, the blocks of a HEIC file. Nothing here refuses a file: what is damaged or absent says
nothing.

Phones that blur the background of a portrait keep the depths that they blurred by. Sources, none of
them of the makers: Samsung's blocks behind the image by the tables of ExifTool (``Samsung.pm``);
Huawei's, which starts with ``edof``, by github.com/jpbarraca/dual-camera-edof (P9) and
github.com/designer2k2/depth-map-extractor (P10 to P30, Mate 20); Xiaomi's element of XMP by what
its camera programs write (``ArcsoftDepthMap``).
"""

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from legcal.vision.exif import Value, read_tags
from legcal.vision.heic import heic_blocks, is_heic

JPEG_SIGNATURE = b"\xff\xd8\xff"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_SIGNATURES = (b"II*\0", b"MM\0*")

_MAKE, _MODEL, _ORIENTATION, _SOFTWARE = 0x010F, 0x0110, 0x0112, 0x0131
_FOCUS, _FOCAL, _COMMENT, _WIDTH, _HEIGHT = 0x9206, 0x920A, 0x9286, 0xA002, 0xA003
_RENDERED, _ZOOM, _FOCAL_35, _SERIAL, _LENS = 0xA401, 0xA404, 0xA405, 0xA431, 0xA434
_TAKEN = 0x9003
_COMPRESSION, _STRIPS, _STRIP_BYTES, _JPEG_TABLES, _XMP = 259, 273, 279, 347, 700
_TAGS = (_MAKE, _MODEL, _ORIENTATION, _SOFTWARE, _FOCUS, _FOCAL, _COMMENT, _WIDTH, _HEIGHT,
         _RENDERED, _ZOOM, _FOCAL_35, _SERIAL, _LENS, _TAKEN)  # fmt: skip
_TIFF_TAGS = (*_TAGS, _COMPRESSION, _STRIPS, _STRIP_BYTES, _JPEG_TABLES, _XMP)
_TIFF_JPEG = (6, 7)  # compressions of a TIFF

_EXIF, _XMP_HEAD = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"
_XMP_KEYWORD = b"XML:com.adobe.xmp"
_SCREENSHOT = re.compile(
    r"screen ?shot|screen ?capture|snipping ?tool|snipaste|flameshot|greenshot|spectacle|\bscrot\b",
    re.IGNORECASE,
)
_SETTING = rb"crs:%s\s*(?:=\s*[\"']|>\s*)(True|False|[01])"  # of Adobe's raw converters, in XMP
_PORTRAIT, _PANORAMA = "portrait mode, which draws outlines anew", "panoramas"
_RENDERINGS = {6.0: _PANORAMA, 7.0: _PORTRAIT, 8.0: _PORTRAIT}  # Apple's, beside those of EXIF
_MODES = {  # by what stands in XMP
    (b"SpecialType-PORTRAIT",): _PORTRAIT,  # Google's
    (b"GPano:ProjectionType",): _PANORAMA,
    (b"MiCamera:XMPMeta", b"&lt;depthmap "): _PORTRAIT,  # Xiaomi's
}
_DEPTHS = (  # behind a JPEG
    b"DualShot_DepthMap_", b"SingeShot_DepthMap_",  # Samsung's, of two cameras and of one
    b"\0edof\0",  # Huawei's
)  # fmt: skip
_MOST_SEGMENTS = 1000
_MOST_TEXT = 60
_MOST_BYTES = 262_144  # of a block that is searched

# Table K.1 of ITU-T T.81 in the order of its zigzag: quality 50 of the IJG's scale.
_LUMINANCE = (
    16, 11, 12, 14, 12, 10, 16, 14, 13, 14, 18, 17, 16, 19, 24, 40,
    26, 24, 22, 22, 24, 49, 35, 37, 29, 40, 58, 51, 61, 60, 57, 51,
    56, 55, 64, 72, 92, 78, 64, 68, 87, 69, 55, 56, 80, 109, 81, 87,
    95, 98, 103, 104, 103, 62, 77, 113, 121, 112, 100, 120, 92, 101, 103, 99,
)  # fmt: skip


@dataclass(frozen=True)
class ImageFacts:
    """What an image file says of itself; "" and None where it says nothing.

    Attributes
    ----------
    form : str
        JPEG, PNG, TIFF or HEIC.
    is_lossy : bool
        Whether pixels are compressed with loss.
    jpeg_quality : int or None
        Of the scale of the IJG, 1 to 100, whose table of luminance is nearest.
    device, serial, lens, software : str
        Make and model of the camera, its number, its lens, and the program that wrote the file.
    focal_length, focal_length_35mm : float or None
        Of the lens, and of one with the same field of view on 35 mm film [mm].
    focus_distance : float or None
        Distance that is in focus [m].
    digital_zoom : float or None
        How many times the middle of the image was made larger.
    orientation : int or None
        How to turn the image for looking at it, 1 to 8; 1 is as it is.
    taken_size : tuple of int or None
        Width and height that the camera wrote [px].
    taken_at : str
        When it was taken by the clock of the camera, ``2026:11:23 10:15:00``.
    lens_corrected, cropped : bool or None
        Whether a program took distortion out, and whether it cut the image.
    is_screenshot : bool
        Whether it says so.
    mode : str
        The mode of the camera, in words, if it does not show what the lens saw.
    """

    form: str = ""
    is_lossy: bool = False
    jpeg_quality: int | None = None
    device: str = ""
    serial: str = ""
    lens: str = ""
    software: str = ""
    focal_length: float | None = None
    focal_length_35mm: float | None = None
    focus_distance: float | None = None
    digital_zoom: float | None = None
    orientation: int | None = None
    taken_size: tuple[int, int] | None = None
    taken_at: str = ""
    lens_corrected: bool | None = None
    cropped: bool | None = None
    is_screenshot: bool = False
    mode: str = ""

    @property
    def unlike_the_lens(self) -> str:
        """Why edges may not lie where the lens put them, in words; "" if nothing says so."""
        return "screenshots" if self.is_screenshot else self.mode


def read_facts(content: bytes) -> ImageFacts:
    """Return what the bytes of an image file say of how it was made."""
    if content.startswith(JPEG_SIGNATURE):
        quality, exif, xmp = _of_jpeg(content)
        tags, mode = read_tags(exif, _TAGS), _PORTRAIT if any(d in content for d in _DEPTHS) else ""
        return _facts("JPEG", tags, xmp, [], is_lossy=True, quality=quality, mode=mode)
    if content.startswith(PNG_SIGNATURE):
        exif, xmp, texts = _of_png(content)
        return _facts("PNG", read_tags(exif, _TAGS), xmp, texts)
    if content.startswith(TIFF_SIGNATURES):
        tags = read_tags(content, _TIFF_TAGS)
        is_lossy = _number(tags, _COMPRESSION) in _TIFF_JPEG
        quality = _of_jpeg(_jpeg_in_tiff(content, tags))[0] if is_lossy else None
        packet = tags.get(_XMP, b"")
        xmp = packet if isinstance(packet, bytes) else b""
        return _facts("TIFF", tags, xmp, [], is_lossy=is_lossy, quality=quality)
    if is_heic(content):
        exif, xmp = heic_blocks(content)
        # pixels come turned already
        upright = {tag: x for tag, x in read_tags(exif, _TAGS).items() if tag != _ORIENTATION}
        return _facts("HEIC", upright, xmp, [], is_lossy=True)
    return ImageFacts()


def _facts(
    form: str,
    tags: Mapping[int, Value],
    xmp: bytes,
    texts: Sequence[str],
    *,
    is_lossy: bool = False,
    quality: int | None = None,
    mode: str = "",
) -> ImageFacts:
    """Return the facts of a file from its tags and texts."""
    make, model = _text(tags, _MAKE), _text(tags, _MODEL)
    known = model.casefold().startswith(make.casefold())
    software, comment = _text(tags, _SOFTWARE), _text(tags, _COMMENT, 8)  # behind its alphabet
    of_png = [text.partition(": ")[2] for text in texts if text.startswith("Software: ")]
    width, height = (_number(tags, tag, 1.0, 65_535.0) for tag in (_WIDTH, _HEIGHT))
    orientation = _number(tags, _ORIENTATION, 1.0, 8.0)
    zoom = _number(tags, _ZOOM, 0.0, 100.0)
    return ImageFacts(
        form=form,
        is_lossy=is_lossy,
        jpeg_quality=quality,
        device=(model if known else f"{make} {model}").strip(),
        serial=_text(tags, _SERIAL),
        lens=_text(tags, _LENS),
        software=software or next(iter(of_png), ""),
        focal_length=_number(tags, _FOCAL, 1e-3, 1e5),
        focal_length_35mm=_number(tags, _FOCAL_35, 1e-3, 1e5),
        focus_distance=_number(tags, _FOCUS, 1e-3, 1e5),
        digital_zoom=1.0 if zoom == 0.0 else zoom,  # 0 says that there was none
        orientation=None if orientation is None else int(orientation),
        taken_size=None if width is None or height is None else (int(width), int(height)),
        taken_at=_text(tags, _TAKEN),
        lens_corrected=_setting(xmp, b"LensProfileEnable"),
        cropped=_setting(xmp, b"HasCrop"),
        is_screenshot=any(_SCREENSHOT.search(text) for text in (software, comment, *texts)),
        mode=mode
        or next(
            (said for words, said in _MODES.items() if all(w in xmp[:_MOST_BYTES] for w in words)),
            _RENDERINGS.get(_number(tags, _RENDERED) or 0.0, ""),
        ),
    )


def _number(
    tags: Mapping[int, Value], tag: int, least: float = -math.inf, most: float = math.inf
) -> float | None:
    """Return the number of a tag, None if there is none between limits."""
    value = tags.get(tag)
    if value is None or isinstance(value, bytes) or not least <= value[0] <= most:
        return None
    return value[0]


def _text(tags: Mapping[int, Value], tag: int, start: int = 0) -> str:
    """Return the text of a tag, as :func:`_clean` makes it."""
    value = tags.get(tag)
    return _clean(value[start:]) if isinstance(value, bytes) else ""


def _clean(text: bytes) -> str:
    """Return the printable beginning of a text, on one line."""
    words = text.partition(b"\0")[0].decode("utf-8", "replace").split()
    plain = "".join(c for c in " ".join(words)[: 4 * _MOST_TEXT] if c.isprintable())
    return plain.replace("\ufffd", "")[:_MOST_TEXT].strip()


def _setting(xmp: bytes, name: bytes) -> bool | None:
    """Return a setting of a raw converter, None if it is not there."""
    match = re.search(_SETTING % name, xmp[:_MOST_BYTES])
    return None if match is None else match[1] in (b"True", b"1")


# What stands where in a file


def _of_jpeg(content: bytes) -> tuple[int | None, bytes, bytes]:
    """Return quality, EXIF and XMP of a JPEG."""
    tables: dict[int, tuple[int, ...]] = {}
    used, exif, xmp = 0, b"", b""
    for marker, body in _segments(content):
        if marker == 0xDB:
            tables |= _tables(body)
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and len(body) > 8:
            used = body[8]
        elif marker == 0xE1 and body.startswith(_EXIF):
            exif = exif or body[len(_EXIF) :]
        elif marker == 0xE1 and body.startswith(_XMP_HEAD):
            xmp = xmp or body[len(_XMP_HEAD) :]
    table = tables.get(used) or next(iter(tables.values()), None)
    return None if table is None else _quality(table), exif, xmp


def _segments(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and body of the segments of a JPEG before its first scan."""
    at = 2
    for _ in range(_MOST_SEGMENTS):
        if content[at : at + 1] != b"\xff":
            return
        while content[at : at + 1] == b"\xff":  # the marker, and bytes that fill up
            at += 1
        marker = content[at] if at < len(content) else 0xD9
        if marker in (0xD9, 0xDA) or at + 3 > len(content):
            return
        (length,) = struct.unpack_from(">H", content, at + 1)
        yield marker, content[at + 3 : at + 1 + length]
        at += 1 + max(length, 2)


def _tables(body: bytes) -> dict[int, tuple[int, ...]]:
    """Return the quantisation tables of a segment by their numbers."""
    found, at = {}, 0
    while at < len(body):
        letters = ">64H" if body[at] >> 4 else ">64B"
        if at + 1 + struct.calcsize(letters) > len(body):
            break
        found[body[at] & 15] = struct.unpack_from(letters, body, at + 1)
        at += 1 + struct.calcsize(letters)
    return found


@lru_cache(maxsize=256)
def _quality(table: tuple[int, ...]) -> int:
    """Return the quality whose table is nearest, by the ratios of their steps."""
    steps = [math.log(max(step, 1)) for step in table]
    return min(
        _standard_tables(),
        key=lambda q: sum(abs(a - b) for a, b in zip(steps, _standard_tables()[q], strict=True)),
    )


@lru_cache(maxsize=1)
def _standard_tables() -> dict[int, tuple[float, ...]]:
    """Return logarithms of the steps of every quality, as the IJG's library scales them."""
    return {
        quality: tuple(math.log(min(max((x * s + 50) // 100, 1), 255)) for x in _LUMINANCE)
        for quality in range(1, 101)
        for s in [5000 // quality if quality < 50 else 200 - 2 * quality]
    }


def _of_png(content: bytes) -> tuple[bytes, bytes, list[str]]:
    """Return EXIF, XMP and texts of a PNG."""
    exif, xmp, texts, at = b"", b"", [], len(PNG_SIGNATURE)
    for _ in range(_MOST_SEGMENTS):
        if at + 12 > len(content):
            break
        length, kind = struct.unpack_from(">I4s", content, at)
        body = content[at + 8 : at + 8 + min(length, _MOST_BYTES)]
        keyword, _, text = body.partition(b"\0")
        if kind == b"eXIf":
            exif = body
        elif kind == b"tEXt":
            texts.append(f"{_clean(keyword)}: {_clean(text)}")
        elif kind == b"iTXt" and keyword == _XMP_KEYWORD:
            xmp = text
        elif kind == b"iTXt" and text[:1] == b"\0":  # it is not compressed
            words = text[2:].split(b"\0", 2)[-1]
            texts.append(f"{_clean(keyword)}: {_clean(words)}")
        at += 12 + length
    return exif, xmp, texts


def _jpeg_in_tiff(content: bytes, tags: Mapping[int, Value]) -> bytes:
    """Return the JPEG with the tables of a TIFF: its own block, or the first strip."""
    tables = tags.get(_JPEG_TABLES)
    if isinstance(tables, bytes):
        return tables
    start, length = _number(tags, _STRIPS), _number(tags, _STRIP_BYTES)
    if start is None or length is None:
        return b""
    return content[int(start) : int(start) + min(int(length), _MOST_BYTES)]
