"""What surfaces of cylinders look like near their limbs: the prior of the limb model.

    python benchmarks/limb_light.py [--surfaces 100000] [--seed 0]

Draws surfaces under two lamps anywhere (most of them before the surface) and even light, matte with
a highlight: Lambert's law, darker towards the limb or not, and lobes about half-way between lamp
and camera (Blinn), exponents 5 to 200. The light along the depth is fitted by powers of r up to
r^4, less the background, which has the mean light of another such surface. Prints the principal
directions of these coefficients in units of the contrast, their median sizes as standard
deviations, and what the powers leave: the first two are ``MATTE_DIRECTIONS`` and ``MATTE_SIGMA`` of
``legcal.perception.limb``.
"""

import argparse

import numpy as np

from legcal.geometry.types import Array
from legcal.perception.limb import MATTE_DIRECTIONS, MATTE_SIGMA

LAMPS, IN_FRONT = 2, 0.8
EXPONENTS, GLOSS, EVEN, DARKENING = (5.0, 200.0), (0.0, 1.0), (0.02, 0.5), 0.6
BACKGROUND_SPREAD = 0.5  # of the logarithm of its light
DEPTH, N_DEPTHS = 0.6, 120  # in half-widths
MEDIAN_SIZE = 0.6745  # of a unit Gaussian
LEAST_CONTRAST = 0.1  # of the median one: surfaces with less show no edge


def surfaces(n: int, rng: np.random.Generator, r: Array) -> Array:
    """Return the light (n, n_depths) of surfaces where normals have cosines r to the camera."""
    darkening = np.maximum(rng.uniform(-DARKENING, DARKENING, size=(n, 1)), 0.0)
    albedo = 1.0 - darkening + darkening * r
    light = albedo * rng.uniform(*EVEN, size=(n, 1))
    sine = np.sqrt(1.0 - r**2)
    for _ in range(LAMPS):
        power = rng.uniform(0.0, 1.0, (n, 1))
        lamp = rng.normal(size=(n, 3))
        lamp /= np.linalg.norm(lamp, axis=1, keepdims=True)
        lamp[:, 2] = np.where(rng.random(n) < IN_FRONT, np.abs(lamp[:, 2]), lamp[:, 2])
        half = lamp + np.array([0.0, 0.0, 1.0])
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        matte, shine = (x[:, [0]] * sine + x[:, [2]] * r for x in (lamp, half))
        exponent = EXPONENTS[0] * (EXPONENTS[1] / EXPONENTS[0]) ** rng.uniform(size=(n, 1))
        gloss = rng.uniform(*GLOSS, size=(n, 1))
        highlight = gloss * np.exp((shine - 1.0) * exponent)
        light += power * (albedo * np.maximum(matte, 0.0) + highlight)
    return light


def main() -> None:
    """Print what the prior of the limb model is, and how far its constants are from that."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--surfaces", type=int, default=100_000, help="drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the draws")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    rho = np.linspace(0.0, DEPTH, N_DEPTHS)
    r = np.sqrt(rho * (2.0 - rho))
    light = surfaces(options.surfaces, rng, r)
    background = rng.permutation(light.mean(axis=1))
    background *= np.exp(rng.normal(0.0, BACKGROUND_SPREAD, len(background)))
    powers = r[:, None] ** np.arange(5)
    coefficients = np.linalg.lstsq(powers, light.T, rcond=None)[0].T
    left = light - coefficients @ powers.T
    coefficients[:, 0] -= background
    both = np.hstack([light, np.repeat(background[:, None], len(r), axis=1)])
    contrast = 2.0 * both.std(axis=1)
    seen = contrast > LEAST_CONTRAST * np.median(contrast)
    coefficients, left = (x[seen] / contrast[seen, None] for x in (coefficients, left))
    _, vector = np.linalg.eigh(coefficients.T @ coefficients)
    vector *= np.sign(np.sum(vector * MATTE_DIRECTIONS.T, axis=0))
    size = np.median(np.abs(coefficients @ vector), axis=0) / MEDIAN_SIZE
    print("principal directions, by r^0 to r^4", np.round(vector.T, 3), sep="\n")
    print("standard deviations", np.round(size, 2))
    print(f"left by the powers: {np.sqrt(np.mean(left**2)):.3f} of the contrast")
    turned = np.abs(vector.T - MATTE_DIRECTIONS).max()
    print(f"constants differ by {turned:.3f}, sizes by {np.abs(size / MATTE_SIGMA - 1).max():.3f}")


if __name__ == "__main__":
    main()
