"""Blocks of pixels fitted with the limb model one by one, and robust lines through them."""

import numpy as np
import pytest
from scipy.integrate import quad

from legcal.geometry.types import Array
from legcal.perception.blocks import (
    COMMON_BIAS,
    TILT_BIAS,
    Line,
    estimate_blur,
    fit_blocks,
    fit_lines,
)
from legcal.perception.light import Samples
from legcal.perception.limb import basis

HALF_WIDTH = 14.0


def column(value: float, n: int) -> Samples:
    return np.full((n, 1), value, dtype=np.float32)


def blocks(
    shift: float, blur: float, amplitude: list[float], noise: float, n: int = 200
) -> tuple[Samples, Samples]:
    """Return distances from a line and the grey levels of outlines ``shift`` further inside."""
    rng = np.random.default_rng(1)
    d = rng.uniform(-4.0, 4.0, (n, 120)).astype(np.float32)
    values, _ = basis(d - np.float32(shift), column(HALF_WIDTH, n), blur)
    grey = np.einsum("nkm,k->nm", values, amplitude) + noise * rng.standard_normal(d.shape)
    return d, grey.astype(np.float32)


@pytest.mark.parametrize("x", [-1.5, -0.2, 0.0, 0.7, 3.0])
def test_limb_is_a_blurred_square_root(x: float) -> None:
    blur, half_width = 0.7, 1e6  # so wide that sqrt(rho (2 - rho)) is sqrt(2 rho)
    values, _ = basis(np.array([[x]], dtype=np.float32), column(half_width, 1), blur)

    def integrand(depth: float) -> float:
        weight = np.exp(-0.5 * ((x - depth) / blur) ** 2) / (blur * np.sqrt(2.0 * np.pi))
        return float(np.sqrt(2.0 * depth / half_width) * weight)

    expected, _ = quad(integrand, 0.0, 12.0, points=[max(x, 0.0)], limit=200)
    assert values[0, 3, 0] == pytest.approx(expected, rel=3e-3, abs=1e-6)


def test_slopes_are_the_derivatives_of_the_basis() -> None:
    d = np.linspace(-5.0, 5.0, 201, dtype=np.float32)[None]
    step = np.float32(0.02)
    before, after = (basis(d + s, column(HALF_WIDTH, 1), 0.6)[0] for s in (-step, step))
    _, slopes = basis(d, column(HALF_WIDTH, 1), 0.6)
    np.testing.assert_allclose((after - before) / (2 * step), slopes, atol=2e-2)


@pytest.mark.parametrize(
    "amplitude",
    [
        [20.0, 0.0, 120.0, 60.0, -30.0],
        [200.0, 4.0, -150.0, 40.0, 0.0],
        [60.0, 0.0, -30.0, 200.0, 0.0],
    ],
    ids=["bright on dark", "dark on bright", "darker at the limb, then brighter"],
)
def test_shift_of_an_outline_is_found_whatever_its_contrast(amplitude: list[float]) -> None:
    d, grey = blocks(0.15, 0.6, amplitude, noise=0.5)
    weight = np.ones(d.shape, dtype=np.float32)
    moved = np.zeros(len(d))
    for _ in range(5):
        at = d - moved[:, None].astype(np.float32)
        fit = fit_blocks(at, grey, weight, column(HALF_WIDTH, len(d)), 0.6)
        moved += fit.shift
    assert np.median(moved) == pytest.approx(0.15, abs=0.01)


def test_claimed_variance_is_the_scatter_of_the_blocks() -> None:
    d, grey = blocks(0.0, 0.6, [20.0, 0.0, 120.0, 60.0, 0.0], noise=3.0)
    weight = np.ones(d.shape, dtype=np.float32)
    fit = fit_blocks(d, grey, weight, column(HALF_WIDTH, len(d)), 0.6)
    assert np.std(fit.shift) == pytest.approx(np.sqrt(np.median(fit.variance)), rel=0.2)
    assert np.sqrt(np.median(fit.noise)) == pytest.approx(3.0, rel=0.05)


def test_flat_blocks_say_nothing() -> None:
    d, grey = blocks(0.0, 0.6, [50.0, 0.0, 0.0, 0.0, 0.0], noise=2.0)
    weight = np.ones(d.shape, dtype=np.float32)
    fit = fit_blocks(d, grey, weight, column(HALF_WIDTH, len(d)), 0.6)
    assert np.median(fit.variance) > 0.2
    hidden = fit_blocks(d, grey, 0.0 * weight, column(HALF_WIDTH, len(d)), 0.6)
    assert np.all(np.isinf(hidden.variance))


@pytest.mark.parametrize("blur", [0.4, 0.7, 1.2])
def test_blur_is_estimated_from_the_picture(blur: float) -> None:
    d, grey = blocks(0.1, blur, [20.0, 0.0, 120.0, 60.0, 0.0], noise=1.0, n=60)
    weight = np.ones(d.shape, dtype=np.float32)
    estimate = estimate_blur(d, grey, weight, column(HALF_WIDTH, len(d)), np.ones(len(d)))
    assert estimate == pytest.approx(blur, rel=0.1)


def fit_straight(position: Array, shift: Array, variance: Array) -> Line | None:
    return fit_lines(np.array([0, len(position)]), position, shift, variance)[0]


def fitted(line: Line | None) -> Line:
    assert line is not None
    return line


def test_line_through_exact_blocks_is_exact() -> None:
    position = np.linspace(0.1, 0.9, 30)
    line = fitted(fit_straight(position, 0.5 - 0.8 * position, np.full(30, 1e-4)))
    np.testing.assert_allclose(line.ends, [0.5, -0.3], atol=1e-9)
    assert line.first == pytest.approx(0.1)
    assert line.last == pytest.approx(0.9)
    assert line.inlier_share == 1.0


def test_an_occlusion_does_not_move_the_line_and_is_left_out() -> None:
    rng = np.random.default_rng(0)
    position = np.linspace(0.0, 1.0, 50)
    shift = 0.2 + 0.02 * rng.standard_normal(50)
    shift[20:35] += 0.7
    line = fitted(fit_straight(position, shift, np.full(50, 4e-4)))
    np.testing.assert_allclose(line.ends, 0.2, atol=0.03)
    assert not np.any(line.kept[20:35])
    assert line.inlier_share == pytest.approx(0.7, abs=0.03)


def test_ends_that_bend_away_are_not_part_of_the_piece() -> None:
    position = np.linspace(0.0, 1.0, 41)
    shift = np.where(position > 0.9, 0.8, 0.0)
    line = fitted(fit_straight(position, shift, np.full(41, 1e-4)))
    assert line.last == pytest.approx(0.9)


@pytest.mark.parametrize("position_range", [(0.0, 1.0), (0.3, 0.6)])
def test_covariance_agrees_with_monte_carlo(position_range: tuple[float, float]) -> None:
    rng = np.random.default_rng(2)
    position = np.linspace(*position_range, 40)
    lines = [
        fitted(fit_straight(position, 0.1 * rng.standard_normal(40), np.full(40, 0.01)))
        for _ in range(400)
    ]
    ends = np.array([[(1 - p) * f.ends[0] + p * f.ends[1] for p in position_range] for f in lines])
    claimed = np.mean([f.covariance for f in lines], axis=0)
    bias = COMMON_BIAS**2 + TILT_BIAS**2 * np.eye(2)
    seen = np.cov(ends.T) + bias
    np.testing.assert_allclose(np.diag(claimed), np.diag(seen), rtol=0.5)
    assert np.all(np.diag(claimed) > 0.8 * np.diag(seen))


def test_covariance_never_claims_more_than_the_model_is_good_for() -> None:
    position = np.linspace(0.0, 1.0, 64)
    line = fitted(fit_straight(position, np.zeros(64), np.full(64, 1e-8)))
    assert np.all(np.diag(line.covariance) >= COMMON_BIAS**2)


def test_blocks_that_share_their_errors_count_for_fewer() -> None:
    rng = np.random.default_rng(3)
    position = np.linspace(0.0, 1.0, 64)
    white = 0.1 * rng.standard_normal(64)
    smooth = np.repeat(white[:16], 4)
    independent = fitted(fit_straight(position, white, np.full(64, 0.01))).covariance
    shared = fitted(fit_straight(position, smooth, np.full(64, 0.01))).covariance
    assert np.trace(shared) > 1.5 * np.trace(independent)


def test_too_few_blocks_give_no_line() -> None:
    position = np.linspace(0.0, 1.0, 10)
    variance = np.where(np.arange(10) < 3, 1e-3, np.inf)
    assert fit_straight(position, np.zeros(10), variance) is None
    assert fit_straight(np.full(10, 0.5), np.zeros(10), np.full(10, 1e-3)) is None


def test_lines_of_several_outlines_are_those_of_each() -> None:
    rng = np.random.default_rng(4)
    counts = [50, 3, 0, 21, 12, 8]
    position = np.concatenate([np.linspace(0.0, 1.0, n) for n in counts])
    shift = 0.3 * position + 0.05 * rng.standard_normal(len(position))
    shift[10:20] += 0.8
    variance = rng.uniform(1e-4, 4e-3, len(position))
    variance[rng.random(len(position)) < 0.1] = np.inf
    variance[-8:-3] = np.inf
    bounds = np.cumsum([0, *counts])
    lines = fit_lines(bounds, position, shift, variance)
    assert [line is None for line in lines] == [False, True, True, False, False, True]
    for line, first, last in zip(lines, bounds[:-1], bounds[1:], strict=True):
        own = slice(first, last)
        alone = fit_straight(position[own], shift[own], variance[own])
        assert (line is None) == (alone is None)
        if line is not None and alone is not None:
            np.testing.assert_allclose(line.ends, alone.ends, atol=1e-12)
            np.testing.assert_array_equal(line.kept, alone.kept)
            np.testing.assert_allclose(line.covariance, alone.covariance, rtol=1e-9)
