"""Outlines of rods that are drawn without the simulator's renderer, by their width.

    OMP_NUM_THREADS=1 python benchmarks/thin_rods.py [--rods 60] [--seed 0] [--lens KIND ...]

A straight rod before an even background, as wide all along: its profile is computed on a grid of
0.01 px, spread by a lens and by the area of pixels, and read off at every pixel. A lens is a
Gaussian, an Airy disk (diffraction), a Gaussian with a faint halo, or a disk (out of focus).
Radiance across the rod is that of a Lambert surface with light from everywhere and from one lamp at
the front, the side or behind, darker towards the limb or not, with a highlight or not; brightness
of the background, direction of the rod and gamma are drawn too.

Outlines are measured as they are near a fit: from lines that are off by ``START`` at each end, with
the blur known to a tenth. "bias" is the mean error in the middle of outlines, positive towards the
inside, "median" their median, "rms" their root mean square, all of those within ``GROSS`` ("gross"
counts the others, which widths reject); "counted" is their rms as a fit counts them, by the squares
of stated precisions; "stated" is the median of the stated standard deviations,
"pull" the root mean square of errors over these. "follows" is by how much of a shift of its start
inwards an outline moves.
"""

import argparse
from collections.abc import Callable

import numpy as np

from legcal.geometry.types import Array
from legcal.perception.profiles import Edge
from legcal.perception.subpixel_edges import MeasuredEdge, measure_edges
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.image_file import Grey
from legcal.vision.visibility import Band

WIDTHS = (6.0, 9.0, 13.0, 20.0, 60.0)  # [px]
SIDE, LENGTH = 260, 200.0  # of the picture, and of the used piece of the rod [px]
FOCAL = 400.0  # [px]
STEP, BESIDE = 0.01, 14.0  # of the grid across the rod, and how far it goes on outside [px]
ELECTRONS, READ_NOISE = 12_000.0, 12.0  # of a pixel at full scale, and noise in the dark
START, SHIFT = 0.15, 0.3  # [px]
GROSS = 0.6  # [px]
MIN_CONTRAST = 10.0  # of an outline [grey levels]


def gaussian(x: Array, sigma: float = 0.5) -> Array:
    """Return the line spread of a Gaussian blur at distances [px]."""
    return np.asarray(np.exp(-0.5 * (x / sigma) ** 2))


def halo(x: Array) -> Array:
    """Return the same of a Gaussian blur with a tenth of the light four times as far."""
    return 0.9 * gaussian(x, 0.45) / 0.45 + 0.1 * gaussian(x, 1.8) / 1.8


def airy(x: Array, cutoff: float = 0.78) -> Array:
    """Return the same of a lens that diffracts light: f/8 with pixels of 3.45 um."""
    share = np.linspace(0.0, 1.0, 800)
    passed = np.arccos(share) - share * np.sqrt(1.0 - share**2)
    return np.maximum(np.cos(2.0 * np.pi * cutoff * np.outer(x, share)) @ passed, 0.0)


def defocus(x: Array) -> Array:
    """Return the same of a lens out of focus, whose blur is a disk."""
    return np.asarray(np.sqrt(np.maximum(1.0 - x**2, 0.0)))


LENSES: dict[str, Callable[[Array], Array]] = {
    "gaussian": gaussian, "airy": airy, "halo": halo, "defocus": defocus,
}  # fmt: skip


def radiance(x: Array, rng: np.random.Generator) -> Array:
    """Return the light of a rod at x (n,) across it, -1 to 1 from limb to limb."""
    facing = np.sqrt(1.0 - x**2)
    away = rng.uniform(*[(0.0, 0.5), (0.7, 1.3), (1.5, 2.1)][rng.integers(3)])
    around = rng.uniform(0.0, 2.0 * np.pi)
    lamp = np.array([np.sin(away) * np.cos(around), np.sin(away) * np.sin(around), np.cos(away)])
    lit = np.maximum(x * lamp[0] + facing * lamp[2], 0.0)
    darkening = rng.choice([0.0, 0.3, 0.7])
    albedo = rng.uniform(0.15, 0.8) * (1.0 - darkening + darkening * facing)
    halfway = lamp + np.array([0.0, 0.0, 1.0])
    halfway /= np.linalg.norm(halfway)
    highlight = np.exp((x * halfway[0] + facing * halfway[2] - 1.0) * rng.choice([8, 40, 120]))
    gloss = rng.choice([0.0, 0.25, 0.8]) * np.minimum(8.0 * lit, 1.0)
    return np.asarray(albedo * (rng.uniform(0.05, 0.4) + lit) + gloss * highlight)


def draw(width: float, lens: str, rng: np.random.Generator) -> tuple[Grey, Camera, Band, Array]:
    """Return a picture of a rod, its camera, the frame of the rod, and offsets of edges (2, 2)."""
    radius = 0.5 * width
    across = np.arange(-radius - BESIDE, radius + BESIDE, STEP)
    on_rod = np.abs(across) < radius
    light = np.where(on_rod, radiance(np.asarray(np.clip(across / radius, -1, 1)), rng), 0.0)
    behind = np.quantile(light[on_rod], 0.9) * rng.uniform(
        *[(0.01, 0.25), (0.3, 1.0), (1.3, 2.5)][rng.integers(3)]
    )
    angle, aside = rng.uniform(0.0, np.pi), rng.uniform(-3.0, 3.0)
    along = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-along[1], along[0]])
    reach = STEP * np.arange(-800.0, 801.0)
    spread = [LENSES[lens](reach)]
    # A pixel's area, seen along the rod, is a box for each of its sides.
    spread += [np.ones(2 * int(0.5 * side / STEP) + 1) for side in np.abs(along)]
    profile = light - behind * on_rod
    for kernel in spread:
        profile = np.convolve(profile, kernel / kernel.sum(), mode="same")
    profile += behind
    gamma = float(rng.choice([1.0, 2.2]))
    middle = 0.5 * (SIDE - 1)
    camera = Camera(
        np.array([[FOCAL, 0.0, middle], [0.0, FOCAL, middle], [0.0, 0.0, 1.0]]),
        SIDE,
        SIDE,
        gamma=gamma,
    )
    y, x = np.mgrid[0:SIDE, 0:SIDE] - middle
    level = np.interp(x * normal[0] + y * normal[1] - aside, across, profile)
    level *= rng.uniform(0.5, 0.95) / np.quantile(profile, 0.98)
    noise = np.sqrt(level / ELECTRONS + (READ_NOISE / ELECTRONS) ** 2)
    level += noise * rng.standard_normal(level.shape)
    grey = np.rint(255.0 * np.clip(level, 0.0, 1.0) ** (1.0 / gamma)).astype(np.float32)
    band = Band((aside * normal - 0.5 * LENGTH * along) / FOCAL, along, normal, FOCAL, LENGTH)
    return grey, camera, band, np.array([[-radius] * 2, [radius] * 2])


def errors(width: float, lens: str, seed: tuple[int, int]) -> Array:
    """Return the errors [px], stated standard deviations, shares followed of both outlines (n, 3).

    Of those with contrast that are found.
    """
    rng = np.random.default_rng(seed)
    grey, camera, band, true = draw(width, lens, rng)
    blur = float(np.hypot(0.5, np.sqrt(1.0 / 12.0))) * rng.uniform(0.9, 1.1)
    off = START * rng.standard_normal((2, 2))
    inwards = np.array(EPSILON)[:, None]
    found = []
    for start in (off, np.full((2, 2), -SHIFT), np.full((2, 2), SHIFT)):
        hidden = np.zeros(8, dtype=np.bool_)
        edges = [
            Edge(band, v, float(epsilon), 0.5 * width, hidden)
            for v, epsilon in zip(true + inwards * start, EPSILON, strict=True)
        ]
        found.append(measure_edges(grey, camera, edges, blur=blur, near_fit=True)[0])
    rows = []
    for edge, v in enumerate(true):
        measured = [one for lines in found if isinstance(one := lines[edge], MeasuredEdge)]
        if len(measured) < len(found) or abs(measured[0].contrast) < MIN_CONTRAST:
            continue
        one, out, inside = measured
        error, low, high = (
            float(EPSILON[edge] * (line.v - v).mean()) for line in (one, out, inside)
        )
        sigma = 0.5 * float(np.sqrt(one.covariance.sum()))
        rows.append((error, sigma, (high - low) / (2.0 * SHIFT)))
    return np.array(rows).reshape(-1, 3)


def row(lens: str, width: float, found: Array) -> str:
    """Return a line of the table."""
    good = np.abs(found[:, 0]) < GROSS
    error, sigma, follows = found[good].T
    weight = sigma**-2 / np.mean(sigma**-2)
    return (
        f"{lens:10}{width:6g}{len(found):6d}{np.count_nonzero(~good):6d}{error.mean():+8.3f}"
        f"{np.median(error):+8.3f}{np.sqrt(np.mean(error**2)):7.3f}"
        f"{np.sqrt(np.mean((weight * error) ** 2)):9.3f}{np.median(sigma):8.3f}"
        f"{np.sqrt(np.mean((error / sigma) ** 2)):6.2f}{np.mean(np.clip(follows, 0.0, 1.0)):9.2f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rods", type=int, default=60, help="of each width; 60")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lens", nargs="*", choices=list(LENSES), default=list(LENSES))
    options = parser.parse_args()
    print(
        f"{'lens':10}{'width':>6}{'n':>6}{'gross':>6}{'bias':>8}{'median':>8}{'rms':>7}"
        f"{'counted':>9}{'stated':>8}{'pull':>6}{'follows':>9}"
    )
    for lens in options.lens:
        for width in WIDTHS:
            seeds = [(options.seed, k) for k in range(options.rods)]
            found = np.concatenate([errors(width, lens, seed) for seed in seeds])
            print(row(lens, width, found), flush=True)


if __name__ == "__main__":
    main()
