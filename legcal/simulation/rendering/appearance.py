"""The appearance of photographs: lights, lens, sensor, patterns of surfaces and backgrounds."""

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Literal, Self

import cv2
import numpy as np

from legcal.errors import UsageError
from legcal.files.schema import closest, describe
from legcal.simulation.rendering.pipeline import CAMERAS, CameraPipeline
from legcal.simulation.rendering.rays import Single

SAMPLES = (13, 21, 34, 55, 89, 144)  # Fibonacci numbers: the lattices of a pixel's rays

_POSITIVE = ("exposure", "gamma", "jpeg")
_MIN = {"electrons": 1.0}
_MAX = {
    "blur": 20.0, "gamma": 10.0, "clutter": 500.0, "cables": 100.0, "limb": 1.0, "texture": 10.0,
    "electrons": math.inf, "jpeg": 100.0,
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
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float) and not isinstance(value, bool):
                _check_number(field.name, value)
        if self.camera not in CAMERAS:
            raise UsageError(
                f"The appearance could not be used: found the camera {describe(self.camera)}, "
                f"needed {', '.join(CAMERAS)}; {closest(self.camera, CAMERAS)}"
            )
        if self.pipeline.jpeg and self.bits != 8:
            raise UsageError(
                f"The appearance could not be used: found {self.bits} bits of a pixel and a camera "
                "that writes JPEG files, needed 8 bits; leave out the bits, or choose the camera "
                "industrial."
            )
        _check_choice("bits", self.bits, (8, 16))
        _check_choice("samples", self.samples, SAMPLES)
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


def _check_number(name: str, value: float) -> None:
    """Refuse a number out of range."""
    most = _MAX.get(name, 1e6)
    least = _MIN.get(name, 0.0)
    words = "above" if name in _POSITIVE else "of at least"
    if not least <= value <= most or (name in _POSITIVE and value == 0.0):
        raise UsageError(
            f"The appearance could not be used: found {name} = {value:g}, needed a number {words} "
            f"{least:g} and at most {most:g}; correct it."
        )


def _check_choice(name: str, value: int, choices: tuple[int, ...]) -> None:
    """Refuse a value that is not among the choices."""
    if value not in choices:
        raise UsageError(
            f"The appearance could not be used: found {name} = {value}, needed one of "
            f"{', '.join(map(str, choices))}; choose one."
        )


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
