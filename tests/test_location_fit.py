"""Robot-world and hand-eye calibration: starts, maximum likelihood, covariance, derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from located import (
    BASE,
    SIGMA_ANGLE,
    SIGMA_POSITION,
    TOOL,
    frame_errors,
    frames_of,
    noisy,
    pairs_at,
)
from scipy.spatial.transform import RigidTransform, Rotation
from thinned import thinned

from legcal.calibration.location.fit import FrameFit, fit
from legcal.calibration.location.frames import (
    PosePairs,
    frames_after,
    jacobian,
    residuals,
    search,
    tool_motions,
)
from legcal.calibration.location.tool_poses import PoseNoise
from legcal.geometry.rotations import nearest_rotation, rotation_matrices
from legcal.geometry.types import Array

STATED = (np.array([SIGMA_POSITION, SIGMA_ANGLE]), (True, True))
UNKNOWN = (np.array([1e-3, 1e-2]), (False, False))


def fitted(pairs: PosePairs, noise: tuple[Array, tuple[bool, bool]] = STATED) -> FrameFit:
    return fit(pairs, search(pairs, 3).frames[0], PoseNoise(*noise))


def test_residuals_are_the_step_that_was_made_and_zero_where_nothing_was_measured() -> None:
    pairs, frames = pairs_at(BASE, TOOL), frames_of(BASE, TOOL)
    step = 1e-4 * np.random.default_rng(9).normal(size=12)
    oriented = np.arange(len(pairs)) < 3
    some = replace(pairs, oriented=oriented)
    r = residuals(frames_after(frames, -step), some)
    np.testing.assert_allclose(r, jacobian(frames, some) @ step, atol=1e-7)
    assert np.all((r[:, 3:] != 0.0).any(axis=1) == oriented)


def test_the_nearest_rotation_is_never_a_mirror() -> None:
    matrices = np.random.default_rng(1).normal(size=(20, 3, 3))
    found = nearest_rotation(matrices)
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    others = rotation_matrices(np.random.default_rng(2).normal(size=(200, 1, 3)))
    apart = np.linalg.norm(matrices - found, axis=(1, 2))
    assert np.all(apart < np.linalg.norm(matrices - others, axis=(2, 3)))


@pytest.mark.parametrize("turn", [[0.3, -1.0, 2.0], [np.pi, 0.0, 0.0]])
def test_moving_the_world_moves_the_base_and_nothing_else(turn: list[float]) -> None:
    world = RigidTransform.from_components([0.7, -0.4, 1.0], Rotation.from_rotvec(turn))
    pairs = noisy(pairs_at(BASE, TOOL), np.random.default_rng(5))
    R = world.rotation.as_matrix()
    before = fitted(pairs, UNKNOWN)
    after = fitted(replace(pairs, p=world.apply(pairs.p), M=R @ pairs.M), UNKNOWN)
    expected = frames_of(world, TOOL)
    expected[0] = world.as_matrix()[:3] @ np.vstack([before.frames[0], [0, 0, 0, 1]])
    expected[1] = before.frames[1]
    assert np.abs(after.frames - expected).max() < 1e-9
    turn = np.kron(np.diag([1.0, 1.0, 0.0, 0.0]), R) + np.kron(np.diag([0, 0, 1.0, 1.0]), np.eye(3))
    np.testing.assert_allclose(turn @ before.information @ turn.T, after.information, rtol=1e-5,
                               atol=1e-5 * np.abs(after.information).max())  # fmt: skip
    assert after.chi2 == pytest.approx(before.chi2, rel=1e-6)


@pytest.mark.parametrize("case", thinned(["stated", "unknown", "model"], ["unknown", "model"]))
def test_errors_are_as_large_as_the_covariance_says(case: str) -> None:
    """Monte Carlo: unknown scatter is estimated without bias, errors of the model are counted."""
    noise, runs, chance = UNKNOWN if case == "unknown" else STATED, 40, np.random.default_rng(8)
    common = 1e-3 * chance.normal(size=(12, 6, 5)) * np.repeat([1.0, 0.2], 3)[:, None]
    truth, exact = frames_of(BASE, TOOL), pairs_at(BASE, TOOL, 12)
    at_tool = tool_motions(common, truth, exact)
    squares, sigmas = [], []
    for seed in range(runs):
        chance = np.random.default_rng(seed)
        pairs, rows = noisy(exact, chance), PoseNoise(*noise)
        if case == "model":
            step = (at_tool @ chance.normal(size=(5, 1)))[..., 0]
            p, M = pairs.p + step[:, :3], rotation_matrices(step[:, 3:]) @ pairs.M
            pairs = replace(pairs, p=p, M=M)
        by_model = common if case == "model" else None
        found = fit(pairs, frames_after(truth, 1e-3 * chance.normal(size=12)), rows, by_model)
        error = frame_errors(found.frames, BASE, TOOL) / pairs.scale
        squares.append(error @ found.information @ error / 12.0)
        sigmas.append(found.noise.sigma)
        assert found.dof == 60
    # 40 x 12: one sigma is 0.065; with some 30 degrees of freedom a kind 1.07 is expected
    assert 0.85 < np.mean(squares) < (1.3 if case == "unknown" else 1.15)
    np.testing.assert_allclose(np.mean(sigmas, axis=0), STATED[0], rtol=0.06)
