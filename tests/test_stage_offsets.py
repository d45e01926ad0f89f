"""Step 3: eqs (13) and (14)."""

from dataclasses import replace

import numpy as np
import pytest
from staged_hexapods import exact_session, five_millimetres_away, noisy_session
from staged_machines import shipped, three_steps

from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import BoolArray
from legcal.machine import LegKind
from legcal.paper.joints_in_base import locate_joints_in_base
from legcal.paper.joints_in_camera import locate_joints_in_cameras
from legcal.paper.leg_directions import (
    LegDirections,
    directions_through_joints,
    observed_directions,
)
from legcal.paper.nominal import Criteria
from legcal.paper.offsets import build_consecutive, identify_offsets, leg_ends, pairs_apart
from legcal.simulation.hexapod import HexapodSession, PaperHexapod
from legcal.simulation.observe import OutlineNoise
from legcal.simulation.paper import nominal_of


def _directions(
    session: HexapodSession, nominal: PaperHexapod, criteria: Criteria
) -> LegDirections:
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


def test_one_image_a_view_has_no_consecutive_positions() -> None:
    session = exact_session()
    directions = _directions(session, session.machine, "literal")
    first = [np.flatnonzero(directions.view == v)[0] for v in np.unique(directions.view)]
    once = _some(directions, np.isin(directions.group, directions.group[first]))
    with pytest.raises(NotIdentifiable, match="no view shows the same two legs in two images"):
        identify_offsets(nominal_of(session.machine), once, 2e-6, criteria="literal")


def test_legs_that_all_meet_on_the_platform_have_no_distance() -> None:
    session = exact_session()
    nominal = nominal_of(session.machine)
    directions = _directions(session, session.machine, "default")
    legs = list(nominal.legs)
    legs[1] = replace(legs[1], B=legs[0].B)
    pair = _some(directions, np.isin(directions.leg, [0, 1]))
    with pytest.raises(NotIdentifiable, match="end in different places of it"):
        identify_offsets(replace(nominal, legs=tuple(legs)), pair, 2e-6)


def test_a_leg_of_constant_length_reads_zero_whatever_the_table_says() -> None:
    observed = shipped("hexapod-rod")
    assert np.isnan(observed.measurements.q[:, 5]).all()
    steps = three_steps(observed)
    constant = steps.directions.leg == 5
    assert not steps.directions.reading[constant].any()
    assert steps.directions.reading[~constant].all()
    assert steps.offsets.q0[5] == pytest.approx(observed.true_legs[5].q0, abs=1e-9)


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_two_legs_that_meet_in_one_platform_joint_are_no_pair(criteria: Criteria) -> None:
    session = exact_session()
    machine = session.machine
    B = machine.parameters.platform_joints.copy()
    B[1] = B[0]
    parameters = replace(machine.parameters, platform_joints=B)
    lengths = [np.linalg.norm(T.apply(B) - parameters.base_joints, axis=1) for T in session.T_Rb_Re]
    m = session.measurements
    q = np.array([length - parameters.offsets for length in lengths])[m.pose]
    axes = session.axes
    u = axes.u.copy()
    for i in np.flatnonzero(axes.leg == 1):
        camera = session.cameras[m.view[axes.row[i]]].T_Rb_camera
        end = session.T_Rb_Re[m.pose[axes.row[i]]].apply(B[1])
        u[i] = camera.inv().rotation.apply(end - parameters.base_joints[1])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    A = np.array([c.T_Rb_camera.inv().apply(parameters.base_joints) for c in session.cameras])
    M = np.where((axes.leg == 1)[:, None], A[m.view[axes.row], axes.leg], axes.M)
    met = replace(
        session,
        machine=replace(machine, parameters=parameters),
        axes=replace(axes, u=u, M=M, basis=normal_basis(u)),
        measurements=replace(m, q=q),
    )
    nominal = five_millimetres_away(met.machine)
    nominal.parameters.platform_joints[1] = nominal.parameters.platform_joints[0]
    directions = _directions(met, nominal, criteria)
    pairs = pairs_apart(nominal_of(nominal), directions)
    together = directions.leg[pairs]
    assert not np.any(np.isin(together, (0, 1)).all(axis=1))
    assert np.any(np.isin(together, 1))
    found = identify_offsets(nominal_of(nominal), directions, 2e-6, criteria=criteria)
    assert np.abs(found.q0 - parameters.offsets).max() < 1e-8


def test_a_leg_fixed_to_the_platform_takes_no_part() -> None:
    observed = shipped("tricept")
    legs = list(observed.nominal.legs)
    legs[3] = replace(legs[3], kind=LegKind.ACTUATED, q0=0.1)
    nominal = replace(observed.nominal, legs=tuple(legs))
    q = np.where(np.isnan(observed.measurements.q), 0.4, observed.measurements.q)
    steps = three_steps(
        replace(observed, nominal=nominal, measurements=replace(observed.measurements, q=q))
    )
    assert steps.offsets.q0[3] == 0.1
    expected = [leg.q0 for leg in observed.true_legs[:3]]
    assert np.abs(steps.offsets.q0[:3] - expected).max() < 1e-9


def test_legs_that_do_not_turn_against_each_other_are_refused_with_what_is_seen() -> None:
    session = exact_session()
    directions = _directions(session, session.machine, "default")
    some = _some(directions, (directions.view == 0) & np.isin(directions.leg, (0, 1)))
    parallel = replace(some, u=np.repeat(some.u[::2], 2, axis=0))
    with pytest.raises(NotIdentifiable, match=r"leg1 hardly turns against .* in 6 poses"):
        identify_offsets(nominal_of(session.machine), parallel, 2e-6)


def test_legs_in_too_few_poses_are_refused_with_their_number() -> None:
    session = exact_session()
    directions = _directions(session, session.machine, "default")
    groups = np.unique(directions.group[directions.leg == 5])[:1]
    few = _some(directions, (directions.leg != 5) | np.isin(directions.group, groups))
    with pytest.raises(NotIdentifiable, match=r"fixes that of leg6 \(leg6 .* in 1 pose\)"):
        identify_offsets(nominal_of(session.machine), few, 2e-6)
