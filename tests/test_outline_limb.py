import numpy as np
import pytest
from scipy.integrate import quad

from legcal.perception.blocks import estimate_blur, fit_blocks
from legcal.perception.light import Samples
from legcal.perception.limb import N_BASIS, basis

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


def test_basis_has_the_documented_size() -> None:
    values, slopes = basis(np.zeros((3, 7), dtype=np.float32), column(HALF_WIDTH, 3), 0.5)
    assert values.shape == slopes.shape == (3, N_BASIS, 7)
