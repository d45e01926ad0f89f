"""Axes and their covariances, from outlines and from the table of the paper."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_sessions import PaperSession, disturbed_hexapod, paper_session
from scipy.spatial.transform import Rotation

from legcal.data.outlines import (
    LegAxes,
    Outlines,
    axes_from_outlines,
    axes_of_table,
)
from legcal.errors import NotVisible
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array, IntArray
from legcal.machine.parameters import geometries
from legcal.simulation.observe import (
    OutlineNoise,
    TableNoise,
    shifted_outlines,
    table_of,
    table_of_lines,
)
from legcal.vision.camera import Camera, sample_camera
from legcal.vision.cylinder import (
    direction_of_angles,
)

LENS = replace(sample_camera(), distortion=np.array([-0.2, 0.1, 0.001, -0.002, 0.0]))


def _session(camera: Camera, n_poses: int = 2) -> PaperSession:
    machine = disturbed_hexapod(3)
    return paper_session(machine, OutlineNoise(), seed=3, camera=camera, n_poses=n_poses)


def _axes(session: PaperSession, outlines: Outlines) -> LegAxes:
    return axes_from_outlines(outlines, session.measurements, session.radii)


def _coordinates(axes: LegAxes, reference: LegAxes) -> Array:
    """Return (alpha1, alpha2, beta1, beta2) of axes in the bases of others, (n, 4)."""
    u = axes.u / np.sum(axes.u * reference.u, axis=1, keepdims=True)
    along = np.sum(reference.u * (reference.M - axes.M), axis=1, keepdims=True)
    alpha = np.einsum("nia,na->ni", reference.basis, u)
    beta = np.einsum("nia,na->ni", reference.basis, axes.M + along * u - reference.M)
    return np.concatenate([alpha, beta], axis=1)


@pytest.mark.parametrize("camera", [sample_camera(), LENS])
def test_exact_outlines_give_axes_through_both_joint_centres(camera: Camera) -> None:
    session = _session(camera)
    axes = _axes(session, session.outlines)
    for i in range(len(axes)):
        row = int(axes.row[i])
        T_camera_Rb = session.T_camera_Rb[session.measurements.view[row]]
        pose = session.T_Rb_Re[session.measurements.pose[row]]
        A = T_camera_Rb.apply(geometries(session.machine)[axes.leg[i]].A)
        B_Rb = pose.apply(geometries(session.machine)[axes.leg[i]].B)
        B = T_camera_Rb.apply(B_Rb)
        assert distance_to_line(A, axes.u[i], axes.M[i]) < 1e-9
        assert distance_to_line(B, axes.u[i], axes.M[i]) < 1e-9
        assert axes.u[i] @ (B - A) > 0.0
        # M is in the middle of the piece that is seen.
        assert abs(axes.u[i] @ (axes.M[i] - 0.5 * (A + B))) < 0.1 * np.linalg.norm(B - A)


def test_the_covariance_of_axes_is_that_of_many_noisy_outlines() -> None:
    session = _session(LENS)
    outlines = session.outlines
    exact = _axes(session, outlines)
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(exact.covariance)
    normalised = []
    for _ in range(150):
        offsets = rng.multivariate_normal(
            np.zeros(2), OutlineNoise().covariance(0.0), len(outlines)
        )
        h, ends = shifted_outlines(LENS, outlines.h, outlines.ends, offsets)
        axes = _axes(session, replace(outlines, h=h, ends=ends))
        normalised.append(np.linalg.solve(root, _coordinates(axes, exact)[..., None])[..., 0])
    samples = np.concatenate(normalised)
    assert np.allclose(samples.mean(axis=0), 0.0, atol=0.08)
    assert np.allclose(np.cov(samples.T), np.eye(4), atol=0.1)


def test_legs_with_one_used_outline_are_passed_over_and_none_with_two_is_refused() -> None:
    session = _session(sample_camera())
    outlines = session.outlines
    used = outlines.used.copy()
    used[0] = False
    axes = _axes(session, replace(outlines, used=used))
    assert len(axes) == len(session.axes) - 1
    assert (int(axes.row[0]), int(axes.leg[0])) == (0, int(outlines.leg[2]))
    with pytest.raises(NotVisible, match="no leg has both outlines in any image"):
        _axes(session, replace(outlines, used=outlines.edge == 1))


# Axes with the noise of Table 1


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
    u, A = _random_lines(200, seed=3)
    u[:4] = [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [-1e-9, -1.0, 0.0], [1e-5, 1e-4, 1.0]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    found = table_of_lines(u, A)
    turns = Rotation.from_euler("xz", found[:, :2])
    assert np.allclose(turns.apply([0.0, 1.0, 0.0]), u, atol=1e-14)
    points = np.stack([found[:, 2], np.zeros(len(u)), found[:, 3]], axis=-1)
    assert np.allclose(distance_to_line(A[4:], u[4:], points[4:]), 0.0, atol=1e-14)


def test_table_1_does_not_exist_for_a_leg_parallel_to_the_image_x_axis() -> None:
    u, A = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.1, 0.9]])
    with pytest.raises(NotVisible, match="parallel to the image x axis"):
        table_of(*_indices(1), u, A, TableNoise(), None)
