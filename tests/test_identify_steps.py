"""The ranks of steps, against the problems that the steps themselves build."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from mechanisms import SHIPPED_YAML
from staged_hexapods import exact_session

from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.session import Session, planned_session
from legcal.geometry.types import Array
from legcal.machine import Machine, load_mechanism
from legcal.paper import joints_in_base, offsets
from legcal.paper.joints_in_base import JointsInBase, register_views
from legcal.paper.joints_in_camera import JointsInCamera, locate_joints_in_cameras
from legcal.paper.least_squares import LeastSquares
from legcal.paper.leg_directions import directions_through_joints
from legcal.paper.platform import RigidProblem, build_rigid
from legcal.paper.platform_printed import build_mean_distances
from legcal.paper.unknowns import Unknowns
from legcal.simulation.hexapod import PaperHexapod
from legcal.simulation.paper import nominal_of

VIEWS = [
    ((0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5)),
    ((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (4, 5)),
    ((0, 1, 2), (3, 4, 5), (0, 1, 2)),
    ((0, 1), (2, 3), (4, 5)),
    ((0, 1, 2, 3), (3, 4, 5)),
    ((0, 1, 2, 3, 4, 5),),
]


@cache
def hexapod() -> Machine:
    return load_mechanism(SHIPPED_YAML)


def rank_of_first(problem: LeastSquares, wanted: int, known: slice = slice(0, 0)) -> int:
    """Return how many of the first unknowns a problem determines, others being free or known."""
    J = problem.jacobian(problem.start).toarray()
    J[:, known] = 0.0
    J /= np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    return _rank(J) - _rank(J[:, wanted:])


def _rank(J: Array) -> int:
    return int(np.linalg.matrix_rank(J, tol=1e-7)) if J.size else 0


def shared_poses(session: Session) -> Session:
    """Return the session in which all views show the poses of the first."""
    n = int((session.view == 0).sum())
    pose = np.tile(np.arange(n), session.n_views)
    return replace(session, R=session.R[:n], t=session.t[:n], pose=pose)


def base_as_drawn(machine: PaperHexapod, joints: JointsInCamera) -> JointsInBase:
    """Return the base of a machine of point-like joints as step 2 would, without solving."""
    nominal = nominal_of(machine)
    cameras = register_views(nominal, joints)
    return JointsInBase(nominal, cameras, joints, np.zeros((machine.n_legs, 3, 3)))


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("views", VIEWS)
def test_default_ranks_are_those_of_the_problems_that_the_steps_solve(
    views: tuple[tuple[int, ...], ...], shared: bool
) -> None:
    session = exact_session(legs=views, n_poses=8, share_poses=shared)
    machine, axes, m = session.machine, session.axes, session.measurements
    joints = locate_joints_in_cameras(nominal_of(machine), axes, m)
    base = base_as_drawn(machine, joints)
    directions = directions_through_joints(axes, m, base)
    q0 = machine.parameters.offsets
    step2 = joints_in_base.build_rigid(nominal_of(machine), joints, base.T_Rb_camera)
    step3 = offsets.build_constant_distances(nominal_of(machine), directions, q0, m.sigma_q)
    unknowns = Unknowns.of_platform(nominal_of(machine))
    rigid = RigidProblem.of(nominal_of(machine), unknowns, base, directions, m.sigma_q)
    step4 = build_rigid(rigid)
    built = [
        3 * int(joints.located.sum()),
        rank_of_first(step2, 12),
        rank_of_first(step3, 6),
        rank_of_first(step4, 12, known=slice(12, 18)),
    ]
    planned = planned_session(hexapod(), views)
    found = Analysis(shared_poses(planned) if shared else planned).step_ranks
    assert [s.rank for s in found if s.criteria == "default"] == built


def test_everything_at_once_determines_as_much_as_rows_are_more_than_unknowns() -> None:
    """Six readings a pose and eight rows an image, for the motions of platform and cameras."""
    planned = planned_session(hexapod(), ((0, 1), (2, 3), (4, 5)), 1)
    alone, together = (Analysis(s).full.rank for s in (planned, shared_poses(planned)))
    assert (alone, together) == (3 * (6 + 8) - 3 * (6 + 6), (6 + 3 * 8) - (6 + 3 * 6))


@pytest.mark.parametrize("coplanar", [True, False])
def test_printed_ranks_are_those_of_the_problems_that_the_steps_solve(coplanar: bool) -> None:
    views = VIEWS[0]
    session = exact_session(legs=views, n_poses=8, coplanar=coplanar)
    machine, axes, m = session.machine, session.axes, session.measurements
    joints = locate_joints_in_cameras(nominal_of(machine), axes, m, criteria="literal")
    base = base_as_drawn(machine, joints)
    directions = directions_through_joints(axes, m, base)
    built = [
        rank_of_first(joints_in_base.build_scalar_products(nominal_of(machine), joints), 12),
        rank_of_first(offsets.build_consecutive(nominal_of(machine), directions), 6),
        rank_of_first(
            build_mean_distances(
                nominal_of(machine), Unknowns.of_platform(nominal_of(machine)), directions
            ),
            12,
        ),
    ]
    assert built == ([9, 6, 9] if coplanar else [12, 6, 12])
    if coplanar:
        found = Analysis(planned_session(hexapod(), views)).step_ranks
        assert [s.rank for s in found if s.criteria == "literal"][1:] == built
