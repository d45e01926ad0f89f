"""Step 3: eqs (13) and (14)."""

from dataclasses import replace

import numpy as np
import pytest
from staged_hexapods import exact_session, five_millimetres_away, noisy_session

from legcal.errors import NotIdentifiable
from legcal.geometry.types import BoolArray
from legcal.simulation.machine import Machine
from legcal.simulation.observe import OutlineNoise
from legcal.stages.joints_in_base import locate_joints_in_base
from legcal.stages.joints_in_camera import locate_joints_in_cameras
from legcal.stages.leg_directions import (
    LegDirections,
    directions_through_joints,
    observed_directions,
)
from legcal.stages.nominal import Criteria
from legcal.stages.offsets import build_consecutive, identify_offsets, leg_ends
from legcal.studies.estimators import nominal_of
from legcal.studies.session import SimulatedSession


def _directions(session: SimulatedSession, nominal: Machine, criteria: Criteria) -> LegDirections:
    joints = locate_joints_in_cameras(
        nominal_of(nominal), session.axes, session.measurements, criteria=criteria
    )
    if criteria == "literal":
        return observed_directions(nominal_of(nominal), session.axes, session.measurements, joints)
    base = locate_joints_in_base(nominal_of(nominal), joints)
    return directions_through_joints(
        nominal_of(nominal), session.axes, session.measurements, joints, base
    )


def _some(directions: LegDirections, keep: BoolArray) -> LegDirections:
    names = ("group", "view", "leg", "A", "u", "basis", "covariance", "reading")
    return LegDirections(**{name: getattr(directions, name)[keep] for name in names})


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_eq14_gives_exact_offsets_from_five_millimetres_away(criteria: Criteria) -> None:
    session = exact_session()
    nominal = five_millimetres_away(session.machine)
    directions = _directions(session, nominal, criteria)
    offsets = identify_offsets(nominal_of(nominal), directions, 2e-6, criteria=criteria)
    assert np.abs(offsets.q0 - session.machine.parameters.offsets).max() < 1e-9


def test_eq13_leg_ends_have_the_distances_of_the_platform_joints() -> None:
    session = exact_session()
    directions = _directions(session, session.machine, "default")
    ends = leg_ends(directions, session.machine.parameters.offsets)
    B_Re = session.machine.parameters.platform_joints
    for group in directions.groups():
        seen = np.linalg.norm(ends[group] - ends[group[0]], axis=1)
        true = np.linalg.norm(B_Re[directions.leg[group]] - B_Re[directions.leg[group[0]]], axis=1)
        assert np.allclose(seen, true, atol=1e-9)


def test_eq14_compares_consecutive_positions_of_a_view_only() -> None:
    session = exact_session(n_poses=6)
    directions = _directions(session, session.machine, "literal")
    problem = build_consecutive(nominal_of(session.machine), directions)
    assert problem.n_residuals == 3 * (6 - 1) * 6


def test_a_motor_that_counts_backwards_gives_the_same_offsets() -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=8)
    sign = np.array([1, -1, 1, -1, -1, 1])
    backwards = replace(session.measurements, q=session.measurements.q * sign)
    machine = replace(session.machine, sign=sign)
    forth = identify_offsets(nominal_of(nominal), _directions(session, nominal, "default"), 2e-6).q0
    directions = _directions(
        replace(session, measurements=backwards, machine=machine),
        replace(nominal, sign=sign),
        "default",
    )
    assert np.allclose(
        identify_offsets(nominal_of(nominal), directions, 2e-6).q0, forth, atol=1e-12
    )


def test_passing_through_the_joint_improves_the_tilt_of_a_leg() -> None:
    session, nominal = noisy_session(1, OutlineNoise(0.2, 100))
    observed = _directions(session, nominal, "literal")
    improved = _directions(session, nominal, "default")
    miss = []
    for directions in (observed, improved):
        true = []
        for i in range(len(directions)):
            v, j = int(directions.view[i]), int(directions.leg[i])
            pose = int(directions.group[i] % session.measurements.n_poses)
            A = session.machine.parameters.base_joints[j]
            B = session.T_Rb_Re[pose].apply(session.machine.parameters.platform_joints[j])
            u = (B - A) / np.linalg.norm(B - A)
            camera = session.cameras[v].T_Rb_camera
            true.append(camera.inv().rotation.apply(u) if directions is observed else u)
        miss.append(np.sqrt(np.mean(np.sum(np.cross(directions.u, true) ** 2, axis=1))))
    assert miss[1] < 0.5 * miss[0]


def test_legs_that_are_always_alone_are_refused_by_name() -> None:
    session = exact_session()
    directions = _directions(session, session.machine, "default")
    # Leg 5 is never seen without leg 6.
    with_leg6 = np.isin(directions.group, directions.group[directions.leg == 5])
    alone = _some(directions, ~with_leg6 | (directions.leg == 5))
    with pytest.raises(NotIdentifiable, match="fixes that of leg5, leg6"):
        identify_offsets(nominal_of(session.machine), alone, 2e-6)


def test_no_two_legs_at_once_is_refused() -> None:
    session = exact_session()
    directions = _directions(session, session.machine, "default")
    with pytest.raises(NotIdentifiable, match="no image shows two legs"):
        identify_offsets(nominal_of(session.machine), _some(directions, directions.leg == 0), 2e-6)
