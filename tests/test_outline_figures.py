"""Outlines of rendered cylinders in every light, before every background: bias and scatter."""

import numpy as np
import pytest
from outlines import CLEAR, outcomes
from rendered_cylinders import BACKGROUNDS, LIGHTS, Looks, photograph


@pytest.mark.parametrize("seed", [0, 2])
def test_outlines_are_good_to_the_figures_that_are_stated(seed: int) -> None:
    """A sixth of what ``benchmarks/outlines.py`` draws: legs of 40 px, a lens of 0.8 px."""
    found, lost = [], 0
    for i, light in enumerate(LIGHTS):
        for j, background in enumerate(BACKGROUNDS):
            rng = np.random.default_rng([seed, i, j])
            scene = photograph(Looks(40.0, 0.8, 1.0, 8000.0, 8, light, background), rng, 1)
            clear = [o for o in outcomes(scene, "legcal", rng) if abs(o.contrast) > CLEAR]
            lost += sum(len(o.errors) == 0 for o in clear)
            found += [o for o in clear if len(o.errors)]
    middle = np.array([o.errors.mean() for o in found])
    pull = np.concatenate([(o.errors / o.sigma).ravel() for o in found])
    assert len(found) > 10
    assert lost <= 1
    assert abs(middle.mean()) < 0.02 + 2.0 * middle.std() / np.sqrt(len(middle))
    assert np.sqrt(np.mean(middle**2)) < 0.08
    assert 0.3 < np.sqrt(np.mean(pull**2)) < 1.5
