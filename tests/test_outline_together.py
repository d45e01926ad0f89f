"""Blocks of an outline fitted together: places, blur and covariance of exact profiles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from legcal.geometry.types import Array
from legcal.perception import line_fit as pool
from legcal.perception.blocks import Blocks
from legcal.perception.light import Samples, to_light
from legcal.perception.limb import (
    HALF,
    LESS_HALF,
    N_AMPLITUDES,
    N_POWERS,
    RAMP,
    SQUARE,
    STEP,
    THREE_HALVES,
    powers,
    profile_functions,
)
from legcal.perception.line_fit import fit_lines

HALF_WIDTH, DEPTH = 15.0, 3.5
BRIGHT = np.array([20.0, 0.0, 120.0, 90.0, -60.0, 0.0, 0.0])
DARK = np.array([180.0, 5.0, 30.0, -20.0, 60.0, 10.0, 0.0])
GLINT = np.array([20.0, 0.0, 60.0, 60.0, -120.0, 40.0, 0.0])
LIMB = np.array([20.0, 0.0, 20.0, 0.0, 150.0, 0.0, 0.0])


def single(value: float, n: int) -> Array:
    return np.full(n, value)


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
    grey = np.einsum("nmp,kp,nk->nm", powers(at / blur), values[0], of_block)
    grey = grey + noise * rng.standard_normal(grey.shape)
    one: Samples = np.ones(d.shape, dtype=np.float32)
    zeros = np.zeros(n)
    return Blocks(
        d.astype(np.float32), grey.astype(np.float32), one, np.ones(n), np.array([0, n]), position,
        np.full((n, 1), HALF_WIDTH, dtype=np.float32), np.full(n, -np.inf, dtype=np.float32),
        zeros, zeros.copy(), zeros.copy(), [None],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("column", "power"), [(HALF, 0.5), (RAMP, 1.0), (THREE_HALVES, 1.5), (SQUARE, 2.0)]
)
@pytest.mark.parametrize("z", [-1.5, -0.2, 0.0, 0.7, 3.0])
def test_powers_are_means_over_a_gaussian(z: float, column: int, power: float) -> None:
    def integrand(x: float) -> float:
        return float(x**power * np.exp(-0.5 * (x - z) ** 2) / np.sqrt(2.0 * np.pi))

    expected, _ = quad(integrand, 0.0, 15.0, points=[max(z, 0.0)], limit=200)
    assert powers(np.array(z))[column] == pytest.approx(expected, rel=2e-3, abs=1e-5)


def test_powers_are_each_others_derivatives() -> None:
    z, step = np.linspace(-6.0, 20.0, 500), 1.0 / 16.0
    slope = (powers(z + step) - powers(z - step)) / (2.0 * step)
    values = powers(z)
    for column, factor, of in ((RAMP, 1.0, STEP), (SQUARE, 2.0, RAMP), (HALF, 0.5, LESS_HALF)):
        np.testing.assert_allclose(slope[:, column], factor * values[:, of], atol=1e-2)


@pytest.mark.parametrize("blur", [0.35, 1.1])
def test_slopes_and_widenings_are_derivatives_of_profiles(blur: float) -> None:
    d, half_width = np.linspace(-4.0, 4.0, 81), single(HALF_WIDTH, 1)

    def profile(d: Array, blur: float) -> Array:
        values, _, _ = profile_functions(half_width, single(blur, 1), DEPTH)
        return np.asarray(values[0] @ powers(d / blur).T)

    _, slopes, widenings = profile_functions(half_width, single(blur, 1), DEPTH)
    U = powers(d / blur).T
    step = 0.02
    by_distance = (profile(d + step, blur) - profile(d - step, blur)) / (2.0 * step)
    np.testing.assert_allclose(by_distance, slopes[0] @ U, atol=0.1)
    by_blur = (profile(d, blur * np.exp(step)) - profile(d, blur * np.exp(-step))) / (2.0 * step)
    np.testing.assert_allclose(by_blur, widenings[0] @ U, atol=0.06)
    assert slopes.shape == (1, N_AMPLITUDES, N_POWERS)


@pytest.mark.parametrize("amplitude", [BRIGHT, DARK, GLINT], ids=["bright", "dark", "glint"])
@pytest.mark.parametrize("blur", [0.4, 0.9])
@pytest.mark.parametrize("change", [0.0, 0.6])
def test_exact_profiles_give_line_and_blur(amplitude: Array, blur: float, change: float) -> None:
    blocks = outline(amplitude, (0.12, -0.06), blur, noise=0.3, change=change)
    found = fit_lines(blocks, np.ones(40, dtype=np.bool_), 1.15 * blur, DEPTH)
    spread = np.sqrt(np.diag(found.covariance[0]))
    assert np.all(np.abs(found.ends[0] - [0.12, -0.06]) < 0.01 + 2.5 * spread)
    assert np.all(spread < 0.1)
    assert found.blur == pytest.approx(blur, rel=0.06)


def test_covariance_covers_the_errors_and_knows_low_contrast() -> None:
    pulls, sigma = [], []
    for contrast in (1.0, 0.1):
        found = [
            fit_lines(
                outline(contrast * BRIGHT, (0.05, 0.0), 0.5, noise=3.0, seed=seed),
                np.ones(40, dtype=np.bool_),
                0.5,
                DEPTH,
            )
            for seed in range(40)
        ]
        error = np.array([f.ends[0] - [0.05, 0.0] for f in found])
        spread = np.array([np.sqrt(np.diag(f.covariance[0])) for f in found])
        pulls.append(float(np.sqrt(np.mean((error / spread) ** 2))))
        sigma.append(float(np.median(spread)))
    assert max(pulls) < 1.4
    assert sigma[1] > 2.0 * sigma[0]


def test_blocks_of_something_else_do_not_move_the_line() -> None:
    clean = outline(BRIGHT, (0.1, 0.1), 0.5, noise=0.5)
    other = outline(BRIGHT, (0.1, 0.1), 0.5, noise=0.5)
    other.grey[10:16] = 120.0 - 30.0 * other.d[10:16]
    everything = np.ones(40, dtype=np.bool_)
    one, two = (fit_lines(blocks, everything, 0.5, DEPTH).ends for blocks in (clean, other))
    np.testing.assert_allclose(one, two, atol=0.02)


def test_outlines_without_blocks_stay_where_they_are() -> None:
    blocks = outline(BRIGHT, (0.1, 0.1), 0.5)
    found = fit_lines(blocks, np.zeros(40, dtype=np.bool_), 0.5, DEPTH)
    np.testing.assert_array_equal(found.ends, np.zeros((1, 2)))
    assert np.all(np.diag(found.covariance[0]) >= 1.0)
    assert found.blur == 0.5


@pytest.mark.parametrize("amplitude", [BRIGHT, DARK, GLINT], ids=["bright", "dark", "glint"])
def test_sums_over_pixels_tell_of_places_and_blurs_nearby(
    amplitude: Array, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks, every = outline(amplitude, (0.1, -0.05), 0.5, noise=0.2), np.ones(40, dtype=np.bool_)
    found = fit_lines(blocks, every, 0.54, DEPTH)
    monkeypatch.setattr(pool, "MAX_MOVE_OF_PRODUCTS", (0.0, 0.0))  # sums anew in every round
    anew = fit_lines(blocks, every, 0.54, DEPTH)
    np.testing.assert_allclose(found.ends, anew.ends, atol=8e-3)
    np.testing.assert_allclose(found.covariance, anew.covariance, rtol=0.2)
    assert found.blur == pytest.approx(anew.blur, rel=5e-3)


def test_outlines_that_have_settled_do_not_depend_on_others() -> None:
    slow, quick = outline(GLINT, (0.2, -0.2), 0.5, noise=0.3), outline(BRIGHT, (0.0, 0.0), 0.5)
    both = replace(
        slow,
        bounds=np.array([0, 40, 80]),
        lines=[None, None],
        **{
            name: np.concatenate([getattr(slow, name), getattr(quick, name)])
            for name in (
                "d", "grey", "weight", "gain", "position", "half_width", "moved", "contrast",
                "sharp",
            )
        },
    )  # fmt: skip
    found = fit_lines(both, np.ones(80, dtype=np.bool_), 0.5, DEPTH)
    np.testing.assert_allclose(found.ends, [[0.2, -0.2], [0.0, 0.0]], atol=0.02)


def read_with(blocks: Blocks, gamma: float) -> Blocks:
    """Return the same blocks as a camera of gamma 2.2 encodes them, read with a gamma."""
    encoded = (255.0 * (np.maximum(blocks.grey, 0.0) / 255.0) ** (1.0 / 2.2)).astype(np.float32)
    light, weight = to_light(encoded, blocks.weight > 0.0, gamma)
    return replace(blocks, grey=light, weight=weight)


@pytest.mark.parametrize("amplitude", [BRIGHT, DARK], ids=["bright", "dark"])
@pytest.mark.parametrize(("gamma", "tolerance"), [(1.0, 0.4), (1.6, 0.4), (2.2, 0.15)])
def test_outlines_know_how_far_they_move_with_gamma(
    amplitude: Array, gamma: float, tolerance: float
) -> None:
    blocks, every = outline(amplitude, (0.1, 0.1), 0.6, noise=0.2), np.ones(40, dtype=np.bool_)
    less, here, more = (
        fit_lines(read_with(blocks, gamma * np.exp(step)), every, 0.6, DEPTH)
        for step in (-0.1, 0.0, 0.1)
    )
    moved = float(more.ends.mean() - less.ends.mean()) / 0.2
    assert abs(moved) > 0.05
    assert here.by_gamma[0] == pytest.approx(moved, rel=tolerance)


def test_bright_and_dark_legs_move_to_opposite_sides_with_gamma() -> None:
    every = np.ones(40, dtype=np.bool_)
    bright, dark = (
        fit_lines(outline(amplitude, (0.0, 0.0), 0.6, noise=0.2), every, 0.6, DEPTH).by_gamma[0]
        for amplitude in (BRIGHT, DARK)
    )
    assert bright > 0.05
    assert dark < -0.05


def test_outlines_of_which_nothing_is_seen_know_no_gamma() -> None:
    blocks = outline(BRIGHT, (0.0, 0.0), 0.6)
    nothing = np.zeros(40, dtype=np.bool_)
    assert np.isnan(fit_lines(blocks, nothing, 0.6, DEPTH).by_gamma).all()


def test_lines_near_a_limb_that_rises_from_the_background_stay_there() -> None:
    """Blocks by themselves hardly know where it is, and together no better than they say."""
    blocks = outline(LIMB, (0.0, 0.0), 0.55, noise=1.0)
    blocks.fit(0.55, 2)
    assert blocks.lines[0] is not None
    assert np.abs(blocks.lines[0].ends).max() > 0.1
    blocks.unmove()
    np.testing.assert_array_equal(blocks.lines[0].ends, [0.0, 0.0])
    found = fit_lines(blocks, blocks.kept(), 0.55, DEPTH)
    assert np.all(np.abs(found.ends[0]) < 3.0 * np.sqrt(np.diag(found.covariance[0])))
