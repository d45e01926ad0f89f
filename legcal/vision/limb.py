"""The shape of the picture across an outline: a background, a blurred step, a lit limb (hazard 9).

At depth D inside the outline of a cylinder of half-width R the surface normal leans towards the
camera by sqrt(rho (2 - rho)) with rho = D / R, which grows like the square root of the depth;
a lit surface shades in proportion to it. The lens blurs outline and shading with a Gaussian.
Basis functions of d, the distance inside the outline in pixels:

    background      1
    its slope       outside the outline only
    step            the surface where it is seen edge-on
    limb            the square-root shading
    lean            shading in proportion to the depth
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Samples = NDArray[np.float32]

N_BASIS = 5
_LIMIT, _STEPS = 40.0, 64  # range of the table of the blurred square root, and entries per unit


def _gauss(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi))


def _blurred_root() -> tuple[Samples, Samples]:
    """Tabulate sqrt(max(x, 0)) blurred by a Gaussian of unit width, and its derivative."""
    x = np.arange(-6.0, _LIMIT + 1e-9, 1.0 / _STEPS)
    root = np.linspace(0.0, 7.0, 2801)  # substitute D = root^2: integrands are smooth
    step = root[1] - root[0]
    kernel = _gauss(x[:, None] - root**2)
    value = 2.0 * step * np.sum(root**2 * kernel, axis=1)
    slope = 2.0 * step * np.sum(root**2 * (root**2 - x[:, None]) * kernel, axis=1)
    return value.astype(np.float32), slope.astype(np.float32)


_ROOT, _ROOT_SLOPE = _blurred_root()


def _look_up(table: Samples, x: Samples) -> Samples:
    """Interpolate a table over [-6, _LIMIT] linearly."""
    place = np.clip((x + 6.0) * _STEPS, 0.0, len(table) - 2.0)
    index = place.astype(np.int32)
    low = table[index]
    return np.asarray(low + (place - index) * (table[index + 1] - low), dtype=np.float32)


def basis(d: Samples, half_width: Samples, blur: float) -> tuple[Samples, Samples]:
    """Return the basis functions and their derivatives with respect to d.

    Parameters
    ----------
    d : (n, m) array of float32
        Distances inside the outline [px], negative outside.
    half_width : (n, 1) array of float32
        Half-width of the cylinder in the image [px].
    blur : float
        Standard deviation of the blur [px].

    Returns
    -------
    values, slopes : (n, m, 5) array of float32
        In the order of the list above; the limb is one at the depth ``half_width``.
    """
    z = d / np.float32(blur)
    step = np.float32(0.5) * (1 + erf(z * np.float32(np.sqrt(0.5))))
    peak = np.exp(np.float32(-0.5) * z * z) * np.float32(1.0 / np.sqrt(2.0 * np.pi))
    depth = np.float32(blur) * (z * step + peak)  # the blurred ramp max(d, 0)
    rho = np.clip(depth / half_width, 0.0, 1.0)
    bend = np.sqrt(2.0 - rho)
    root_scale = np.sqrt(np.float32(blur) / half_width)
    root = _look_up(_ROOT, z) * root_scale
    root_slope = _look_up(_ROOT_SLOPE, z) * (root_scale / np.float32(blur))
    values = np.empty((*d.shape, N_BASIS), dtype=np.float32)
    slopes = np.empty_like(values)
    values[..., 0], slopes[..., 0] = 1.0, 0.0
    values[..., 1], slopes[..., 1] = (depth - d) / half_width, (step - 1.0) / half_width
    values[..., 2], slopes[..., 2] = step, peak / np.float32(blur)
    values[..., 3] = root * bend
    slopes[..., 3] = root_slope * bend - root * step / (2.0 * half_width * bend)
    values[..., 4], slopes[..., 4] = depth / half_width, step / half_width
    return values, slopes
