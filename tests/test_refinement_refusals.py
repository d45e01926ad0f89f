"""What the fit refuses, starting values, and the predicted platform error."""

import dataclasses

import numpy as np
import pytest
from hexapod_session import (
    FRAME_LEGS,
    PINHOLE,
    TRUTH,
    Session,
    disturbed_start,
    geometry_of,
    joint_errors,
    moved_outlines,
    noisy_outlines,
    simulate,
)

from legcal.calibration.joint_fit.fit import refine, refine_from_best
from legcal.calibration.joint_fit.variables import (
    cameras_from_hints,
    fitted_legs,
    platform_poses,
    start_from,
)
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable
from legcal.files import motion_from_xyz_quat
from legcal.machine import LegKind, load_mechanism


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(6, legs_seen=5)


def test_two_images_are_too_few() -> None:
    two = simulate(1, n_views=2)
    with pytest.raises(
        NotIdentifiable,
        match=r"2 images with 16 outlines and 12 readings give \d+ equations for \d+ unknowns; add",
    ):
        refine(two.legs, two.measurements, two.outlines, disturbed_start(two))


def one_pose_many_times(n_times: int) -> Session:
    """Return a session in which three views see the same pose again and again."""
    once = simulate(1, shared_poses=True)
    m, o = once.measurements, once.outlines
    n = 3 * n_times
    measurements = Measurements(
        m.views,
        tuple(f"{i:03d}.png" for i in range(n)),
        np.tile(m.view, n_times),
        np.arange(n),
        np.tile(m.q, (n_times, 1)),
        m.sigma_q,
    )
    outlines = Outlines(
        np.concatenate([o.row + 3 * i for i in range(n_times)]),
        np.tile(o.leg, n_times),
        o.part * n_times,
        np.tile(o.edge, n_times),
        np.tile(o.h, (n_times, 1)),
        np.tile(o.ends, (n_times, 1, 1)),
        np.tile(o.covariance, (n_times, 1, 1)),
        np.tile(o.used, n_times),
        o.reason * n_times,
        o.source * n_times,
    )
    return dataclasses.replace(
        once, measurements=measurements, outlines=outlines, T_Rb_Re=once.T_Rb_Re * n
    )


def test_the_same_pose_again_and_again_is_refused() -> None:
    still = one_pose_many_times(6)
    start = start_from(
        geometry_of(TRUTH),
        still.measurements,
        still.legs,
        disturbed_start(still).T_camera_Rb,
        still.T_Rb_Re,
        "nominal",
    )
    with pytest.raises(NotIdentifiable, match=r"found \d+ of \d+ directions .* leave open .*leg"):
        refine(still.legs, still.measurements, still.outlines, start)


def test_no_outline_at_all_is_refused(session: Session) -> None:
    none = dataclasses.replace(session.outlines, used=np.zeros(len(session.outlines), np.bool_))
    with pytest.raises(NotIdentifiable, match="with 0 outlines and 108 readings"):
        refine(session.legs, session.measurements, none, disturbed_start(session))


def test_one_leg_alone_does_not_determine_the_others() -> None:
    session = simulate(15)
    noisy = noisy_outlines(session, np.random.default_rng(0))
    shown = dataclasses.replace(noisy, used=noisy.leg == 0)
    start = start_from(
        geometry_of(TRUTH),
        session.measurements,
        session.legs,
        session.T_camera_Rb,
        session.T_Rb_Re,
        "nominal",
    )
    with pytest.raises(NotIdentifiable, match=r"found \d+ of \d+ directions .* and that matter"):
        refine(session.legs, session.measurements, shown, start)


@pytest.mark.parametrize("n_left", [0, 1])
def test_a_view_with_hardly_an_outline_neither_helps_nor_harms(n_left: int) -> None:
    session = simulate(12, legs_seen=5)
    of_last = np.flatnonzero(session.measurements.view[session.outlines.row] == 2)
    used = session.outlines.used.copy()
    used[of_last[n_left:]] = False
    found = refine(
        session.legs,
        session.measurements,
        dataclasses.replace(session.outlines, used=used),
        disturbed_start(session),
    )
    assert np.abs(joint_errors(found.parameters)).max() < 1e-9


def test_a_start_far_away_is_refused(session: Session) -> None:
    far = disturbed_start(session, joints=0.1, camera=0.5, angle=2.0)
    with pytest.raises(DidNotConverge, match=r"still falls by|outlines disagree with it"):
        refine(session.legs, session.measurements, session.outlines, far)
    with pytest.raises(DidNotConverge, match=r"still falls|disagree") as refused:
        refine_from_best(session.legs, session.measurements, session.outlines, [far, far])
    assert len(refused.value.problems) == 1
    with pytest.raises(DidNotConverge, match="needs at least one"):
        refine_from_best(session.legs, session.measurements, session.outlines, [])


def test_swapped_edges_are_refused_instead_of_fitted_with_negative_radii(session: Session) -> None:
    swapped = dataclasses.replace(session.outlines, edge=3 - session.outlines.edge)
    with pytest.raises(DidNotConverge, match=r"right legs and edges|disagree with it"):
        refine(session.legs, session.measurements, swapped, disturbed_start(session))


def test_outlines_that_mostly_disagree_are_refused(session: Session) -> None:
    rng = np.random.default_rng(0)
    errors = rng.uniform(-15.0, 15.0, (len(session.outlines), 2))
    wrong = moved_outlines(session.outlines, PINHOLE, errors)
    with pytest.raises(DidNotConverge, match=r"disagree with it and the others are \d+.\d px off"):
        refine(session.legs, session.measurements, wrong, disturbed_start(session))


def test_a_covariance_that_is_none_is_refused(session: Session) -> None:
    covariance = session.outlines.covariance.copy()
    covariance[3] = [[0.01, 0.02], [0.02, 0.01]]
    bad = dataclasses.replace(session.outlines, covariance=covariance)
    with pytest.raises(DatasetError, match=r"leg\d in c1_000.png .* not positive definite"):
        refine(session.legs, session.measurements, bad, disturbed_start(session))


def test_a_part_that_the_mechanism_does_not_have_is_refused(session: Session) -> None:
    o = session.outlines
    bad = dataclasses.replace(o, part=("tube", *o.part[1:]))
    with pytest.raises(DatasetError, match=r"leg\d\.tube could not be used"):
        refine(session.legs, session.measurements, bad, disturbed_start(session))


def test_views_without_a_rough_pose_are_named(session: Session) -> None:
    T = motion_from_xyz_quat([0.1, 0.2, 0.3], [0.0, 0.0, 0.6, 0.8])
    with pytest.raises(DatasetError, match="c1, c2, c3 have no T_base_camera"):
        cameras_from_hints(session.measurements, T)
    views = tuple(View(v.name, v.camera, T) for v in session.measurements.views)
    hinted = dataclasses.replace(session.measurements, views=views)
    for T_camera_Rb in cameras_from_hints(hinted, T):
        np.testing.assert_allclose(T_camera_Rb.as_matrix(), np.eye(4), atol=1e-15)


def test_platform_poses_have_the_lengths_of_the_readings(session: Session) -> None:
    m = session.measurements
    start = start_from(
        geometry_of(TRUTH),
        m,
        session.legs,
        session.T_camera_Rb,
        disturbed_start(session, camera=0.02, angle=0.1).T_Rb_Re,
        "nominal",
    )
    for found, true in zip(start.T_Rb_Re, session.T_Rb_Re, strict=True):
        assert np.linalg.norm((found.inv() * true).translation) < 1e-11


def test_lengths_that_no_pose_has_give_the_nearest_pose(session: Session) -> None:
    lengths = session.measurements.q + TRUTH.offsets
    lengths[0, 2] += 0.4
    poses = platform_poses(geometry_of(TRUTH), lengths, session.T_Rb_Re, FRAME_LEGS)
    assert np.all(np.isfinite(poses[0].as_matrix()))
    np.testing.assert_allclose(poses[1].as_matrix(), session.T_Rb_Re[1].as_matrix(), atol=1e-9)


def test_legs_of_a_mechanism_bring_names_signs_axes_and_radii() -> None:
    machine = load_mechanism("tricept")
    legs = fitted_legs(machine)
    assert legs.names == machine.leg_names
    assert legs.sign.tolist() == machine.sign.tolist()
    assert legs.frame_legs == tuple(machine.frame_legs)
    assert legs.spatial
    assert legs.radii[3, "centre_rod"] == machine.legs[3].radius_of_part["centre_rod"]
    assert "centre.base_axis.1" in legs.parametrization.names
    assert "centre.twist" in legs.parametrization.names
    assert not fitted_legs(load_mechanism("3-rpr")).spatial


def test_a_passive_leg_needs_no_reading() -> None:
    session = simulate(10, legs_seen=6)
    q = session.measurements.q.copy()
    q[:, 3] = np.nan
    start = disturbed_start(session)
    passive = [
        dataclasses.replace(leg, kind=LegKind.PASSIVE) if j == 3 else leg
        for j, leg in enumerate(start.legs)
    ]
    start = dataclasses.replace(start, legs=tuple(passive))
    legs = dataclasses.replace(session.legs, nominal=start.legs)
    found = refine(legs, dataclasses.replace(session.measurements, q=q), session.outlines, start)
    error = joint_errors(found.parameters)
    assert np.isnan(error[-3])
    assert np.nanmax(np.abs(error)) < 1e-9
    assert "leg4.offset" not in found.names
    assert found.kinematic_covariance.shape == (29, 29)
