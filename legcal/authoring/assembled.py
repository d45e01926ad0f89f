"""A described machine put together at home: lengths, axes and travel, all checked."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.authoring.checks import wrong_axes, wrong_lengths, wrong_sizes
from legcal.authoring.home import find_home
from legcal.authoring.machine import Description, Home, LegEntry, LegType
from legcal.errors import ModelError
from legcal.geometry.frames import frame_on_points
from legcal.geometry.types import Array
from legcal.mechanism.leg import LegKind

PARALLEL = 1e-9
FREE_TRAVEL = (0.5, 1.5)  # of the length at home, for passive sliders without limits


@dataclass(frozen=True, eq=False)
class AssembledLeg:
    """A leg of which everything is known.

    Attributes
    ----------
    name, type, kind, tube, rod
        As described, see :class:`legcal.authoring.machine.LegEntry`.
    A_base, B_platform : (3,) array
        Joint centres in the base and the platform link [m].
    u : (3,) array
        Direction from A to B at home, in the base link.
    q0 : float
        Length at reading zero, or of a constant leg [m].
    travel : tuple of float
        Lowest and highest reading [m]; (0, 0) for a constant leg.
    base_axis, platform_axis : (3,) array
        Axes of R and outer axes of U, both in the base link at home; of an S any direction across
        the leg.
    """

    name: str
    type: LegType
    kind: LegKind
    A_base: Array
    B_platform: Array
    u: Array
    q0: float
    travel: tuple[float, float]
    tube: float | None
    rod: float | None
    base_axis: Array
    platform_axis: Array

    @property
    def shortest_shown(self) -> float:
        """The length at reading zero, or at the reading nearest to it within the travel [m]."""
        return self.q0 + min(max(0.0, self.travel[0]), self.travel[1])


@dataclass(frozen=True, eq=False)
class Assembled:
    """A machine of which everything is known.

    Attributes
    ----------
    name : str
        Its name.
    legs : tuple of AssembledLeg
        In order.
    home : Home
        A pose in which it closes, as the file gets it.
    base_frame : tuple of str
        The legs whose joints define R_b and R_e.
    planar : bool
        Whether it moves in the xy plane of base and platform.
    """

    name: str
    legs: tuple[AssembledLeg, ...]
    home: Home
    base_frame: tuple[str, ...]
    planar: bool

    @property
    def T_base_platform(self) -> RigidTransform:
        """The home pose."""
        return self.home.motion()


def assemble(described: Description) -> Assembled:
    """Return a described machine with its home, lengths and axes.

    Parameters
    ----------
    described : Description
        What a table or a family says.

    Raises
    ------
    ModelError
        If it cannot be: joints that coincide, lengths out of all proportion, a travel that does
        not reach home, an axis that does not fit the leg; one sentence for each.
    """
    _refuse(wrong_sizes(described))
    home = find_home(described)
    T = home.motion()
    A = np.array([leg.A_base for leg in described.legs])
    B = T.apply(np.array([leg.B_platform for leg in described.legs]))
    lengths = np.linalg.norm(B - A, axis=1)
    _refuse(wrong_lengths(described, lengths))
    u = (B - A) / lengths[:, None]
    tangents = np.array([across_leg(u[j], A[j] - A.mean(axis=0)) for j in range(len(A))])
    if all_revolute(described):
        tangents[:] = [0.0, 0.0, 1.0]
    legs, problems = [], []
    for j, entry in enumerate(described.legs):
        axes = _axes(entry, tangents[j], T)
        problems += wrong_axes(described, entry, u[j], axes)
        q0, travel = _law(entry, float(lengths[j]))
        legs.append(
            AssembledLeg(
                entry.name, entry.type, entry.kind, entry.A_base, entry.B_platform, u[j], q0,
                travel, entry.tube, entry.rod, *axes,
            )
        )  # fmt: skip
    _refuse(problems)
    planar = all_revolute(described) and is_planar(legs, T)
    frame = _base_frame(described, 2 if _in_a_plane(legs) else 3)
    return Assembled(described.name, tuple(legs), home, frame, planar)


def all_revolute(described: Description) -> bool:
    """Say whether all joints are R, as in planar mechanisms."""
    return all((leg.type.base, leg.type.platform) == ("R", "R") for leg in described.legs)


def _in_a_plane(legs: Sequence[AssembledLeg]) -> bool:
    """Say whether all axes are parallel revolutes across all legs."""
    n = legs[0].base_axis
    return all(
        (leg.type.base, leg.type.platform) == ("R", "R")
        and np.linalg.norm(np.cross(axis, n)) < PARALLEL
        and abs(leg.u @ n) < PARALLEL
        for leg in legs
        for axis in (leg.base_axis, leg.platform_axis)
    )


def is_planar(legs: Sequence[AssembledLeg], T: RigidTransform) -> bool:
    """Say whether the plane of motion is the xy plane of base and platform link."""
    z = np.array([0.0, 0.0, 1.0])
    upright = np.linalg.norm(np.cross(legs[0].base_axis, z)) < PARALLEL
    return _in_a_plane(legs) and bool(upright) and bool(T.rotation.apply(z)[2] > 1.0 - 1e-15)


def across_leg(u: Array, outward: Array) -> Array:
    """Return the horizontal direction across a leg; across the way outward for upright legs."""
    z = np.array([0.0, 0.0, 1.0])
    for other in (u, outward, np.array([1.0, 0.0, 0.0])):
        across = np.cross(z, other)
        if np.linalg.norm(across) > 1e-6 * max(1.0, float(np.linalg.norm(other))):
            across = across - (across @ u) * u
            return np.asarray(across / np.linalg.norm(across))
    return np.array([0.0, 1.0, 0.0])


def _axes(entry: LegEntry, tangent: Array, T: RigidTransform) -> tuple[Array, Array]:
    """Return the axes of a leg at base and platform, both in the base link."""
    base = tangent if entry.base_axis is None else entry.base_axis
    platform = tangent
    if entry.platform_axis is not None:
        platform = np.asarray(T.rotation.apply(entry.platform_axis))
    return base, platform


def _law(entry: LegEntry, length: float) -> tuple[float, tuple[float, float]]:
    """Return length at reading zero and travel of a leg [m]."""
    if entry.kind is LegKind.CONSTANT:
        return length if entry.offset is None else entry.offset, (0.0, 0.0)
    q0 = 0.0 if entry.offset is None else entry.offset
    free = (FREE_TRAVEL[0] * length - q0, FREE_TRAVEL[1] * length - q0)
    return q0, free if entry.travel is None else entry.travel


def _base_frame(described: Description, count: int) -> tuple[str, ...]:
    """Return the legs that define the frames: as told, or 1, 3, 5 of six, or the first that can."""
    legs = described.legs
    if described.base_frame is not None:
        names = [leg.name for leg in legs]
        told = [names.index(name) for name in described.base_frame]
        if len(told) != count or _degenerate(described, told):
            raise ModelError(
                f"{described.source}: base_frame could not be used: found "
                f"{', '.join(described.base_frame)}, needed {count} legs whose joints on base and "
                "platform are not in one point or on one line; choose others, or leave it out."
            )
        return described.base_frame
    combos = list(combinations(range(len(legs)), count))
    if len(legs) == 6 and count == 3:
        combos.insert(0, (0, 2, 4))
    for chosen in combos:
        if not _degenerate(described, chosen):
            return tuple(legs[j].name for j in chosen)
    raise ModelError(
        f"{described.source}: the frames of base and platform could not be built: found the joints "
        f"of the base or of the platform all in one point or on one line, needed {count} legs "
        "whose joints span them; correct base_joints or platform_joints."
    )


def _degenerate(described: Description, chosen: Sequence[int]) -> bool:
    """Say whether the joints of some legs define no frame."""
    try:
        for side in ("A_base", "B_platform"):
            frame_on_points(np.array([getattr(described.legs[j], side) for j in chosen]))
    except ValueError:
        return True
    return False


def _refuse(problems: list[str]) -> None:
    """Raise all problems at once, if there are any."""
    if problems:
        raise ModelError(problems)
