"""From the light of a scene to the file of a camera: lens, sensor, processing, compression.

An industrial camera writes the counts of its sensor. Consumer cameras do more: a mosaic of colour
filters is filled in, noise is smoothed, edges are sharpened until they overshoot, a tone curve is
applied, and the result is written as a JPEG. :data:`CAMERAS` are typical cameras; their numbers
are within the ranges that reviews and standards (ISO 12233, ISO 15739, IEC 61966-2-1) report.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from legcal.errors import OutOfResources
from legcal.geometry.types import Image
from legcal.simulation.rendering.rays import Single

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
