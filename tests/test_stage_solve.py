"""Least squares through IPOPT."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.stages.motion import moved, moved_points, register_points
from legcal.stages.solve import LeastSquares, solve_least_squares


def _line(outlier: float, robust: bool) -> LeastSquares:
    x = ca.SX.sym("x", 2)
    t = np.linspace(0.0, 1.0, 21)
    y = 1.0 + 2.0 * t + 1e-2 * np.cos(40.0 * t)
    y[4] += outlier
    residuals = (x[0] + x[1] * ca.DM(t) - ca.DM(y)) / 1e-2
    block = np.arange(len(t)) if robust else None
    return LeastSquares("A line", x, residuals, np.array([50.0, -3.0]), block=block)


def test_a_linear_problem_is_solved_exactly_with_the_covariance_of_linear_algebra() -> None:
    solution = solve_least_squares(_line(0.0, robust=False))
    design = np.stack([np.ones(21), np.linspace(0.0, 1.0, 21)], axis=1) / 1e-2
    assert np.allclose(solution.jacobian, design)
    assert np.allclose(solution.jacobian.T @ solution.residuals, 0.0, atol=1e-8)
    assert np.allclose(solution.covariance(), np.linalg.inv(design.T @ design))
    assert not solution.unseen(2).any()
    assert solution.cost == pytest.approx(0.5 * np.sum(solution.residuals**2))


def test_an_outlier_moves_a_robust_fit_far_less() -> None:
    clean = solve_least_squares(_line(0.0, robust=False)).x
    plain = solve_least_squares(_line(5.0, robust=False)).x
    robust = solve_least_squares(_line(5.0, robust=True)).x
    assert np.abs(robust - clean).max() < 0.02 * np.abs(plain - clean).max()


def test_a_curved_problem_converges_from_far_away() -> None:
    x = ca.SX.sym("x", 2)
    residuals = ca.vertcat(1.0 - x[0], 10.0 * (x[1] - x[0] ** 2))
    solution = solve_least_squares(LeastSquares("A valley", x, residuals, np.array([-1.2, 1.0])))
    assert np.allclose(solution.x, 1.0, atol=1e-9)
    assert solution.status == "Solve_Succeeded"


def test_a_direction_that_no_residual_shows_is_found() -> None:
    x = ca.SX.sym("x", 3)
    residuals = ca.vertcat(x[0] - 1.0, x[1] + x[2], 2.0 * (x[1] + x[2]) - 1.0)
    solution = solve_least_squares(LeastSquares("A sum", x, residuals, np.zeros(3)))
    assert solution.unseen(3).tolist() == [False, True, True]
    assert solution.unseen(1).tolist() == [False]


def test_a_problem_that_ipopt_gives_up_is_refused_with_its_status() -> None:
    x = ca.SX.sym("x", 1)
    problem = LeastSquares("A root", x, ca.sqrt(x) - 1.0, np.array([-1.0]))
    with pytest.raises(DidNotConverge, match=r"A root could not be computed.*Invalid_Number"):
        solve_least_squares(problem)


def test_points_moved_in_casadi_are_those_moved_by_the_rigid_motion() -> None:
    rng = np.random.default_rng(0)
    start = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
    step, points = rng.normal(size=6), rng.normal(size=(5, 3))
    symbol = ca.SX.sym("step", 6)
    function = ca.Function("f", [symbol], [moved_points(symbol, start, ca.SX(points.T))])
    expected = moved(step, start).apply(points)
    assert np.allclose(function(step).full().T, expected, atol=1e-12)
    assert np.allclose(moved(np.zeros(6), start).as_matrix(), start.as_matrix())


@pytest.mark.parametrize("flat", [False, True])
def test_registration_finds_the_motion_and_never_a_mirror(flat: bool) -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(size=(4, 3)) * [1.0, 1.0, 0.0 if flat else 1.0]
    T = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
    found = register_points(points, T.apply(points))
    assert np.allclose(found.as_matrix(), T.as_matrix(), atol=1e-12)
    mirrored = points * [1.0, 1.0, -1.0]
    assert np.linalg.det(register_points(points, mirrored).rotation.as_matrix()) > 0.0
