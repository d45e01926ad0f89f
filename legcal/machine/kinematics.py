"""Poses of the platform as the paper has them: of R_e in R_b, and how two of them differ."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry import Array, product
from legcal.machine.closing import close_near, platform_pose, readings_at
from legcal.machine.equations import unmet
from legcal.machine.home import settle
from legcal.machine.leg import LegKind
from legcal.machine.model import Mechanism
from legcal.machine.poses import follow, follow_rows


def forward_kinematics(
    mechanism: Mechanism, q: Array, start: RigidTransform | None = None
) -> RigidTransform:
    """Return the platform pose at motor readings.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    q : (n_legs,) array
        Readings [m]; those of legs without a motor are ignored and may be NaN.
    start : RigidTransform, optional
        T_base_platform of a pose in the wanted assembly mode; ``mechanism.home`` without it.

    Returns
    -------
    RigidTransform
        T_base_platform, with every loop closed to 1e-12 m.

    Raises
    ------
    NotIdentifiable
        If the motors do not determine the pose.
    DidNotConverge
        If no closed pose is reached from ``start`` without crossing a singularity.
    UsageError
        If the readings are too few or not finite.
    """
    return Follower(mechanism, start).move_to(q)


class Follower:
    """A closed configuration that is moved from readings to readings, each step from the last.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    start : RigidTransform, optional
        T_base_platform of a pose in the wanted assembly mode; ``mechanism.home`` without it.

    Attributes
    ----------
    configuration : (nq,) array
        The closed chain at the last readings.

    Raises
    ------
    NotIdentifiable
        If the motors do not determine the pose.
    UsageError
        If the legs do not allow the start, by more than 1 % of a leg length.
    DidNotConverge
        If the legs do not reach the start.
    """

    def __init__(self, mechanism: Mechanism, start: RigidTransform | None = None) -> None:
        _check_determined(mechanism)
        self._mechanism = mechanism
        self.configuration = mechanism.home_configuration
        if start is not None:
            settled, problem = settle(mechanism, start)
            if problem is not None:
                raise UsageError(
                    f"The pose could not be followed from its start: found {problem} there, needed "
                    "a pose that the legs allow; correct the start."
                )
            self.configuration = close_near(mechanism, settled, self.configuration)

    @property
    def pose(self) -> RigidTransform:
        """T_base_platform at the last readings."""
        return platform_pose(self._mechanism, self.configuration)

    def move_to(self, q: Array) -> RigidTransform:
        """Return the platform pose at readings, followed from the last ones.

        Parameters
        ----------
        q : (n_legs,) array
            Readings [m]; those of legs without a motor are ignored and may be NaN.

        Raises
        ------
        DidNotConverge
            If no closed pose is reached without crossing a singularity; the configuration stays
            where it was.
        UsageError
            If the readings are too few or not finite.
        """
        readings = _readings(self._mechanism, np.asarray(q, dtype=np.float64)[None])[0]
        self.configuration = follow(self._mechanism, self.configuration, readings)
        return self.pose


def forward_kinematics_many(mechanism: Mechanism, q: Array) -> list[RigidTransform]:
    """Return the platform poses at many rows of readings, in the assembly mode of home.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    q : (n_rows, n_legs) array
        Readings [m]; each row starts from the nearest one that is solved already, or from home.

    Returns
    -------
    list of RigidTransform
        T_base_platform of every row.

    Raises
    ------
    NotIdentifiable, DidNotConverge, UsageError
        As :func:`forward_kinematics`.
    """
    poses = []
    for pose, failure in followed_poses(mechanism, q):
        if failure is not None:
            raise failure
        poses.append(pose)
    return poses


def followed_poses(
    mechanism: Mechanism, q: Array
) -> Iterator[tuple[RigidTransform, DidNotConverge | None]]:
    """Yield the platform pose at each of many rows of readings, or one nearby, and why.

    Where a row is not reached, the pose is that of the nearest row that is, or home. Arguments and
    other exceptions are those of :func:`forward_kinematics_many`.
    """
    readings = _readings(mechanism, np.asarray(q, dtype=np.float64))
    for configuration, failure in follow_rows(mechanism, readings):
        yield platform_pose(mechanism, configuration), failure


def inverse_kinematics(mechanism: Mechanism, T_base_platform: RigidTransform) -> Array:
    """Return the joint value of every leg at a pose, q = sign (|AB| - q0).

    A length is a distance, so that no leg is ever flipped. Values outside the travel are
    returned as they are; :func:`outside_travel` names them.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T_base_platform : RigidTransform
        Pose of the platform link in the base link.

    Returns
    -------
    (n_legs,) array
        Joint values [m]; zero for a leg of constant length.

    Raises
    ------
    UsageError
        If the legs or the plane of motion do not allow the pose: a rod that is too short or too
        long, a revolute axis that is not perpendicular to its leg, a leg that would be twisted.
    """
    problem = unmet(mechanism, T_base_platform)
    if problem is not None:
        raise UsageError(
            f"The platform cannot stand there: {problem}, needed a pose that every leg "
            "allows; choose one that keeps it."
        )
    q = readings_at(mechanism, T_base_platform)
    q[[leg.kind is LegKind.CONSTANT for leg in mechanism.legs]] = 0.0
    return q


def outside_travel(mechanism: Mechanism, q: Array) -> dict[str, float]:
    """Return the legs whose joint value lies outside their travel.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    q : (n_legs,) array
        Joint values [m].

    Returns
    -------
    dict of str to float
        Leg name, and how far outside [m]: negative below the travel, positive above it.
    """
    outside = {}
    for leg, value in zip(mechanism.legs, q, strict=True):
        lower, upper = leg.travel
        if leg.kind is not LegKind.CONSTANT and not lower <= value <= upper:
            outside[leg.name] = float(value - (lower if value < lower else upper))
    return outside


def _readings(mechanism: Mechanism, q: Array) -> Array:
    """Return the readings of the motors, (n_rows, n_motors), checked."""
    if q.ndim != 2 or q.shape[1] != mechanism.n_legs:
        raise UsageError(
            f"The pose could not be computed: found readings of shape {q.shape[1:]}, needed "
            f"({mechanism.n_legs},), one for each leg; pass them in the order of the legs."
        )
    _check_determined(mechanism)
    readings = q[:, list(mechanism.motors)]
    legs = list(mechanism.motors)
    lengths = mechanism.sign[legs] * readings + mechanism.q0[legs]
    wrong = np.argwhere(~((lengths > 0.0) & np.isfinite(lengths)))
    if len(wrong):
        row, column = wrong[0]
        raise UsageError(
            f"The pose of row {row + 1} could not be computed: found the reading "
            f"{readings[row, column]:g} of leg '{mechanism.legs[legs[column]].name}', needed a "
            "finite number above a leg length of zero; correct the reading."
        )
    return readings


def _check_determined(mechanism: Mechanism) -> None:
    """Refuse a mechanism whose motors do not determine the pose."""
    if not mechanism.is_determined:
        raise NotIdentifiable(
            f"{mechanism.yaml_path}: the pose cannot be computed from readings: found mobility "
            f"{mechanism.mobility} and {len(mechanism.motors)} motors, needed as many motors as "
            "mobility; correct name_mot, or do not ask for poses of this mechanism."
        )


def platform_in_base(mechanism: Mechanism, T_base_platform: RigidTransform) -> RigidTransform:
    """Return T_Rb_Re, the pose of the frame on the platform joints, from that of the links."""
    return product(mechanism.T_base_Rb.inv(), T_base_platform, mechanism.T_platform_Re)


def pose_differences(
    poses: Sequence[RigidTransform], references: Sequence[RigidTransform]
) -> tuple[Array, Array]:
    """Return the displacement [m] and the rotation angle [rad] between poses of R_e, eq (20).

    Parameters
    ----------
    poses, references : sequence of RigidTransform
        T_Rb_Re of two models at the same readings.

    Returns
    -------
    displacement : (n_poses,) array
        Delta X: of the platform joint of the first frame leg, the origin of R_e [m].
    rotation : (n_poses,) array
        Delta E: the angle of the rotation between both orientations [rad].
    """
    T, T_reference = (
        np.array([pose.as_matrix() for pose in several]).reshape(-1, 4, 4)
        for several in (poses, references)
    )
    displacement = np.linalg.norm(T[:, :3, 3] - T_reference[:, :3, 3], axis=1)
    if len(T) == 0:
        return displacement, np.zeros(0)
    between = np.swapaxes(T_reference[:, :3, :3], 1, 2) @ T[:, :3, :3]
    return displacement, np.asarray(Rotation.from_matrix(between).magnitude())
