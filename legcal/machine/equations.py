"""What legs demand of poses, with derivatives by the pose and by the numbers of the legs.

A row holds by a reading (the length of an actuated leg) or by the machine alone (the length of a
rod, a revolute axis, a twist, the plane of a planar machine). Freedoms are a rotation about the
origin of the platform's frame [rad] and a displacement [m], both in the frame of the base. The
rows of :func:`linearize` are those of the paper; :func:`pose_equations` counts rows without a unit
at the far end of their leg, so that all are lengths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, cross, normal_basis
from legcal.machine.leg import N_LOCAL, Demand, Leg, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """Equations at k poses, m rows each."""

    values: Array  # (k, m) how far from met [m]; |AB| - q0 for a length, to equal the leg's s q
    by_pose: Array  # (k, m, 6) derivative by rotation [rad] and displacement [m]
    by_local: Array  # (k, m, 12) by the numbers of the row's leg, exact where the rows are met:
    # A, B, q0 [m], turns of both axes about their normal_basis, twist [rad]; or (k, m, 0)
    leg: IntArray  # (m,) the leg of each row, -1 for the plane
    demands: tuple[Demand, ...]  # (m,) what each row is about
    measured: BoolArray  # (m,) rows that hold by a reading

    def of(self, rows: BoolArray) -> PoseEquations:
        """Return some of the rows."""
        return PoseEquations(
            self.values[:, rows],
            self.by_pose[:, rows],
            self.by_local[:, rows],
            self.leg[rows],
            tuple(d for d, is_in in zip(self.demands, rows, strict=True) if is_in),
            self.measured[rows],
        )

    def by_parameters(self, parametrization: Parametrization) -> Array:
        """Return the derivatives by parameters, (k, m, p)."""
        k, m, _ = self.by_local.shape
        wide = np.zeros((k, m, len(parametrization) + 1))  # the last one for what is none
        wide[:, np.arange(m)[:, None], parametrization.place[self.leg]] = self.by_local
        return wide[..., :-1]


def pose_equations(
    legs: Sequence[Leg], R: Array, t: Array, *, by_local: bool = True
) -> PoseEquations:
    """Return what legs demand of poses R (k, 3, 3), t (k, 3) [m]; all rows are lengths.

    Without *by_local* these derivatives have no columns, which takes two thirds of the time.
    """
    if all(map(_is_point_like, legs)):
        return _point_like(legs, R, t, by_local)
    parts = []
    for j, leg in enumerate(legs):
        found = linearize(leg, R, t, by_local=by_local)
        rows = np.array([leg.kind is not LegKind.PASSIVE] + [True] * (len(leg.demands) - 1))
        arm = np.where(_are(Demand.LENGTH, leg.demands), 1.0, found.values[:, :1] + leg.q0)
        parts.append(
            PoseEquations(
                arm * found.values,
                arm[..., None] * found.by_pose,
                arm[..., None] * found.by_local,
                np.full(len(rows), j),
                found.demands,
                found.measured,
            ).of(rows)
        )
    return _stacked(parts)


def linearize(leg: Leg, R: Array, t: Array, *, by_local: bool = True) -> PoseEquations:
    """Return all equations of one leg at poses R (k, 3, 3), t (k, 3) [m], as the paper has them.

    Rows but that of the length have no unit; a passive leg has the row of its length too.
    """
    state = _State(leg, R, t, by_local)
    rows = [_ROWS[demand](state) for demand in leg.demands]
    is_length = _are(Demand.LENGTH, leg.demands)
    return PoseEquations(
        np.stack([row.value for row in rows], axis=1),
        np.stack([row.by_pose for row in rows], axis=1),
        np.stack([row.by_local for row in rows], axis=1),
        np.zeros(len(rows), dtype=np.intp),
        leg.demands,
        is_length & (leg.kind is LegKind.ACTUATED),
    )


def equations_at(machine: Machine, R: Array, t: Array) -> PoseEquations:
    """Return all equations of a machine, its plane too, at poses of its links, without by_local."""
    found = pose_equations(machine.legs, R, t, by_local=False)
    return found if machine.spatial else _stacked([found, _plane(machine, R, t)])


def demands_at(machine: Machine, T_base_platform: RigidTransform) -> PoseEquations:
    """Return the same at one pose."""
    matrix = T_base_platform.as_matrix()[None]
    return equations_at(machine, matrix[:, :3, :3], matrix[:, :3, 3])


def constraints_at(machine: Machine, T_base_platform: RigidTransform) -> PoseEquations:
    """Return the equations that hold at one pose whatever the readings are."""
    demands = demands_at(machine, T_base_platform)
    return demands.of(~demands.measured)


def is_constrained(machine: Machine) -> bool:
    """Say whether the machine itself forbids some poses, whatever the lengths of its sliders."""
    return not machine.spatial or any(map(n_bonds, machine.legs))


def n_bonds(leg: Leg) -> int:
    """Return how many equations of a leg hold without a reading."""
    return len(leg.demands) - (leg.kind is not LegKind.CONSTANT)


def freedoms(frame_legs: Sequence[int]) -> tuple[int, ...]:
    """Return which of the six components of a platform's motion in R_b are possible at all."""
    return (0, 1, 2, 3, 4, 5) if len(frame_legs) == 3 else (2, 3, 4)


_SINGULAR = 1e-9  # of the largest singular value


def pose_sensitivity(
    legs: Sequence[Leg],
    parametrization: Parametrization,
    frame_legs: Sequence[int],
    R: Array,
    t: Array,
) -> Array:
    """Return how parameters move R_e in R_b at given readings, (k, 6, p): rotation, displacement.

    The equations of all legs hold before and after: F_pose d_pose + F_xi d_xi = 0. Where there are
    more than freedoms (a 3-UPU that only translates) the platform goes where they are met best.

    Raises
    ------
    NotIdentifiable
        If readings and legs do not determine a pose.
    """
    equations = pose_equations(legs, R, t)
    columns = list(freedoms(frame_legs))
    F = equations.by_pose[:, :, columns]
    singular = np.linalg.svd(F, compute_uv=False)
    few = singular.shape[1] < len(columns)
    bad = np.flatnonzero((singular[:, -1] < _SINGULAR * singular[:, 0]) | few)
    if len(bad):
        raise NotIdentifiable(
            f"The platform error could not be predicted: the {int(equations.measured.sum())} "
            f"readings do not determine platform pose {bad[0] + 1}, where the machine is singular "
            f"or has too few motors; {len(columns)} independent equations are needed; leave this "
            "pose out."
        )
    moved = np.zeros((len(t), 6, len(parametrization)))
    moved[:, columns] = -np.linalg.pinv(F) @ equations.by_parameters(parametrization)
    return moved


_WORDS = {
    Demand.LENGTH: "off its constant length",
    Demand.BASE_AXIS: "off the plane normal to its axis at the base",
    Demand.PLATFORM_AXIS: "off the plane normal to its axis at the platform",
    Demand.ALONG_1: "off the direction that it has in the platform",
    Demand.ALONG_2: "off the direction that it has in the platform",
    Demand.TWIST: "twisted at its end",
    Demand.PLANE: "out of its plane",
}
_EXACT = 1e-9  # [m]


def worst_in_words(machine: Machine, equations: PoseEquations, verb: str = "") -> str:
    """Return the row furthest from met at the first pose: who (verb) how far how."""
    row = int(np.argmax(np.abs(equations.values[0])))
    leg, how = equations.leg[row], _WORDS[equations.demands[row]]
    who = "the platform" if leg < 0 else f"leg '{machine.leg_names[leg]}'"
    return " ".join(f"{who} {verb} {1e3 * abs(equations.values[0, row]):.3g} mm {how}".split())


def unmet(machine: Machine, T_base_platform: RigidTransform) -> str | None:
    """Return which constraint a pose does not meet, in words; None where it meets all.

    A constraint counts as met within a nanometre, or as well as the machine meets it at home where
    its axes are a little off (they may be, by up to a milliradian).
    """
    if not is_constrained(machine):
        return None
    here = constraints_at(machine, T_base_platform)
    worst = np.abs(here.values).max()
    if worst <= _EXACT:
        return None
    at_home = np.abs(constraints_at(machine, machine.home).values).max()
    if worst <= _EXACT + 10.0 * at_home:
        return None
    return worst_in_words(machine, here, "would be")


def _is_point_like(leg: Leg) -> bool:
    """Say whether a leg demands its length and nothing else."""
    return leg.kind is not LegKind.PASSIVE and leg.demands == (Demand.LENGTH,)


def _point_like(legs: Sequence[Leg], R: Array, t: Array, by_local: bool) -> PoseEquations:
    """Return the lengths of all legs at once."""
    A = np.array([leg.A for leg in legs]).reshape(-1, 3)
    arms = np.array([leg.B for leg in legs]).reshape(-1, 3) @ np.swapaxes(R, 1, 2)
    vectors = arms + t[:, None] - A
    lengths = np.sqrt(np.einsum("knx,knx->kn", vectors, vectors))
    u = vectors / lengths[..., None]
    local = np.zeros((*lengths.shape, N_LOCAL if by_local else 0))
    if by_local:
        local[..., :3], local[..., 3:6], local[..., 6] = -u, u @ R, -1.0
    return PoseEquations(
        lengths - np.array([leg.q0 for leg in legs]),
        np.concatenate([cross(arms, u), u], axis=2),
        local,
        np.arange(len(legs)),
        (Demand.LENGTH,) * len(legs),
        np.array([leg.kind is LegKind.ACTUATED for leg in legs], dtype=np.bool_),
    )


def _plane(machine: Machine, R: Array, t: Array) -> PoseEquations:
    """Return the three equations that keep a platform in its plane, tilts at a mean leg's end."""
    normal = machine.T_base_Rb.as_matrix()[:3, 2]
    carried = R @ machine.T_platform_Re.as_matrix()[:3, 2]
    arms = machine.B_platform @ np.swapaxes(R, 1, 2)
    vectors = arms + t[:, None] - machine.A_base
    scale = np.linalg.norm(vectors, axis=2).mean(axis=1)
    values, by_pose = np.zeros((len(t), 3)), np.zeros((len(t), 3, 6))
    values[:, 0] = (vectors @ normal).mean(axis=1)
    by_pose[:, 0, :3] = np.cross(arms.mean(axis=1), normal)
    by_pose[:, 0, 3:] = normal
    for row, e in enumerate(normal_basis(normal), start=1):
        values[:, row] = scale * (carried @ e)
        by_pose[:, row, :3] = scale[:, None] * np.cross(carried, e)
    none = np.zeros((len(t), 3, 0))
    is_read = np.zeros(3, dtype=np.bool_)
    return PoseEquations(values, by_pose, none, np.full(3, -1), (Demand.PLANE,) * 3, is_read)


def _stacked(parts: Sequence[PoseEquations]) -> PoseEquations:
    """Return the rows of several together."""
    return PoseEquations(
        np.concatenate([part.values for part in parts], axis=1),
        np.concatenate([part.by_pose for part in parts], axis=1),
        np.concatenate([part.by_local for part in parts], axis=1),
        np.concatenate([part.leg for part in parts]),
        tuple(demand for part in parts for demand in part.demands),
        np.concatenate([part.measured for part in parts]),
    )


def _are(which: Demand, demands: Sequence[Demand]) -> BoolArray:
    """Return which rows are about one thing."""
    return np.array([demand is which for demand in demands], dtype=np.bool_)


class _State:
    """A leg at poses: its direction, and its axes turned into the frame of the base."""

    def __init__(self, leg: Leg, R: Array, t: Array, by_local: bool) -> None:
        self.leg, self.R, self.by_local = leg, R, by_local
        self.arm = R @ leg.B
        vector = self.arm + t - leg.A
        self.length = np.linalg.norm(vector, axis=1)
        self.u = vector / self.length[:, None]

    def turned(self, vector: Array) -> Array:
        """Return a direction of the platform in the frame of the base, (k, 3)."""
        return np.asarray(self.R @ vector)


class _Row:
    """One equation at poses, its derivative collected from what it depends on."""

    def __init__(self, state: _State, value: Array) -> None:
        self.state, self.value = state, value
        self.by_pose = np.zeros((len(value), 6))
        self.by_local = np.zeros((len(value), N_LOCAL if state.by_local else 0))

    def depends_on_leg(self, gradient: Array) -> None:
        """Add the dependence on the vector from A to B."""
        self.by_pose[:, :3] += cross(self.state.arm, gradient)
        self.by_pose[:, 3:] += gradient
        if self.state.by_local:
            self.by_local[:, :3] -= gradient
            self.by_local[:, 3:6] += _back(self.state.R, gradient)

    def depends_on_u(self, gradient: Array) -> None:
        """Add the dependence on the leg's direction."""
        u = self.state.u
        across = gradient - u * _dot(u, gradient)[:, None]
        self.depends_on_leg(across / self.state.length[:, None])

    def depends_on_base_axis(self, gradient: Array) -> None:
        """Add the dependence on the axis at the base."""
        if not self.state.by_local:
            return
        e1, e2 = _basis(_given(self.state.leg.base_axis))
        self.by_local[:, 7] -= gradient @ e2
        self.by_local[:, 8] += gradient @ e1

    def depends_on_platform_vector(self, vector: Array, gradient: Array) -> None:
        """Add the dependence on a direction that is tied to the platform and to its axis."""
        axis = _given(self.state.leg.platform_axis)
        self.by_pose[:, :3] += cross(self.state.turned(vector), gradient)
        if not self.state.by_local:
            return
        inside = _back(self.state.R, gradient)
        for column, e in zip((9, 10), _basis(axis), strict=True):
            self.by_local[:, column] += inside @ cross(e, vector)


def _length(state: _State) -> _Row:
    """Return |AB| - q0."""
    row = _Row(state, state.length - state.leg.q0)
    row.depends_on_leg(state.u)
    row.by_local[:, 6:7] = -1.0
    return row


def _base_axis(state: _State) -> _Row:
    """Return v . u of eq (7) at the base."""
    v = np.broadcast_to(_given(state.leg.base_axis), state.u.shape)
    row = _Row(state, _dot(v, state.u))
    row.depends_on_u(v)
    row.depends_on_base_axis(state.u)
    return row


def _platform_axis(state: _State) -> _Row:
    """Return v . u of eq (7) at the platform."""
    return _component(state, _given(state.leg.platform_axis))


def _along(which: int, state: _State) -> _Row:
    """Return a component of u across the direction that the platform gives the leg."""
    return _component(state, _basis(_given(state.leg.platform_axis))[which])


def _component(state: _State, vector: Array) -> _Row:
    """Return the component of u along a direction of the platform."""
    v = state.turned(vector)
    row = _Row(state, _dot(v, state.u))
    row.depends_on_u(v)
    row.depends_on_platform_vector(vector, state.u)
    return row


def _twist(state: _State) -> _Row:
    """Return sin(angle - twist) of the inner axes p and w about u."""
    leg, u = state.leg, state.u
    a, tau = _given(leg.base_axis), float(leg.twist or 0.0)
    across = cross(a, u)
    reach = np.linalg.norm(across, axis=1)[:, None]
    p = np.broadcast_to(a, u.shape) if leg.base_joint == "R" else across / reach
    b = _given(leg.platform_axis)
    outer = _basis(b)[0] if leg.platform_joint == "" else b
    far = cross(state.turned(outer), u)
    far_reach = np.linalg.norm(far, axis=1)[:, None]
    w = far / far_reach if leg.platform_joint == "U" else state.turned(outer)
    c, s = np.cos(tau), np.sin(tau)
    row = _Row(state, c * _dot(u, cross(p, w)) - s * _dot(p, w))
    by_p, by_w = c * cross(w, u) - s * w, c * cross(u, p) - s * p
    row.depends_on_u(c * cross(p, w))
    if leg.base_joint == "U":
        row.depends_on_u(cross(by_p, a) / reach)
        by_p = cross(u, by_p) / reach
    row.depends_on_base_axis(by_p)
    if leg.platform_joint == "U":
        row.depends_on_u(cross(by_w, state.turned(outer)) / far_reach)
        by_w = cross(u, by_w) / far_reach
    row.depends_on_platform_vector(outer, by_w)
    if state.by_local:
        row.by_local[:, 11] = -(s * _dot(u, cross(p, w)) + c * _dot(p, w))
    return row


_ROWS = {
    Demand.LENGTH: _length,
    Demand.BASE_AXIS: _base_axis,
    Demand.PLATFORM_AXIS: _platform_axis,
    Demand.ALONG_1: lambda state: _along(0, state),
    Demand.ALONG_2: lambda state: _along(1, state),
    Demand.TWIST: _twist,
}


def _given(vector: Array | None) -> Array:
    """Return an axis that a leg with this demand has."""
    if vector is None:
        raise ValueError("a leg whose joints need an axis was described without one")
    return vector


def _basis(axis: Array) -> Array:
    """Return the two directions across an axis of a leg, which is asked for at every pose."""
    return _basis_of(np.ascontiguousarray(axis, dtype=np.float64).tobytes())


@lru_cache(maxsize=1024)
def _basis_of(axis: bytes) -> Array:
    """Return the basis of an axis by its three numbers, not to be written to."""
    basis = normal_basis(np.frombuffer(axis))
    basis.flags.writeable = False
    return basis


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products of rows."""
    return np.asarray(np.einsum("ki,ki->k", a, b))


def _back(R: Array, vectors: Array) -> Array:
    """Return directions of the base's frame in that of the platform, (k, 3)."""
    return np.asarray((vectors[:, None] @ R)[:, 0])
