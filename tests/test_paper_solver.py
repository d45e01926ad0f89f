"""What the steps are built of: least squares by IPOPT, equations, unknown axes, registration."""

import os
import signal
from dataclasses import replace
from threading import Timer

import casadi as ca
import numpy as np
import pytest
from random_legs import closed_leg
from scipy.spatial.transform import Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.lines import normal_basis
from legcal.machine.equations import leg_equations
from legcal.machine.leg import EquationKind
from legcal.paper.equations import axis_frames, closure_of_leg, end_of_leg, leg_across_axis
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares


def _problem(name: str, x: ca.SX, residuals: ca.SX, start: list[float]) -> LeastSquares:
    function = ca.Function("all", [x, ca.SX.sym("error", 0)], [residuals])
    return LeastSquares(
        name, (Term(function, np.arange(len(start))[None, :], ()),), np.array(start)
    )


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
    assert np.allclose(solve_least_squares(problem).x, 1.0)


# Equations


@pytest.mark.parametrize("joints", ["UU", "U", "RU", "UR", "RR"])
def test_equations_of_a_leg_are_those_of_the_machine(joints: str) -> None:
    """Length (13), axis across the leg (7), and closure."""
    rng = np.random.default_rng(3)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.standard_normal(3)
    leg = replace(closed_leg(joints, R, t, rng), q0=0.3)
    leg = replace(leg, A=leg.A + 0.1 * rng.standard_normal(3))
    assert leg.base_axis is not None
    assert leg.platform_axis is not None
    expected = leg_equations(leg, R[None], t[None])
    values = dict(zip(expected.kinds, expected.values[0], strict=True))
    vector = R @ leg.B + t - leg.A
    length = float(np.linalg.norm(vector))
    u = vector / length
    E, none = normal_basis(u), np.zeros(8)
    a, b = (axis_frames(v[None])[0] for v in (leg.base_axis, leg.platform_axis))
    column = np.concatenate([leg.A, u, [length - leg.q0], *E])
    np.testing.assert_allclose(
        end_of_leg()(leg.q0, np.zeros(3), column).full().ravel(), R @ leg.B + t, atol=1e-12
    )
    assert values[EquationKind.LENGTH] == pytest.approx(length - leg.q0, abs=1e-12)
    for about, body, frame in (
        (EquationKind.BASE_AXIS, np.eye(3), a),
        (EquationKind.PLATFORM_AXIS, R, b),
    ):
        if about in values:
            sine = float(leg_across_axis()(np.zeros(2), none, u, E, body, frame))
            assert sine == pytest.approx(values[about], abs=1e-12)
    if EquationKind.TWIST in values:
        function = closure_of_leg(leg.base_joint, leg.platform_joint)
        sine = float(function(np.zeros(5), none, u, E, R, a, b, float(leg.twist or 0.0), 0.5))
        assert sine == pytest.approx(2.0 * values[EquationKind.TWIST], abs=1e-12)
