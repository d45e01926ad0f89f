"""Least squares through IPOPT."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry import register_groups, register_points
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares
from legcal.paper.motions import moved, moved_points


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
    solution = solve_least_squares(_problem("A valley", x, residuals, [-1.2, 1.0]))
    assert np.allclose(solution.x, 1.0, atol=1e-9)
    assert solution.status == "Solve_Succeeded"


def test_a_direction_that_no_residual_shows_is_found() -> None:
    x = ca.SX.sym("x", 3)
    residuals = ca.vertcat(x[0] - 1.0, x[1] + x[2], 2.0 * (x[1] + x[2]) - 1.0)
    solution = solve_least_squares(_problem("A sum", x, residuals, [0.0, 0.0, 0.0]))
    assert solution.unseen(3).tolist() == [False, True, True]
    assert solution.unseen(1).tolist() == [False]


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


def test_the_sparse_jacobian_is_the_derivative_of_the_residuals() -> None:
    problem = _poses_of_a_plane(4, 3)
    x, h = problem.start, 1e-6
    columns = [problem.residuals(x + h * e) - problem.residuals(x - h * e) for e in np.eye(len(x))]
    found = problem.jacobian(x)
    assert np.allclose(found.toarray(), np.column_stack(columns) / (2.0 * h), atol=1e-8)
    assert found.nnz <= problem.n_residuals * 5


def test_covariance_and_unseen_do_not_depend_on_which_unknowns_are_called_shared() -> None:
    for seen in (2, 3, 4):
        problem = _poses_of_a_plane(5, seen)
        apart = solve_least_squares(problem)
        together = solve_least_squares(replace(problem, n_shared=None))
        assert apart.n_shared == 5
        assert together.covariance().shape == (20, 20)
        assert np.allclose(apart.covariance(), together.covariance()[:5, :5], atol=1e-9)
        for solution in (apart, together):
            assert solution.unseen(5).tolist() == (np.arange(5) >= 2 * seen - 3).tolist()
        assert apart.unseen(2).tolist() == together.unseen(2).tolist()


def test_an_unknown_that_no_residual_contains_stays_where_it_is() -> None:
    problem = _poses_of_a_plane(5, 3)
    solution = solve_least_squares(problem)
    assert solution.cost < 1e-16
    assert np.array_equal(solution.x[3:5], problem.start[3:5])
    assert np.abs(solution.x[:3] - [1.0, 0.3, 1.1]).max() < 1e-9


def test_few_unknowns_beside_many_shared_ones_are_eliminated() -> None:
    x = ca.SX.sym("x", 7)
    shown = [2.0 * x[k] - k for k in range(6)]
    residuals = ca.vertcat(*shown, x[6] + x[0], x[6] - x[5])
    problem = replace(_problem("One pose", x, residuals, [0.5] * 7), n_shared=6)
    apart, together = (
        solve_least_squares(replace(problem, n_shared=n_shared)) for n_shared in (6, None)
    )
    assert np.allclose(apart.covariance(), together.covariance()[:6, :6], atol=1e-9)
    assert not apart.unseen(6).any()


def test_the_number_of_nonzeros_grows_with_the_number_of_poses_and_no_faster() -> None:
    few, many = (solve_least_squares(_poses_of_a_plane(n, 4)) for n in (10, 40))
    assert many.jacobian.nnz == 4 * few.jacobian.nnz


def test_a_problem_that_ipopt_gives_up_is_refused_with_its_status() -> None:
    x = ca.SX.sym("x", 1)
    problem = _problem("A root", x, ca.sqrt(x) - 1.0, [-1.0])
    with pytest.raises(DidNotConverge, match=r"A root could not be .*Invalid_Number.*, needed "):
        solve_least_squares(problem)


def test_points_moved_in_casadi_are_those_moved_by_the_rigid_motion() -> None:
    rng = np.random.default_rng(0)
    start = RigidTransform.from_components(rng.normal(size=3), Rotation.random(rng=rng))
    step, points = rng.normal(size=6), rng.normal(size=(5, 3))
    symbol = ca.SX.sym("step", 6)
    R, t = ca.SX(ca.DM(start.rotation.as_matrix())), ca.SX(ca.DM(start.translation))
    function = ca.Function("f", [symbol], [moved_points(symbol, R, t, ca.SX(ca.DM(points.T)))])
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


def test_groups_of_points_are_registered_as_each_alone() -> None:
    rng = np.random.default_rng(2)
    group = np.array([0, 1, 0, 1, 1, 0, 1])
    P_from, P_to = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    R, t = register_groups(P_from, P_to, group)
    for g in range(2):
        alone = register_points(P_from[group == g], P_to[group == g])
        assert np.allclose(R[g], alone.rotation.as_matrix(), atol=1e-12)
        assert np.allclose(t[g], alone.translation, atol=1e-12)
