"""The appearance of photographs: lights, lens, sensor, patterns of surfaces and backgrounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, Self

import cv2
import numpy as np

from legcal.errors import OutOfResources, UsageError
from legcal.files.schema import closest, describe
from legcal.geometry.types import Image
from legcal.simulation.rendering.rays import Single

SAMPLES = (13, 21, 34, 55, 89, 144)  # Fibonacci numbers: the lattices of a pixel's rays

_LIMITS = {  # least and most of numbers
    "exposure": (1e-6, 1e6), "gamma": (0.01, 10.0), "jpeg": (1, 100), "electrons": (1.0, math.inf),
    "blur": (0.0, 20.0), "clutter": (0, 500), "cables": (0, 100), "limb": (0.0, 1.0),
    "texture": (0.0, 10.0),
}  # fmt: skip

_SIZE = 512  # points of the tile along a side
_PERIOD = 0.25  # [m] period of a surface's pattern


@dataclass(frozen=True)
class Light:
    """A round lamp.

    Attributes
    ----------
    direction : tuple of float
        Direction of the lamp from the middle of the machine, in the base frame.
    with_camera : bool
        The direction is (right, up, back) of the camera instead: the lamp moves with it.
    distance : float
        Distance from the middle, in radii of the machine.
    strength : float
        Radiance of a white surface that faces it at the middle of the machine; 1 is full scale.
    radius : float
        Its size in radii of the machine: soft shadows, 0 for hard ones.
    shadows : bool
        Whether solids cast shadows in its light.
    """

    direction: tuple[float, float, float]
    with_camera: bool = False
    distance: float = 4.0
    strength: float = 0.8
    radius: float = 0.15
    shadows: bool = True


WORKSHOP_LIGHTS = (
    Light(direction=(0.5, -0.8, 1.1), strength=0.95),
    Light(direction=(-0.5, 0.6, 1.0), with_camera=True, strength=0.3, shadows=False),
)


@dataclass(frozen=True)
class Appearance:
    """The appearance of a photograph. The defaults are a workshop; :meth:`clean` is flat light.

    Attributes
    ----------
    lights : tuple of Light
        The lamps.
    ambient : float
        Radiance of a white surface by light from everywhere, a little more from above.
    shadows : bool
        Whether any shadows are cast.
    limb, specular, texture : float
        Factors on the properties of materials: darkening towards grazing incidence, highlights and
        reflections, and mottled patterns. Zero leaves them out.
    background : float
        Mean radiance behind everything; 1 is full scale.
    background_contrast : float
        Variation of the background, as a fraction of its mean; 0 for a plain one.
    clutter : int
        Rods, boxes and balls around and behind the machine.
    cables : int
        Thin cylinders that hang in front of the machine.
    table : bool
        Whether the machine stands on a table, for cameras above it.
    exposure : float
        Factor on all radiance before it saturates at full scale.
    blur : float
        Standard deviation of the lens's Gaussian blur [px]. Light is blurred before pixels count
        it, in pictures of up to 2 megapixels, which below 1 px takes two to four times the time and
        up to four times the memory.
    gamma : float
        Grey levels are radiance to the power 1 / gamma; 1 is linear.
    electrons : float
        Electrons of a pixel at full scale, which fixes the shot noise; infinite for no noise at
        all, since read noise is counted in electrons too.
    read_noise : float
        Standard deviation of the noise in the dark [electrons].
    bits : {8, 16}
        Bits of a pixel.
    colour : bool
        Blue, green, red as OpenCV has them instead of grey.
    samples : int
        Rays of each pixel that an edge may cross: 13, 21, 34, 55, 89 or 144. It does not bias
        outlines, but their position scatters from one row of pixels to the next, by 0.030 px
        (root mean square over directions) with 21 rays, 0.026 with 34, 0.015 with 55, 0.011
        with 89.
    camera : {"industrial", "machine-jpeg", "webcam", "phone", "action"}
        Kind of camera: an industrial camera does not process the light, others process it and write
        JPEG files of 8 bits. A webcam, phone or action camera has a mosaic of colour filters, which
        matters if ``colour`` is set.
    jpeg : int or None
        Quality of the JPEG, 1 to 100, in place of the default of the camera.

    Raises
    ------
    UsageError
        If a number is outside its range.
    """

    lights: tuple[Light, ...] = WORKSHOP_LIGHTS
    ambient: float = 0.07
    shadows: bool = True
    limb: float = 1.0
    specular: float = 1.0
    texture: float = 1.0
    background: float = 0.03
    background_contrast: float = 0.5
    clutter: int = 15
    cables: int = 0
    table: bool = True
    exposure: float = 1.0
    blur: float = 0.5
    gamma: float = 2.2
    electrons: float = 12_000.0
    read_noise: float = 12.0
    bits: Literal[8, 16] = 8
    colour: bool = False
    samples: int = 34
    camera: str = "industrial"
    jpeg: int | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            least, most = _LIMITS.get(name, (0.0, 1e6))
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if is_number and not least <= value <= most:
                raise _refused(name, f"{value:g}", f"{least:g} to {most:g}; correct it.")
        if self.camera not in CAMERAS:
            kinds = f"{', '.join(CAMERAS)}; {closest(str(self.camera), CAMERAS)}"
            raise _refused("camera", describe(self.camera), kinds)
        for name, choices in (("bits", (8, 16)), ("samples", SAMPLES)):
            if getattr(self, name) not in choices:
                needed = f"one of {', '.join(map(str, choices))}; choose one."
                raise _refused(name, getattr(self, name), needed)
        if self.pipeline.jpeg and self.bits != 8:
            needed = "8 where the camera writes JPEG files; leave out the bits."
            raise _refused("bits", self.bits, needed)
        is_list = isinstance(self.lights, list | tuple)
        if not is_list or not all(isinstance(light, Light) for light in self.lights):
            raise _refused("lights", describe(self.lights), "some of Light; correct it.")
        for light in self.lights:
            if not (math.hypot(*light.direction) > 0.0 and 0.0 < light.distance < 1e6):
                raise UsageError(
                    f"The light could not be placed: found direction {light.direction} and "
                    f"distance {light.distance:g}, needed a direction and a distance above 0; "
                    "correct them."
                )
            if not (light.strength >= 0.0 and light.radius >= 0.0):
                raise UsageError(
                    f"The light could not shine: found strength {light.strength:g} and radius "
                    f"{light.radius:g}, needed numbers of at least 0; correct them."
                )

    @property
    def pipeline(self) -> CameraPipeline:
        """The processing of the light by the camera."""
        camera = CAMERAS[self.camera]
        return camera if self.jpeg is None else replace(camera, jpeg=self.jpeg)

    @classmethod
    def clean(cls, **changes: object) -> Self:
        """Return flat light on a dark plain background, without blur or noise, linear, 16 bit.

        Every surface has one grey level, its albedo, so that outlines are edges between two
        constants. Keyword arguments override these.
        """
        plain = cls(
            lights=(), ambient=1.0, shadows=False, limb=0.0, specular=0.0, texture=0.0,
            background=0.02, background_contrast=0.0, clutter=0, table=False,
            blur=0.0, gamma=1.0, electrons=math.inf, read_noise=0.0, bits=16, samples=89,
        )  # fmt: skip
        return replace(plain, **changes)  # type: ignore[arg-type]


def _refused(name: str, value: object, needed: str) -> UsageError:
    """Return the refusal of a value of an appearance."""
    return UsageError(f"The appearance could not be used: found {name} = {value}, needed {needed}")


@lru_cache(maxsize=1)
def tile() -> Single:
    """Return a pattern that repeats, mean 0 and standard deviation 1."""
    rng = np.random.default_rng(7)
    pattern = np.zeros((_SIZE, _SIZE), dtype=np.float32)
    for octave in range(3, 8):
        coarse = rng.standard_normal((2**octave, 2**octave)).astype(np.float32)
        wrapped = np.pad(coarse, 4, mode="wrap")
        k = _SIZE // 2**octave
        fine = cv2.resize(wrapped, None, fx=k, fy=k, interpolation=cv2.INTER_CUBIC)
        pattern += fine[4 * k : -4 * k, 4 * k : -4 * k] * np.float32(0.9**octave)
    return np.asarray((pattern - pattern.mean()) / pattern.std(), dtype=np.float32)


def mottled(local: Single) -> Single:
    """Return the pattern (n,) at points (3, n) in the frame of a solid [m]."""
    k = np.float32(_SIZE / _PERIOD)
    a, b, c = local * k
    i = (a + np.float32(0.31) * c).astype(np.int32) & (_SIZE - 1)
    j = (b + np.float32(0.73) * c).astype(np.int32) & (_SIZE - 1)
    return np.asarray(tile()[i, j])


def background(width: int, height: int, contrast: float, rng: np.random.Generator) -> Single:
    """Return a smooth picture (height, width) of mean 1 that varies by the contrast, never dark."""
    picture = np.zeros((height, width), dtype=np.float32)
    for octave in range(2, 7):
        cells = 2**octave
        shape = max(3 * cells // 4, 2), cells
        coarse = rng.standard_normal(shape).astype(np.float32)
        fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        picture += fine * np.float32(0.6**octave)
    picture /= max(float(picture.std()), 1e-6)
    picture = np.exp(np.float32(contrast) * np.clip(picture, -2.5, 2.5))
    return np.asarray(picture / picture.mean(), dtype=np.float32)


# Lens, sensor, processing, compression


Subsampling = Literal["4:4:4", "4:2:2", "4:2:0"]

_FACTORS: dict[Subsampling, int] = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}
_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # for colours; grey levels are written faster without
_FIELD_LEVELS = 4  # levels of blur between the middle and the corners
_CHANNELS = (-1.0, 0.0, 1.0)  # factors of chromatic aberration: blue, green, red
_SAMPLED_BLUR = 1.0  # [px] minimum blur that can be applied to whole pixels
_MOST_FINE = 2**23  # maximum number of pixels of a finer picture, for memory


@dataclass(frozen=True)
class CameraPipeline:
    """The processing of light by a kind of camera.

    Attributes
    ----------
    colour : bool
        Whether a mosaic of colour filters (RGGB) is in front of the sensor, and filled in after it.
    vignetting : float
        Fraction of the light that is lost in the corners; it grows with the square of the distance
        from the middle.
    chromatic : float
        Relative magnification of red over green, and of green over blue.
    field_blur : float
        Standard deviation of the blur in the corners, besides the blur of the middle [px].
    sensor_bits : int
        Bits of the sensor's counts.
    denoise : float
        Standard deviation of the grey levels, as a fraction of full scale, up to which differences
        of neighbours are smoothed (a bilateral filter); 0 for none.
    tone : float
        Strength of an S-shaped tone curve: relative increase of its slope in the middle; 0 is
        straight. It follows the gamma.
    sharpen, radius : float
        Unsharp mask: factor of the difference from a Gaussian blur of a radius [px].
    jpeg : int
        Quality of the JPEG, 1 to 100; 0 for a PNG.
    subsampling : {"4:4:4", "4:2:2", "4:2:0"}
        Chroma subsampling of the JPEG.
    """

    colour: bool = False
    vignetting: float = 0.0
    chromatic: float = 0.0
    field_blur: float = 0.0
    sensor_bits: int = 16
    denoise: float = 0.0
    tone: float = 0.0
    sharpen: float = 0.0
    radius: float = 1.0
    jpeg: int = 0
    subsampling: Subsampling = "4:2:0"

    @property
    def suffix(self) -> str:
        """Return the suffix of its file names."""
        return ".jpg" if self.jpeg else ".png"

    def fineness(self, blur: float, n_pixels: int) -> int:
        """Return the number of parts of a pixel along rows and columns that a blur [px] needs.

        A lens blurs light before pixels count it. Values of whole pixels do not resolve the
        distribution of light inside them: with a blur below a pixel, edges would not be spread by a
        Gaussian, and outlines would move inwards by a tenth of a pixel.
        """
        is_fine = blur < _SAMPLED_BLUR and (blur > 0.0 or self.field_blur > 0.0)
        return 2 if is_fine and 4 * n_pixels <= _MOST_FINE else 1

    def through_lens(self, light: Single, blur: float, fineness: int = 1) -> Single:
        """Return the light (height, width[, 3]) on pixels, with a blur in the middle [px].

        The light is sampled ``fineness`` times a pixel along rows and columns.
        """
        light = self._refracted(light, blur, fineness)
        if fineness > 1:
            height, width = (size // fineness for size in light.shape[:2])
            light = np.asarray(cv2.resize(light, (width, height), interpolation=cv2.INTER_AREA))
        if self.vignetting > 0.0:
            kept = 1.0 - self.vignetting * _corner_distance(*light.shape[:2]) ** 2
            light = light * (kept if light.ndim == 2 else kept[..., None])
        return light

    def _refracted(self, light: Single, blur: float, fineness: int) -> Single:
        """Return light after the lens: chromatic aberration and blur."""
        if self.chromatic > 0.0 and light.ndim == 3:
            light = np.stack(
                [
                    _scaled(np.ascontiguousarray(light[..., k]), 1.0 + sign * self.chromatic)
                    for k, sign in enumerate(_CHANNELS)
                ],
                axis=-1,
            )
        if self.field_blur > 0.0:
            return self._blurred(light, blur, fineness)
        return np.asarray(cv2.GaussianBlur(light, (0, 0), fineness * blur)) if blur else light

    def _blurred(self, light: Single, blur: float, fineness: int) -> Single:
        """Return light with a blur that grows from the middle to the corners."""
        height, width = light.shape[:2]
        sigmas = np.hypot(blur, self.field_blur * np.linspace(0.0, 1.0, _FIELD_LEVELS))
        sigmas *= fineness
        place = _corner_distance(height, width) * (_FIELD_LEVELS - 1)
        blurred = np.zeros_like(light)
        for k, sigma in enumerate(sigmas.tolist()):
            share = np.maximum(1.0 - np.abs(place - np.float32(k)), 0.0)
            level = cv2.GaussianBlur(light, (0, 0), sigma) if sigma > 0.0 else light
            blurred += level * (share if light.ndim == 2 else share[..., None])
        return blurred

    def counted(
        self, light: Single, electrons: float, read_noise: float, rng: np.random.Generator
    ) -> Single:
        """Return the counts of the sensor for light (height, width[, 3]), 0 to 1 at full scale.

        Electrons of a pixel at full scale (infinite: no noise) and noise in the dark [electrons].
        Behind a mosaic of filters each pixel counts one colour; the others are filled in.
        """
        is_mosaic = self.colour and light.ndim == 3
        level = _mosaic(light) if is_mosaic else light.copy()
        np.minimum(level, 1.0, out=level)
        if np.isfinite(electrons):
            sigma = np.sqrt(level / electrons + (read_noise / electrons) ** 2)
            sigma *= rng.standard_normal(level.shape, dtype=np.float32)
            level += sigma
        np.clip(level, 0.0, 1.0, out=level)
        if self.sensor_bits < 16 or is_mosaic:
            full = np.float32(2**self.sensor_bits - 1)
            counts = np.rint(level * full)
            if is_mosaic:
                whole = cv2.demosaicing(counts.astype(np.uint16), cv2.COLOR_BayerBG2BGR_EA)
                return np.asarray(whole, dtype=np.float32) / full
            level = counts / full
        return level

    def processed(self, level: Single, gamma: float) -> Single:
        """Return the processed counts (height, width[, 3]), 0 to 1: gamma, tone, sharpening."""
        if gamma != 1.0:
            level = np.asarray(cv2.pow(level, 1.0 / gamma))
        if self.denoise > 0.0:
            level = np.asarray(cv2.bilateralFilter(level, 5, self.denoise, 1.5))
        if self.tone > 0.0:
            # x + tone x (1 - x) (2 x - 1): straight at both ends and in the middle
            level = level + np.float32(self.tone) * level * (1.0 - level) * (2.0 * level - 1.0)
        if self.sharpen > 0.0:
            soft = np.asarray(cv2.GaussianBlur(level, (0, 0), self.radius))
            level = level + np.float32(self.sharpen) * (level - soft)
        return np.clip(level, 0.0, 1.0)

    def file(self, image: Image) -> bytes:
        """Return an image as the camera writes it.

        Raises OutOfResources for an image that is too large for the format.
        """
        if self.jpeg:
            options = [cv2.IMWRITE_JPEG_QUALITY, self.jpeg]
            if image.ndim == 3:
                options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, _FACTORS[self.subsampling]]
        else:
            options = list(_FAST) if image.ndim == 3 else []
        encoded, content = cv2.imencode(self.suffix, image, options)
        if not encoded:
            raise OutOfResources(
                f"A photograph could not be encoded: found an image of {image.shape[1]} x "
                f"{image.shape[0]} px that {self.suffix[1:].upper()} does not take, needed a "
                "smaller one; use another camera."
            )
        return content.tobytes()


INDUSTRIAL = CameraPipeline()
CAMERAS: dict[str, CameraPipeline] = {
    "industrial": INDUSTRIAL,
    "machine-jpeg": CameraPipeline(sensor_bits=12, vignetting=0.1, sharpen=0.3, jpeg=85),
    "webcam": CameraPipeline(
        colour=True, vignetting=0.3, chromatic=4e-4, field_blur=0.5, sensor_bits=10, denoise=0.03,
        tone=0.3, sharpen=1.0, radius=1.2, jpeg=75,
    ),
    "phone": CameraPipeline(
        colour=True, vignetting=0.1, chromatic=1e-4, field_blur=0.3, sensor_bits=12, denoise=0.02,
        tone=0.4, sharpen=0.8, radius=1.0, jpeg=92,
    ),
    "action": CameraPipeline(
        colour=True, vignetting=0.35, chromatic=6e-4, field_blur=0.8, sensor_bits=10, denoise=0.03,
        tone=0.5, sharpen=1.3, radius=1.5, jpeg=85,
    ),
}  # fmt: skip


def _corner_distance(height: int, width: int) -> Single:
    """Return the distance of pixels from the middle of the image, 1 in the corners."""
    y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None] * height
    x = np.linspace(-1.0, 1.0, width, dtype=np.float32) * width
    return np.asarray(np.hypot(x, y) / np.float32(np.hypot(height, width)), dtype=np.float32)


def _scaled(light: Single, scale: float) -> Single:
    """Return light (height, width) that is larger by a factor about the middle of the image."""
    height, width = light.shape
    matrix = np.array(
        [
            [scale, 0.0, 0.5 * (1.0 - scale) * (width - 1)],
            [0.0, scale, 0.5 * (1.0 - scale) * (height - 1)],
        ]
    )
    moved = cv2.warpAffine(
        light, matrix, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.maximum(np.asarray(moved, dtype=np.float32), 0.0)


def _mosaic(light: Single) -> Single:
    """Return counts (height, width) behind filters R G, G B from blue, green, red (..., 3)."""
    counted = light[..., 1].copy()
    counted[0::2, 0::2] = light[0::2, 0::2, 2]
    counted[1::2, 1::2] = light[1::2, 1::2, 0]
    return counted
