"""Section 3.2: base joint centres and revolute axes in the camera frames, eqs (6) and (7).

All axes (u, M) of one leg in the images of one view meet in its base joint centre A, and are
normal to the revolute axis v of that joint:

    (M - A) x u = 0   (6)        v . u = 0   (7)

In a planar machine the axes v of a view are one common normal. Of rods on an actuator A moves with
its reading, (6') of :mod:`legcal.paper.carriers`. ``literal`` solves (6), then
(7), every equation with the same weight. What an image knows badly is the tilt of a leg towards
the camera: the default weights both by the covariances of the axes, robustly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.axes import LegAxes
from legcal.data.measurements import Measurements
from legcal.errors import NotIdentifiable
from legcal.geometry.axes import turned_axis
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.motions import register_points
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import Actuator
from legcal.paper.camera_poses import candidate_camera_poses, side_of_plane, signs_seen
from legcal.paper.carriers import (
    MIN_IMAGES,
    Carrier,
    CarrierColumns,
    linear_motion,
    points_on,
)
from legcal.paper.criteria import Criteria
from legcal.paper.nominal import NominalMachine

_WRONG_SCALE = 0.02  # of the motion of a carriage: as wrong as radii may be
_SURE = 5.0  # standard deviations
_LEAST = 1e-13  # of the largest information: what is known worse is not known
_SAME_DIRECTION = 1e-9  # of the normalised information: directions that differ by less are one
_MAX_SIGMA_CENTRE = 0.1  # of the distance to the camera
_MAX_SIGMA_TURN = 1.0  # [rad] of an axis; beyond, nothing is known of it
MAX_REWEIGHTINGS = 100
_MIN_REWEIGHTINGS = 10
_CONVERGED = 1e-6  # standard deviations: smaller steps no longer matter
_OUTLIER = 3.0  # an axis with a residual of this many times the median has half its weight
_MIN_THRESHOLD = 1e-3  # standard deviations: smaller residuals are rounding
_MAX_STEP = 0.2  # [rad] of an axis, and in its distance of a centre
_LINEAR = 5  # weighted solutions of (6') before its condition is kept exactly


@dataclass(frozen=True, eq=False)
class JointsInCamera:
    """Base joint centres and revolute axes in the frame of each view; zero where not located."""

    A_camera: Array  # (n_views, n_legs, 3) [m]; on actuators at reading 0
    located: BoolArray  # (n_views, n_legs)
    v_camera: Array  # (n_views, n_legs, 3); the common normal in a plane; signs: :func:`oriented`
    axis_located: BoolArray  # (n_views, n_legs)
    # (n_views, n_legs, 5, 5), of A [m^2] and of two turns of v about its normal basis [rad^2]; in
    # a plane that of each leg and the common normal
    covariance: Array
    diagnostics: tuple[str, ...]  # which legs were left out of which views, and why
    # (n_views,), planar machines: lengths of legs decide from which side the camera sees the plane,
    # so that the sign of the normal is known
    sided: BoolArray
    # by view and leg, of located joints that actuators move: what carries them
    carriers: Mapping[tuple[int, int], Carrier] = field(default_factory=dict)

    def A_at(self, view: IntArray, leg: IntArray, q: Array) -> Array:
        """Return A in the cameras of views (k,) of legs (k,) at readings (k,), (k, 3) [m]."""
        A = self.A_camera[view, leg]
        for here, carrier in self.carried(view, leg):
            A[here] = carrier.at(q[here])[0]
        return A

    def v_at(self, view: IntArray, leg: IntArray, q: Array) -> Array:
        """Return the revolute axes in the same way, (k, 3)."""
        v = self.v_camera[view, leg]
        for here, carrier in self.carried(view, leg):
            v[here] = np.where(
                np.any(v[here], axis=1, keepdims=True), carrier.axis_at(q[here])[0], 0.0
            )
        return v

    def carried(self, view: IntArray, leg: IntArray) -> list[tuple[IntArray, Carrier]]:
        """Return which of some views and legs (k,) each carrier is that of."""
        found = [
            (np.flatnonzero((view == v) & (leg == j)), carrier)
            for (v, j), carrier in self.carriers.items()
        ]
        return [(here, carrier) for here, carrier in found if len(here)]


def locate_joints_in_cameras(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    *,
    criteria: Criteria = "default",
) -> JointsInCamera:
    """Locate base joint centres and revolute axes in each camera frame, eqs (6) and (7).

    Raises NotIdentifiable if some leg has two different directions in no view, or a rod on an
    actuator too few in all.
    """
    names, n_legs = machine.leg_names, machine.n_legs
    if not machine.spatial and machine.carried.any():
        raise NotIdentifiable(
            "The four steps could not be run: found joints at the base that actuators move in a "
            "machine that moves in a plane, needed a machine that moves in space; use the joint "
            "fit alone."
        )
    found = _joints_of_bundles(machine, axes, measurements, criteria)
    shape = (len(measurements.views), n_legs)
    located, axis_located = np.zeros((2, *shape), dtype=np.bool_)
    located[found.at], axis_located[found.at] = found.good, found.good_axis
    missing = [(j, names[j]) for j in np.flatnonzero(~located.any(axis=0)).tolist()]
    if missing:
        raise NotIdentifiable(
            [
                f"The base joint of leg {name} could not be located: found no view that shows the "
                f"{_needed(machine, j)}, needed one; add images in which it is visible."
                for j, name in missing
            ]
            + list(found.diagnostics)
        )
    A_camera, v_camera, covariance = (np.zeros((*shape, *n)) for n in ((3,), (3,), (5, 5)))
    A_camera[found.at] = np.where(found.good[:, None], found.A, 0.0)
    v_camera[found.at] = np.where(found.good_axis[:, None], found.v, 0.0)
    covariance[found.at] = np.where(found.good[:, None, None], found.covariance, 0.0)
    unsided = np.zeros(len(located), dtype=np.bool_)
    joints = oriented(
        machine,
        JointsInCamera(
            A_camera,
            located,
            v_camera,
            axis_located,
            covariance,
            found.diagnostics,
            unsided,
            {at: carrier for at, carrier in found.carriers.items() if located[at]},
        ),
    )
    return joints if machine.spatial else _sided(machine, axes, measurements, joints)


class _JointsOfBundles(NamedTuple):
    """Joints by the axes of one leg in one view each, n of them."""

    at: tuple[IntArray, IntArray]  # views and legs, (n,) each
    A: Array  # (n, 3)
    v: Array  # (n, 3); zero without an axis
    covariance: Array  # (n, 5, 5)
    good: BoolArray  # (n,) which centres are known well enough
    good_axis: BoolArray  # (n,) which axes are
    carriers: Mapping[tuple[int, int], Carrier]
    diagnostics: tuple[str, ...]


def _joints_of_bundles(
    machine: NominalMachine, axes: LegAxes, measurements: Measurements, criteria: Criteria
) -> _JointsOfBundles:
    """Return the joints of every leg in every view that its axes there determine, (6) and (7)."""
    key = measurements.view[axes.row] * machine.n_legs + axes.leg
    views, legs = np.divmod(np.unique(key), machine.n_legs)
    bundles = Bundles.of(key)
    information, _ = _plain_equations(axes, bundles)
    reasons = [
        "" if moves else _no_single_point(F, n)
        for F, n, moves in zip(
            information, bundles.counts.tolist(), machine.carried[legs].tolist(), strict=True
        )
    ]
    rods = {
        (int(views[i]), int(legs[i])): bundles.rows[bundles.bundle == i]
        for i in np.flatnonzero(machine.carried[legs]).tolist()
    }
    carriers, why_not, scales = _carried_joints(machine, axes, measurements, rods, criteria)
    reasons = [
        why_not.get(place, reason)
        for place, reason in zip(
            zip(views.tolist(), legs.tolist(), strict=True), reasons, strict=True
        )
    ]
    clear = np.array([not reason for reason in reasons], dtype=np.bool_)
    at = views[clear], legs[clear]
    A, v, covariance = _estimate(machine, axes, bundles.some(clear), *at, carriers, criteria)
    has_axis = np.any(v != 0.0, axis=1)
    axis_reasons = [""] * len(A)
    if criteria == "default":
        for k, i in enumerate(np.flatnonzero(clear)):
            if not machine.carried[legs[i]]:
                reasons[i] = _uncertain_centre(A[k], covariance[k, :3, :3])
            if has_axis[k] and not reasons[i]:
                axis_reasons[k] = _uncertain_axis(covariance[k, 3:, 3:])
    good = np.array([not reason for reason in reasons], dtype=np.bool_)[clear]
    good_axis = good & has_axis & np.array([not reason for reason in axis_reasons], dtype=np.bool_)
    diagnostics = tuple(
        f"The {what} of leg {machine.leg_names[leg]} in view {measurements.views[view].name} was "
        f"left out: {reason}."
        for what, places, said in (
            ("base joint", (views, legs), reasons),
            ("revolute axis", at, axis_reasons),
        )
        for view, leg, reason in zip(*(place.tolist() for place in places), said, strict=True)
        if reason
    )
    return _JointsOfBundles(at, A, v, covariance, good, good_axis, carriers, diagnostics + scales)


def _no_single_point(information: Array, n_images: int) -> str:
    """Return why (6) has no single solution, or an empty string."""
    if float(np.linalg.eigvalsh(information)[0]) > _SAME_DIRECTION * n_images:
        return ""
    if n_images == 1:
        return "it was found in one image, and at least two different directions are needed"
    return f"its direction is the same in all {n_images} images, and two are needed"


def _needed(machine: NominalMachine, leg: int) -> str:
    """Return in what a view must show a leg for its joint to be located."""
    actuator = machine.legs[leg].actuator
    if actuator is None:
        return "leg in two different directions"
    return f"leg at {MIN_IMAGES[actuator.turns]} different readings of {actuator.joint}"


def _uncertain_centre(A: Array, covariance: Array) -> str:
    """Return why a centre is not determined, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    distance = float(np.linalg.norm(A))
    if sigma <= _MAX_SIGMA_CENTRE * distance:
        return ""
    return (
        f"its directions differ too little to say where they meet (sigma {1e3 * sigma:.0f} mm "
        f"at {1e3 * distance:.0f} mm from the camera)"
    )


def _uncertain_axis(covariance: Array) -> str:
    """Return why an axis is not determined, or an empty string."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if sigma <= _MAX_SIGMA_TURN:
        return ""
    return (
        "its leg's directions differ too little to say what they are normal to "
        f"(sigma {np.degrees(sigma):.0f} deg)"
    )


# Signs of axes


def oriented(machine: NominalMachine, joints: JointsInCamera) -> JointsInCamera:
    """Return joints with their axes pointing to the side of the nominal axes.

    An axis in a camera is a line: (7) gives it up to its sign, while products of vectors need one.
    The nominal base is laid on the joints of each view, and each axis takes the sign with which it
    points to the side of its nominal axis. Where two turns about a line of joints agree alike, the
    sign remains a matter of choice: step 2 by default tries both. That of an axis whose joint is
    alone in its view does not matter. In a planar machine lengths of legs decide afterwards.
    """
    nominal = machine.base_normals
    signs = np.ones(joints.located.shape)
    for v, with_axis in enumerate(joints.axis_located):
        seen = joints.v_camera[v, with_axis]
        A_Rb, A_camera = points_in_both(machine, joints, v)
        poses, _ = candidate_camera_poses(A_Rb, nominal[with_axis], A_camera, seen)
        if poses:
            signs[v, with_axis] = signs_seen(nominal[with_axis], seen, poses[0])
    return with_signs(joints, signs)


def points_in_both(
    machine: NominalMachine, joints: JointsInCamera, view: int
) -> tuple[Array, Array]:
    """Return points of the base (n, 3) that a view locates, in R_b and in the camera [m].

    They are the joints, and of those that actuators move three places along the travel.
    """
    A_Rb, A_camera = list[Array](), list[Array]()
    for j in np.flatnonzero(joints.located[view]).tolist():
        leg, carrier = machine.legs[j], joints.carriers.get((view, j))
        if leg.actuator is None or carrier is None:
            A_Rb.append(leg.A[None])
            A_camera.append(joints.A_camera[view, j][None])
        else:
            A_Rb.append(points_on(leg.actuator, leg.A))
            A_camera.append(points_on(carrier.actuator, carrier.A))
    none = np.zeros((0, 3))
    return np.concatenate([none, *A_Rb]), np.concatenate([none, *A_camera])


def _sided(
    machine: NominalMachine, axes: LegAxes, measurements: Measurements, joints: JointsInCamera
) -> JointsInCamera:
    """Return joints whose normals point up where the lengths of legs decide which way that is."""
    signs, sided = np.ones(joints.located.shape), joints.sided.copy()
    view = measurements.view[axes.row]
    for v, with_axis in enumerate(joints.axis_located):
        legs = np.flatnonzero(with_axis)
        if len(legs) < 2:
            continue
        of_view = axes.choose(np.flatnonzero(view == v))
        seen = joints.A_camera[v, legs], joints.v_camera[v, legs[0]], legs
        side = side_of_plane(machine, of_view, measurements, *seen)
        sided[v], signs[v] = side != 0.0, -1.0 if side < 0.0 else 1.0
    return replace(with_signs(joints, signs), sided=sided)


def with_signs(joints: JointsInCamera, signs: Array) -> JointsInCamera:
    """Return joints with the axes turned round whose sign (n_views, n_legs) is -1."""
    turned_round = (signs < 0.0)[..., None]
    e2 = np.array([1.0, 1.0, 1.0, 1.0, -1.0])  # of the normal basis changes its sign with v
    flipped = joints.covariance * np.outer(e2, e2)
    carriers = dict(joints.carriers)
    for at in [at for at in carriers if signs[at] < 0.0]:
        sign = np.append(e2, np.ones(CarrierColumns.COUNT - len(e2)))
        covariance = carriers[at].covariance * np.outer(sign, sign)
        carriers[at] = replace(carriers[at], v=-carriers[at].v, covariance=covariance)
    return replace(
        joints,
        carriers=carriers,
        v_camera=np.where(turned_round, -joints.v_camera, joints.v_camera),
        covariance=np.where(turned_round[..., None], flipped, joints.covariance),
    )


# Estimation of many joints at once


@dataclass(frozen=True, eq=False)
class Bundles:
    """Axes in bundles, each of one leg in one view, whose axes meet in one point."""

    rows: IntArray  # (k,): the axes, bundle by bundle
    counts: IntArray  # (n,): how many axes each bundle has

    @classmethod
    def of(cls, key: IntArray) -> Bundles:
        """Return the bundles of axes with equal keys, by key."""
        return cls(np.argsort(key, kind="stable"), np.unique(key, return_counts=True)[1])

    @property
    def bundle(self) -> IntArray:
        """The bundle of each of ``rows``, (k,)."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def some(self, wanted: BoolArray) -> Bundles:
        """Return some of the bundles."""
        return Bundles(self.rows[wanted[self.bundle]], self.counts[wanted])

    def total(self, values: Array) -> Array:
        """Return the sum over each bundle of values of ``rows``."""
        if len(self.counts) == 0:
            return np.zeros((0, *values.shape[1:]))
        return np.asarray(np.add.reduceat(values, np.cumsum(self.counts) - self.counts))

    def median(self, values: Array) -> Array:
        """Return the median over each bundle of values (k,) of ``rows``."""
        ordered = values[np.lexsort((values, self.bundle))]
        first = np.cumsum(self.counts) - self.counts
        low, high = first + (self.counts - 1) // 2, first + self.counts // 2
        return np.asarray(0.5 * (ordered[low] + ordered[high]))


def _estimate(
    machine: NominalMachine,
    axes: LegAxes,
    bundles: Bundles,
    views: IntArray,
    legs: IntArray,
    carriers: Mapping[tuple[int, int], Carrier],
    criteria: Criteria,
) -> tuple[Array, Array, Array]:
    """Return A (n, 3), v (n, 3), zero where there is none, and covariances (n, 5, 5) of bundles.

    Those that actuators move are those of *carriers*.
    """
    A, v = np.zeros((2, len(legs), 3))
    C, carried = np.zeros((len(legs), 5, 5)), machine.carried[legs]
    for k in np.flatnonzero(carried).tolist():
        carrier = carriers[int(views[k]), int(legs[k])]
        A[k], v[k], C[k] = carrier.A, carrier.v, carrier.covariance[:5, :5]
    A[~carried], C[~carried, :3, :3] = _nearest_points(
        *_plain_equations(axes, bundles.some(~carried))
    )
    revolute = ~carried & (machine.revolute[legs] | (not machine.spatial))
    points = ~carried & ~revolute
    if criteria == "default" and points.any():
        some = bundles.some(points)
        A[points], C[points, :3, :3] = _weighted_points(axes, some, A[points])
    if revolute.any():
        # Bundles of one pool share v: each its own, or all of a view in a plane.
        some, pool = bundles.some(revolute), np.arange(int(revolute.sum()))
        if not machine.spatial:
            pool = np.unique(views[revolute], return_inverse=True)[1].ravel()
        v[revolute], C[revolute, 3:, 3:] = _plain_axes(axes, some, pool)
        if criteria == "default":
            A[revolute], v[revolute], C[revolute] = _weighted_joints(
                axes, some, pool, A[revolute], v[revolute]
            )
    return A, v, C


def _plain_equations(axes: LegAxes, bundles: Bundles) -> tuple[Array, Array]:
    """Return the normal equations of (6), (n, 3, 3) and (n, 3): sums of I - u u' and of its M."""
    u, M = axes.u[bundles.rows], axes.M[bundles.rows]
    normal = np.eye(3) - u[:, :, None] * u[:, None, :]
    return bundles.total(normal), bundles.total(np.einsum("kij,kj->ki", normal, M))


def _nearest_points(normal: Array, right: Array) -> tuple[Array, Array]:
    """Return the least-squares points A (n, 3) and the inverses of their normal matrices."""
    inverse = np.asarray(np.linalg.inv(normal))
    return np.asarray((inverse @ right[..., None])[..., 0]), inverse


def _plain_axes(axes: LegAxes, bundles: Bundles, pool: IntArray) -> tuple[Array, Array]:
    """Return v (n, 3) of (7) of any sign, and inverse normal matrices (n, 2, 2) by its turns."""
    u = axes.u[bundles.rows]
    scatter = _by_pool(bundles.total(u[:, :, None] * u[:, None, :]), pool)
    v = np.linalg.eigh(scatter)[1][:, :, 0]
    N = normal_basis(v)
    information = N[:, ::-1] @ scatter @ np.swapaxes(N[:, ::-1], 1, 2)
    information *= np.array([[1.0, -1.0], [-1.0, 1.0]])  # v turned about e1 by t is v - t e2
    return v[pool], np.asarray(np.linalg.inv(information))[pool]


def _weighted_points(axes: LegAxes, bundles: Bundles, A: Array) -> tuple[Array, Array]:
    """Return the points nearest to axes in units of their covariances, and their covariances.

    The covariance at A depends on A: the weights are computed again until A stays.
    """
    A, C = A.copy(), np.zeros((len(A), 3, 3))

    def update(active: IntArray) -> Array:
        some, before = bundles.some(np.isin(np.arange(len(A)), active)), A[active]
        E, M = axes.basis[some.rows], axes.M[some.rows]
        nowhere = np.zeros((len(some.rows), 3))
        residual, spread, _ = joint_residuals(axes, some.rows, before[some.bundle], nowhere)
        weight = _robust_weights(some, residual[:, :2], spread[:, :2, :2])
        normal = np.swapaxes(E, -1, -2) @ weight @ E
        right = (normal @ M[..., None])[..., 0]
        A[active], C[active] = _nearest_points(some.total(normal), some.total(right))
        return A[active] - before

    _until_converged(update, A, C, np.arange(len(A)))
    return A, C


def _weighted_joints(
    axes: LegAxes, bundles: Bundles, pool: IntArray, A: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return A, v of revolute joints and covariances (n, 5, 5), (6) and (7) weighted together.

    The tilt of a leg towards the camera enters the residual of A, in proportion to the distance,
    and the angle to v: both are weighted by their joint covariance. The derivatives are those at
    the adjusted directions, which meet in A and are normal to v; at the observed ones, tilts would
    pass for turns, and v would come out biased.
    """
    A, v, C = A.copy(), v.copy(), np.zeros((len(A), 5, 5))

    def update(active: IntArray) -> Array:
        some = bundles.some(np.isin(np.arange(len(A)), active))
        rows, bundle, before = some.rows, some.bundle, v[active]
        residual, spread, tilt = joint_residuals(axes, rows, A[active][bundle], before[bundle])
        weight = _robust_weights(some, residual, spread)
        alpha = (tilt @ np.linalg.solve(spread, residual[..., None]))[..., 0]
        J = residual_jacobian(axes, rows, before[bundle], alpha)
        back = np.swapaxes(J, 1, 2) @ weight
        right = (back @ residual[..., None])[..., 0]
        of_pool = np.unique(pool[active], return_inverse=True)[1].ravel()
        step, C[active] = _pooled(some.total(back @ J), some.total(right), of_pool)
        # Within _MAX_STEP the equations are nearly linear.
        of_A, of_v = np.linalg.norm(step[:, :3], axis=1), np.linalg.norm(step[:, 3:], axis=1)
        size = np.maximum(of_A / np.linalg.norm(A[active], axis=1), of_v)
        step /= np.maximum(size / _MAX_STEP, 1.0)[:, None]
        A[active] -= step[:, :3]
        v[active] = turned_axis(before, -step[:, 3:])
        return step

    _until_converged(update, A, C, pool)
    return A, v, C


# Joints that actuators move


_Place = tuple[int, int]  # view and leg


def _carried_joints(
    machine: NominalMachine,
    axes: LegAxes,
    measurements: Measurements,
    rods: Mapping[_Place, IntArray],
    criteria: Criteria,
) -> tuple[dict[_Place, Carrier], dict[_Place, str], tuple[str, ...]]:
    """Return what carries joints, from the axes of each rod in a view, or why not, (6') and (7).

    The weighted criterion starts from the linear solution, and from the nominal machine where all
    rods of the view have it; the better end is kept. Last come scales that disagree.
    """
    found, why_not = dict[_Place, Carrier](), dict[_Place, str]()
    q = {place: measurements.q[axes.row[rows], place[1]] for place, rows in rods.items()}
    for place, rows in rods.items():
        carrier = _linear_carrier(machine, axes, rows, q[place], place[1], criteria)
        if isinstance(carrier, str):
            why_not[place] = carrier
        else:
            found[place] = carrier
    if criteria == "literal":
        return found, why_not, ()
    starts = _nominal_carriers(machine, axes, rods, q, found)
    scales = dict[str, list[float]]()
    for place in list(found):
        ends = [
            _weighted_carrier(axes, rods[place], q[place], start)
            for start in (found.pop(place), starts[place])
        ]
        carrier, _, scale = min(ends, key=lambda end: end[1])
        why_not[place] = _uncertain_carrier(carrier, q[place])
        if not why_not[place]:
            found[place] = carrier
            if scale:
                scales.setdefault(carrier.actuator.joint, []).append(scale)
    wrong = tuple(
        f"The outlines show '{joint}' moving {np.median(scale):.2f} mm where its readings say "
        "1 mm; check the unit of the readings, the radii of the rods, and the camera."
        for joint, scale in scales.items()
    )
    return found, why_not, wrong


def _linear_carrier(
    machine: NominalMachine,
    axes: LegAxes,
    rows: IntArray,
    q: Array,
    leg: int,
    criteria: Criteria,
) -> Carrier | str:
    """Return a joint by (6'), linear, and (7) in the carriage or arm; or why there is none."""
    nominal = machine.legs[leg].actuator
    if nominal is None:
        raise ValueError("a leg that hangs on no actuator")
    n, least = len(np.unique(q)), MIN_IMAGES[nominal.turns]
    if n < least:
        readings = "reading" if n == 1 else "readings"
        return f"it was found at {n} {readings} of {nominal.joint}, and {least} are needed"
    u, M, E = axes.u[rows], axes.M[rows], axes.basis[rows]
    one, nowhere = Bundles(rows, np.array([len(rows)])), np.zeros((len(rows), 3))
    normal = np.eye(3) - u[:, :, None] * u[:, None, :]
    for _ in range(1 + (_LINEAR if criteria == "default" else 0)):
        start = linear_motion(nominal, q, normal, M)
        if start is None:
            return (
                f"its directions at {n} readings of {nominal.joint} do not determine how the joint "
                "moves"
            )
        A, actuator = start
        residual, spread, _ = joint_residuals(axes, rows, actuator.at(A, q), nowhere)
        weight = _robust_weights(one, residual[:, :2], spread[:, :2, :2])
        normal = np.swapaxes(E, -1, -2) @ weight @ E
    v = np.zeros(3)
    if machine.revolute[leg]:
        there = np.einsum("kji,kj->ki", actuator.rotations(q), u)
        v = np.linalg.eigh(there.T @ there)[1][:, 0]
    return Carrier(A, v, actuator, np.zeros((CarrierColumns.COUNT,) * 2))


def _nominal_carriers(
    machine: NominalMachine,
    axes: LegAxes,
    rods: Mapping[_Place, IntArray],
    q: Mapping[_Place, Array],
    found: Mapping[_Place, Carrier],
) -> dict[_Place, Carrier]:
    """Return the nominal joints, laid on the axes of each view as one rigid body."""
    laid = dict[_Place, Carrier]()
    for view in sorted({v for v, _ in found}):
        places = [place for place in found if place[0] == view]
        rows = np.concatenate([rods[place] for place in places])
        leg = np.concatenate([np.full(len(q[place]), place[1]) for place in places])
        readings = np.concatenate([q[place] for place in places])
        A_Rb = machine.A_at(leg, readings)
        seen = np.concatenate([found[place].at(q[place])[0] for place in places])
        T = register_points(A_Rb, seen)
        one, nowhere = Bundles(rows, np.array([len(rows)])), np.zeros_like(A_Rb)
        for _ in range(_MIN_REWEIGHTINGS):
            A, E = T.apply(A_Rb), axes.basis[rows]
            residual, spread, _ = joint_residuals(axes, rows, A, nowhere)
            weight = _robust_weights(one, residual[:, :2], spread[:, :2, :2])
            J = np.concatenate([cross(A[:, None], E), E], axis=2)
            back = np.swapaxes(J, 1, 2) @ weight
            F, right = (back @ J).sum(axis=0), (back @ residual[:, :2, None]).sum(axis=0)[:, 0]
            step = -np.linalg.pinv(F, rcond=1e-12, hermitian=True) @ right
            step /= max(float(np.linalg.norm(step[:3])) / _MAX_STEP, 1.0)
            turn = Rotation.from_rotvec(step[:3])
            T = RigidTransform.from_components(step[3:], turn) * T
        for place in places:
            own = machine.legs[place[1]]
            if own.actuator is not None:
                v = found[place].v
                if v.any() and own.base_axis is not None:
                    v = T.rotation.apply(own.base_axis)
                actuator = own.actuator.in_frame(T.as_matrix())
                laid[place] = replace(found[place], A=T.apply(own.A), v=v, actuator=actuator)
    return laid


def _weighted_carrier(
    axes: LegAxes, rows: IntArray, q: Array, carrier: Carrier
) -> tuple[Carrier, float, float]:
    """Return the joint with (6') and (7) weighted together, as :func:`_weighted_joints`.

    Returns its robust cost too, and the length of its d where that is surely wrong, else 0.
    """
    columns, one = carrier.columns, Bundles(rows, np.array([len(rows)]))
    kept, u, E = slice(0, 3 if carrier.v.any() else 2), axes.u[rows], axes.basis[rows]
    carrier = carrier.moved(np.zeros(CarrierColumns.COUNT))
    for k in range(MAX_REWEIGHTINGS):
        (A, by_A), (v, by_v) = carrier.at(q), carrier.axis_at(q)
        residual, spread, tilt = joint_residuals(axes, rows, A, v)
        residual, spread, tilt = residual[:, kept], spread[:, kept, kept], tilt[:, :, kept]
        weight = _robust_weights(one, residual, spread)
        alpha = (tilt @ np.linalg.solve(spread, residual[..., None]))[..., 0]
        across = E - alpha[:, :, None] * u[:, None]
        better = u + np.einsum("kia,ki->ka", E, alpha)
        J = np.empty((len(rows), 3, CarrierColumns.COUNT))
        J[:, :2], J[:, 2] = across @ by_A, -np.einsum("ka,kac->kc", better, by_v)
        J = J[:, kept][..., columns]
        back = np.swapaxes(J, 1, 2) @ weight
        F, right = (back @ J).sum(axis=0), (back @ residual[..., None]).sum(axis=0)[:, 0]
        C = _covariance_of(F)
        step = np.zeros(CarrierColumns.COUNT)
        step[columns] = -C @ right
        far = np.linalg.norm(step[[0, 1, 2, 7, 8]]) / np.linalg.norm(A, axis=1).mean()
        size = max(float(far), float(np.linalg.norm(step[3:7])))
        if k >= _MIN_REWEIGHTINGS and np.all(step[columns] ** 2 <= _CONVERGED**2 * np.diag(C)):
            break
        carrier = carrier.moved(step / max(size / _MAX_STEP, 1.0))
    covariance = np.zeros_like(carrier.covariance)
    covariance[np.ix_(columns, columns)] = C
    chi = np.einsum("ki,kij,kj->k", residual, np.linalg.inv(spread), residual)
    by_gain = np.zeros((len(rows), 3))
    by_gain[:, :2] = np.einsum("kia,ka->ki", across, carrier.actuator.motion(carrier.A, q).by_gain)
    wrong = _wrong_scale(carrier.actuator, J, weight, residual, C, by_gain[:, kept])
    return replace(carrier, covariance=covariance), float(np.log1p(chi).sum()), wrong


def _covariance_of(F: Array) -> Array:
    """Return the inverse of an information matrix, large where nothing is known."""
    size = np.sqrt(np.diag(F))
    size = np.maximum(size, _LEAST * float(size.max()))
    values, vectors = np.linalg.eigh(F / np.outer(size, size))
    inverse = (vectors / np.maximum(values, _LEAST * values[-1])) @ vectors.T
    return np.asarray(inverse / np.outer(size, size))


def _wrong_scale(
    actuator: Actuator, J: Array, weight: Array, residual: Array, C: Array, by_gain: Array
) -> float:
    """Return the |d| of readings and outlines where it is surely not 1, else 0."""
    weighted = np.einsum("kij,kj->ki", weight, by_gain)
    mixed = np.einsum("kic,ki->c", J, weighted)
    information = float(np.sum(by_gain * weighted) - mixed @ C @ mixed)
    if actuator.turns or information <= 0.0:
        return 0.0
    change = -float(np.sum(residual * weighted)) / information
    return 0.0 if abs(change) < max(_WRONG_SCALE, _SURE / np.sqrt(information)) else 1.0 + change


def _uncertain_carrier(carrier: Carrier, q: Array) -> str:
    """Return why a joint that an actuator moves is not determined, or an empty string."""
    A, by_A = carrier.at(np.array([np.median(q)]))
    reason = _uncertain_centre(A[0], by_A[0] @ carrier.covariance @ by_A[0].T)
    of_axis = carrier.covariance[CarrierColumns.AXIS, CarrierColumns.AXIS]
    sigma = float(np.sqrt(np.linalg.eigvalsh(of_axis)[-1]))
    if reason or sigma <= _MAX_SIGMA_TURN:
        return reason
    return (
        f"its directions do not say how {carrier.actuator.joint} moves it "
        f"(sigma of the axis {np.degrees(sigma):.0f} deg)"
    )


# Weights and residuals


def _until_converged(
    update: Callable[[IntArray], Array], A: Array, C: Array, pool: IntArray
) -> None:
    """Update the bundles in place whose pools still move; ``update`` returns their steps.

    One that does not determine its joint would diverge, and is left where it is.
    """
    active = np.arange(len(A))
    for k in range(MAX_REWEIGHTINGS):
        step = update(active)
        if k + 1 < _MIN_REWEIGHTINGS:
            continue
        moves = np.any(step**2 > _CONVERGED**2 * np.einsum("nii->ni", C[active]), axis=1)
        sound = np.array(
            [not _uncertain_centre(A[i], C[i, :3, :3]) for i in active], dtype=np.bool_
        )
        active = active[sound & np.isin(pool[active], pool[active[moves & sound]])]
        if not len(active):
            break


def _robust_weights(bundles: Bundles, residual: Array, spread: Array) -> Array:
    """Return the inverses of covariances (k, r, r), less for residuals (k, r) far from the rest."""
    weight = np.linalg.inv(spread)
    chi = np.sqrt(np.einsum("ki,kij,kj->k", residual, weight, residual))
    limit = np.maximum(_OUTLIER * bundles.median(chi), _MIN_THRESHOLD)[bundles.bundle]
    return np.asarray(weight / (1.0 + (chi / limit) ** 2)[:, None, None])


def joint_residuals(
    axes: LegAxes, here: IntArray, A: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return the residuals of axes about points A and normals v (k, 3), (6) and (7).

    The observed axis at the height s of the point is M + s u + e (beta + s alpha), e = (e1, e2).
    Returns the residuals (k, 3): e . (A - M) [m] and -v . u; their covariance (k, 3, 3); and the
    covariance (k, 2, 3) of alpha with them.
    """
    arm, u, E = A - axes.M[here], axes.u[here], axes.basis[here]
    across = np.einsum("kia,ka->ki", E, arm)
    residual = np.column_stack([across, -np.sum(v * u, axis=1)])
    T = np.zeros((len(here), 3, 4))
    T[:, :2, :2] = np.sum(arm * u, axis=1)[:, None, None] * np.eye(2)
    T[:, :2, 2:] = np.eye(2)
    T[:, 2, :2] = np.einsum("kia,ka->ki", E, v)
    tilt = axes.covariance[here, :2] @ np.swapaxes(T, 1, 2)
    return residual, np.asarray(T @ axes.covariance[here] @ np.swapaxes(T, 1, 2)), tilt


def residual_jacobian(axes: LegAxes, here: IntArray, v: Array, alpha: Array) -> Array:
    """Return the derivative (k, 3, 5) of the residuals by A and turns of v, at u + e alpha."""
    N, E, u = normal_basis(v), axes.basis[here], axes.u[here]
    better = u + np.einsum("kia,ki->ka", E, alpha)
    J = np.zeros((len(here), 3, 5))
    J[:, :2, :3] = E - alpha[:, :, None] * u[:, None, :]
    J[:, 2, 3] = np.sum(N[:, 1] * better, axis=1)
    J[:, 2, 4] = -np.sum(N[:, 0] * better, axis=1)
    return J


def _pooled(F: Array, b: Array, pool: IntArray) -> tuple[Array, Array]:
    """Return steps (n, 5) and covariances of A and v from normal equations, v being pooled."""
    C_A = np.linalg.inv(F[:, :3, :3])
    G = -C_A @ F[:, :3, 3:]  # how A follows v
    rest = F[:, 3:, 3:] + np.swapaxes(F[:, :3, 3:], 1, 2) @ G
    right = b[:, 3:] + (np.swapaxes(G, 1, 2) @ b[:, :3, None])[..., 0]
    C_v = np.linalg.inv(_by_pool(rest, pool))
    turn = (C_v @ _by_pool(right, pool)[..., None])[..., 0][pool]
    C_v = C_v[pool]
    A = (C_A @ b[:, :3, None] + G @ turn[..., None])[..., 0]
    C = np.zeros((len(F), 5, 5))
    C[:, :3, :3] = C_A + G @ C_v @ np.swapaxes(G, 1, 2)
    C[:, :3, 3:] = G @ C_v
    C[:, 3:, :3] = np.swapaxes(C[:, :3, 3:], 1, 2)
    C[:, 3:, 3:] = C_v
    return np.column_stack([A, turn]), C


def _by_pool(values: Array, pool: IntArray) -> Array:
    """Return the sums of values (n, ...) over each pool."""
    total = np.zeros((int(pool.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(total, pool, values)
    return total
