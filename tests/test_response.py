"""Cameras that encode light: their outlines lie where the light has its edge."""

import numpy as np
import pytest
from dataset_folder import folder
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from legcal.perception.blocks import fit_blocks
from legcal.perception.profiles import PixelBins, to_light

__all__ = ["folder"]
BLUR, HALF_WIDTH, WHITE = 0.6, 14.0, 255.0


def found(gamma_of_camera: float, gamma_told: float, dark: float, bright: float) -> float:
    """Return where an outline is found that lies 0.15 px inside the line [px]."""
    rng = np.random.default_rng(1)
    d = rng.uniform(-3.5, 3.5, (150, 120)).astype(np.float32)
    step = ndtr((d - 0.15) / BLUR)
    light = dark + (bright - dark) * step
    grey = WHITE * light ** (1.0 / gamma_of_camera) + 0.5 * rng.standard_normal(d.shape)
    levels, weight = to_light(grey.astype(np.float32), np.ones(d.shape, np.bool_), gamma_told)
    moved = np.zeros(len(d))
    for _ in range(5):
        at = d - moved[:, None].astype(np.float32)
        sums = PixelBins.of(at, weight, BLUR).sums(levels)
        edge = np.zeros(len(d), dtype=np.intp)
        moved += fit_blocks(sums, np.array([HALF_WIDTH]), np.array([BLUR]), edge).shift
    return float(np.median(moved))


@pytest.mark.parametrize(("dark", "bright"), [(0.02, 0.7), (0.7, 0.02), (0.1, 0.2)])
@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2])
def test_outline_is_where_the_light_has_its_edge(gamma: float, dark: float, bright: float) -> None:
    assert found(gamma, gamma, dark, bright) == pytest.approx(0.15, abs=0.01)


@settings(deadline=None, max_examples=30)
@given(
    gamma=st.floats(0.5, 3.0),
    level=st.floats(20.0, 230.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_weights_make_the_noise_of_light_that_of_grey_levels(
    gamma: float, level: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    grey = np.concatenate([np.full(4000, level), np.full(4000, 0.5 * level + 15.0)])
    noisy = (grey + 0.3 * rng.standard_normal(grey.shape)).astype(np.float32)[None]
    window = np.ones(noisy.shape, dtype=np.float32)
    light, weight = to_light(noisy, window, gamma)
    for half in (np.s_[:4000], np.s_[4000:]):
        scatter = np.std(light[0, half]) * np.mean(weight[0, half])
        assert scatter == pytest.approx(0.3, rel=0.1)
    assert not np.any(to_light(noisy, np.zeros_like(window), gamma)[1])
