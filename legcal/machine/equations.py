"""The equations of legs at poses, with derivatives by the pose and by the numbers of the legs.

An equation is measured (the length of an actuated leg) or a constraint of the machine alone (the
length of a rod, a revolute axis, a twist, the plane of a planar machine). Steps of a pose are a
rotation about the origin of the platform frame [rad] and a displacement [m], both in the base
frame. The rows of :func:`leg_equations` are as in the paper; :func:`pose_equations` multiplies
dimensionless rows by the leg length, so that all are lengths. The joints of a leg determine its
equations (:class:`legcal.machine.leg.JointType`); each is one function here that returns the
residual and its gradients by the vector from A to B and by the axes.

The joint at A of a rod on an actuator moves with its reading, and with it all equations of the rod
(:func:`pose_equations` with ``q``). Readings that are not given are eliminated: one combination of
the equations of all rods on an actuator determines its reading, the others are constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns, JointMotion
from legcal.machine.leg import EquationKind, JointType, Leg, LegColumns, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization, is_spatial
from legcal.machine.rods import (
    actuator_index,
    actuators_of,
    first_rods,
    readings_of_rods,
)


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """Equations at k poses, m rows each."""

    values: Array  # (k, m) residuals [m]; |AB| - q0 for a length, which equals s q
    by_pose: Array  # (k, m, 6) derivative by rotation [rad] and displacement [m]
    by_local: Array  # (k, m, 21) derivative by the numbers of the row's leg (LegColumns), axes by
    # rotations about their normal_basis, exact at zero residuals; or (k, m, 0)
    leg: IntArray  # (m,) the leg of each row, -1 for the plane
    kinds: tuple[EquationKind, ...]  # (m,) kind of each row
    measured: BoolArray  # (m,) rows of readings; the others are constraints
    by_q: Array  # (k, m, n) derivative by readings of actuators; or (k, m, 0)

    def of(self, rows: BoolArray | IntArray) -> PoseEquations:
        """Return some of the rows, or all in another order."""
        chosen = np.arange(len(self.leg))[rows]
        return PoseEquations(
            self.values[:, rows],
            self.by_pose[:, rows],
            self.by_local[:, rows],
            self.leg[rows],
            tuple(self.kinds[row] for row in chosen.tolist()),
            self.measured[rows],
            self.by_q[:, rows],
        )

    def by_parameters(self, parametrization: Parametrization) -> Array:
        """Return the derivatives by parameters, (k, m, p)."""
        k, m, _ = self.by_local.shape
        # The last column collects numbers that are no parameters.
        wide = np.zeros((k, m, len(parametrization) + 1))
        wide[:, np.arange(m)[:, None], parametrization.place[self.leg]] = self.by_local
        return wide[..., :-1]


def pose_equations(
    legs: Sequence[Leg], R: Array, t: Array, *, by_local: bool = True, q: Array | None = None
) -> PoseEquations:
    """Return the equations of legs at poses R (k, 3, 3), t (k, 3) [m]; all rows are lengths.

    *q* (k, n) are the readings of actuators [m, rad], in the order of
    :func:`~legcal.machine.rods.actuators_of`; all rows of their rods then count as measured, since
    they hold at these readings. Without *q* the actuators are at
    :func:`~legcal.machine.rods.readings_of_rods`; one row per actuator is measured, the others are
    constraints, and there are no derivatives by parameters. Without *by_local* there are none
    either, and the call takes two thirds of the time.
    """
    on = actuator_index(legs)
    if q is None and max(on, default=-1) >= 0:
        there = pose_equations(legs, R, t, by_local=False, q=readings_of_rods(legs, R, t))
        return _without_readings(legs, there)
    groups: dict[tuple[object, ...], list[int]] = {}  # of similar legs
    for j, leg in enumerate(legs):
        joints = (leg.base_joint, leg.platform_joint) * (leg.twist is not None)
        key = on[j] >= 0, leg.kind is LegKind.PASSIVE, *joints, *leg.equations
        groups.setdefault(key, []).append(j)
    parts = []
    for alike in groups.values():
        similar, at = [legs[j] for j in alike], None
        if q is not None and on[alike[0]] >= 0:
            at = q[:, [on[j] for j in alike]]
        length, *of_rows = _equations_of_similar(similar, R, t, by_local, at)
        rows = slice(1 if similar[0].kind is LegKind.PASSIVE else 0, None)
        kinds = similar[0].equations[rows]
        values, by_pose, local, by_reading = (x[:, :, rows] for x in of_rows)
        by_q = np.zeros((*values.shape, 0 if q is None else q.shape[1]))
        if at is not None:
            for i, j in enumerate(alike):
                by_q[:, i, :, on[j]] = by_reading[:, i, :, 0]
        if set(kinds) != {EquationKind.LENGTH}:
            is_length = np.array([kind is EquationKind.LENGTH for kind in kinds], dtype=np.bool_)
            arm = np.where(is_length, 1.0, length[..., None])
            values = arm * values
            by_pose, local, by_q = (arm[..., None] * x for x in (by_pose, local, by_q))
        shape = len(t), len(alike) * len(kinds)
        parts.append(
            PoseEquations(
                values.reshape(shape),
                by_pose.reshape(*shape, 6),
                local.reshape(*shape, local.shape[3]),
                np.repeat(alike, len(kinds)),
                kinds * len(alike),
                np.array([_is_read(leg, kind) for leg in similar for kind in kinds], np.bool_),
                by_q.reshape(*shape, by_q.shape[3]),
            )
        )
    if len(parts) == 1:
        return parts[0]
    stacked = _stacked(parts)
    return stacked.of(np.argsort(stacked.leg, kind="stable"))


def n_pose_constraints(legs: Sequence[Leg]) -> int:
    """Return the number of equations of legs that hold at any readings."""
    return sum(leg.n_constraints for leg in legs) - len(actuators_of(legs))


def _without_readings(legs: Sequence[Leg], equations: PoseEquations) -> PoseEquations:
    """Return the equations of legs with the readings of all actuators eliminated.

    A reflection of the rows of an actuator leaves its reading in the row of the first rod only,
    which is then measured; the others are constraints.
    """
    values, measured = equations.values.copy(), equations.measured.copy()
    slopes = np.concatenate([equations.by_pose, equations.by_q], axis=2)  # reflected together
    on = np.array(actuator_index(legs))[equations.leg]
    is_first = np.diff(equations.leg, prepend=-1) != 0
    for a, first in enumerate(first_rods(legs)):
        rows = np.flatnonzero(on == a)
        pivot = int(np.argmax(is_first[rows] & (equations.leg[rows] == first)))
        measured[rows] = np.arange(len(rows)) == pivot
        if len(rows) == 1:
            continue
        g = slopes[:, rows, 6 + a]
        size = np.linalg.norm(g, axis=1, keepdims=True)
        e = np.eye(len(rows))[pivot]
        g = np.where(size > 0.0, g / np.where(size > 0.0, size, 1.0), e)
        v = g + np.where(g[:, [pivot]] < 0.0, -1.0, 1.0) * e  # the reflection takes g to e or -e
        scale = 2.0 / np.sum(v * v, axis=1)
        along = scale[:, None] * np.einsum("kr,krc->kc", v, slopes[:, rows])
        slopes[:, rows] -= v[:, :, None] * along[:, None]
        values[:, rows] -= v * (scale * np.einsum("kr,kr->k", v, values[:, rows]))[:, None]
    none = np.zeros((*values.shape, 0))
    return PoseEquations(
        values, slopes[:, :, :6], none, equations.leg, equations.kinds, measured, slopes[:, :, 6:]
    )


def posture_constraints(
    legs: Sequence[Leg], R: Array, t: Array, q: Array, *, by_local: bool = False
) -> PoseEquations:
    """Return the constraints at poses and readings q (k, n) of actuators, without leg readings."""
    equations = pose_equations(legs, R, t, by_local=by_local, q=q if q.shape[1] else None)
    hangs = np.array([leg.actuator is not None for leg in legs], dtype=np.bool_)
    return equations.of(~equations.measured | hangs[equations.leg])


def equations_at_readings(
    legs: Sequence[Leg], R: Array, t: Array, lengthening: Array, *, by_local: bool = False
) -> PoseEquations:
    """Return the residuals of legs at poses and readings, optionally with parameter derivatives.

    *lengthening* (k, n_legs) is s q of actuated legs [m] and q of rods on actuators [m, rad]; rows
    of unknown readings (NaN) are zero.
    """
    on = actuator_index(legs)
    rods = [on.index(a) for a in range(max(on, default=-1) + 1)]
    q = np.nan_to_num(np.broadcast_to(lengthening[:, rods], (len(t), len(rods))))
    equations = pose_equations(legs, R, t, by_local=by_local, q=q if rods else None)
    wanted = np.where(equations.measured, lengthening[:, equations.leg], 0.0)
    is_read = np.isfinite(wanted)
    hangs = np.array(on)[equations.leg] >= 0
    return replace(
        equations,
        values=np.where(is_read, equations.values - np.where(hangs, 0.0, wanted), 0.0),
        by_pose=equations.by_pose * is_read[..., None],
    )


def leg_equations(
    leg: Leg,
    R: Array,
    t: Array,
    *,
    by_local: bool = True,
    q: Array | None = None,
) -> PoseEquations:
    """Return all equations of one leg at poses R (k, 3, 3), t (k, 3) [m], as in the paper.

    All rows but the length are dimensionless; a passive leg has a length row, too. For a rod on an
    actuator *q* (k,) are the readings, zero by default.
    """
    at = None if q is None or leg.actuator is None else q[:, None]
    _, *equations = _equations_of_similar([leg], R, t, by_local, at)
    values, by_pose, local, by_q = (x[:, 0] for x in equations)
    owner = np.zeros(len(leg.equations), dtype=np.intp)
    measured = np.array([_is_read(leg, kind) for kind in leg.equations])
    return PoseEquations(values, by_pose, local, owner, leg.equations, measured, by_q)


def _is_read(leg: Leg, kind: EquationKind) -> bool:
    """Return whether an equation of a leg contains its reading."""
    if leg.actuator is not None:
        return True
    return kind is EquationKind.LENGTH and leg.kind is LegKind.ACTUATED


def _equations_of_similar(
    legs: Sequence[Leg],
    R: Array,
    t: Array,
    by_local: bool,
    q: Array | None,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the equations of n legs with the same joints and equations.

    The result is lengths (k, n), and for m rows values (k, n, m) and derivatives (k, n, m, 6) by
    the pose, (k, n, m, 21) by the numbers of the legs and (k, n, m, 1) by the readings q (k, n) of
    their actuators, zero by default.
    """
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    motions = [
        leg.actuator.motion(leg.A, np.zeros(len(t)) if q is None else q[:, i])
        for i, leg in enumerate(legs)
        if leg.actuator is not None
    ]
    arm = B @ np.swapaxes(R, 1, 2)
    vector = arm + t[:, None] - (_of_each(motions, "A") if motions else A)
    length = np.sqrt(_dot(vector, vector))
    at = _Placed(legs, R, length, vector / length[..., None], motions)
    kinds, shape = legs[0].equations, length.shape
    values, by_pose = np.empty((*shape, len(kinds))), np.empty((*shape, len(kinds), 6))
    local = np.zeros((*shape, len(kinds), LegColumns.COUNT if by_local else 0))
    by_q = np.zeros((*shape, len(kinds), 1))
    for i, kind in enumerate(kinds):
        row = _RESIDUALS[kind](at)
        values[:, :, i] = row.value
        by_pose[:, :, i, :3], by_pose[:, :, i, 3:] = cross(arm, row.by_leg), row.by_leg
        if row.by_tied is not None:
            by_pose[:, :, i, :3] += cross(at.in_base(row.tied), row.by_tied)
        if motions:
            by_q[:, :, i, 0] = _by_actuators(at, row, local[:, :, i])
        if by_local:
            local[:, :, i, LegColumns.A] = -at.back(row.by_leg)
            local[:, :, i, LegColumns.B] = row.by_leg @ R
            local[:, :, i, LegColumns.LENGTH] = row.by_q0
            local[:, :, i, LegColumns.TWIST] = row.by_twist
            if row.by_base_axis is not None:
                e = _basis(at.axes("base"))
                by_axis = at.back(row.by_base_axis)
                turns = [-_dot(by_axis, e[:, 1]), _dot(by_axis, e[:, 0])]
                local[:, :, i, LegColumns.BASE_AXIS] = np.stack(turns, axis=-1)
            if row.by_tied is not None:
                turned = cross(_basis(at.axes("platform")), row.tied[:, None])
                by_platform = np.einsum("kni,nji->knj", row.by_tied @ R, turned)
                local[:, :, i, LegColumns.PLATFORM_AXIS] = by_platform
    return length, values, by_pose, local, by_q


def _of_each(motions: Sequence[JointMotion], name: str) -> Array:
    """Return positions or derivatives (k, n, ...) of n joints at A."""
    return np.stack([getattr(motion, name) for motion in motions], axis=1)


def _by_actuators(at: _Placed, row: _EquationRow, local: Array) -> Array:
    """Return the derivatives (k, n) of a row by readings; write those by numbers of actuators.

    The latter go into *local* (k, n, 21), which may have no columns.
    """
    by_q, columns = -_dot(_of_each(at.motions, "by_q"), row.by_leg), ActuatorColumns
    if local.shape[2]:
        for name, place in (("by_axis", columns.AXIS), ("by_point", columns.POINT)):
            by_line = np.einsum("knij,kni->knj", _of_each(at.motions, name), row.by_leg)
            local[..., place] = -by_line
        local[..., columns.GAIN] = -_dot(_of_each(at.motions, "by_gain"), row.by_leg)
    for i, moved in enumerate(at.motions if row.by_base_axis is not None else ()):
        actuator, axis = moved.actuator, at.legs[i].base_axis
        if row.by_base_axis is None or axis is None or not actuator.turns:
            continue
        v, by_axis = moved.by_A @ axis, row.by_base_axis[:, i]  # it turns with the arm
        by_angle = _dot(cross(actuator.axis, v), by_axis)
        by_q[:, i] += actuator.gain * by_angle
        if local.shape[2]:
            for k, e in enumerate(actuator.line.across):
                turned = cross(e, v) - moved.by_A @ cross(e, axis)
                local[:, i, columns.AXIS.start + k] += _dot(turned, by_axis)
            local[:, i, columns.GAIN] += by_angle * moved.angle / actuator.gain
    return by_q


def least_squares_equations(
    equations: PoseEquations,
    n_dependent: int = 0,  # constraints that follow from the others where all hold
) -> tuple[Array, Array]:
    """Return equations (k, m) and derivatives (k, m, 6) of the least squares of reading residuals.

    They are the constraints, and the projection of the reading residuals onto motions that the
    constraints allow; steps to their root are Gauss-Newton steps with exact constraints.
    """
    constraints, J = (
        equations.by_pose[:, ~equations.measured],
        equations.by_pose[:, equations.measured],
    )
    _, size, along = np.linalg.svd(constraints, full_matrices=False)
    counts = size > _DEPENDENT * size[:, :1]
    counts[:, max(constraints.shape[1] - n_dependent, 0) :] = False
    along = along * counts[:, :, None]
    left = J - J @ np.swapaxes(along, 1, 2) @ along
    U, singular, _ = np.linalg.svd(left, full_matrices=False)
    U = np.swapaxes(U * (singular > _SINGULAR * singular[:, :1])[:, None], 1, 2)
    residual = (U @ equations.values[:, equations.measured, None])[..., 0]
    return (
        np.concatenate([equations.values[:, ~equations.measured], residual], axis=1),
        np.concatenate([constraints, U @ J], axis=1),
    )


def machine_equations(
    machine: Machine, poses: Array, readings: Array | None = None
) -> PoseEquations:
    """Return all equations of a machine, with its plane, at poses of its links (no by_local).

    Poses are (k, 3 or 4, 4). With readings of the motors (k, n_motors) [m or rad] the values are
    residuals there.
    """
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    if readings is None:
        equations = pose_equations(machine.legs, R, t, by_local=False)
    else:
        motors = machine.sign * machine.at_readings(readings)
        equations = equations_at_readings(machine.legs, R, t, motors)
    return equations if machine.spatial else _stacked([equations, _plane(machine, R, t)])


def equations_at(machine: Machine, T_base_platform: RigidTransform) -> PoseEquations:
    """Return the equations of a machine at one pose."""
    return machine_equations(machine, T_base_platform.as_matrix()[None])


def constraints_at(machine: Machine, T_base_platform: RigidTransform) -> PoseEquations:
    """Return the constraints of a machine at one pose."""
    equations = equations_at(machine, T_base_platform)
    return equations.of(~equations.measured)


def is_constrained(machine: Machine) -> bool:
    """Return whether the machine forbids some poses at any lengths of its sliders."""
    return not machine.spatial or n_pose_constraints(machine.legs) > 0


def freedoms(frame_legs: Sequence[int]) -> tuple[int, ...]:
    """Return the possible components of a platform motion in R_b, as indices of the six."""
    return (0, 1, 2, 3, 4, 5) if is_spatial(frame_legs) else (2, 3, 4)


_SINGULAR = 1e-9  # least singular value of equations, relative to the largest
_DEPENDENT = 1e-7  # the same for constraints, some of which may be dependent


def pose_sensitivity(
    legs: Sequence[Leg],
    parametrization: Parametrization,
    frame_legs: Sequence[int],
    R: Array,
    t: Array,
) -> Array:
    """Return the motion (k, 6, p) of R_e in R_b by parameters at readings: rotation, displacement.

    The equations of all legs hold before and after: F_pose d_pose + F_xi d_xi = 0. With redundant
    motors the squares of the lengths are minimised, with exact constraints; if the constraints
    alone outnumber the freedoms (a 3-UPU that only translates), the squares of all equations.

    Raises NotIdentifiable if readings and legs do not determine a pose.
    """
    equations = pose_equations(legs, R, t, q=readings_of_rods(legs, R, t))
    columns = list(freedoms(frame_legs))
    F, by_parameters = equations.by_pose[:, :, columns], equations.by_parameters(parametrization)
    singular = np.linalg.svd(F, compute_uv=False)
    bad = np.arange(len(t))
    if singular.shape[1] == len(columns):
        bad = np.flatnonzero(singular[:, -1] < _SINGULAR * singular[:, 0])
    if len(bad):
        raise NotIdentifiable(
            f"The platform error could not be predicted: the {int(equations.measured.sum())} "
            f"readings do not determine platform pose {bad[0] + 1}, where the machine is singular "
            f"or has too few motors; {len(columns)} independent equations are needed; leave this "
            "pose out."
        )
    moved = np.zeros((len(t), 6, len(parametrization)))
    if not is_overdetermined(equations, columns):
        moved[:, columns] = -np.linalg.pinv(F) @ by_parameters
        return moved
    read = equations.measured
    C, D = F[:, ~read], by_parameters[:, ~read]
    inverse = np.linalg.pinv(C, rcond=_DEPENDENT)
    follow = -inverse @ D  # the constraints
    left = np.eye(len(columns)) - inverse @ C
    rest = by_parameters[:, read] + F[:, read] @ follow
    moved[:, columns] = follow - np.linalg.pinv(F[:, read] @ left, rcond=_SINGULAR) @ rest
    return moved


def is_overdetermined(equations: PoseEquations, columns: Sequence[int]) -> bool:
    """Return whether readings outnumber the freedoms that constraints leave at the first pose."""
    n_constraints, n_read = int(np.sum(~equations.measured)), int(equations.measured.sum())
    if n_read + n_constraints <= len(columns):
        return False
    constraints = equations.by_pose[0][~equations.measured][:, columns]
    rank = np.linalg.matrix_rank(constraints, rtol=_DEPENDENT) if n_constraints else 0
    return n_read > len(columns) - int(rank)


_WORDS = {
    EquationKind.LENGTH: "off its constant length",
    EquationKind.BASE_AXIS: "off the plane normal to its axis at the base",
    EquationKind.PLATFORM_AXIS: "off the plane normal to its axis at the platform",
    EquationKind.DIRECTION_1: "off the direction that it has in the platform",
    EquationKind.DIRECTION_2: "off the direction that it has in the platform",
    EquationKind.TWIST: "twisted at its end",
    EquationKind.PLANE: "out of its plane",
}
_TOLERANCE = 2.5e-9  # residual of a constraint that counts as zero, in mean leg lengths


def describe_worst(machine: Machine, equations: PoseEquations, verb: str = "") -> str:
    """Return the row with the largest residual at the first pose, in words with *verb*."""
    row = int(np.argmax(np.abs(equations.values[0])))
    leg, how = equations.leg[row], _WORDS[equations.kinds[row]]
    who = "the platform" if leg < 0 else f"leg '{machine.leg_names[leg]}'"
    return " ".join(f"{who} {verb} {1e3 * abs(equations.values[0, row]):.3g} mm {how}".split())


def violated_constraint(machine: Machine, T_base_platform: RigidTransform) -> str | None:
    """Return the constraint that a pose violates, in words; None if it meets all.

    A residual counts as zero up to a nanometre, or up to the residual of the machine at home, since
    its axes may be off by up to a milliradian.
    """
    if not is_constrained(machine):
        return None
    here = constraints_at(machine, T_base_platform)
    worst = np.abs(here.values).max()
    least = _TOLERANCE * machine.size
    if worst <= least:
        return None
    at_home = np.abs(constraints_at(machine, machine.home).values).max()
    if worst <= least + 10.0 * at_home:
        return None
    return describe_worst(machine, here, "would be")


def _plane(machine: Machine, R: Array, t: Array) -> PoseEquations:
    """Return the three equations of a planar platform, tilts as lengths at a mean leg's end."""
    normal = machine.T_base_Rb.as_matrix()[:3, 2]
    carried = R @ machine.T_platform_Re.as_matrix()[:3, 2]
    arms = machine.B_platform @ np.swapaxes(R, 1, 2)
    vectors = arms + t[:, None] - machine.A_base
    scale = np.linalg.norm(vectors, axis=2).mean(axis=1)
    values, by_pose = np.zeros((len(t), 3)), np.zeros((len(t), 3, 6))
    values[:, 0] = (vectors @ normal).mean(axis=1)
    by_pose[:, 0, :3] = cross(arms.mean(axis=1), normal)
    by_pose[:, 0, 3:] = normal
    for row, e in enumerate(normal_basis(normal), start=1):
        values[:, row] = scale * (carried @ e)
        by_pose[:, row, :3] = scale[:, None] * cross(carried, e)
    none = np.zeros((len(t), 3, 0))
    is_read = np.zeros(3, dtype=np.bool_)
    kinds = (EquationKind.PLANE,) * 3
    return PoseEquations(values, by_pose, none, np.full(3, -1), kinds, is_read, none)


def _stacked(parts: Sequence[PoseEquations]) -> PoseEquations:
    """Return the concatenated rows of several sets."""
    return PoseEquations(
        np.concatenate([part.values for part in parts], axis=1),
        np.concatenate([part.by_pose for part in parts], axis=1),
        np.concatenate([part.by_local for part in parts], axis=1),
        np.concatenate([part.leg for part in parts]),
        tuple(kind for part in parts for kind in part.kinds),
        np.concatenate([part.measured for part in parts]),
        np.concatenate([part.by_q for part in parts], axis=1),
    )


class VectorOps(NamedTuple):
    """Vector products: of arrays (..., 3) in numpy, or of CasADi symbols."""

    dot: Callable[[Any, Any], Any]
    cross: Callable[[Any, Any], Any]
    unit: Callable[[Any], Any]
    cos: Callable[[Any], Any]
    sin: Callable[[Any], Any]


def axis_in_leg(joint: JointType, axis: Any, u: Any, ops: VectorOps) -> Any:
    """Return the axis of a joint that is fixed in the leg, from its axis in base or platform."""
    return ops.unit(ops.cross(axis, u)) if joint.inner_is_across else axis


def twist_residual(p: Any, w: Any, u: Any, twist: Any, ops: VectorOps) -> Any:
    """Return sin(angle - twist), with the angle about u from axis p in the leg to axis w."""
    return ops.cos(twist) * ops.dot(u, ops.cross(p, w)) - ops.sin(twist) * ops.dot(p, w)


class _Placed(NamedTuple):
    """n legs with the same joints and equations, at k poses."""

    legs: Sequence[Leg]
    R: Array  # (k, 3, 3)
    length: Array  # (k, n) [m]
    u: Array  # (k, n, 3)
    motions: Sequence[JointMotion] = ()  # of the joints at A, if all legs are on actuators

    def axes(self, end: Literal["base", "platform"]) -> Array:
        """Return the axes of the joints at one end, (n, 3), at reading 0."""
        return np.array([_given(getattr(leg, f"{end}_axis")) for leg in self.legs])

    @property
    def base_axis(self) -> Array:
        """The axes of the joints at A, (k, n, 3)."""
        v = np.broadcast_to(self.axes("base"), self.u.shape)
        if not self.motions:
            return v
        return np.asarray(np.einsum("knij,knj->kni", _of_each(self.motions, "by_A"), v))

    def back(self, vectors: Array) -> Array:
        """Convert gradients (k, n, 3) by moved points into gradients by the points at reading 0."""
        if not self.motions:
            return vectors
        return np.asarray(np.einsum("knij,kni->knj", _of_each(self.motions, "by_A"), vectors))

    def in_base(self, vectors: Array) -> Array:
        """Return directions (n, 3) of the platform in the frame of the base, (k, n, 3)."""
        return np.asarray(vectors @ np.swapaxes(self.R, 1, 2))

    def by_leg(self, by_u: Array) -> Array:
        """Return the gradient by the vector from A to B of a function of its direction."""
        across = by_u - self.u * _dot(self.u, by_u)[..., None]
        return np.asarray(across / self.length[..., None])


_NOTHING = np.zeros((1, 3))


class _EquationRow(NamedTuple):
    """One equation of each leg at k poses: its residual, and its gradients."""

    value: Array  # (k, n)
    by_leg: Array  # (k, n, 3) by the vector from A to B
    by_base_axis: Array | None = None  # (k, n, 3)
    tied: Array = _NOTHING  # (n, 3) a direction fixed in the platform, with its axis
    by_tied: Array | None = None  # (k, n, 3), in the frame of the base
    by_q0: float = 0.0
    by_twist: Array | float = 0.0


def _length(at: _Placed) -> _EquationRow:
    """Return |AB| - q0."""
    return _EquationRow(at.length - np.array([leg.q0 for leg in at.legs]), at.u, by_q0=-1.0)


def _base_axis(at: _Placed) -> _EquationRow:
    """Return v . u of eq (7) at the base."""
    v = at.base_axis
    return _EquationRow(_dot(v, at.u), at.by_leg(v), by_base_axis=at.u)


def _platform_axis(at: _Placed) -> _EquationRow:
    """Return v . u of eq (7) at the platform."""
    return _component(at, at.axes("platform"))


def _component(at: _Placed, tied: Array) -> _EquationRow:
    """Return the component of u along a direction of the platform."""
    v = at.in_base(tied)
    return _EquationRow(_dot(v, at.u), at.by_leg(v), tied=tied, by_tied=at.u)


def _twist(at: _Placed) -> _EquationRow:
    """Return sin(angle - twist) of the axes p and w in the leg, and its gradients."""
    leg, u, b = at.legs[0], at.u, at.axes("platform")
    tau = np.array([float(its_leg.twist or 0.0) for its_leg in at.legs])
    tied = _basis(b)[:, 0] if leg.is_fixed_to_platform else b
    outer = at.base_axis, at.in_base(tied)
    joints = leg.base_joint, leg.platform_joint
    p, w = (axis_in_leg(*end, u, _ROWS) for end in zip(joints, outer, strict=True))
    c, s = np.cos(tau)[:, None], np.sin(tau)[:, None]
    by_u, by_axes = c * cross(p, w), [c * cross(w, u) - s * w, c * cross(u, p) - s * p]
    for i, (joint, axis) in enumerate(zip(joints, outer, strict=True)):
        if joint.inner_is_across:
            size = np.linalg.norm(cross(axis, u), axis=-1)[..., None]
            by_u = by_u + cross(by_axes[i], axis) / size
            by_axes[i] = cross(u, by_axes[i]) / size
    return _EquationRow(
        twist_residual(p, w, u, tau, _ROWS),
        at.by_leg(by_u),
        by_base_axis=by_axes[0],
        tied=tied,
        by_tied=by_axes[1],
        by_twist=-twist_residual(p, w, u, tau - 0.5 * np.pi, _ROWS),
    )


_RESIDUALS: dict[EquationKind, Callable[[_Placed], _EquationRow]] = {
    EquationKind.LENGTH: _length,
    EquationKind.BASE_AXIS: _base_axis,
    EquationKind.PLATFORM_AXIS: _platform_axis,
    EquationKind.DIRECTION_1: lambda at: _component(at, _basis(at.axes("platform"))[:, 0]),
    EquationKind.DIRECTION_2: lambda at: _component(at, _basis(at.axes("platform"))[:, 1]),
    EquationKind.TWIST: _twist,
}


def _given(vector: Array | None) -> Array:
    """Return the axis, which a leg with this equation has."""
    if vector is None:
        raise ValueError("a leg whose joints need an axis was described without one")
    return vector


def _basis(axes: Array) -> Array:
    """Return the two directions (n, 2, 3) perpendicular to axes (n, 3) of legs, cached."""
    return _basis_of(np.ascontiguousarray(axes, dtype=np.float64).tobytes())


@lru_cache(maxsize=1024)
def _basis_of(axes: bytes) -> Array:
    """Return the bases of axes by their numbers, read-only."""
    basis = normal_basis(np.frombuffer(axes).reshape(-1, 3))
    basis.flags.writeable = False
    return basis


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1)[..., None])


_ROWS = VectorOps(_dot, cross, _unit, np.cos, np.sin)
