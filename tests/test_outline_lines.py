"""Sub-pixel lines: noise beside an outline, the limb model, and blocks fitted to it."""

import numpy as np
import pytest
from scipy.special import ndtr

from legcal.geometry.types import Array
from legcal.perception.blocks import Blocks
from legcal.perception.limb import MATTE_DIRECTIONS, powers, profile_functions
from legcal.perception.pooled_fit import fit_pooled
from legcal.perception.profiles import Edge, Samples, to_light
from legcal.perception.subpixel_edges import limb_shifts
from legcal.vision.camera import Camera
from legcal.vision.visibility import Band

# All blocks of outlines together.

HALF_WIDTH, DEPTH = 15.0, 3.5


def amplitudes(background: float, slope: float, *of_r: float) -> Array:
    """Return the amplitudes of a profile with a surface of so much of r^0 to r^4."""
    surface = np.linalg.solve(MATTE_DIRECTIONS.T, np.array(of_r) - [background, 0.0, 0.0, 0.0, 0.0])
    return np.array([background, slope, *surface])


BRIGHT = amplitudes(20.0, 0.0, 120.0, 90.0, -60.0, 0.0, 0.0)
DARK = amplitudes(180.0, 5.0, 30.0, -20.0, 60.0, 10.0, 0.0)
GLINT = amplitudes(20.0, 0.0, 60.0, 60.0, -120.0, 40.0, 0.0)


def single(value: float, n: int) -> Array:
    return np.full(n, value)


def blocks_of(d: Samples, light: Samples, weight: Samples, position: Array) -> Blocks:
    """Return blocks of an outline of a matte part that were not fitted."""
    n = len(d)
    window, clipped = (weight > 0.0).astype(np.float32), np.full(n, -np.inf, dtype=np.float32)
    bounds, matte = np.array([0, n]), np.zeros(1, dtype=np.intp)
    at = np.ones(n), bounds, position, np.array([HALF_WIDTH]), matte
    return Blocks(d, light, weight, window, *at, clipped)


def outline(
    amplitude: Array,
    shift: tuple[float, float],
    blur: float,
    noise: float = 0.0,
    seed: int = 0,
    n: int = 40,
    change: float = 0.0,
) -> Blocks:
    """Return the blocks of an outline that lies ``shift`` further inside at both ends."""
    rng = np.random.default_rng(seed)
    position = (np.arange(n) + 0.5) / n
    d = rng.uniform(-DEPTH, DEPTH, (n, 104))
    at = d - (shift[0] + (shift[1] - shift[0]) * position)[:, None]
    values, _, _ = profile_functions(single(HALF_WIDTH, 1), single(blur, 1), DEPTH)
    brightness = 1.0 + change * (position - 0.5)
    of_block = brightness[:, None] * amplitude
    grey = np.einsum("nmp,kp,nk->nm", powers(at / blur)[0], values[0], of_block)
    grey = grey + noise * rng.standard_normal(grey.shape)
    one: Samples = np.ones(d.shape, dtype=np.float32)
    read = blocks_of(d.astype(np.float32), grey.astype(np.float32), one, position)
    read.noise[:] = max(noise, 0.3) ** 2  # as the blocks by themselves show it
    return read


@pytest.mark.parametrize("amplitude", [BRIGHT, DARK, GLINT], ids=["bright", "dark", "glint"])
@pytest.mark.parametrize(("blur", "change"), [(0.4, 0.6), (0.9, 0.0)])
def test_exact_profiles_give_line_and_blur(amplitude: Array, blur: float, change: float) -> None:
    blocks = outline(amplitude, (0.12, -0.06), blur, noise=0.3, change=change)
    found = fit_pooled(blocks, np.ones(40), 1.15 * blur, DEPTH)
    spread = np.sqrt(np.diag(found.covariance[0]))
    assert np.all(np.abs(found.ends[0] - [0.12, -0.06]) < 0.01 + 2.5 * spread)
    assert np.all(spread < 0.1)
    assert found.blur == pytest.approx(blur, rel=0.06)


def test_covariance_covers_the_errors_and_knows_low_contrast() -> None:
    pulls, sigma = [], []
    for contrast in (1.0, 0.1):
        found = [
            fit_pooled(
                outline(contrast * BRIGHT, (0.05, 0.0), 0.5, noise=3.0, seed=seed),
                np.ones(40),
                0.5,
                DEPTH,
            )
            for seed in range(25)
        ]
        error = np.array([f.ends[0] - [0.05, 0.0] for f in found])
        spread = np.array([np.sqrt(np.diag(f.covariance[0])) for f in found])
        pulls.append(float(np.sqrt(np.mean((error / spread) ** 2))))
        sigma.append(float(np.median(spread)))
    assert max(pulls) < 1.4
    assert sigma[1] > 2.0 * sigma[0]


def read_with(blocks: Blocks, gamma: float) -> Blocks:
    """Return the same blocks as a camera of gamma 2.2 encodes them, read with a gamma."""
    seen = np.maximum(blocks.light + blocks.level[0], 0.0)
    encoded = (255.0 * (seen / 255.0) ** (1.0 / 2.2)).astype(np.float32)
    light, weight = to_light(encoded, blocks.window, gamma)
    read = blocks_of(blocks.d, light, weight, blocks.position)
    read.noise[:] = blocks.noise
    return read


@pytest.mark.parametrize("amplitude", [BRIGHT, DARK], ids=["bright", "dark"])
@pytest.mark.parametrize(("gamma", "tolerance"), [(1.5, 0.3), (2.2, 0.15)])
def test_outlines_know_how_far_they_move_with_gamma(
    amplitude: Array, gamma: float, tolerance: float
) -> None:
    blocks, every = outline(amplitude, (0.1, 0.1), 0.6, noise=0.5), np.ones(40)
    less, here, more = (
        fit_pooled(read_with(blocks, gamma * np.exp(step)), every, 0.6, DEPTH)
        for step in (-0.1, 0.0, 0.1)
    )
    moved = float(more.ends.mean() - less.ends.mean()) / 0.2
    assert abs(moved) > 0.05
    assert (moved > 0.0) == (amplitude is BRIGHT)
    assert here.by_gamma[0] == pytest.approx(moved, rel=tolerance)


# Limbs and stripes.

ROD = 15.0  # half-width [px]
UPRIGHT = Camera(np.array([[500.0, 0.0, 200.0], [0.0, 500.0, 150.0], [0.0, 0.0, 1.0]]), 400, 300)


def rod_edges(moved: float) -> list[Edge]:
    """Return both edges of an upright rod in the middle of the image, moved inside [px]."""
    along, normal = np.array([0.0, 1.0]), np.array([1.0, 0.0])
    band = Band(np.array([0.0, -0.2]), along, normal, 500.0, 200.0)
    free = np.zeros(10, dtype=np.bool_)
    return [
        Edge(band, epsilon * (moved - ROD) * np.ones(2), epsilon, ROD, free)
        for epsilon in (1.0, -1.0)
    ]


def rod_picture(stripe: float, noise: float = 4.0) -> Samples:
    """Return a rod as dark as most of the background, with a bright stripe inside each limb [px].

    Bright bands of the background, half of its length, end at the limbs.
    """
    y, x = np.indices((300, 400)).astype(float)
    inside = ROD - np.abs(x - 200.0)
    background = 40.0 + 60.0 * (np.sin(y / 9.0) > 0.0)
    step = ndtr(inside / 0.5)
    reflected = 40.0 * np.exp(-(((inside - stripe) / 1.5) ** 2))
    grey = background + (40.0 + reflected - background) * step
    grey += noise * np.random.default_rng(0).standard_normal(grey.shape)
    return np.asarray(grey, dtype=np.float32)


@pytest.mark.parametrize("start", [0.0, 2.5], ids=["from the limbs", "from inside"])
def test_limbs_are_where_the_background_ends_not_where_stripes_begin(start: float) -> None:
    edges, width = rod_edges(start), 2.0 * start
    found = limb_shifts(rod_picture(4.0), UPRIGHT, edges, 0.5, np.array([-width]), np.array([2.0]))
    np.testing.assert_allclose(found, -start, atol=0.5)


def test_surfaces_that_reflect_stripes_are_told_from_matte_ones() -> None:
    r = np.linspace(0.0, 0.7, 50)
    stripe = 20.0 + 100.0 * np.exp(-(((r - 0.35) / 0.12) ** 2))
    of_r = np.polynomial.polynomial.polyfit(r, stripe, 4)
    polish = [
        float(fit_pooled(outline(light, (0.0, 0.0), 0.5, 1.0), np.ones(40), 0.5, DEPTH).polish[0])
        for light in (BRIGHT, DARK, amplitudes(20.0, 0.0, *of_r))
    ]
    assert max(polish[:2]) < -1.0
    assert polish[2] > 4.0
