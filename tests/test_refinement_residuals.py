"""The residuals of the fit against NumPy, and their derivatives against finite differences."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
from hexapod_session import FRAME_LEGS, LENS, PINHOLE, Session, disturbed_start, simulate

from legcal.geometry.types import Array
from legcal.refinement.inputs import evaluate, evaluate_jacobian, inputs_of
from legcal.refinement.loss import curvature, efficiency, robust_loss, weights
from legcal.refinement.normal import linearize, normal_equations
from legcal.refinement.problem import FitProblem
from legcal.refinement.refine import build_fit
from legcal.refinement.residuals import (
    Residual,
    encoder_residual,
    outline_residual,
    prior_residual,
)
from legcal.refinement.state import State, cayley
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

K = 0.1


def problem_and_state(camera: Camera = PINHOLE) -> tuple[Session, FitProblem, State]:
    session = simulate(2, camera=camera, legs_seen=5)
    problem = build_fit(session.legs, session.measurements, session.outlines)
    state = disturbed_start(session).state(1.01 * problem.radius_prior.mean)
    return session, problem, state


@pytest.fixture(scope="module")
def fitted() -> tuple[FitProblem, State]:
    _, problem, state = problem_and_state()
    return problem, state


def whitening(problem: FitProblem) -> Array:
    rng = np.random.default_rng(4)
    T = np.tril(rng.uniform(1.0, 3.0, (len(problem.outlines), 2, 2)))
    return np.asarray(T)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_outline_residual_is_the_camera_s_line_offset_of_the_numpy_outline(camera: Camera) -> None:
    _, problem, state = problem_and_state(camera)
    o = problem.outlines
    unit = np.broadcast_to(np.eye(2), (len(o), 2, 2))
    offsets = evaluate(outline_residual(), inputs_of(problem, state, unit, 0.0)[0])

    cameras, poses = state.T_camera_Rb, state.T_Rb_Re
    for i in range(len(o)):
        T = cameras[o.view[i]]
        A = T.apply(state.base_joints[o.leg[i]])
        B = T.apply(poses[o.pose[i]].apply(state.platform_joints[o.leg[i]]))
        u = (B - A) / np.linalg.norm(B - A)
        both = outlines_of_axis(u, A, float(state.radii[o.radius[i]]))
        h = both[0 if o.epsilon[i] > 0 else 1]
        expected = camera.line_offset(np.tile(h, (2, 1)), o.feet[i])
        np.testing.assert_allclose(offsets[i], expected, rtol=0, atol=1e-9)
    assert np.abs(offsets).max() > 1.0


def test_outline_residual_measures_pixels_of_a_shifted_outline() -> None:
    session, problem, _ = problem_and_state(LENS)
    truth = State(
        session.truth.base_joints,
        session.truth.platform_joints,
        session.truth.offsets,
        problem.radius_prior.mean,
        np.array([T.rotation.as_matrix() for T in session.T_camera_Rb]),
        np.array([T.translation for T in session.T_camera_Rb]),
        np.array([T.rotation.as_matrix() for T in session.T_Rb_Re]),
        np.array([T.translation for T in session.T_Rb_Re]),
    )
    unit = np.broadcast_to(np.eye(2), (len(problem.outlines), 2, 2))
    inputs = inputs_of(problem, truth, unit, 0.0)[0]
    J = problem.outlines.J_inverse_transposed[:, 0]
    h = session.outlines.h[problem.outlines.index]
    normal = np.einsum("nij,nj->ni", J, h[:, :2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pixels = LENS.distort(problem.outlines.feet[:, 0])
    inputs[:, 31:33] = LENS.undistort(pixels + 0.5 * normal)
    offsets = evaluate(outline_residual(), inputs)
    np.testing.assert_allclose(offsets[:, 0], 0.5, atol=2e-3)
    np.testing.assert_allclose(offsets[:, 1], 0.0, atol=1e-8)


def test_encoder_residual_is_the_closure_of_the_leg(fitted: tuple[FitProblem, State]) -> None:
    problem, state = fitted
    e, poses = problem.readings, state.T_Rb_Re
    r = evaluate(encoder_residual(), inputs_of(problem, state, whitening(problem), 0.0)[1])
    for i in range(len(e)):
        leg = poses[e.pose[i]].apply(state.platform_joints[e.leg[i]]) - state.base_joints[e.leg[i]]
        closure = np.linalg.norm(leg) - e.length[i] - state.offsets[e.leg[i]]
        assert r[i, 0] * e.sigma == pytest.approx(closure, abs=1e-14)


@pytest.mark.parametrize(
    ("residual", "kind"),
    [(outline_residual, 0), (encoder_residual, 1), (prior_residual, 2)],
    ids=["outline", "encoder", "prior"],
)
def test_jacobians_agree_with_finite_differences(
    residual: Callable[[], Residual], kind: int, fitted: tuple[FitProblem, State]
) -> None:
    problem, state = fitted
    inputs = inputs_of(problem, state, whitening(problem), 0.0)[kind]
    _, J = evaluate_jacobian(residual(), inputs)
    function, n = residual().function, residual().n_local
    step = 1e-3
    for row in (0, len(inputs) - 1):
        for i in range(n):
            ends = [
                np.asarray(function(s * step * np.eye(n)[i], inputs[row])).ravel()
                for s in (1.0, -1.0)
            ]
            slope = (ends[0] - ends[1]) / (2.0 * step)
            np.testing.assert_allclose(J[row][:, i], slope, rtol=1e-5, atol=1e-5)


def dm(problem: FitProblem, state: State) -> list[ca.DM]:
    return [ca.DM(part.T.copy()) for part in inputs_of(problem, state, whitening(problem), K)]


def test_gradient_of_the_whole_cost_agrees_with_finite_differences(
    fitted: tuple[FitProblem, State],
) -> None:
    problem, state = fitted
    inputs = dm(problem, state)
    n = problem.layout.size
    g = np.asarray(problem.gradient(np.zeros(n), *inputs)).ravel()
    rng = np.random.default_rng(0)
    for _ in range(5):
        d = rng.standard_normal(n)
        step = 1e-5
        slope = (
            float(problem.cost(step * d, *inputs)) - float(problem.cost(-step * d, *inputs))
        ) / (2.0 * step)
        assert float(g @ d) == pytest.approx(slope, rel=1e-5)


def test_hessian_is_the_weighted_gauss_newton_matrix(fitted: tuple[FitProblem, State]) -> None:
    problem, state = fitted
    n = problem.layout.size
    upper = np.asarray(problem.hessian(np.zeros(n), *dm(problem, state)))
    assert not np.tril(upper, -1).any()
    H = upper + np.triu(upper, 1).T
    linear = linearize(problem, state, whitening(problem))
    dense = np.zeros((n + 1, n + 1))
    w = weights(np.sum(linear.outline_r**2, axis=1), K)
    for index, J, weight in [
        (problem.outline_index, linear.outline_J, w),
        (problem.encoder_index, linear.encoder_J, np.ones(len(problem.readings))),
    ]:
        for place, block, factor in zip(index, J, weight, strict=True):
            dense[np.ix_(place, place)] += factor * block.T @ block
    position = problem.radius_prior.position
    dense[position, position] += linear.prior_J**2
    np.testing.assert_allclose(H, dense[:n, :n], rtol=1e-9, atol=1e-6)
    assert np.linalg.eigvalsh(H)[0] > 0.0


def test_eliminating_the_poses_gives_the_step_of_the_whole_system(
    fitted: tuple[FitProblem, State],
) -> None:
    problem, state = fitted
    linear = linearize(problem, state, whitening(problem))
    step = normal_equations(problem, linear, 0.0).step()
    inputs = [ca.DM(p.T.copy()) for p in inputs_of(problem, state, whitening(problem), 0.0)]
    n = problem.layout.size
    upper = np.asarray(problem.hessian(np.zeros(n), *inputs))
    H = upper + np.triu(upper, 1).T
    g = np.asarray(problem.gradient(np.zeros(n), *inputs)).ravel()
    np.testing.assert_allclose(step, -np.linalg.solve(H, g), rtol=1e-4, atol=1e-6)


def test_loss_is_quadratic_near_and_linear_far_and_its_curvature_is_exact() -> None:
    cost = robust_loss(prior_residual()).cost

    def value(r: float) -> float:
        return float(cost(0.0, np.array([r, 1.0, K])))

    assert value(1e-3) == pytest.approx(0.5e-6, rel=1e-6)
    assert value(2e6) - value(1e6) == pytest.approx(1e6 / np.sqrt(K), rel=1e-5)
    r = np.array([[1.3, -2.0]])

    def gradient(r: Array) -> Array:
        return np.asarray(weights(np.sum(r**2, axis=-1), K)[:, None] * r)

    for i in range(2):
        d = 1e-6 * np.eye(2)[i]
        slope = (gradient(r + d) - gradient(r - d)) / 2e-6
        np.testing.assert_allclose(curvature(r, K)[0][:, i], slope[0], atol=1e-8)


def test_efficiency_of_the_loss_agrees_with_monte_carlo() -> None:
    assert efficiency(0.0) == pytest.approx(1.0, abs=1e-12)
    r = np.random.default_rng(0).standard_normal((400_000, 2))
    s = np.sum(r**2, axis=1)
    psi = weights(s, K)[:, None] * r
    slope = curvature(r, K)[:, 0, 0].mean()
    assert efficiency(K) == pytest.approx(slope**2 / np.mean(psi[:, 0] ** 2), rel=5e-3)


def test_cayley_rotations_are_orthogonal_and_rotate_about_the_vector() -> None:
    w = np.array([[0.3, -0.2, 0.5], [0.0, 0.0, 0.0]])
    R = cayley(w)
    np.testing.assert_allclose(
        R @ np.swapaxes(R, -1, -2), np.tile(np.eye(3), (2, 1, 1)), atol=1e-15
    )
    np.testing.assert_allclose(R[0] @ w[0], w[0], atol=1e-15)
    d = np.array([[1e-5, 0.0, 0.0]])
    np.testing.assert_allclose(cayley(d)[0][2, 1], 1e-5, rtol=1e-9)


def test_state_moves_only_what_the_layout_frees(fitted: tuple[FitProblem, State]) -> None:
    problem, state = fitted
    moved = state.moved(np.ones(problem.layout.size), problem.layout)
    change = moved.base_joints - state.base_joints
    for rank, leg in enumerate(FRAME_LEGS):
        np.testing.assert_array_equal(change[leg, rank:], 0.0)
    assert np.count_nonzero(change) == 12
    np.testing.assert_allclose(moved.radii - state.radii, 1e-3)


def test_residuals_of_no_measurement_are_empty() -> None:
    assert evaluate(encoder_residual(), np.zeros((0, 22))).shape == (0, 1)
    assert evaluate_jacobian(encoder_residual(), np.zeros((0, 22)))[1].shape == (0, 1, 13)
