"""What pixels count for by the noise on their side of an outline."""

import numpy as np
import pytest
from scipy.special import ndtr

from legcal.geometry.types import Array, BoolArray
from legcal.perception.light import MAX_NOISE_RATIO, Samples, evened_weights

N_BLOCKS, ROWS, REACH, BLUR = 40, 8, 6, 0.6
BOUNDS = np.array([0, N_BLOCKS // 2, N_BLOCKS])


def blocks(sides: Array, rng: np.random.Generator) -> tuple[Samples, Samples]:
    """Return distances and light of blocks across a step, noisy on its sides by edge (2, 2)."""
    row = np.arange(-REACH, REACH + 1.0) + rng.uniform(-0.5, 0.5, (N_BLOCKS, ROWS, 1))
    d = row.reshape(N_BLOCKS, -1).astype(np.float32)
    rise = ndtr(d / BLUR)
    outer, inner = np.repeat(sides, N_BLOCKS // 2, axis=0).T[..., None]
    noise = np.sqrt(outer**2 + (inner**2 - outer**2) * rise) * rng.normal(size=d.shape)
    return d, (20.0 + 100.0 * rise + 2.0 * d + noise).astype(np.float32)


def evened(d: Samples, light: Samples, weight: Samples, kept: BoolArray | None = None) -> Samples:
    """Return the weights of blocks that lie on their edges."""
    kept = np.ones(len(d), dtype=np.bool_) if kept is None else kept
    return evened_weights(d, light, weight, BOUNDS, kept, BLUR)


def test_both_sides_are_equally_noisy_when_weighted() -> None:
    sides = np.array([[2.0, 8.0], [6.0, 3.0]])
    d, light = blocks(sides, np.random.default_rng(1))
    weight = evened(d, light, np.ones_like(d))
    for k, (outer, inner) in enumerate(sides):
        of_edge = slice(BOUNDS[k], BOUNDS[k + 1])
        far_out, far_in = (
            np.median(weight[of_edge][side > 3.0]) for side in (-d[of_edge], d[of_edge])
        )
        assert far_out * outer == pytest.approx(far_in * inner, rel=0.1)


def test_equal_noise_leaves_pixels_equal() -> None:
    d, light = blocks(np.full((2, 2), 4.0), np.random.default_rng(2))
    assert evened(d, light, np.ones_like(d)) == pytest.approx(np.ones_like(d), rel=0.1)


def test_the_mean_of_both_variances_keeps_its_weight() -> None:
    d, light = blocks(np.array([[2.0, 8.0], [2.0, 8.0]]), np.random.default_rng(3))
    weight = evened(d, light, np.ones_like(d))
    assert np.median(weight[np.abs(d) < 0.05]) == pytest.approx(1.0, abs=0.1)


def test_pixels_that_are_not_to_be_used_stay_so() -> None:
    d, light = blocks(np.array([[2.0, 8.0], [2.0, 8.0]]), np.random.default_rng(4))
    weight = np.ones_like(d)
    weight[:, ::3] = 0.0
    assert np.array_equal(evened(d, light, weight) > 0.0, weight > 0.0)


def test_smooth_shading_is_no_noise() -> None:
    d, light = blocks(np.full((2, 2), 3.0), np.random.default_rng(5))
    shaded = light + np.where(d > 0.0, 4.0 * d - 0.5 * d**2, 0.0).astype(np.float32)
    assert evened(d, shaded, np.ones_like(d)) == pytest.approx(np.ones_like(d), rel=0.15)


def test_a_side_without_any_noise_does_not_outweigh_the_other() -> None:
    d, light = blocks(np.array([[0.0, 200.0], [0.0, 200.0]]), np.random.default_rng(6))
    weight = evened(d, light, np.ones_like(d))
    assert np.max(weight) / np.min(weight) <= MAX_NOISE_RATIO * 1.001


def test_an_edge_with_too_few_blocks_keeps_its_weights() -> None:
    d, light = blocks(np.array([[2.0, 8.0], [2.0, 8.0]]), np.random.default_rng(7))
    kept = np.ones(N_BLOCKS, dtype=np.bool_)
    kept[: BOUNDS[1] - 2] = False
    weight = evened(d, light, np.ones_like(d), kept)
    assert np.array_equal(weight[: BOUNDS[1]], np.ones_like(d[: BOUNDS[1]]))
    assert np.max(weight[BOUNDS[1] :]) > 1.2
