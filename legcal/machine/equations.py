"""Everything that a mechanism demands of a pose: the equations of all legs, and the plane.

A row holds by a reading (the length of an actuated leg) or by the mechanism alone (the length of a
rod, a revolute axis, a twist, the plane of a planar mechanism). All rows are lengths: an
equation without a unit counts at the far end of its leg. Freedoms are a rotation about the
origin of the platform link and a displacement, in the base link.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, BoolArray, motion_of, normal_basis
from legcal.machine.leg import N_LOCAL, Demand, LegGeometry, LegKind, geometry_of
from legcal.machine.model import Mechanism


@dataclass(frozen=True, eq=False)
class Linearization:
    """The equations of one leg at poses.

    Attributes
    ----------
    demands : tuple of Demand
        What each row is about.
    values : (k, m) array
        |AB| - q0 [m] for the length, which the leg's s q is to equal; zero where a demand is met
        for the other rows, which have no unit.
    by_pose : (k, m, 6) array
        Derivative by a small rotation of the platform about its origin [rad] and by its
        displacement [m], both in the frame of the base.
    by_local : (k, m, 12) array
        Derivative by A, B, q0 [m], turns of the base axis and of the platform axis about the
        first and second vector of :func:`legcal.geometry.lines.normal_basis`, and the twist [rad].
        Exact where the demands are met.
    """

    demands: tuple[Demand, ...]
    values: Array
    by_pose: Array
    by_local: Array


def linearize(leg: LegGeometry, R: Array, t: Array, *, by_local: bool = True) -> Linearization:
    """Return a leg's equations and their derivatives at poses of the platform.

    Parameters
    ----------
    leg : LegGeometry
        The leg.
    R, t : (k, 3, 3) and (k, 3) array
        Rotation and position [m] of the platform's frame in that of the base.
    by_local : bool
        Whether derivatives by the leg's numbers are wanted too; without them they are
        (k, m, 0), in two thirds of the time.

    Returns
    -------
    Linearization
    """
    state = _State(leg, R, t, by_local)
    rows = [_ROWS[demand](state) for demand in leg.demands]
    return Linearization(
        leg.demands,
        np.stack([row.value for row in rows], axis=1),
        np.stack([row.by_pose for row in rows], axis=1),
        np.stack([row.by_local for row in rows], axis=1),
    )


def demanded(leg: LegGeometry, R: Array, t: Array, *, by_local: bool = True) -> Linearization:
    """Return what a leg really demands at poses: a passive one nothing of its length.

    All rows are lengths [m]: those without a unit are counted at the far end of the leg. For the
    rest see :func:`linearize`.
    """
    found = linearize(leg, R, t, by_local=by_local)
    rows = slice(1 if leg.kind is LegKind.PASSIVE else 0, None)
    is_length = np.array([d is Demand.LENGTH for d in found.demands[rows]], dtype=np.bool_)
    arm = np.where(is_length, 1.0, found.values[:, :1] + leg.q0)
    return Linearization(
        found.demands[rows],
        arm * found.values[:, rows],
        arm[..., None] * found.by_pose[:, rows],
        arm[..., None] * found.by_local[:, rows],
    )


class _State:
    """A leg at poses: its direction, and its axes turned into the frame of the base."""

    def __init__(self, leg: LegGeometry, R: Array, t: Array, by_local: bool) -> None:
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
        self.by_pose[:, :3] += _cross(self.state.arm, gradient)
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
        self.by_pose[:, :3] += _cross(self.state.turned(vector), gradient)
        if not self.state.by_local:
            return
        inside = _back(self.state.R, gradient)
        for column, e in zip((9, 10), _basis(axis), strict=True):
            self.by_local[:, column] += inside @ _cross(e, vector)


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
    across = _cross(a, u)
    reach = np.linalg.norm(across, axis=1)[:, None]
    p = np.broadcast_to(a, u.shape) if leg.base_joint == "R" else across / reach
    b = _given(leg.platform_axis)
    outer = _basis(b)[0] if leg.platform_joint == "" else b
    far = _cross(state.turned(outer), u)
    far_reach = np.linalg.norm(far, axis=1)[:, None]
    w = far / far_reach if leg.platform_joint == "U" else state.turned(outer)
    c, s = np.cos(tau), np.sin(tau)
    row = _Row(state, c * _dot(u, _cross(p, w)) - s * _dot(p, w))
    by_p, by_w = c * _cross(w, u) - s * w, c * _cross(u, p) - s * p
    row.depends_on_u(c * _cross(p, w))
    if leg.base_joint == "U":
        row.depends_on_u(_cross(by_p, a) / reach)
        by_p = _cross(u, by_p) / reach
    row.depends_on_base_axis(by_p)
    if leg.platform_joint == "U":
        row.depends_on_u(_cross(by_w, state.turned(outer)) / far_reach)
        by_w = _cross(u, by_w) / far_reach
    row.depends_on_platform_vector(outer, by_w)
    if state.by_local:
        row.by_local[:, 11] = -(s * _dot(u, _cross(p, w)) + c * _dot(p, w))
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


def _cross(a: Array, b: Array) -> Array:
    """Return vector products of rows or single vectors; np.cross is slow on few of them."""
    (x, y, z), (i, j, k) = a.T, b.T
    first = y * k - z * j
    product = np.empty((*first.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = first, z * i - x * k, x * j - y * i
    return product


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products of rows."""
    return np.asarray(np.einsum("ki,ki->k", a, b))


def _back(R: Array, vectors: Array) -> Array:
    """Return directions of the base's frame in that of the platform, (k, 3)."""
    return np.asarray((vectors[:, None] @ R)[:, 0])


_WORDS = {
    Demand.LENGTH: "off its constant length",
    Demand.BASE_AXIS: "off the plane normal to its axis at the base",
    Demand.PLATFORM_AXIS: "off the plane normal to its axis at the platform",
    Demand.ALONG_1: "off the direction that it has in the platform",
    Demand.ALONG_2: "off the direction that it has in the platform",
    Demand.TWIST: "twisted at its end",
}
_EXACT = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class Demands:
    """The equations of a mechanism at one pose.

    Attributes
    ----------
    found : tuple of pairs of str
        What a row that is not met means, in words: who, and how ("leg 'leg2'", "off its constant
        length").
    values : (m,) array
        How far each row is from met [m]; for the length of an actuated leg |AB| - q0.
    jacobian : (m, 6) array
        Derivative by rotation [rad] and displacement [m] of the platform.
    measured : (m,) array of bool
        The rows that hold by a reading.
    """

    found: tuple[tuple[str, str], ...]
    values: Array
    jacobian: Array
    measured: BoolArray

    def of(self, rows: BoolArray) -> "Demands":
        """Return some of the rows."""
        chosen = tuple(f for f, is_in in zip(self.found, rows, strict=True) if is_in)
        return Demands(chosen, self.values[rows], self.jacobian[rows], self.measured[rows])

    def worst(self, verb: str = "") -> str:
        """Return the row that is furthest from met, with the amount: who (verb) how far how."""
        if not len(self.values):
            return "nothing is demanded"
        row = int(np.argmax(np.abs(self.values)))
        who, how = self.found[row]
        return " ".join(f"{who} {verb} {1e3 * abs(self.values[row]):.3g} mm {how}".split())


def is_constrained(mechanism: Mechanism) -> bool:
    """Say whether the mechanism itself forbids some poses, whatever the lengths of its sliders."""
    return not mechanism.spatial or any(
        leg.kind is LegKind.CONSTANT or len(geometry_of(leg).demands) > 1 for leg in mechanism.legs
    )


def demands_at(mechanism: Mechanism, T_base_platform: RigidTransform) -> Demands:
    """Return all equations of a mechanism at a pose.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T_base_platform : RigidTransform
        Pose of the platform link.

    Returns
    -------
    Demands
    """
    matrix = T_base_platform.as_matrix()
    R, t = matrix[None, :3, :3], matrix[None, :3, 3]
    found: list[tuple[str, str]] = []
    values: list[float] = []
    rows: list[Array] = []
    measured: list[bool] = []
    for leg in mechanism.legs:
        at = demanded(geometry_of(leg), R, t, by_local=False)
        for demand, value, by_pose in zip(at.demands, at.values[0], at.by_pose[0], strict=True):
            found.append((f"leg '{leg.name}'", _WORDS[demand]))
            values.append(float(value))
            rows.append(by_pose)
            measured.append(demand is Demand.LENGTH and leg.kind is LegKind.ACTUATED)
    if not mechanism.spatial:
        for value, row in _plane(mechanism, matrix):
            found.append(("the platform", "out of its plane"))
            values.append(value)
            rows.append(row)
            measured.append(False)
    return Demands(
        tuple(found),
        np.array(values),
        np.array(rows).reshape(-1, 6),
        np.array(measured, dtype=np.bool_),
    )


def constraints_at(mechanism: Mechanism, T_base_platform: RigidTransform) -> Demands:
    """Return the equations that hold whatever the readings are."""
    demands = demands_at(mechanism, T_base_platform)
    return demands.of(~demands.measured)


def unmet(mechanism: Mechanism, T_base_platform: RigidTransform) -> str | None:
    """Return which constraint a pose does not meet, in words; None where it meets all.

    A constraint counts as met within a nanometre, or as well as the mechanism meets it at home
    where its axes are a little off (they may be, by up to a milliradian).
    """
    if not is_constrained(mechanism):
        return None
    here = constraints_at(mechanism, T_base_platform)
    if np.abs(here.values).max() <= _EXACT:
        return None
    home = np.abs(constraints_at(mechanism, mechanism.home).values).max()
    return here.worst("would be") if np.abs(here.values).max() > _EXACT + 10.0 * home else None


def leg_scale(mechanism: Mechanism, T_base_platform: RigidTransform) -> float:
    """Return the mean length of the legs at a pose [m]."""
    B = T_base_platform.apply(mechanism.B_platform)
    return float(np.linalg.norm(B - mechanism.A_base, axis=1).mean())


def moved(T_base_platform: RigidTransform, step: Sequence[float] | Array) -> RigidTransform:
    """Return a pose after a rotation [rad] and a displacement [m] as :class:`Demands` has them."""
    change = np.asarray(step, dtype=np.float64)
    matrix, turn = T_base_platform.as_matrix(), Rotation.from_rotvec(change[:3])
    return motion_of(turn.as_matrix() @ matrix[:3, :3], matrix[:3, 3] + change[3:])


def _plane(mechanism: Mechanism, matrix: Array) -> list[tuple[float, Array]]:
    """Return the three equations that keep a platform in its plane, tilts at a mean leg's end."""
    normal = mechanism.T_base_Rb.as_matrix()[:3, 2]
    carried = matrix[:3, :3] @ mechanism.T_platform_Re.as_matrix()[:3, 2]
    arms = mechanism.B_platform @ matrix[:3, :3].T
    vectors = arms + matrix[:3, 3] - mechanism.A_base
    scale = float(np.linalg.norm(vectors, axis=1).mean())
    height = float((vectors @ normal).mean())
    found = [(height, np.concatenate([np.cross(arms.mean(axis=0), normal), normal]))]
    for e in normal_basis(normal):
        gradient = np.concatenate([np.cross(carried, e), np.zeros(3)])
        found.append((scale * float(e @ carried), scale * gradient))
    return found
