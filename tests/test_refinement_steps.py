"""Rows, normal equations and steps of the fit against the same written out densely."""

from dataclasses import replace

import numpy as np
import pytest
from dense_fit import (
    allowed,
    by_differences,
    jacobian,
    kept_move,
    residuals,
    violations,
    whitened,
)
from machine_session import LENS, PINHOLE, MachineSession, machine_session
from thinned import thinned

from legcal.calibration.joint_fit.choices import Choices, Prior
from legcal.calibration.joint_fit.outline_errors import N_KINDS, EdgeBiases
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.variables import State
from legcal.data.axes import axes_from_outlines
from legcal.estimation import Frames, PseudoHuber, Rows, linearize, normal_equations, solver
from legcal.geometry.types import Array

K = 0.1
LOSS = PseudoHuber(K**-0.5)
BOUND = ("3-rps", "3-upu-tilted", "tricept", "3-rpr", "hexapod-rod")
FREED = {
    "hexapod": Choices(
        free=frozenset({"c1.fx", "c1.cy", "c1.k1"}),
        fixed=frozenset({"leg2.offset", "leg1.radius.leg1_tube"}),
        priors={"leg1.offset": Prior(0.4, 1e-3)},
    ),
    "3-rps": Choices(priors={"leg1.base_axis.1": Prior(0.01, 2e-3)}),
    "tricept": Choices(priors={"centre.platform_axis.2": Prior(0.0, 1e-3)}),
    "3-upu-tilted": Choices(free=frozenset({"leg2.twist"})),
}


def _small(name: str) -> MachineSession:
    n_poses = 5 if name == "3-upu-tilted" else 2
    return machine_session(name, n_poses=n_poses, camera=PINHOLE if name == "3-rps" else LENS)


def _problem(name: str) -> FitProblem:
    session = _small(name)
    axes = None
    if name == "6-sps":
        radii = {part: r for (_, part), r in session.legs.radii.items()}
        rods = [part.endswith("_rod") for part in session.outlines.part]
        axes = axes_from_outlines(
            replace(session.outlines, used=np.array(rods)), session.measurements, radii
        )
    problem = build_fit(
        session.legs,
        session.measurements,
        session.outlines,
        axes=axes,
        choices=FREED.get(name, Choices()),
    )
    if name != "nategh-agheli":
        return problem
    n = len(problem.outlines)
    shift = np.random.default_rng(0).uniform(-1.0, 1.0, (n, 2, 2))
    index = np.stack([np.zeros(n, dtype=np.intp), 1 + problem.outlines.leg], axis=1)
    names = ("all", *problem.legs.names)
    kind = np.zeros(len(names), dtype=np.intp)
    shifts = EdgeBiases(names, kind, np.full(N_KINDS, 0.3), index, shift)
    return problem.with_biases(shifts)


def _whitening(problem: FitProblem) -> Array:
    n = len(problem.outlines)
    return np.asarray(np.tril(np.random.default_rng(4).uniform(1.0, 3.0, (n, 2, 2))))


def _state(problem: FitProblem, session: MachineSession) -> State:
    """Return a state away from the truth, with no axis or radius where it is nominal."""
    state = problem.begin(session.start)
    x = 1e-3 * np.random.default_rng(2).uniform(-1.0, 1.0, problem.size)
    return kept_move(problem, state, x)


@pytest.mark.parametrize(
    "name",
    thinned(
        ["hexapod", "nategh-agheli", "6-sps", "3-rps", "3-upu-tilted", "hexapod-rod", "tricept"],
        ["hexapod", "3-rps", "hexapod-rod", "tricept"],
    ),
)
def test_rows_have_the_derivatives_of_finite_differences(name: str) -> None:
    problem = _problem(name)
    state, T = _state(problem, _small(name)), _whitening(problem)
    assert problem.places["axes"].index.shape[0] == 0 or name == "6-sps"
    J = jacobian(problem, linearize(whitened(problem, T), state))
    unit = np.eye(problem.size)
    expected = by_differences(problem, state, lambda s: residuals(problem, s, T), unit)
    size = np.abs(expected).max(axis=0)
    # What acts on the constraints alone: axes, twists, constant lengths.
    idle = [problem.named[i] for i in np.flatnonzero(size[: problem.n_named] == 0.0)]
    assert all("axis" in n or n.endswith((".twist", ".length")) for n in idle)
    # Differences of an angle with a prior are rounded by 1e-16 rad over its sigma and the step.
    assert np.abs((J - expected) / np.maximum(size, 0.1)).max() < 1e-6


@pytest.mark.parametrize("name", thinned(BOUND, ["3-rps", "tricept", "hexapod-rod"]))
def test_poses_follow_every_parameter_as_finite_differences_do(name: str) -> None:
    problem = _problem(name)
    state, T = _state(problem, _small(name)), _whitening(problem)
    J = jacobian(problem, linearize(whitened(problem, T), state))
    assert problem.constraint is not None
    motion = problem.constraint.tangent(problem, state)
    assert motion is not None
    n = problem.n_named
    steps = np.zeros((n, problem.size))
    steps[:, :n] = np.eye(n)
    expected = by_differences(problem, state, lambda s: residuals(problem, s, T), steps, kept_move)
    steps[:, problem.n_kept :] = motion.Q[:n].reshape(n, -1)
    size = np.abs(expected).max(axis=0)
    assert np.all(size > 0.0)
    assert np.abs((J @ steps.T - expected) / size).max() < 1e-6


def _robust(linear_rows: Rows, J: Array) -> tuple[Array, Array]:
    """Return Hessian and gradient of the loss of measurements, from its definition."""
    n, q = linear_rows.r.shape
    blocks = J.reshape(n, q, J.shape[1])
    H, g = np.zeros((J.shape[1], J.shape[1])), np.zeros(J.shape[1])
    for r, Ji in zip(linear_rows.r, blocks, strict=True):
        w = 1.0 / np.sqrt(1.0 + K * (r @ r))
        H += Ji.T @ (w * np.eye(q) - K * w**3 * np.outer(r, r)) @ Ji
        g += w * Ji.T @ r
    return H, g


@pytest.mark.parametrize("name", ["3-rps", "3-spr", "3-upu-tilted", "tricept"])
def test_angles_of_axes_follow_their_turns_as_finite_differences_do(name: str) -> None:
    session = machine_session(name, n_poses=2)
    problem = build_fit(session.legs, session.measurements, session.outlines)
    state = problem.begin(session.start)
    step = np.where(np.arange(problem.size) < problem.n_kinematic, 0.1, 0.0)
    state = problem.moved(state, step)  # far from nominal, where turns do not simply add up
    J, h = problem.jacobian(state), 1e-6
    for j in range(problem.n_named):
        by_h = np.where(np.arange(problem.size) == j, h, 0.0)
        ahead, behind = (
            problem.coordinates(problem.moved(state, sign * by_h)) for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(J[:, j], (ahead - behind) / (2.0 * h), rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("is_held", [False, True])
@pytest.mark.parametrize(
    "name",
    thinned(
        ["hexapod", "nategh-agheli", "6-sps", "3-rps", "3-upu-tilted", "tricept", "3-rpr"],
        ["hexapod", "3-upu-tilted", "tricept", "3-rpr"],
    ),
)
def test_a_step_is_that_of_the_whole_system_inside_the_constraints(
    name: str, is_held: bool
) -> None:
    problem = _problem(name)
    state, T = _state(problem, _small(name)), _whitening(problem)
    if is_held:
        held = np.random.default_rng(1).normal(size=(problem.n_kept, 2))
        problem = replace(problem, held=np.linalg.qr(held)[0].T)
    linear = linearize(whitened(problem, T), state)
    J = jacobian(problem, linear)
    n, m, q = linear["outlines"].r.size, linear["readings"].r.size, linear["axes"].r.size
    H, g = _robust(linear["outlines"], J[:n])
    H_axes, g_axes = _robust(linear["axes"], J[n + m : n + m + q])
    plain = np.concatenate([J[n : n + m], J[n + m + q :]])
    H += H_axes + plain.T @ plain
    g += g_axes + plain.T @ np.concatenate([linear["readings"].r.ravel(), linear.prior_r])
    N = allowed(problem, state)
    assert N.shape[1] == problem.n_unknowns - len(problem.held)
    inside = N.T @ H @ N
    scale = 1.0 / np.sqrt(np.diag(inside))
    free = np.linalg.solve(scale[:, None] * inside * scale, scale * (N.T @ g))
    expected = -N @ (scale * free)
    step, promised = normal_equations(problem, state, linear, LOSS).step(0.0)
    assert promised == pytest.approx(-0.5 * g @ expected, rel=1e-6)
    wrong = step - expected
    assert wrong @ H @ wrong < 1e-10 * promised


def test_damping_turns_a_step_towards_the_gradient_and_shortens_it() -> None:
    problem = _problem("3-rps")
    state = _state(problem, _small("3-rps"))
    normal = normal_equations(
        problem, state, linearize(whitened(problem, _whitening(problem)), state), LOSS
    )
    sizes = [float(np.linalg.norm(normal.step(damping)[0])) for damping in (0.0, 1e-3, 1.0, 1e3)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 1e-2 * sizes[0]
    assert all(normal.step(damping)[1] > 0.0 for damping in (0.0, 1e-3, 1.0, 1e3))


@pytest.mark.parametrize("name", BOUND)
def test_constraints_hold_at_every_state_that_the_solver_looks_at(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = machine_session(name)
    problem = build_fit(session.legs, session.measurements, session.outlines)
    looked_at: list[State] = []

    def watched(problem: FitProblem, state: State) -> object:
        looked_at.append(state)
        return linearize(problem, state)

    monkeypatch.setattr(solver, "linearize", watched)
    begin = problem.begin(session.start)
    found = solver.minimise(problem, begin, PseudoHuber(3.0))
    assert len(looked_at) >= 4
    for state in looked_at:
        assert np.abs(violations(problem, state) - _heights(problem, begin)).max() < 1e-12
        turned = state.platform_pose.R @ np.swapaxes(state.platform_pose.R, 1, 2)
        assert np.abs(turned - np.eye(3)).max() < 1e-14
    assert found.cost < 1e-12


def _heights(problem: FitProblem, begin: State) -> Array:
    """Return what the violations of a planar machine are where its platform has its height."""
    heights = np.zeros_like(violations(problem, begin))
    if not problem.legs.spatial:
        heights[-3 * problem.n_elements :][2::3] = begin.platform_pose.t[:, 2]
    return heights


def test_poses_go_back_to_their_constraints_the_shortest_way() -> None:
    session = _small("3-rps")
    problem = build_fit(session.legs, session.measurements, session.outlines)
    state = problem.begin(session.truth)
    x = np.zeros(problem.size)
    x[problem.n_kept :] = 1e-6 * np.random.default_rng(0).normal(size=6 * problem.n_elements)
    back = problem.projected(problem.moved(state, x))
    done = x[problem.n_kept :].reshape(-1, 6)
    there, here = back.platform_pose, state.platform_pose
    left = np.concatenate([_turn(there, here), there.t - here.t], axis=1) - done
    # What was taken back is normal to what the constraints leave.
    N = allowed(problem, state)[problem.n_kept :]
    of_poses = N[:, np.abs(N).max(axis=0) > 0.0]
    C = by_differences(problem, state, lambda s: violations(problem, s), np.eye(len(x)))
    free = np.linalg.svd(C[:, problem.n_kept :])[2][C.shape[0] :]
    assert np.abs(left).max() > 1e-7
    assert np.abs(free @ left.ravel()).max() < 1e-10
    assert of_poses.shape[0] == free.shape[1]


def _turn(there: Frames, here: Frames) -> Array:
    """Return the small rotation vectors between poses."""
    R = there.R @ np.swapaxes(here.R, 1, 2)
    return 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
