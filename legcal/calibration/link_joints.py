"""Joint centres in the links of the model, as its URDF has them, with what is known of them there.

Results are computed in R_b and R_e, which the joints of the ``base_frame`` legs define: an owner
knows the links. The calibrated R_b is laid on the nominal one in the base link and R_e likewise on
the platform, as in ``calibrated.urdf``: p_link = T_link_frame p_frame, and a covariance is turned
with it, R C R^T. What a frame defines has no uncertainty there: coordinates and directions in which
its joints cannot move have the variance zero, and are marked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import (
    AxisInLink,
    ComparedJoint,
    ComparedLink,
    CoordinateStatus,
    Distance,
    FrameMark,
    JointInLink,
    Kinematic,
    LinkBlock,
    ParameterRow,
    WeakInLinks,
)
from legcal.files.motions import Pose
from legcal.geometry.axes import turned_axis
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.directions import SHOWN, describe_direction
from legcal.machine.leg import LegColumns
from legcal.machine.model import Machine
from legcal.machine.parameters import free_coordinates, geometries, parametrization_of
from legcal.machine.rods import AT_ZERO
from legcal.vision.board import LINKS, Link

FRAMES: dict[Link, str] = {"base": "R_b", "platform": "R_e"}
_MARKS: tuple[FrameMark, ...] = ("origin", "x axis", "xy plane")
_STATUSES: tuple[CoordinateStatus, ...] = ("weak", "estimated", "fixed", "frame")
_ROUNDING = 1e-9  # of the components of unit vectors


@dataclass(frozen=True, eq=False)
class _LinkFrame:
    """R_b in the base link, or R_e in the platform link, and what it makes of coordinates."""

    side: Link
    link: str
    T_link_frame: RigidTransform
    points: Array  # (n_legs, 3) joint centres in the frame [m]
    place: IntArray  # (n_legs, 3) of their coordinates among all kinematic parameters, or -1
    names: tuple[str, ...]  # of these parameters
    legs: tuple[str, ...]
    frame_legs: tuple[int, ...]
    zero: BoolArray  # (n_legs, 3) zero by the definition of the frame
    axes: tuple[Array | None, ...]  # of the joints of the legs in the frame, where they have one
    turns: IntArray  # (n_legs, 2) of the turns of these axes among all kinematic parameters, or -1

    @classmethod
    def of(cls, machine: Machine, side: Link) -> _LinkFrame:
        """Return that of a machine."""
        found, legs = parametrization_of(machine, twists=True), geometries(machine)
        is_base = side == "base"
        n_d = len(machine.frame_legs)
        zero = ~free_coordinates(machine.n_legs, machine.frame_legs)
        zero[:, n_d:] = False  # heights in a plane are kept, and define nothing
        return cls(
            side,
            machine.base if is_base else machine.platform,
            machine.T_link_frame(side),
            np.array([leg.A if is_base else leg.B for leg in legs]),
            found.place[:, LegColumns.A if is_base else LegColumns.B],
            found.names,
            machine.leg_names,
            machine.frame_legs,
            zero,
            tuple(leg.base_axis if is_base else leg.platform_axis for leg in legs),
            found.place[:, LegColumns.BASE_AXIS if is_base else LegColumns.PLATFORM_AXIS],
        )

    @property
    def R(self) -> Array:
        """Rotation (3, 3) from the frame to the link."""
        return np.asarray(self.T_link_frame.rotation.as_matrix())

    def points_with(self, values: Mapping[str, float]) -> Array:
        """Return the joint centres (n_legs, 3) with these values of parameters, in the link [m]."""
        points = self.points.copy()
        for at in np.argwhere(self.place >= 0).tolist():
            name = self.names[self.place[tuple(at)]]
            points[tuple(at)] = values.get(name, points[tuple(at)])
        return np.asarray(self.T_link_frame.apply(points))

    def defines(self, leg: int) -> FrameMark | None:
        """Return what of the frame a joint defines."""
        return _MARKS[self.frame_legs.index(leg)] if leg in self.frame_legs else None

    def named(self, of: IntArray) -> list[str]:
        """Return the names of parameters, "" where there is none."""
        return [self.names[k] if k >= 0 else "" for k in of.tolist()]

    def turned(self, leg: int, w: Array) -> Array:
        """Return two turns of an axis (2,) as a rotation vector in the link [rad]."""
        axis = self.axes[leg]
        return np.zeros(3) if axis is None else np.asarray(self.R @ (w @ normal_basis(axis)))

    def statuses(self, leg: int, status: Mapping[str, str]) -> list[CoordinateStatus]:
        """Return what each coordinate of a joint in the link is, by that of its parameters."""
        found: list[CoordinateStatus] = []
        for row in self.R:
            parts = {
                "frame" if is_zero else "fixed" if k < 0 else status.get(self.names[k], "fixed")
                for k, is_zero, part in zip(self.place[leg], self.zero[leg], row, strict=True)
                if abs(part) > _ROUNDING
            }
            found.append(next(one for one in _STATUSES if one in parts))
        return found


def joints_title(side: str, link: str, joints_move: bool) -> str:
    """Return the title of a table of joints, of which those at A may move with readings."""
    return (
        f"Joints of the {side} in the link {link}{AT_ZERO * (joints_move and side == 'base')} [mm]"
    )


def joints_in_links(
    machine: Machine,
    parameters: Sequence[ParameterRow],
    kinematic: Kinematic,
    axes: Mapping[str, Mapping[str, Sequence[float]]] | None = None,
) -> dict[Link, LinkBlock]:
    """Return the joints of a calibration in the links of base and platform.

    Parameters
    ----------
    machine : Machine
        The nominal or the calibrated model: R_b and R_e stand where they stood in the links.
    parameters : sequence of ParameterRow
        Those of ``result.json``, in R_b and R_e [m].
    kinematic : Kinematic
        The covariance of all kinematic parameters by name, zero where they are fixed or held.
    axes : mapping, optional
        The nominal axes by side and leg, in R_b and R_e; without them none are returned.

    Returns
    -------
    dict
        A :class:`LinkBlock` for ``base`` and ``platform`` [m]; joints in the order of the legs.
    """
    rows = {row.name: row for row in parameters}
    status = {name: row.status for name, row in rows.items()}
    number = {name: k for k, name in enumerate(kinematic.names)}
    everything = np.array(kinematic.covariance)
    blocks: dict[Link, LinkBlock] = {}
    for side in LINKS:
        frame = _LinkFrame.of(machine, side)
        nominal = frame.points_with({name: row.nominal for name, row in rows.items()})
        calibrated = frame.points_with({name: row.value for name, row in rows.items()})
        joints = []
        for j, leg in enumerate(frame.legs):
            names = frame.named(frame.place[j])
            known = [i for i, name in enumerate(names) if name in number]
            at = [number[names[i]] for i in known]
            C = np.zeros((3, 3))
            C[np.ix_(known, known)] = everything[np.ix_(at, at)]
            C = frame.R @ C @ frame.R.T
            statuses = frame.statuses(j, status)
            sigma = np.sqrt(np.maximum(np.diagonal(C), 0.0)).tolist()
            joints.append(
                JointInLink(
                    leg=leg,
                    xyz=calibrated[j].tolist(),
                    nominal=nominal[j].tolist(),
                    sigma=[
                        s if one == "estimated" else None
                        for s, one in zip(sigma, statuses, strict=True)
                    ],
                    covariance=(0.5 * (C + C.T)).tolist(),
                    status=statuses,
                    defines=frame.defines(j),
                )
            )
        blocks[side] = LinkBlock(
            link=frame.link,
            T_link_frame=Pose.of(frame.T_link_frame),
            joints=joints,
            axes=_axes_in_link(frame, (axes or {}).get(side, {}), rows, number, everything),
        )
    return blocks


def _axes_in_link(
    frame: _LinkFrame,
    nominal: Mapping[str, Sequence[float]],
    rows: Mapping[str, ParameterRow],
    number: Mapping[str, int],
    C: Array,
) -> list[AxisInLink]:
    """Return the axes of joints, with C the covariance of the numbered parameters."""
    found = []
    for j, leg in enumerate(frame.legs):
        names = frame.named(frame.turns[j])
        if leg not in nominal or not all(names):
            continue
        axis = np.array(nominal[leg])
        turns = normal_basis(axis) @ frame.R.T  # (2, 3) unit turns in the link
        w = np.array([rows[name].value if name in rows else 0.0 for name in names])
        sigma = None
        if all(name in rows and rows[name].status == "estimated" for name in names):
            at = [number[name] for name in names]
            variance = np.einsum("ki,kl,li->i", turns, C[np.ix_(at, at)], turns)
            sigma = np.sqrt(np.maximum(variance, 0.0)).tolist()
        found.append(
            AxisInLink(
                leg=leg,
                direction=(frame.R @ turned_axis(axis, w)).tolist(),
                nominal=(frame.R @ axis).tolist(),
                turn=(w @ turns).tolist(),
                sigma=sigma,
            )
        )
    return found


def weak_in_links(machine: Machine, parts: Sequence[tuple[str, float]]) -> WeakInLinks:
    """Return a combination of parameters with joints and axes along the axes of their links.

    ``parts`` are names and components of a vector in R_b and R_e; what is no joint or axis stays.
    """
    component, found = dict(parts), dict[str, float]()
    for side in LINKS:
        frame = _LinkFrame.of(machine, side)
        for j, leg in enumerate(frame.legs):
            for kind, names in (
                (side, frame.named(frame.place[j])),
                (f"{side}_axis", frame.named(frame.turns[j])),
            ):
                own = np.array([component.pop(name, 0.0) for name in names])
                v = frame.R @ own if kind == side else frame.turned(j, own)
                found |= {
                    f"{leg}.{kind}.{axis}": float(x) for axis, x in zip("xyz", v, strict=True)
                }
    found |= component
    largest = max(map(abs, found.values()), default=0.0)
    shown = {name: x for name, x in found.items() if abs(x) > SHOWN * largest}
    return WeakInLinks(
        direction=describe_direction(list(shown), machine.leg_names),
        parameters=list(shown),
        components=list(shown.values()),
    )


def compared_joints(machine: Machine, reference: Machine) -> dict[Link, ComparedLink]:
    """Return the joints of two models of a machine in the links of the first [m].

    R_b and R_e of the reference are laid on those of the model, as in eq (20): where they stand in
    the links cannot be seen.
    """
    found: dict[Link, ComparedLink] = {}
    for side in LINKS:
        frame, other = _LinkFrame.of(machine, side), _LinkFrame.of(reference, side)
        ours = np.asarray(frame.T_link_frame.apply(frame.points))
        theirs = np.asarray(frame.T_link_frame.apply(other.points))
        apart = frame.T_link_frame.inv() * other.T_link_frame
        shift = frame.T_link_frame.translation - other.T_link_frame.translation
        found[side] = ComparedLink(
            link=frame.link,
            frames_apart=Distance(
                dX_m=float(np.linalg.norm(shift)), dE_rad=float(apart.rotation.magnitude())
            ),
            joints=[
                ComparedJoint(
                    leg=leg,
                    xyz=ours[j].tolist(),
                    reference=theirs[j].tolist(),
                    difference=((frame.points[j] - other.points[j]) @ frame.R.T).tolist(),
                    defined=[one == "frame" for one in frame.statuses(j, {})],
                    defines=frame.defines(j),
                )
                for j, leg in enumerate(frame.legs)
            ],
        )
    return found


def mark_in_words(side: Link, status: CoordinateStatus, defines: FrameMark | None) -> str:
    """Return what a coordinate is where it is not simply estimated: ``defines R_b``."""
    if status == "frame":
        return f"defines {FRAMES[side]}"
    if status == "estimated":
        return "" if defines is None else f"{defines} of {FRAMES[side]}"
    return status
