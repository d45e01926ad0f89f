"""The residuals of the fit against NumPy, their derivatives, the loss, and where the fit stands."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_session import FRAME_LEGS, LENS, PINHOLE, Session, disturbed_start, simulate
from scipy.spatial.transform import Rotation

from legcal.calibration.joint_fit.factors import (
    Residual,
    axis_residual,
    corner_residual,
    encoder_residual,
    outline_residual,
)
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.variables import Start, State
from legcal.estimation import Huber, PseudoHuber, linearize
from legcal.geometry import cayley, turned
from legcal.geometry.types import Array
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

LOSS = PseudoHuber(0.1**-0.5)


def problem_and_state(camera: Camera = PINHOLE) -> tuple[Session, FitProblem, State]:
    session = simulate(2, camera=camera, legs_seen=5)
    problem = build_fit(session.legs, session.measurements, session.outlines)
    state = problem.begin(disturbed_start(session))
    return session, problem, replace(state, radii=1.01 * state.radii)


@pytest.fixture(scope="module")
def fitted() -> tuple[FitProblem, State]:
    _, problem, state = problem_and_state()
    return problem, state


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_outline_residual_is_the_camera_s_line_offset_of_the_numpy_outline(camera: Camera) -> None:
    _, problem, state = problem_and_state(camera)
    o, offsets = problem.outlines, problem.offsets(state)
    cameras, poses = state.camera_pose.motions, state.platform_pose.motions
    for i in range(len(o)):
        T = cameras[o.view[i]]
        A = T.apply(state.A[o.leg[i]])
        B = T.apply(poses[o.pose[i]].apply(state.B[o.leg[i]]))
        u = (B - A) / np.linalg.norm(B - A)
        both = outlines_of_axis(u, A, float(state.radii[o.radius[i]]))
        h = both[0 if o.epsilon[i] > 0 else 1]
        expected = camera.line_offset(np.tile(h, (2, 1)), o.feet[i])
        np.testing.assert_allclose(offsets[i], expected, rtol=0, atol=1e-9)
    assert np.abs(offsets).max() > 1.0


def test_outline_residual_measures_pixels_of_a_shifted_outline() -> None:
    session, problem, _ = problem_and_state(LENS)
    legs = tuple(replace(leg, A=A, B=B) for leg, A, B in zip(
        session.legs.nominal, session.truth.base_joints, session.truth.platform_joints, strict=True
    ))  # fmt: skip
    truth = problem.begin(Start(legs, session.T_camera_Rb, session.T_Rb_Re, "truth"))
    o = problem.outlines
    np.testing.assert_allclose(problem.offsets(truth), 0.0, atol=1e-8)
    J = np.swapaxes(o.constants[:, :8].reshape(-1, 2, 2, 2), -1, -2)[:, 0]
    normal = np.einsum("nij,nj->ni", J, session.outlines.h[o.index][:, :2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    feet = o.feet.copy()
    feet[:, 0] = LENS.undistort(o.pixels[:, 0] + 0.5 * normal)
    moved = replace(o, feet=feet).offsets((), truth)
    np.testing.assert_allclose(moved[:, 0], 0.5, atol=2e-3)
    np.testing.assert_allclose(moved[:, 1], 0.0, atol=1e-8)


def test_encoder_residual_is_the_closure_of_the_leg(fitted: tuple[FitProblem, State]) -> None:
    problem, state = fitted
    e, poses = problem.readings, state.platform_pose.motions
    r = linearize(problem, state)["readings"].r
    for i in range(len(e)):
        leg = poses[e.pose[i]].apply(state.B[e.leg[i]]) - state.A[e.leg[i]]
        closure = np.linalg.norm(leg) - e.length[i] - state.lengths[e.leg[i]]
        assert r[i, 0] * e.sigma == pytest.approx(closure, abs=1e-14)


def test_prior_residual_counts_standard_deviations(fitted: tuple[FitProblem, State]) -> None:
    problem, state = fitted
    found = linearize(problem, state)
    # Radii a hundredth off, known to two hundredths.
    np.testing.assert_allclose(found.prior_r, 0.5, rtol=1e-9)
    assert np.count_nonzero(found.prior_J) == len(found.prior_r)


@pytest.mark.parametrize(
    ("residual", "n_data"),
    [
        (outline_residual(), 9),
        (encoder_residual(), 1),
        (axis_residual(), 9),
        (corner_residual(), 4),
    ],
    ids=["outline", "encoder", "axis", "corner"],
)
def test_jacobians_agree_with_finite_differences(residual: Residual, n_data: int) -> None:
    rng = np.random.default_rng(n_data)
    local = rng.uniform(0.5, 1.5, (5, residual.n_local))
    data = rng.uniform(0.5, 1.5, (5, n_data))
    if residual is outline_residual():
        local[:, 6] *= 0.01  # radius
        data[:, 8] = [1.0, -1.0, 1.0, -1.0, 1.0]
        data[:, [0, 3, 4, 7]] += 2.0
    r, J = residual.evaluate(local, data)
    assert r.shape == (5, residual.n_rows)
    step = 1e-6
    for i in range(residual.n_local):
        d = step * np.eye(residual.n_local)[i]
        slope = (residual.evaluate(local + d, data)[0] - residual.evaluate(local - d, data)[0]) / (
            2.0 * step
        )
        np.testing.assert_allclose(J[:, :, i], slope, rtol=1e-6, atol=1e-7)


def test_residuals_of_no_measurement_are_empty() -> None:
    r, J = encoder_residual().evaluate(np.zeros((0, 7)), np.zeros((0, 1)))
    assert (r.shape, J.shape) == ((0, 1), (0, 1, 7))


def test_loss_is_quadratic_near_and_linear_far() -> None:
    def value(r: float) -> float:
        return LOSS.cost(np.array([r * r]))

    assert value(1e-3) == pytest.approx(0.5e-6, rel=1e-6)
    assert value(2e6) - value(1e6) == pytest.approx(1e6 * LOSS.width, rel=1e-5)
    assert value(7.0) == pytest.approx(7.0**2 / (1.0 + np.sqrt(1.0 + LOSS.k * 7.0**2)))
    assert PseudoHuber().cost(np.array([9.0])) == 4.5
    assert Huber(3.0).cost(np.array([4.0, 100.0])) == 2.0 + 3.0 * (10.0 - 1.5)


def test_softened_rows_have_gradient_and_curvature_of_the_loss() -> None:
    rng = np.random.default_rng(0)
    r, J = 3.0 * rng.normal(size=(1, 2)), rng.normal(size=(1, 2, 3))
    soft_r, soft_J = LOSS.softened(r, J)

    def cost(x: Array) -> float:
        moved = r[0] + J[0] @ x
        return LOSS.cost(np.array([moved @ moved]))

    eye = 1e-4 * np.eye(3)
    gradient = [(cost(d) - cost(-d)) / 2e-4 for d in eye]
    np.testing.assert_allclose(soft_J[0].T @ soft_r[0], gradient, rtol=1e-6)
    hessian = [
        [(cost(d + e) - cost(d - e) - cost(e - d) + cost(-d - e)) / 4e-8 for d in eye] for e in eye
    ]
    np.testing.assert_allclose(soft_J[0].T @ soft_J[0], hessian, rtol=1e-5, atol=1e-6)
    assert PseudoHuber().softened(r, J)[1] is J


@pytest.mark.parametrize("m", [2, 4])
def test_efficiency_of_the_loss_agrees_with_monte_carlo(m: int) -> None:
    assert PseudoHuber().efficiency(m) == pytest.approx(1.0, abs=1e-12)
    r = np.random.default_rng(0).standard_normal((400_000, m))
    s = np.sum(r**2, axis=1)
    w = LOSS.weights(s)
    slope = np.mean(w - LOSS.k * w**3 * r[:, 0] ** 2)
    assert LOSS.efficiency(m) == pytest.approx(slope**2 / np.mean((w * r[:, 0]) ** 2), rel=5e-3)


def test_cayley_rotations_are_orthogonal_and_rotate_about_the_vector() -> None:
    w = np.array([[0.3, -0.2, 0.5], [0.0, 0.0, 0.0]])
    R = cayley(w)
    np.testing.assert_allclose(
        R @ np.swapaxes(R, -1, -2), np.tile(np.eye(3), (2, 1, 1)), atol=1e-15
    )
    np.testing.assert_allclose(R[0] @ w[0], w[0], atol=1e-15)
    d = np.array([[1e-5, 2e-5, -1e-5]])
    np.testing.assert_allclose(cayley(d)[0], Rotation.from_rotvec(d[0]).as_matrix(), atol=1e-14)


def test_rotations_stay_orthogonal_after_many_turns() -> None:
    rng = np.random.default_rng(0)
    R = np.eye(3)[None]
    for _ in range(2000):
        R = turned(R, rng.normal(scale=0.3, size=(1, 3)))
    np.testing.assert_allclose(R[0] @ R[0].T, np.eye(3), atol=1e-14)


def test_state_moves_only_what_the_layout_frees(fitted: tuple[FitProblem, State]) -> None:
    problem, state = fitted
    moved = problem.moved(state, np.full(problem.size, 0.1))
    change = moved.A - state.A
    for rank, leg in enumerate(FRAME_LEGS):
        np.testing.assert_array_equal(change[leg, rank:], 0.0)
    assert np.count_nonzero(change) == 12
    np.testing.assert_allclose(moved.radii - state.radii, 0.1)
    np.testing.assert_allclose(moved.lengths - state.lengths, 0.1)
    np.testing.assert_allclose(moved.camera_pose.t - state.camera_pose.t, 0.1)
    np.testing.assert_allclose(moved.platform_pose.t - state.platform_pose.t, 0.1)
    assert moved.cameras == state.cameras
    assert moved.biases.shape == (0,)
