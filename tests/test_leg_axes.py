"""Axes and their covariances from outlines."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_sessions import PaperSession, disturbed_hexapod, paper_session

from legcal.data.outlines import (
    LegAxes,
    Outlines,
    axes_from_outlines,
)
from legcal.errors import NotVisible
from legcal.geometry.lines import distance_to_line
from legcal.geometry.types import Array
from legcal.simulation.observe import OutlineNoise, shifted_outlines
from legcal.vision.camera import Camera, sample_camera

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
        A = T_camera_Rb.apply(session.machine.parameters.base_joints[axes.leg[i]])
        B_Rb = pose.apply(session.machine.parameters.platform_joints[axes.leg[i]])
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
