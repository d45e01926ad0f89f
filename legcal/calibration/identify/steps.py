"""Information of each of the four steps on its parameters, given the steps before.

Step 1 locates joints in each camera (6), (7); step 2 the base (9), step 3 the offsets (14), step 4
the platform (16) to (19): by the default criteria, and as printed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement

import numpy as np

from legcal.calibration.identify.information import WhitenedEquations, pose_unit
from legcal.calibration.identify.predicted_observations import (
    Across,
    PredictedObservations,
    at_base_joints,
    at_platform_joints,
)
from legcal.estimation.square_root import compress, eliminate, stack_by_group
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import Actuator, ActuatorColumns, ActuatorKind
from legcal.machine.leg import EquationKind, JointType, LegColumns
from legcal.paper.carriers import Carrier, CarrierColumns

MAX_SIGMA = 1.0  # mean leg lengths: above, a direction is not determined
_MIN_DISTANCE = 1e-3  # mean leg lengths: nearer joints are one joint
_MIN_VARIANCE = 1e-12  # of a variance [m^2]


@dataclass(frozen=True, eq=False)
class Located:
    """Step 1: base joints and revolute axes in the frames of cameras, or of the board."""

    # (n_frames, n_legs, 9, 9): whitened rows by A along the axes of R_b [m], the two turns of the
    # revolute axis [m at the leg's length], those of the axis of the actuator, and two
    # displacements of this [m] (CarrierColumns); zero where the leg is not seen or has none
    information: Array
    # joint, axis: (n_frames, n_legs): which joints are located, and which revolute axes
    joint: BoolArray
    axis: BoolArray
    rank: int  # rank, of: unknowns that are determined, and all of them
    of: int


@dataclass(frozen=True, eq=False)
class StepInformation:
    """One step's information on the parameters that it identifies."""

    name: str
    columns: IntArray  # (c,): the parameters
    information: Array  # (m, c): whitened rows by these parameters in metres


def locate_joints(predicted: PredictedObservations) -> Located:
    """Information of step 1: the axes of a leg in a frame meet in A (6), and v . u = 0 (7)."""
    A, B = at_base_joints(predicted), at_platform_joints(predicted)
    revolute = revolute_axes(predicted)
    shape = predicted.n_frames, predicted.n_legs
    found = np.zeros((*shape, CarrierColumns.COUNT, CarrierColumns.COUNT))
    joint, axis = np.zeros((2, *shape), dtype=np.bool_)
    limit = 1.0 / (MAX_SIGMA * predicted.mean_length)
    frame, wanted = predicted.frame[predicted.view], 0
    for f, legs in enumerate(predicted.frames):
        for j in legs:
            here = np.flatnonzero((frame == f) & predicted.seen[predicted.view, j])
            own = columns_of_joint(predicted, j)
            rows = np.zeros((1, CarrierColumns.COUNT))
            if revolute[j]:
                rows = _joint_and_axis(predicted, A, B, here, j)
            else:
                carrier = carrier_of(predicted, j)
                by_unknowns = _by_unknowns(predicted, carrier, predicted.pose[here], j)[0]
                rows = (A.gradient[here, j] @ by_unknowns).reshape(-1, CarrierColumns.COUNT)
            found[f, j][np.ix_(own, own)] = compress(rows[:, own])
            wanted += len(own)
            place = np.setdiff1d(own, [3, 4])
            singular = np.linalg.svd(found[f, j][:, place], compute_uv=False)[len(place) - 1]
            joint[f, j] = singular > limit
            smallest = np.linalg.svd(found[f, j][:, own], compute_uv=False)[len(own) - 1]
            axis[f, j] = revolute[j] and joint[f, j] and smallest > limit
    singular = np.linalg.svd(found, compute_uv=False)
    return Located(found, joint, axis, int(np.sum(singular > limit)), wanted)


def carrier_of(predicted: PredictedObservations, j: int) -> Carrier:
    """Return the joint at A of a leg with its actuator, as estimated in step 1."""
    leg = predicted.legs[j]
    v = leg.base_axis if revolute_axes(predicted)[j] else None
    actuator = leg.actuator
    if actuator is None:  # it stands still
        actuator = Actuator("", ActuatorKind.PRISMATIC, np.eye(3)[2], leg.A, (0.0, 0.0))
    elif actuator.turns:  # known by its point beside A
        along = float((leg.A - actuator.point) @ actuator.axis)
        actuator = replace(actuator, point=actuator.point + along * actuator.axis)
    none = np.zeros((CarrierColumns.COUNT, CarrierColumns.COUNT))
    return Carrier(leg.A, np.zeros(3) if v is None else v, actuator, none)


def columns_of_joint(predicted: PredictedObservations, j: int) -> IntArray:
    """Return the unknowns (CarrierColumns) of the joint at A of a leg."""
    own = carrier_of(predicted, j).columns
    return own if predicted.carried_by[j] >= 0 else own[own < CarrierColumns.AXIS.start]


def _by_unknowns(
    predicted: PredictedObservations, carrier: Carrier, pose: IntArray, j: int
) -> tuple[Array, Array]:
    """Return derivatives (k, 3, 9) of A, and of the revolute axis, by the unknowns in metres."""
    a = int(predicted.carried_by[j])
    q = predicted.q[pose, a] if a >= 0 else np.zeros(len(pose))
    unit = np.ones(CarrierColumns.COUNT)
    unit[CarrierColumns.V] = unit[CarrierColumns.AXIS] = 1.0 / predicted.mean_length
    return carrier.at(q)[1] * unit, carrier.axis_at(q)[1] * unit


def identify_base(predicted: PredictedObservations, located: Located) -> StepInformation:
    """Information of step 2 on base joints and revolute axes, frames marginalised out."""
    columns, by_frame = base_by_frames(predicted, located)
    return StepInformation("base_joints", columns, eliminate(by_frame, 6)[:, columns])


def base_by_frames(predicted: PredictedObservations, located: Located) -> tuple[IntArray, Array]:
    """Return the parameters of step 2, and rows by each frame and all parameters, (k, r, 6 + p)."""
    columns = np.union1d(
        predicted.columns(LegColumns.A, ActuatorColumns.AXIS, ActuatorColumns.POINT),
        predicted.columns(LegColumns.BASE_AXIS, legs=revolute_axes(predicted)),
    )
    pairs = np.argwhere(located.joint)
    n = CarrierColumns.COUNT
    rows = np.zeros((len(pairs), n, 6 + len(predicted.unit)))
    for row, (f, j) in zip(rows, pairs, strict=True):
        F = located.information[f, j]
        if not located.axis[f, j]:  # the information on A alone
            rest = np.setdiff1d(np.arange(n), np.r_[CarrierColumns.V])
            F = np.zeros_like(F)
            F[: len(rest), rest] = compress(
                eliminate(located.information[f, j][None][:, :, [3, 4, *rest]], 2)
            )
        row[:, :6] = _by_camera(predicted, j, F)
        row[:, 6:] = F @ _unknowns_by_parameters(predicted, j)
    return columns, stack_by_group(rows, pairs[:, 0], predicted.n_frames)


def _unknowns_by_parameters(predicted: PredictedObservations, j: int) -> Array:
    """Return the derivative (9, p) of the unknowns of a joint (CarrierColumns) by the parameters.

    The point of an axis beside A is the actuator's point shifted along the axis, so that it moves
    with rotations of the axis.
    """
    scatter, length = predicted.local_to_parameters[j], predicted.mean_length
    found = np.zeros((CarrierColumns.COUNT, scatter.shape[1]))
    found[CarrierColumns.A] = scatter[LegColumns.A]
    found[CarrierColumns.V] = length * scatter[LegColumns.BASE_AXIS]
    found[CarrierColumns.AXIS] = length * scatter[ActuatorColumns.AXIS]
    found[CarrierColumns.POINT] = scatter[ActuatorColumns.POINT]
    leg = predicted.legs[j]
    if leg.actuator is not None and leg.actuator.turns:
        w, basis = leg.actuator.axis, normal_basis(leg.actuator.axis)
        along = float((leg.A - leg.actuator.point) @ w)
        found[CarrierColumns.POINT] += (
            along * basis @ cross(basis, w).T @ scatter[ActuatorColumns.AXIS]
        )
    return found


def distance_rows(
    predicted: PredictedObservations, located: Located
) -> tuple[Array, Array, IntArray]:
    """Return the derivatives of distances between leg ends by the offsets.

    Legs on a common platform joint are left out: their distance is always zero.

    Returns (m, n_lengths): Derivative of each distance by the offsets and lengths, whitened; (m, ):
    One over the standard deviation of each distance [1/m]; (m, 4): Frame, pose, and both legs of
    each distance.
    """
    columns = predicted.columns(LegColumns.LENGTH)
    place = np.full(predicted.n_legs, -1)
    place[predicted.with_length] = np.arange(len(columns))
    B = at_platform_joints(predicted)
    ends = located.joint & predicted.with_length
    centres = np.array([leg.B for leg in predicted.legs])
    gaps = np.linalg.norm(centres[:, None] - centres, axis=2)
    frame = predicted.frame[predicted.view]
    shown = ends[frame] & predicted.seen[predicted.view]
    keys = [
        (f, i, j, g)
        for f in range(predicted.n_frames)
        for i in np.flatnonzero(frame == f)
        for j, g in combinations(np.flatnonzero(shown[i]).tolist(), 2)
        if gaps[j, g] > _MIN_DISTANCE * predicted.mean_length
    ]
    if not keys:
        return np.zeros((0, len(columns))), np.zeros(0), np.zeros((0, 4), dtype=np.intp)
    f, i, j, g = np.array(keys, dtype=np.intp).T
    apart = B.point[i, j] - B.point[i, g]
    n = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    pose = predicted.pose[i]
    variance = sum(_end_variance(predicted, B, i, leg, n) for leg in (j, g))
    weight = 1.0 / np.sqrt(variance)
    rows = np.zeros((len(keys), len(columns)))
    each = np.arange(len(keys))
    rows[each, place[j]] = weight * np.einsum("ki,ki->k", n, predicted.u[pose, j])
    rows[each, place[g]] = -weight * np.einsum("ki,ki->k", n, predicted.u[pose, g])
    return rows, np.asarray(weight), np.stack([f, pose, j, g], axis=1)


def offsets_from_distances(
    predicted: PredictedObservations, rows: Array, weight: Array, key: IntArray
) -> StepInformation:
    """Information of step 3: the distance of each pair is constant and unknown (14)."""
    columns = predicted.columns(LegColumns.LENGTH)
    _, pair = np.unique(key[:, 2:], axis=0, return_inverse=True)
    pair = pair.ravel()
    own = np.concatenate([weight[:, None], rows], axis=1)
    laid = stack_by_group(own[:, None], pair, int(pair.max(initial=-1)) + 1)
    return StepInformation("offsets", columns, eliminate(laid, 1))


def identify_platform(
    predicted: PredictedObservations, located: Located, images: Array, equations: WhitenedEquations
) -> StepInformation:
    """Information of step 4 on platform joints and axes, and on universal axes at the base.

    *images* and *equations* are from the joint fit.
    """
    universal = np.array(
        [leg.base_joint is JointType.UNIVERSAL for leg in predicted.legs], dtype=np.bool_
    )
    columns = np.unique(
        np.concatenate(
            [
                predicted.columns(LegColumns.B, LegColumns.PLATFORM_AXIS, LegColumns.TWIST),
                predicted.columns(LegColumns.BASE_AXIS, legs=universal),
            ]
        )
    )
    n_f, n_p = predicted.n_motions, len(predicted.unit)
    keep = np.concatenate([np.arange(n_f), n_f + columns])
    groups = _groups(predicted, located)
    seen = np.delete(images[:, :, 2:], np.s_[n_f : n_f + 6], axis=3)  # at B
    seen = seen * groups.used[groups.of_image][:, :, None, None]
    seen = seen * located.joint[predicted.frame[predicted.view]][:, :, None, None]
    seen = seen.reshape(len(predicted.view), 2 * predicted.n_legs, n_f + n_p)
    rows = np.concatenate([equations.by_pose, equations.by_parameters], axis=2)[groups.pose]
    wanted = _step_4_equations(equations, groups)
    rows = np.concatenate(
        [rows * wanted[..., None], stack_by_group(seen, groups.of_image, len(groups.pose))], axis=1
    )
    ties = predicted.ties[:, columns] / predicted.sigma_exact
    found = np.concatenate([eliminate(rows[:, :, keep], n_f), ties])
    return StepInformation("platform_joints", columns, found)


def scalar_products(predicted: PredictedObservations, located: Located) -> StepInformation:
    """Information of (9): all products of vectors A_j A_g and revolute axes of each frame."""
    columns = identify_base(predicted, located).columns
    by_unknowns = np.concatenate(
        [_unknowns_by_parameters(predicted, j) for j in range(predicted.n_legs)]
    )
    rows = [np.zeros((0, len(predicted.unit)))]
    for f in range(predicted.n_frames):
        vectors, slopes, is_unit = _vectors_of(predicted, located, f)
        pairs = [
            (p, q)
            for p, q in combinations_with_replacement(range(len(vectors)), 2)
            if p != q or not is_unit[p]  # v . v = 1 is trivial
        ]
        if not pairs:
            continue
        G = np.array([vectors[p] @ slopes[q] + vectors[q] @ slopes[p] for p, q in pairs])
        variance = np.einsum("pi,ij,pj->p", G, _covariance(predicted, located, f), G)
        rows.append(G @ by_unknowns / np.sqrt(variance + _MIN_VARIANCE)[:, None])
    return StepInformation("base_joints", columns, np.concatenate(rows)[:, columns])


def consecutive_distances(
    rows: Array, weight: Array, key: IntArray, columns: IntArray
) -> StepInformation:
    """Information of (14): equal distances at consecutive poses of a frame.

    The rows, weights and keys are those of :func:`distance_rows`.
    """
    last: dict[tuple[int, int, int], int] = {}
    found = [np.zeros((0, len(columns)))]
    for k, (f, _, j, g) in enumerate(key.tolist()):
        before = last.get((f, j, g))
        if before is not None:
            change = rows[k] / weight[k] - rows[before] / weight[before]
            found.append((change / np.hypot(1.0 / weight[k], 1.0 / weight[before]))[None])
        last[f, j, g] = k
    return StepInformation("offsets", columns, np.concatenate(found))


def mean_distances(
    predicted: PredictedObservations, weight: Array, key: IntArray
) -> StepInformation:
    """Information of (16): mean distances of leg ends in each frame equal joint distances."""
    columns = predicted.columns(LegColumns.B)
    B = np.array([leg.B for leg in predicted.legs])
    distinct, which = np.unique(key[:, [0, 2, 3]], axis=0, return_inverse=True)
    number = np.bincount(which.ravel(), weights=weight**2)
    rows = np.zeros((len(distinct), len(predicted.unit)))
    scatter = predicted.local_to_parameters[:, LegColumns.B]
    for row, (_, j, g), n in zip(rows, distinct, number, strict=True):
        apart = B[g] - B[j]
        row += np.sqrt(n) * (apart / np.linalg.norm(apart)) @ (scatter[g] - scatter[j])
    return StepInformation("platform_joints", columns, rows[:, columns])


def by_all_parameters(step: StepInformation, n_parameters: int) -> Array:
    """Expand a step's rows to all parameters; those outside the step are known."""
    rows = np.zeros((len(step.information) + n_parameters, n_parameters))
    rows[: len(step.information), step.columns] = step.information
    known = np.setdiff1d(np.arange(n_parameters), step.columns)
    rows[len(step.information) + known, known] = 1e12
    return rows


def revolute_axes(predicted: PredictedObservations) -> BoolArray:
    """Return a mask of legs with a revolute base axis among the parameters, (n_legs,)."""
    return np.array(
        [EquationKind.BASE_AXIS in leg.equations for leg in predicted.legs],
        dtype=np.bool_,
    )


def _joint_and_axis(
    predicted: PredictedObservations, A: Across, B: Across, here: IntArray, j: int
) -> Array:
    """Rows by the unknowns of a joint with an axis, leg directions marginalised out."""
    carrier, pose = carrier_of(predicted, j), predicted.pose[here]
    a = int(predicted.carried_by[j])
    axis = carrier.axis_at(predicted.q[pose, a] if a >= 0 else np.zeros(len(pose)))[0]
    by_A, by_v = _by_unknowns(predicted, carrier, pose, j)
    u, length = predicted.u[pose, j], predicted.length[pose, j]
    E = normal_basis(u)
    # The end moves by e1, e2 of the direction; then the unknowns
    rows = np.zeros((len(here), 5, 2 + CarrierColumns.COUNT))
    rows[:, :2, 2:] = A.gradient[here, j] @ by_A
    rows[:, 2:4, :2] = B.gradient[here, j] @ np.swapaxes(E, 1, 2)
    rows[:, 2:4, 2:] = B.gradient[here, j] @ by_A
    rows[:, 4, :2] = np.einsum("kia,ka->ki", E, axis) / length[:, None]
    rows[:, 4, 2:] = np.einsum("ka,kac->kc", u, by_v)
    rows[:, 4] *= predicted.mean_length / predicted.sigma_exact
    return eliminate(rows, 2)


def _by_camera(predicted: PredictedObservations, j: int, F: Array) -> Array:
    """Transform rows F by a joint to rows by rotation and displacement of the camera."""
    columns, rows = CarrierColumns, np.zeros((len(F), 6))
    rows[:, :3] = -cross(predicted.A[j], F[:, columns.A])
    rows[:, 3:] = -F[:, columns.A]
    carrier = carrier_of(predicted, j)
    if carrier.v.any():
        rows[:, :3] -= predicted.mean_length * F[:, columns.V] @ normal_basis(carrier.v)
    basis = normal_basis(carrier.actuator.axis)
    rows[:, :3] -= predicted.mean_length * F[:, columns.AXIS] @ basis
    of_point = F[:, columns.POINT] @ basis
    rows[:, :3] -= cross(carrier.actuator.point, of_point)
    rows[:, 3:] -= of_point
    return rows * pose_unit(predicted)


def _end_variance(
    predicted: PredictedObservations, B: Across, image: IntArray, leg: IntArray, n: Array
) -> Array:
    """Variance of leg ends along directions n, (k,) [m^2], for known base joints."""
    gradient = B.gradient[image, leg]
    size = np.maximum(np.sum(gradient**2, axis=2), 1e-30)
    across = np.sum((np.einsum("ki,kri->kr", n, gradient) / size) ** 2, axis=1)
    along = np.einsum("ki,ki->k", n, predicted.u[predicted.pose[image], leg])
    along *= predicted.sigma_of_legs[leg]
    return np.asarray(across + along**2)


@dataclass(frozen=True, eq=False)
class _Groups:
    """Legs of one pose that were seen in one frame: of all located cameras, or of one other."""

    of_image: IntArray
    pose: IntArray
    in_base: BoolArray
    used: BoolArray
    enough: BoolArray


def _groups(predicted: PredictedObservations, located: Located) -> _Groups:
    """Return the groups of a session, with the legs that take part in step 4."""
    n_d = len(predicted.frame_legs)
    frame = predicted.frame[predicted.view]
    in_base = (located.joint.sum(axis=1) >= n_d)[frame]
    key = np.stack([predicted.pose, np.where(in_base, -1, frame)], axis=1)
    distinct, of_image = np.unique(key, axis=0, return_inverse=True)
    of_image = of_image.ravel()
    legs = np.zeros((len(distinct), predicted.n_legs), dtype=np.bool_)
    np.logical_or.at(legs, of_image, located.joint[frame] & predicted.seen[predicted.view])
    ends = legs & predicted.with_length
    number = ends.sum(axis=1)
    enough = number >= n_d
    used = np.where(enough[:, None], legs, ends & (number >= 2)[:, None])
    return _Groups(of_image, distinct[:, 0], distinct[:, 1] < 0, used, enough)


def _step_4_equations(equations: WhitenedEquations, groups: _Groups) -> BoolArray:
    """Mask of the leg equations used in step 4 by group, (n_groups, m)."""
    kinds = np.array([d.name for d in equations.demand])
    length, base_axis, twist = (kinds == d for d in ("LENGTH", "BASE_AXIS", "TWIST"))
    others = ~length & ~base_axis & (~twist | groups.in_base[:, None])
    wanted = length | (others & groups.enough[:, None])
    return np.asarray((wanted & groups.used[:, equations.leg]) | equations.reading)


def _vectors_of(
    predicted: PredictedObservations, located: Located, f: int
) -> tuple[list[Array], list[Array], list[bool]]:
    """Set V of (8), derivatives (3, 9 n) of each by the unknowns of all legs, and unit flags."""
    vectors, slopes, is_unit = list[Array](), list[Array](), list[bool]()
    columns, n = CarrierColumns, predicted.n_legs

    def add(vector: Array, *parts: tuple[int, slice, Array], unit: bool) -> None:
        slope = np.zeros((3, n, columns.COUNT))
        for j, where, part in parts:
            slope[:, j, where] = part
        vectors.append(vector)
        slopes.append(slope.reshape(3, -1))
        is_unit.append(unit)

    eye, turn = np.eye(3), 1.0 / predicted.mean_length
    for j, g in combinations(np.flatnonzero(located.joint[f]).tolist(), 2):
        apart = predicted.A[g] - predicted.A[j]
        add(apart, (j, columns.A, -eye), (g, columns.A, eye), unit=False)
    for j in np.flatnonzero(located.joint[f] & (predicted.carried_by >= 0)).tolist():
        carrier = carrier_of(predicted, j)
        w = carrier.actuator.axis
        basis = normal_basis(w)
        add(w, (j, columns.AXIS, turn * cross(basis, w).T), unit=True)
        if carrier.actuator.turns:  # across w: the point is beside A
            arm, across = carrier.A - carrier.actuator.point, eye - np.outer(w, w)
            of_axis = -turn * np.outer(w, cross(basis, w) @ arm)
            parts = (columns.A, across), (columns.AXIS, of_axis), (columns.POINT, -basis.T)
            add(arm, *((j, *part) for part in parts), unit=False)
    for j in np.flatnonzero(located.axis[f]).tolist():
        v = carrier_of(predicted, j).v
        add(v, (j, columns.V, turn * cross(normal_basis(v), v).T), unit=True)
    return vectors, slopes, is_unit


def _covariance(predicted: PredictedObservations, located: Located, f: int) -> Array:
    """Covariance of joints and axes of a frame after step 1, (9 n, 9 n) [m^2]."""
    n = CarrierColumns.COUNT
    covariance = np.zeros((n * predicted.n_legs,) * 2)
    for j in np.flatnonzero(located.joint[f]).tolist():
        F = located.information[f, j]
        here = slice(n * j, n * j + n)
        covariance[here, here] = np.linalg.pinv(F.T @ F, hermitian=True)
    return covariance
