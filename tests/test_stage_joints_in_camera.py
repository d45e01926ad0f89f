"""Step 1: eq (6)."""

from dataclasses import replace

import numpy as np
import pytest
from staged_hexapods import exact_session, noisy_session

from legcal.data.axes import LegAxes
from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.paper.joints_in_camera import JointsInCamera, locate_joints_in_cameras
from legcal.paper.nominal import Criteria
from legcal.simulation.hexapod import HexapodSession
from legcal.simulation.observe import OutlineNoise
from legcal.simulation.paper import nominal_of


def _locate(session: HexapodSession, axes: LegAxes, criteria: Criteria) -> JointsInCamera:
    return locate_joints_in_cameras(
        nominal_of(session.machine), axes, session.measurements, criteria=criteria
    )


def _true(session: HexapodSession) -> Array:
    A_Rb = session.machine.parameters.base_joints
    return np.array([v.T_Rb_camera.inv().apply(A_Rb) for v in session.cameras])


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_eq06_exact_axes_meet_in_the_joint_centre(criteria: Criteria) -> None:
    session = exact_session()
    joints = _locate(session, session.axes, criteria)
    assert joints.located.sum() == 12
    error = np.linalg.norm(joints.A_camera - _true(session), axis=-1)[joints.located]
    assert error.max() < 1e-9


def test_weights_make_a_centre_far_better_and_its_covariance_true() -> None:
    default, literal, normalised = [], [], []
    for seed in range(4):
        session, _ = noisy_session(seed, OutlineNoise(0.2, 100), n_poses=10)
        true = _true(session)
        joints = _locate(session, session.axes, "default")
        plain = _locate(session, session.axes, "literal")
        for v, j in np.argwhere(joints.located):
            error = joints.A_camera[v, j] - true[v, j]
            default.append(error @ error)
            literal.append(np.sum((plain.A_camera[v, j] - true[v, j]) ** 2))
            normalised.append(error @ np.linalg.solve(joints.covariance[v, j, :3, :3], error))
    assert np.mean(default) < 0.25 * np.mean(literal)
    assert 2.0 < np.mean(normalised) < 5.0  # 3 by rights; outlier weights cost a little


def test_a_wrong_outline_hardly_moves_the_centre() -> None:
    session = exact_session(n_poses=10)
    M = session.axes.M.copy()
    M[0] += 0.02 * session.axes.basis[0, 0] + 0.02 * session.axes.basis[0, 1]
    joints = _locate(session, replace(session.axes, M=M), "default")
    error = np.linalg.norm(joints.A_camera - _true(session), axis=-1)[joints.located]
    assert error.max() < 2e-5


def test_a_leg_with_one_image_in_a_view_is_left_out_of_it_with_the_reason() -> None:
    session = exact_session()
    axes = session.axes
    view = session.measurements.view[axes.row]
    here = np.flatnonzero((view == 0) & (axes.leg == 2))
    keep = np.ones(len(axes), dtype=np.bool_)
    keep[here[1:]] = False
    joints = _locate(session, axes.choose(np.flatnonzero(keep)), "default")
    assert not joints.located[0, 2]
    assert joints.located[1, 2]
    (sentence,) = joints.diagnostics
    assert "leg3 in view c1 was left out: it was found in one image" in sentence


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_a_leg_that_never_turns_is_refused_by_name(criteria: Criteria) -> None:
    session = exact_session()
    axes = session.axes
    view = session.measurements.view[axes.row]
    u, M = axes.u.copy(), axes.M.copy()
    for v in range(3):
        here = (view == v) & (axes.leg == 4)
        if here.any():
            u[here], M[here] = u[here][0], M[here][0]
    with pytest.raises(NotIdentifiable, match="leg leg5 could not be located") as refusal:
        _locate(session, replace(axes, u=u, M=M), criteria)
    assert "its direction is the same in all 6 images" in str(refusal.value)


def test_directions_that_hardly_differ_are_refused() -> None:
    session = exact_session()
    axes = session.axes
    u = axes.u.copy()
    here = axes.leg == 4
    view = session.measurements.view[axes.row]
    for v in (1, 2):
        for i in np.flatnonzero(here & (view == v)):
            first = np.flatnonzero(here & (view == v))[0]
            u[i] = axes.u[first] + 2e-4 * (axes.u[i] - axes.u[first])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    with pytest.raises(NotIdentifiable, match="directions differ too little"):
        _locate(session, replace(axes, u=u, basis=normal_basis(u)), "default")


def test_a_leg_that_no_view_shows_is_refused_by_name() -> None:
    session = exact_session(legs=((0, 1, 2, 3), (2, 3, 4), (0, 1, 4)))
    with pytest.raises(NotIdentifiable, match="leg leg6 could not be located: found no view"):
        _locate(session, session.axes, "default")
