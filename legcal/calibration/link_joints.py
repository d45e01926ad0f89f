"""Joint centres in the links of the model, as in its URDF, with their covariance.

Results are computed in R_b and R_e, defined by the joints of the ``base_frame`` legs; users know
the links. The calibrated R_b is aligned with the nominal one in the base link and R_e likewise in
the platform link, as in ``calibrated.urdf``: p_link = T_link_frame p_frame, with the covariance
R C R^T. Coordinates that define a frame have no uncertainty there: their variance is zero, and they
are marked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import (
    AxisInLink,
    CoordinateStatus,
    FrameMark,
    JointInLink,
    Kinematic,
    LinkBlock,
    ParameterRow,
    WeakInLinks,
)
from legcal.calibration.quantities import FRAMES
from legcal.files.motions import Pose
from legcal.geometry.lines import normal_basis, turned_axis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LegColumns
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    SHOWN,
    describe_direction,
    free_coordinates,
    geometries,
    parametrization_of,
)
from legcal.machine.rods import AT_ZERO
from legcal.vision.board import LINKS, Link

_MARKS: tuple[FrameMark, ...] = ("origin", "x axis", "xy plane")
_STATUSES: tuple[CoordinateStatus, ...] = ("weak", "estimated", "fixed", "frame")
_ROUNDING = 1e-9  # rounding of the components of unit vectors


@dataclass(frozen=True, eq=False)
class _LinkFrame:
    """R_b in the base link, or R_e in the platform link, with the joints of that side."""

    side: Link
    link: str
    T_link_frame: RigidTransform
    points: Array  # (n_legs, 3): joint centres in the frame [m]
    place: IntArray  # (n_legs, 3): indices of the coordinates among kinematic parameters, or -1
    names: tuple[str, ...]  # names of the kinematic parameters
    legs: tuple[str, ...]
    frame_legs: tuple[int, ...]
    zero: BoolArray  # (n_legs, 3): whether the definition of the frame makes a coordinate zero
    axes: tuple[Array | None, ...]  # joint axes of the legs in the frame; None without one
    turns: IntArray  # (n_legs, 2): indices of the axis rotations among kinematic parameters, or -1

    @classmethod
    def of(cls, machine: Machine, side: Link) -> _LinkFrame:
        """Return the frame of one side of a machine."""
        parametrization, legs = parametrization_of(machine, twists=True), geometries(machine)
        is_base = side == "base"
        n_d = len(machine.frame_legs)
        zero = ~free_coordinates(machine.n_legs, machine.frame_legs)
        zero[:, n_d:] = False  # heights of planar machines are fixed, and define nothing
        return cls(
            side,
            machine.base if is_base else machine.platform,
            machine.T_link_frame(side),
            np.array([leg.A if is_base else leg.B for leg in legs]),
            parametrization.place[:, LegColumns.A if is_base else LegColumns.B],
            parametrization.names,
            machine.leg_names,
            machine.frame_legs,
            zero,
            tuple(leg.base_axis if is_base else leg.platform_axis for leg in legs),
            parametrization.place[:, LegColumns.BASE_AXIS if is_base else LegColumns.PLATFORM_AXIS],
        )

    @property
    def R(self) -> Array:
        """Rotation (3, 3) from the frame to the link."""
        return np.asarray(self.T_link_frame.rotation.as_matrix())

    def points_with(self, values: Mapping[str, float]) -> Array:
        """Return the joint centres (n_legs, 3) in the link at given parameter values [m]."""
        points = self.points.copy()
        for index in np.argwhere(self.place >= 0).tolist():
            name = self.names[self.place[tuple(index)]]
            points[tuple(index)] = values.get(name, points[tuple(index)])
        return np.asarray(self.T_link_frame.apply(points))

    def defines(self, leg: int) -> FrameMark | None:
        """Return the part of the frame that a joint defines."""
        return _MARKS[self.frame_legs.index(leg)] if leg in self.frame_legs else None

    def named(self, indices: IntArray) -> list[str]:
        """Return the names of parameters by index; "" for -1."""
        return [self.names[k] if k >= 0 else "" for k in indices.tolist()]

    def turned(self, leg: int, w: Array) -> Array:
        """Return two turns of an axis (2,) as a rotation vector in the link [rad]."""
        axis = self.axes[leg]
        return np.zeros(3) if axis is None else np.asarray(self.R @ (w @ normal_basis(axis)))

    def statuses(self, leg: int, status: Mapping[str, str]) -> list[CoordinateStatus]:
        """Return the status of each coordinate of a joint in the link, by its parameters."""
        statuses: list[CoordinateStatus] = []
        for row in self.R:
            parts = {
                "frame" if is_zero else "fixed" if k < 0 else status.get(self.names[k], "fixed")
                for k, is_zero, part in zip(self.place[leg], self.zero[leg], row, strict=True)
                if abs(part) > _ROUNDING
            }
            statuses.append(next(possible for possible in _STATUSES if possible in parts))
        return statuses


def joints_title(side: str, link: str, joints_move: bool) -> str:
    """Return the title of a table of joints; *joints_move* if motors move the joints at A."""
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
        The nominal or the calibrated model; R_b and R_e in the links are the same.
    parameters : sequence of ParameterRow
        Parameters of ``result.json``, in R_b and R_e [m].
    kinematic : Kinematic
        The covariance of all kinematic parameters by name, zero for fixed or held ones.
    axes : mapping, optional
        The nominal axes by side and leg, in R_b and R_e; axes are returned only if given.

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
            numbered = [i for i, name in enumerate(names) if name in number]
            indices = [number[names[i]] for i in numbered]
            C = np.zeros((3, 3))
            C[np.ix_(numbered, numbered)] = everything[np.ix_(indices, indices)]
            C = frame.R @ C @ frame.R.T
            statuses = frame.statuses(j, status)
            sigma = np.sqrt(np.maximum(np.diagonal(C), 0.0)).tolist()
            joints.append(
                JointInLink(
                    leg=leg,
                    xyz=calibrated[j].tolist(),
                    nominal=nominal[j].tolist(),
                    sigma=[
                        s if coordinate_status == "estimated" else None
                        for s, coordinate_status in zip(sigma, statuses, strict=True)
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
    axes = []
    for j, leg in enumerate(frame.legs):
        names = frame.named(frame.turns[j])
        if leg not in nominal or not all(names):
            continue
        axis = np.array(nominal[leg])
        turns = normal_basis(axis) @ frame.R.T  # (2, 3) unit turns in the link
        w = np.array([rows[name].value if name in rows else 0.0 for name in names])
        sigma = None
        if all(name in rows and rows[name].status == "estimated" for name in names):
            indices = [number[name] for name in names]
            variance = np.einsum("ki,kl,li->i", turns, C[np.ix_(indices, indices)], turns)
            sigma = np.sqrt(np.maximum(variance, 0.0)).tolist()
        axes.append(
            AxisInLink(
                leg=leg,
                direction=(frame.R @ turned_axis(axis, w)).tolist(),
                nominal=(frame.R @ axis).tolist(),
                turn=(w @ turns).tolist(),
                sigma=sigma,
            )
        )
    return axes


def weak_in_links(machine: Machine, parts: Sequence[tuple[str, float]]) -> WeakInLinks:
    """Return a combination of parameters with joints and axes in link coordinates.

    ``parts`` are names and components of a vector in R_b and R_e; other parameters stay.
    """
    component, named_parts = dict(parts), dict[str, float]()
    for side in LINKS:
        frame = _LinkFrame.of(machine, side)
        for j, leg in enumerate(frame.legs):
            for kind, names in (
                (side, frame.named(frame.place[j])),
                (f"{side}_axis", frame.named(frame.turns[j])),
            ):
                in_frame = np.array([component.pop(name, 0.0) for name in names])
                v = frame.R @ in_frame if kind == side else frame.turned(j, in_frame)
                named_parts |= {
                    f"{leg}.{kind}.{axis}": float(x) for axis, x in zip("xyz", v, strict=True)
                }
    named_parts |= component
    largest = max(map(abs, named_parts.values()), default=0.0)
    significant = {name: x for name, x in named_parts.items() if abs(x) > SHOWN * largest}
    return WeakInLinks(
        direction=describe_direction(list(significant), machine.leg_names),
        parameters=list(significant),
        components=list(significant.values()),
    )


def mark_in_words(side: str, status: str, defines: FrameMark | None) -> str:
    """Return the remark on a coordinate that is not simply estimated: ``defines R_b``."""
    if status == "frame":
        return f"defines {FRAMES[side]}"
    if status == "estimated":
        return "" if defines is None else f"{defines} of {FRAMES[side]}"
    return status
