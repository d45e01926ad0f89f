"""Grey levels as light: what the lens blurs is light, and many cameras encode it.

A camera with a gamma g writes (light)^(1/g). A blurred step between dark and bright is then no
blurred step of grey levels: taken for one, it lies half of the blur towards the dark side, so
that bright legs seem thicker before a dark background, and dark ones thinner before a bright one.
"""

import numpy as np
from numpy.typing import NDArray

from legcal.detection.limb import Samples

DARK = 12.0  # grey level below which noise is taken to be that of this level


def to_light(
    grey: Samples, inside: NDArray[np.bool_], gamma: float
) -> tuple[Samples, NDArray[np.float32]]:
    """Return the light in blocks of pixels, and the weights that its noise asks for.

    Parameters
    ----------
    grey : (n, m) array of float32
        Grey levels, 255 at full scale.
    inside : (n, m) array of bool
        Pixels to use.
    gamma : float
        Grey levels are light to the power 1 / gamma.

    Returns
    -------
    light : (n, m) array of float32
        In units in which it changes like grey levels do at the mean grey level of the block.
    weight : (n, m) array of float32
        The change of a grey level with light: noise of grey levels is taken to be the same in all
        pixels of a block. Zero outside.

    Notes
    -----
    Shot noise grows like the root of light, so that its grey levels scatter the same all over a
    picture where gamma is 2.
    """
    use = inside.astype(np.float32)
    if gamma == 1.0:
        return grey, use
    level = np.sum(grey * use, axis=1) / np.maximum(use.sum(axis=1), 1.0)
    level = np.maximum(level, DARK).astype(np.float32)[:, None]
    light = (level / np.float32(gamma)) * (np.maximum(grey, 0.0) / level) ** np.float32(gamma)
    weight = use * (np.maximum(grey, DARK) / level) ** np.float32(1.0 - gamma)
    return light.astype(np.float32), weight.astype(np.float32)
