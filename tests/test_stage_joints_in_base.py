"""Step 2: eqs (8) and (9), and their rigid replacement."""

from dataclasses import replace

import numpy as np
import pytest
from staged_hexapods import exact_session, five_millimetres_away

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine import KinematicParameters
from legcal.paper.joints_in_base import JointsInBase, build_scalar_products, locate_joints_in_base
from legcal.paper.joints_in_camera import locate_joints_in_cameras
from legcal.paper.nominal import Criteria
from legcal.simulation.hexapod import HexapodSession, PaperHexapod, hexapod
from legcal.simulation.paper import nominal_of


def _locate(
    session: HexapodSession, nominal: PaperHexapod, criteria: Criteria = "default"
) -> JointsInBase:
    joints = locate_joints_in_cameras(nominal_of(nominal), session.axes, session.measurements)
    return locate_joints_in_base(nominal_of(nominal), joints, criteria=criteria)


def _with_base(machine: PaperHexapod, A_Rb: Array) -> PaperHexapod:
    parameters = KinematicParameters(
        A_Rb, machine.parameters.platform_joints, machine.parameters.offsets
    )
    return replace(machine, parameters=parameters)


@pytest.mark.parametrize("coplanar", [False, True])
def test_rigid_parts_give_joints_and_cameras_exactly_from_five_millimetres(coplanar: bool) -> None:
    session = exact_session(coplanar=coplanar)
    nominal = five_millimetres_away(session.machine)
    true = session.machine.parameters.base_joints
    assert np.abs(nominal.parameters.base_joints - true).max() == pytest.approx(0.005)
    base = _locate(session, nominal)
    assert np.abs(base.A_Rb - true).max() < 1e-9
    for T, viewpoint in zip(base.T_Rb_camera, session.cameras, strict=True):
        assert T is not None
        difference = T.inv() * viewpoint.T_Rb_camera
        assert np.linalg.norm(difference.translation) < 1e-9
        assert difference.rotation.magnitude() < 1e-8


def test_eq09_has_21_products_of_6_pairs_for_four_legs_seen() -> None:
    session = exact_session()
    joints = locate_joints_in_cameras(
        nominal_of(session.machine), session.axes, session.measurements
    )
    problem = build_scalar_products(nominal_of(session.machine), joints)
    assert problem.n_residuals == 3 * 21
    assert len(problem.start) == 12


def test_eq09_never_moves_z_from_a_coplanar_nominal_model() -> None:
    session = exact_session()
    true = session.machine.parameters.base_joints
    assert np.abs(true[:, 2]).max() > 5e-4
    literal = _locate(session, hexapod(), "literal")
    assert np.abs(literal.A_Rb[:, 2]).max() < 1e-9
    assert np.abs(literal.A_Rb - true).max() > 5e-4
    assert np.abs(_locate(session, hexapod()).A_Rb - true).max() < 1e-9


def test_eq09_accepts_a_mirror_image_that_the_rigid_criterion_corrects() -> None:
    session = exact_session()
    true = session.machine.parameters.base_joints
    mirrored = true * np.array([1.0, 1.0, -1.0])
    nominal = _with_base(session.machine, mirrored)
    assert np.abs(_locate(session, nominal, "literal").A_Rb - mirrored).max() < 1e-6
    assert np.abs(_locate(session, nominal).A_Rb - true).max() < 1e-9


def test_a_view_of_two_joints_gives_their_distance_and_no_camera() -> None:
    session = exact_session(legs=((0, 1, 2, 3, 4), (0, 2, 4, 5), (1, 5)))
    base = _locate(session, five_millimetres_away(session.machine))
    assert np.abs(base.A_Rb - session.machine.parameters.base_joints).max() < 1e-9
    assert [T is None for T in base.T_Rb_camera] == [False, False, True]


def test_a_joint_that_hangs_on_one_distance_is_refused_though_eq12_counts_enough() -> None:
    session = exact_session(legs=((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (4, 5)))
    with pytest.raises(NotIdentifiable, match=r"those of leg6 can move.*by view: 5, 5, 2"):
        _locate(session, session.machine)


def test_three_pairs_are_refused_although_together_they_might_be_enough() -> None:
    session = exact_session(legs=((0, 1), (2, 3), (4, 5)))
    with pytest.raises(NotIdentifiable, match="could not be tied together"):
        _locate(session, session.machine)


def test_joints_that_were_never_seen_together_are_refused() -> None:
    session = exact_session()
    joints = locate_joints_in_cameras(
        nominal_of(session.machine), session.axes, session.measurements
    )
    alone = np.zeros_like(joints.located)
    alone[0, 0] = True
    with pytest.raises(NotIdentifiable, match=r"by view: 1, 0, 0"):
        locate_joints_in_base(nominal_of(session.machine), replace(joints, located=alone))


def test_eq09_does_not_leave_joints_at_nominal_that_are_in_none_of_its_products() -> None:
    session = exact_session(legs=((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (5,)))
    with pytest.raises(NotIdentifiable, match=r"base joints of leg6 together.*by view: 5, 5, 1"):
        _locate(session, session.machine, "literal")


def test_eq09_with_fewer_products_than_unknowns_is_refused() -> None:
    session = exact_session(legs=((0, 1), (2, 3), (4, 5)))
    words = r"found 3 scalar products in all views for 12 unknowns .*by view: 2, 2, 2"
    with pytest.raises(NotIdentifiable, match=words):
        _locate(session, session.machine, "literal")
