"""Section 3.2: base joint centres and revolute axes in the camera frames, eqs (6) and (7).

All axes of one leg in the images of one view meet in its base joint centre A, and are normal
to the revolute axis v of that joint. In a planar mechanism the axes of a view are one normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.observations.leg_axes import LegAxes, choose_axes
from legcal.observations.measurements import Measurements
from legcal.stages.base_unknowns import nominal_axes
from legcal.stages.bundles import Bundles
from legcal.stages.camera_starts import camera_starts, signs_seen
from legcal.stages.doubts import too_few_directions, too_tilted, too_uncertain
from legcal.stages.meeting_axes import flipped, plain_axes, weighted_joints
from legcal.stages.meeting_points import nearest_points, plain_information, weighted_points
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.plane_sides import side_of_plane


@dataclass(frozen=True, eq=False)
class JointsInCamera:
    """Base joint centres and revolute axes in the frame of each view.

    Attributes
    ----------
    A_camera : (n_views, n_legs, 3) array
        Centres in the camera frame [m]; zero where not located.
    located : (n_views, n_legs) array of bool
        Which centres were located.
    v_camera : (n_views, n_legs, 3) array
        Unit revolute axes in the camera frame, the common normal in a planar mechanism; zero
        where not located. They point as :func:`oriented` says.
    axis_located : (n_views, n_legs) array of bool
        Which axes were located.
    covariance : (n_views, n_legs, 5, 5) array
        Covariance of the centres [m^2] and of two turns of the axes about their
        :func:`legcal.geometry.lines.normal_basis` [rad^2]; zero where not located. Of a planar
        mechanism, that of each leg and the common normal.
    diagnostics : tuple of str
        Which legs were left out of which views, and why.
    sided : (n_views,) array of bool
        Planar mechanisms: where lengths of legs say from which side the camera sees the plane, so
        that the sign of the normal is known.
    """

    A_camera: Array
    located: BoolArray
    v_camera: Array
    axis_located: BoolArray
    covariance: Array
    diagnostics: tuple[str, ...]
    sided: BoolArray


def locate_joints_in_cameras(
    mechanism: NominalMechanism,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> JointsInCamera:
    """Locate base joint centres and revolute axes in each camera frame, eqs (6) and (7).

    Parameters
    ----------
    mechanism : NominalMechanism
        Names and joints of the legs; its base says to which side axes point.
    axes : LegAxes
        Leg axes in the camera frames.
    measurements : Measurements
        The view of each image.
    criteria : {"default", "literal"}
        ``literal`` solves (6) and then (7) as printed, every equation with the same weight.

    Returns
    -------
    JointsInCamera

    Raises
    ------
    NotIdentifiable
        If some leg is not located in any view: each needs two different directions in one.

    Notes
    -----
    The default weights the distance of A from each axis, and the angle of the axis to v, by the
    covariance of the axis: see :mod:`legcal.stages.meeting_points` and
    :mod:`legcal.stages.meeting_axes`. Axes that miss the others by far are given less.
    """
    key = measurements.view[axes.row] * mechanism.n_legs + axes.leg
    views, legs = np.divmod(np.unique(key), mechanism.n_legs)
    bundles = Bundles.of(key)
    spread = plain_information(axes, bundles)[0]
    reasons = [
        too_few_directions(*told) for told in zip(spread, bundles.counts.tolist(), strict=True)
    ]
    clear = np.flatnonzero([not reason for reason in reasons])
    bundles = bundles.some(np.isin(np.arange(len(reasons)), clear))
    A, v, C = _estimate(mechanism, axes, bundles, views[clear], legs[clear], criteria)
    has_axis = np.any(v != 0.0, axis=1)
    doubts = [""] * len(clear)
    if criteria == "default":
        for k, i in enumerate(clear):
            reasons[i] = too_uncertain(A[k], C[k, :3, :3])
            if has_axis[k] and not reasons[i]:
                doubts[k] = too_tilted(C[k, 3:, 3:])
    good = np.array([not reasons[i] for i in clear], dtype=np.bool_)
    good_axis = good & has_axis & np.array([not doubt for doubt in doubts], dtype=np.bool_)
    at = (views[clear], legs[clear])
    shape = (len(measurements.views), mechanism.n_legs)
    diagnostics = (
        *_left_out("base joint", mechanism, measurements, (views, legs), reasons),
        *_left_out("revolute axis", mechanism, measurements, at, doubts),
    )
    found = JointsInCamera(
        _laid_out(shape, at, np.where(good[:, None], A, 0.0)),
        _laid_out(shape, at, good),
        _laid_out(shape, at, np.where(good_axis[:, None], v, 0.0)),
        _laid_out(shape, at, good_axis),
        _laid_out(shape, at, np.where(good[:, None, None], C, 0.0)),
        diagnostics,
        np.zeros(shape[0], dtype=np.bool_),
    )
    _check_every_leg(mechanism, found.located, diagnostics)
    found = oriented(mechanism, found)
    return found if mechanism.spatial else _sided(mechanism, axes, measurements, found)


def oriented(mechanism: NominalMechanism, joints: JointsInCamera) -> JointsInCamera:
    """Return joints with their axes pointing to the side of the nominal axes.

    An axis in a camera is a line: (7) gives it up to its sign, while products of vectors need one.
    The nominal base is laid on the joints of each view, and each axis takes the sign with which it
    points to the side of its nominal axis. Where the joints lie on one line, the base is
    turned about it until the axes agree best, as lines. Where two turns agree alike, as for
    axes normal to the line between two joints, the sign remains a matter of choice: step 2 by
    default tries both. That of an axis whose joint is alone in its view does not matter. In a
    planar mechanism all axes are normal to that line, and lengths of legs decide
    (:mod:`legcal.stages.plane_sides`).
    """
    nominal, A_Rb = nominal_axes(mechanism), mechanism.parameters.base_joints
    signs = np.ones(joints.located.shape)
    for v, (located, with_axis) in enumerate(zip(joints.located, joints.axis_located, strict=True)):
        seen = joints.v_camera[v, with_axis]
        starts = camera_starts(A_Rb[located], nominal[with_axis], joints.A_camera[v, located], seen)
        if starts:
            signs[v, with_axis] = signs_seen(nominal[with_axis], seen, starts[0].T_Rb_camera)
    return with_signs(joints, signs)


def _sided(
    mechanism: NominalMechanism, axes: LegAxes, measurements: Measurements, joints: JointsInCamera
) -> JointsInCamera:
    """Return joints whose normals point up where the lengths of legs say which way that is."""
    signs, sided = np.ones(joints.located.shape), joints.sided.copy()
    view = measurements.view[axes.row]
    for v, with_axis in enumerate(joints.axis_located):
        legs = np.flatnonzero(with_axis)
        if len(legs) < 2:
            continue
        of_view = choose_axes(axes, np.flatnonzero(view == v))
        seen = joints.A_camera[v, legs], joints.v_camera[v, legs[0]], legs
        side = side_of_plane(mechanism, of_view, measurements, *seen)
        sided[v], signs[v] = side != 0.0, -1.0 if side < 0.0 else 1.0
    return replace(with_signs(joints, signs), sided=sided)


def with_signs(joints: JointsInCamera, signs: Array) -> JointsInCamera:
    """Return joints with the axes turned round whose sign (n_views, n_legs) is -1."""
    turned = (signs < 0.0)[..., None]
    return replace(
        joints,
        v_camera=np.where(turned, -joints.v_camera, joints.v_camera),
        covariance=np.where(turned[..., None], flipped(joints.covariance), joints.covariance),
    )


def _estimate(
    mechanism: NominalMechanism,
    axes: LegAxes,
    bundles: Bundles,
    views: IntArray,
    legs: IntArray,
    criteria: Criteria,
) -> tuple[Array, Array, Array]:
    """Return A (n, 3), v (n, 3), zero where there is none, and covariances (n, 5, 5) of bundles."""
    A, C_A = nearest_points(plain_information(axes, bundles))
    v, C = np.zeros((len(A), 3)), np.zeros((len(A), 5, 5))
    C[:, :3, :3] = C_A
    revolute = mechanism.revolute[legs] | (not mechanism.spatial)
    if criteria == "default" and not revolute.all():
        some = bundles.some(~revolute)
        A[~revolute], C[~revolute, :3, :3] = weighted_points(axes, some, A[~revolute])
    if revolute.any():
        some, pool = bundles.some(revolute), np.arange(int(revolute.sum()))
        if not mechanism.spatial:
            pool = np.unique(views[revolute], return_inverse=True)[1].ravel()
        v[revolute], C[revolute, 3:, 3:] = plain_axes(axes, some, pool)
        if criteria == "default":
            A[revolute], v[revolute], C[revolute] = weighted_joints(
                axes, some, pool, A[revolute], v[revolute]
            )
    return A, v, C


def _laid_out(shape: tuple[int, int], at: tuple[IntArray, IntArray], values: Any) -> Any:
    """Return values of bundles by view and leg, zero where there is no bundle."""
    found = np.zeros((*shape, *values.shape[1:]), dtype=values.dtype)
    found[at] = values
    return found


def _left_out(
    what: str,
    mechanism: NominalMechanism,
    measurements: Measurements,
    at: tuple[IntArray, IntArray],
    reasons: Sequence[str],
) -> tuple[str, ...]:
    """Return a sentence for each bundle that gives nothing, by view and leg."""
    return tuple(
        f"The {what} of leg {mechanism.leg_names[int(j)]} in view "
        f"{measurements.views[int(v)].name} was left out: {reason}."
        for v, j, reason in zip(*at, reasons, strict=True)
        if reason
    )


def _check_every_leg(
    mechanism: NominalMechanism, located: BoolArray, diagnostics: Sequence[str]
) -> None:
    """Refuse when a leg was located in no view."""
    missing = [mechanism.leg_names[int(j)] for j in np.flatnonzero(~located.any(axis=0))]
    if missing:
        raise NotIdentifiable(
            [
                f"The base joint of leg {name} could not be located: found no view that shows the "
                "leg in two different directions, needed one; add images in which it is visible."
                for name in missing
            ]
            + list(diagnostics)
        )
