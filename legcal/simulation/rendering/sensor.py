"""Lens and sensor: radiance to grey levels."""

import cv2
import numpy as np

from legcal.geometry.types import Image
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.rays import Single


def develop(radiance: Single, appearance: Appearance, rng: np.random.Generator) -> Image:
    """Return the image of a radiance: blur, saturation, noise, gamma, rounding.

    Parameters
    ----------
    radiance : (height, width) or (height, width, 3) array
        Linear light, 1 at full scale.
    appearance : Appearance
        Lens and sensor.
    rng : numpy.random.Generator
        Source of the noise.

    Returns
    -------
    array of uint8 or uint16
        The image.
    """
    level = radiance * np.float32(appearance.exposure)
    if appearance.blur > 0.0:
        level = np.asarray(cv2.GaussianBlur(level, (0, 0), appearance.blur))
    np.minimum(level, 1.0, out=level)
    electrons = appearance.electrons
    if np.isfinite(electrons):
        sigma = np.sqrt(level / electrons + (appearance.read_noise / electrons) ** 2)
        sigma *= rng.standard_normal(level.shape, dtype=np.float32)
        level += sigma
    np.clip(level, 0.0, 1.0, out=level)
    if appearance.gamma != 1.0:
        cv2.pow(level, 1.0 / appearance.gamma, level)
    full = 255.0 if appearance.bits == 8 else 65535.0
    level *= full
    level += 0.5
    return level.astype(np.uint8 if appearance.bits == 8 else np.uint16)
