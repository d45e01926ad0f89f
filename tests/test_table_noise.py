"""Axes with the noise of Table 1: the angles as they are defined, the spread as it is claimed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from legcal.data.outlines import LegAxes, axes_of_table
from legcal.errors import NotVisible
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array, IntArray
from legcal.simulation.observe import TableNoise, table_of, table_of_lines
from legcal.vision.cylinder import (
    angles_of_direction,
    direction_of_angles,
)


def _indices(n: int) -> tuple[IntArray, IntArray]:
    return np.arange(n, dtype=np.intp), np.zeros(n, dtype=np.intp)


def _observed(u: Array, A: Array, noise: TableNoise, rng: np.random.Generator | None) -> LegAxes:
    """Return axes with the noise of Table 1 as the method takes them from the table."""
    return axes_of_table(*table_of(*_indices(len(u)), u, A, noise, rng))


def _random_lines(n: int, seed: int = 0) -> tuple[Array, Array]:
    """Return n directions well away from the plane y = 0, and points before the camera."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3))
    u[:, 1] = np.copysign(0.3 + np.abs(u[:, 1]), u[:, 1])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, rng.uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.2], (n, 3))


def test_the_axis_is_the_y_axis_turned_by_psi_about_x_and_then_by_theta_about_z() -> None:
    rng = np.random.default_rng(0)
    psi, theta = rng.uniform(-1.5, 1.5, 50), rng.uniform(-3.1, 3.1, 50)
    turns = Rotation.from_euler("xz", np.stack([psi, theta], axis=-1))
    u = direction_of_angles(psi, theta)
    assert np.allclose(u, turns.apply([0.0, 1.0, 0.0]), atol=1e-15)
    assert np.allclose(angles_of_direction(u), (psi, theta), atol=1e-14)


def test_the_noise_of_table_1_has_the_spread_of_its_covariance() -> None:
    n = 4000
    u = np.tile([0.2, -0.95, 0.24], (n, 1))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    A = np.tile([0.1, 0.2, 0.9], (n, 1))
    noise = TableNoise()
    axes = _observed(u, A, noise, np.random.default_rng(0))
    exact = _observed(u, A, noise, None)
    M, basis, covariance = exact.M[0], exact.basis[0], exact.covariance[0]
    beta = (axes.M - M) @ basis.T
    alpha = (axes.u / (axes.u @ u[0])[:, None]) @ basis.T
    found = np.cov(np.hstack([alpha, beta]).T)
    scale = np.sqrt(np.diag(covariance))
    assert np.allclose(
        found / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.1
    )


def test_the_simulator_has_its_own_way_to_the_table_and_it_leads_to_the_same() -> None:
    u, A = _random_lines(200, seed=3)
    u[:4] = [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [-1e-9, -1.0, 0.0], [1e-5, 1e-4, 1.0]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    M = A - u * (A[:, 1:2] / u[:, 1:2])  # the point of the line in the plane y = 0
    psi, theta = angles_of_direction(u)
    found = table_of_lines(u, A)
    turn = np.abs(found[:, 1] - theta)
    assert np.abs(found[:, 0] - psi).max() < 1e-14
    assert np.minimum(turn, 2.0 * np.pi - turn).max() < 1e-11  # near the optical axis
    assert np.minimum(turn, 2.0 * np.pi - turn)[4:].max() < 1e-14
    assert np.allclose(found[:, 2:], M[:, [0, 2]], rtol=1e-11, atol=1e-14)
    # and both to the line that was there, by turning it back
    turns = Rotation.from_euler("xz", found[:, :2])
    assert np.allclose(turns.apply([0.0, 1.0, 0.0]), u, atol=1e-14)
    points = np.stack([found[:, 2], np.zeros(len(u)), found[:, 3]], axis=-1)
    assert np.allclose(distance_to_line(A[4:], u[4:], points[4:]), 0.0, atol=1e-14)


def test_table_1_does_not_exist_for_a_leg_parallel_to_the_image_x_axis() -> None:
    u, A = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.1, 0.9]])
    with pytest.raises(NotVisible, match="parallel to the image x axis"):
        table_of(*_indices(1), u, A, TableNoise(), None)
