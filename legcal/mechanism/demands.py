"""Everything that a mechanism demands of a pose: the equations of all legs, and the plane.

A row holds by a reading (the length of an actuated leg) or by the mechanism alone (the length of a
rod, a revolute axis, a twist, the plane of a planar mechanism). All rows are lengths: an
equation without a unit counts at the far end of its leg. Freedoms are a rotation about the
origin of the platform link and a displacement, in the base link.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.frames import motion_of
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.equations import demanded
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import Demand, geometry_of
from legcal.mechanism.model import Mechanism

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
