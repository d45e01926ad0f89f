"""Axes and their covariances, from outlines and from the table of the paper."""

from dataclasses import replace

import numpy as np
import pytest
from fit_sessions import irregular_hexapod, machine_session
from scipy.spatial.transform import Rotation

from legcal.data.outlines import LegAxes, axes_of_table
from legcal.errors import NotVisible
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array, IntArray
from legcal.simulation.observe import TableNoise, table_of, table_of_lines
from legcal.vision.camera import sample_camera
from legcal.vision.cylinder import direction_of_angles

LENS = replace(sample_camera(), distortion=np.array([-0.2, 0.1, 0.001, -0.002, 0.0]))


def test_the_covariance_of_axes_is_that_of_many_noisy_outlines() -> None:
    session = machine_session("hexapod", n_poses=2, camera=LENS)
    o = session.outlines  # of which the first edges are known twice as well
    covariance = np.where(o.edge == 1, 0.25, 1.0)[:, None, None] * o.covariance
    session = replace(session, outlines=replace(o, covariance=covariance))
    exact = session.axes
    root = np.linalg.cholesky(exact.covariance)
    normalised = []
    for seed in range(150):
        axes = session.noisy(seed).axes  # and (alpha1, alpha2, beta1, beta2) in the exact bases
        u = axes.u / np.sum(axes.u * exact.u, axis=1, keepdims=True)
        along = np.sum(exact.u * (exact.M - axes.M), axis=1, keepdims=True)
        away = np.stack([u, axes.M + along * u - exact.M], axis=1)
        coordinates = np.einsum("nia,nka->nki", exact.basis, away).reshape(-1, 4, 1)
        normalised.append(np.linalg.solve(root, coordinates)[..., 0])
    samples = np.concatenate(normalised)
    assert np.allclose(samples.mean(axis=0), 0.0, atol=0.08)
    assert np.allclose(np.cov(samples.T), np.eye(4), atol=0.1)


def test_legs_with_one_used_outline_are_passed_over_and_none_with_two_is_refused() -> None:
    session = irregular_hexapod(2)  # whose legs have one part each
    outlines = session.outlines
    used = outlines.used.copy()
    used[0] = False
    axes = replace(session, outlines=replace(outlines, used=used)).axes
    assert len(axes) == len(session.axes) - 1
    assert (int(axes.row[0]), int(axes.leg[0])) == (0, int(outlines.leg[2]))
    one_edge = replace(session, outlines=replace(outlines, used=outlines.edge == 1))
    with pytest.raises(NotVisible, match="no leg has both outlines in any image"):
        _ = one_edge.axes


# Axes with the noise of Table 1


def _indices(n: int) -> tuple[IntArray, IntArray]:
    return np.arange(n, dtype=np.intp), np.zeros(n, dtype=np.intp)


def _observed(u: Array, A: Array, noise: TableNoise, rng: np.random.Generator | None) -> LegAxes:
    """Return axes with the noise of Table 1 as the method takes them from the table."""
    return axes_of_table(*table_of(*_indices(len(u)), u, A, noise, rng))


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


def test_the_table_of_a_line_leads_back_to_it() -> None:
    rng = np.random.default_rng(3)
    u, A = rng.normal(size=(200, 3)), rng.uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.2], (200, 3))
    u[:, 1] = np.copysign(0.3 + np.abs(u[:, 1]), u[:, 1])  # away from the plane y = 0
    u[:4] = [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [-1e-9, -1.0, 0.0], [1e-5, 1e-4, 1.0]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    found = table_of_lines(u, A)
    turns = Rotation.from_euler("xz", found[:, :2])  # psi about x, and then theta about z
    assert np.allclose(turns.apply([0.0, 1.0, 0.0]), u, atol=1e-14)
    assert np.allclose(direction_of_angles(*found[:, :2].T), u, atol=1e-14)
    points = np.stack([found[:, 2], np.zeros(len(u)), found[:, 3]], axis=-1)
    assert np.allclose(distance_to_line(A[4:], u[4:], points[4:]), 0.0, atol=1e-14)


def test_table_1_does_not_exist_for_a_leg_parallel_to_the_image_x_axis() -> None:
    u, A = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.1, 0.9]])
    with pytest.raises(NotVisible, match="parallel to the image x axis"):
        table_of(*_indices(1), u, A, TableNoise(), None)
