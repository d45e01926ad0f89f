"""The noise of single outlines, estimated from how far they are from a fit."""

import numpy as np
import pytest
from hexapod_session import (
    PINHOLE,
    disturbed_start,
    moved_outlines,
    noisy_outlines,
    noisy_readings,
    simulate,
)

from legcal.geometry.types import Array
from legcal.refinement.noise import NoiseModel, estimate_noise, noise_of_the_median
from legcal.refinement.refine import refine

CLAIMED = np.array([[0.010, 0.003], [0.003, 0.008]])
NOTHING = np.zeros((2, 2))


def offsets_of(
    rng: np.random.Generator, n: int, *, scale: float, bias: float = 0.0, tilt: float = 0.0
) -> tuple[Array, Array]:
    """Return offsets of n outlines with these errors, and what is claimed of them."""
    offsets = scale * rng.standard_normal((n, 2)) @ np.linalg.cholesky(CLAIMED).T
    offsets += bias * rng.standard_normal((n, 1))
    offsets += tilt * rng.standard_normal((n, 1)) * np.array([-1.0, 1.0])
    return offsets, np.tile(CLAIMED, (n, 1, 1))


def test_bias_or_tilt_are_told_from_noise_at_each_end() -> None:
    for bias, tilt in ((0.3, 0.0), (0.0, 0.2)):
        offsets, claimed = offsets_of(
            np.random.default_rng(2), 4000, scale=1.5, bias=bias, tilt=tilt
        )
        noise = estimate_noise(offsets, np.zeros_like(claimed), claimed)
        assert noise.scale == pytest.approx(1.5, rel=0.05)
        assert noise.bias_px == pytest.approx(bias, rel=0.05)
        assert noise.tilt_px == pytest.approx(tilt, rel=0.05)


def test_bias_and_tilt_at_once_are_found_with_what_they_make_of_covariances() -> None:
    """With covariances that are all alike, noise at each end is bias and tilt."""
    offsets, claimed = offsets_of(np.random.default_rng(3), 4000, scale=1.5, bias=0.3, tilt=0.2)
    noise = estimate_noise(offsets, np.zeros_like(claimed), claimed)
    expected = NoiseModel(1.5, 0.3, 0.2).covariance(claimed)[0]
    np.testing.assert_allclose(noise.covariance(claimed)[0], expected, rtol=0.1)
    same = np.tile(np.eye(2), (len(offsets), 1, 1))
    noise = estimate_noise(offsets, np.zeros_like(same), same)
    np.testing.assert_allclose(noise.covariance(same)[0], expected, rtol=0.1, atol=0.01)


def test_noise_as_claimed_has_neither_bias_nor_tilt() -> None:
    rng = np.random.default_rng(5)
    found = []
    for _ in range(200):
        offsets, claimed = offsets_of(rng, 150, scale=0.8)
        noise = estimate_noise(offsets, np.zeros_like(claimed), claimed)
        assert noise.bias_px == noise.tilt_px == 0.0
        found.append(noise.scale)
    assert np.mean(found) == pytest.approx(0.8, rel=0.01)


def test_what_a_fit_takes_up_of_the_noise_is_given_back() -> None:
    rng = np.random.default_rng(6)
    offsets, claimed = offsets_of(rng, 4000, scale=1.0)
    left = 0.6  # of every offset, as a fit with many unknowns leaves it
    noise = estimate_noise(left * offsets, (1.0 - left**2) * claimed, claimed)
    assert noise.scale == pytest.approx(1.0, rel=0.03)


def test_wrong_outlines_hardly_move_the_noise_of_the_median() -> None:
    rng = np.random.default_rng(2)
    offsets, claimed = offsets_of(rng, 4000, scale=1.0, bias=0.3)
    clean = noise_of_the_median(offsets, claimed)
    offsets[:800] += rng.uniform(2.0, 30.0, (800, 1))
    dirty = noise_of_the_median(offsets, claimed)
    assert clean.bias_px == pytest.approx(0.3, rel=0.1)
    assert dirty.bias_px < 1.6 * clean.bias_px
    assert dirty.scale == pytest.approx(1.0, rel=0.15)


def test_biased_outlines_widen_the_covariance() -> None:
    rng = np.random.default_rng(3)
    session = simulate(8)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    start = disturbed_start(session)
    plain = refine(session.legs, measurements, outlines, start)
    bias = 0.3 * rng.standard_normal((len(outlines), 1)) * np.ones(2)
    biased = refine(session.legs, measurements, moved_outlines(outlines, PINHOLE, bias), start)
    assert biased.noise.bias_px == pytest.approx(0.3, abs=0.06)
    assert biased.noise.scale == pytest.approx(1.0, abs=0.2)
    assert biased.chi2 / biased.dof == pytest.approx(1.0, abs=0.1)
    assert np.all(biased.sigma > plain.sigma)
    assert plain.noise.bias_px == NoiseModel().bias_px == 0.0
