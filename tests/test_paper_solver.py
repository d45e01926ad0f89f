"""What the steps are built of: least squares by IPOPT, unknown motions and axes, registration."""

import os
import signal
from dataclasses import replace
from threading import Timer

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.axes import axis_angles, turned_axis
from legcal.geometry.lines import normal_basis
from legcal.geometry.motions import register_groups, register_in_plane, register_points
from legcal.paper.gibbs import (
    angles_of,
    axis_frames,
    axis_slope,
    gibbs_of,
    turned_frame,
)
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares


def _line(outlier: float, robust: bool) -> LeastSquares:
    x, t_i, y_i = ca.SX.sym("x", 2), ca.SX.sym("t"), ca.SX.sym("y")
    residual = ca.Function("line", [x, t_i, y_i], [(x[0] + x[1] * t_i - y_i) / 1e-2])
    t = np.linspace(0.0, 1.0, 21)
    y = 1.0 + 2.0 * t + 1e-2 * np.cos(40.0 * t)
    y[4] += outlier
    term = Term(residual, np.tile([0, 1], (len(t), 1)), (t, y), robust=robust)
    return LeastSquares("A line", (term,), np.array([50.0, -3.0]))


def _problem(name: str, x: ca.SX, residuals: ca.SX, start: list[float]) -> LeastSquares:
    function = ca.Function("all", [x], [residuals])
    return LeastSquares(
        name, (Term(function, np.arange(len(start))[None, :], ()),), np.array(start)
    )


def test_a_linear_problem_is_solved_exactly_with_the_covariance_of_linear_algebra() -> None:
    solution = solve_least_squares(_line(0.0, robust=False))
    design = np.stack([np.ones(21), np.linspace(0.0, 1.0, 21)], axis=1) / 1e-2
    jacobian = np.asarray(solution.jacobian.todense())
    assert np.allclose(jacobian, design)
    assert np.allclose(jacobian.T @ solution.residuals, 0.0, atol=1e-8)
    assert np.allclose(solution.covariance(), np.linalg.inv(design.T @ design))
    assert not solution.undetermined(2).any()
    assert solution.cost == pytest.approx(0.5 * np.sum(solution.residuals**2))


def test_a_robust_fit_is_that_of_cauchy_weights() -> None:
    clean = solve_least_squares(_line(0.0, robust=False)).x
    plain = solve_least_squares(_line(5.0, robust=False)).x
    problem = _line(5.0, robust=True)
    found = solve_least_squares(problem).x
    assert np.abs(found - clean).max() < 0.02 * np.abs(plain - clean).max()
    # Reweighted until no root of a weight changes by 0.01: half a weight at four medians.
    A, b = problem.jacobian(found).toarray(), -problem.residuals(np.zeros(2))
    x, root = plain, np.ones(len(b))
    while True:
        residuals = A @ x - b
        last = root
        root = 1.0 / np.sqrt(1.0 + (residuals / (4.0 * np.median(np.abs(residuals)))) ** 2)
        if np.abs(root - last).max() < 0.01:
            break
        x = np.linalg.lstsq(root[:, None] * A, root * b, rcond=None)[0]
    assert np.abs(found - x).max() < 1e-6


def test_a_curved_problem_converges_from_far_away() -> None:
    x = ca.SX.sym("x", 2)
    residuals = ca.vertcat(1.0 - x[0], 10.0 * (x[1] - x[0] ** 2))
    solution = solve_least_squares(_problem("A valley", x, residuals, [-1.2, 1.0]))
    assert np.allclose(solution.x, 1.0, atol=1e-9)
    assert solution.status == "Solve_Succeeded"


def test_a_direction_that_no_residual_shows_is_undetermined() -> None:
    x = ca.SX.sym("x", 3)
    residuals = ca.vertcat(x[0] - 1.0, x[1] + x[2], 2.0 * (x[1] + x[2]) - 1.0)
    solution = solve_least_squares(_problem("A sum", x, residuals, [0.0, 0.0, 0.0]))
    assert solution.undetermined(3).tolist() == [False, True, True]
    assert solution.undetermined(1).tolist() == [False]


def test_a_problem_that_ipopt_gives_up_is_refused_with_its_status() -> None:
    x = ca.SX.sym("x", 1)
    problem = _problem("A root", x, ca.sqrt(x) - 1.0, [-1.0])
    with pytest.raises(DidNotConverge, match=r"A root could not be .*Invalid_Number.*, needed "):
        solve_least_squares(problem)


@pytest.mark.usefixtures("answered_signals")
def test_an_interrupt_inside_ipopt_reaches_the_caller() -> None:
    x = ca.SX.sym("x", 2)
    problem = _problem("A valley", x, ca.vertcat(1.0 - x[0], 10.0 * (x[1] - x[0] ** 2)), [-1.2, 1])
    solve_least_squares(problem)  # compiled

    def solve_until_killed(killer: Timer) -> None:
        killer.start()
        while True:
            solve_least_squares(problem)

    for delay in np.linspace(0.001, 0.03, 12).tolist():
        killer = Timer(delay, os.kill, (os.getpid(), signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            solve_until_killed(killer)
        killer.join()
    assert solve_least_squares(problem).status == "Solve_Succeeded"


def _poses_of_a_plane(n_poses: int, seen: int) -> LeastSquares:
    """Return points of a plane, two on its x axis, in frames that are shifted and turned."""
    local, place = ca.SX.sym("local", 5), ca.SX.sym("place", 2)
    c, s = ca.cos(local[4]), ca.sin(local[4])
    turned = ca.vertcat(c * local[0] - s * local[1], s * local[0] + c * local[1])
    miss = ca.Function("miss", [local, place], [turned + local[2:4] - place])
    rng = np.random.default_rng(0)
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.3, 1.1], [-0.8, 0.5]])
    pose = np.repeat(np.arange(n_poses), seen)
    point = np.tile(np.arange(seen), n_poses)
    steps = np.column_stack([rng.normal(size=(n_poses, 2)), rng.uniform(-1.0, 1.0, n_poses)])
    cosine, sine = np.cos(steps[:, 2]), np.sin(steps[:, 2])
    R = np.moveaxis(np.array([[cosine, -sine], [sine, cosine]]), 2, 0)
    places = np.einsum("nij,nj->ni", R[pose], points[point]) + steps[pose, :2]
    positions = np.array([[-1, -1], [0, -1], [1, 2], [3, 4]])
    index = np.hstack([positions[point], 5 + 3 * pose[:, None] + np.arange(3)])
    start = np.concatenate([points[positions >= 0] + 0.05, (steps + 0.05).ravel()])
    return LeastSquares("A plane", (Term(miss, index, (places,)),), start, n_shared=5)


def test_covariance_and_rank_do_not_depend_on_which_unknowns_are_called_shared() -> None:
    for seen in (2, 3, 4):
        problem = _poses_of_a_plane(5, seen)
        apart = solve_least_squares(problem)
        together = solve_least_squares(replace(problem, n_shared=None))
        assert apart.n_shared == 5
        assert together.covariance().shape == (20, 20)
        assert np.allclose(apart.covariance(), together.covariance()[:5, :5], atol=1e-9)
        for solution in (apart, together):
            assert solution.undetermined(5).tolist() == (np.arange(5) >= 2 * seen - 3).tolist()
        assert apart.undetermined(2).tolist() == together.undetermined(2).tolist()
        assert apart.cost < 1e-16
        if seen == 3:  # an unknown that no residual contains stays where it is
            assert np.array_equal(apart.x[3:5], problem.start[3:5])
            assert np.abs(apart.x[:3] - [1.0, 0.3, 1.1]).max() < 1e-9


def test_few_unknowns_beside_many_shared_ones_are_eliminated() -> None:
    x = ca.SX.sym("x", 7)
    shown = [2.0 * x[k] - k for k in range(6)]
    residuals = ca.vertcat(*shown, x[6] + x[0], x[6] - x[5])
    problem = replace(_problem("One pose", x, residuals, [0.5] * 7), n_shared=6)
    apart, together = (
        solve_least_squares(replace(problem, n_shared=n_shared)) for n_shared in (6, None)
    )
    assert np.allclose(apart.covariance(), together.covariance()[:6, :6], atol=1e-9)
    assert not apart.undetermined(6).any()


def test_the_number_of_nonzeros_grows_with_the_number_of_poses_and_no_faster() -> None:
    few, many = (_poses_of_a_plane(n, 4) for n in (10, 40))
    assert many.jacobian(many.start).nnz == 4 * few.jacobian(few.start).nnz <= 5 * many.n_residuals


# Unknown motions and axes


@given(turns=st.tuples(*[st.floats(-1.0, 1.0)] * 2), seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_turns_of_an_axis_are_its_angles_from_the_nominal_one(
    turns: tuple[float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    nominal = rng.standard_normal(3)
    nominal /= np.linalg.norm(nominal)
    w = np.array(turns)
    symbol, frame = ca.SX.sym("turns", 2), ca.SX(ca.DM(axis_frames(nominal[None])[0]))
    in_casadi = ca.Function("axis", [symbol], [turned_frame(symbol, frame)[:, 0]])
    axis = in_casadi(w).full().ravel()
    np.testing.assert_allclose(turned_axis(nominal, angles_of(w)), axis, atol=1e-12)
    np.testing.assert_allclose(gibbs_of(axis_angles(axis, nominal)), w, atol=1e-9)
    np.testing.assert_allclose(axis_angles(-axis, nominal), angles_of(w), atol=1e-9)
    exact = Rotation.from_rotvec(angles_of(w) @ normal_basis(nominal)).apply(nominal)
    np.testing.assert_allclose(axis, exact, atol=1e-12)
    h = 1e-6
    slope = [(in_casadi(w + h * e) - in_casadi(w - h * e)).full() / (2.0 * h) for e in np.eye(2)]
    np.testing.assert_allclose(axis_slope(nominal, w), np.hstack(slope), atol=1e-8)


# Registration of points


def test_groups_of_points_are_registered_as_each_alone() -> None:
    rng = np.random.default_rng(2)
    group = np.array([0, 1, 0, 1, 1, 0, 1])
    P_from, P_to = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    R, t = register_groups(P_from, P_to, group)
    for g in range(2):
        alone = register_points(P_from[group == g], P_to[group == g])
        assert np.allclose(R[g], alone.rotation.as_matrix(), atol=1e-12)
        assert np.allclose(t[g], alone.translation, atol=1e-12)


def test_two_points_register_a_plane_whatever_their_heights() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (2, 2)), [0.0, 0.02]])
    T = RigidTransform.from_components([0.1, 0.2, 0.0], Rotation.from_rotvec([0.0, 0.0, 0.7]))
    ends = np.asarray(T.apply(points)) + np.array([0.0, 0.0, 0.005])
    R, t = register_in_plane(points, ends, np.zeros(2, dtype=np.intp))
    np.testing.assert_allclose(R[0], T.rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(t[0], T.translation, atol=1e-12)
