"""Forward and inverse kinematics, on the equations of legs and on the closed chain.

Poses are solved from the equations of the legs, configurations from the closures of the URDF in
Pinocchio; both use the same solver. Forward kinematics follows the closed chain from a known
configuration in steps that cannot cross a singularity, so that the assembly mode is kept and no leg
is flipped: the pose is followed, and the chain is closed at its end.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry.motions import motion_of, motions_of, product
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.closing import (
    CLOSED,
    ROUNDING,
    TOLERANCE,
    close_at,
    closure_equations,
    dimensionless,
    excludes_singularity,
    is_on_same_side,
    leg_scale,
    pose_error,
    project_pose,
)
from legcal.machine.equations import (
    is_constrained,
    least_squares_equations,
    machine_equations,
    violated_constraint,
)
from legcal.machine.model import (
    Machine,
    Pose,
    platform_pose,
    pose_of,
    readings_at,
    readings_at_poses,
    slider_columns,
)
from legcal.machine.redundancy import contradictions
from legcal.machine.solver import Equations, newton, poses_after, solve
from legcal.machine.ties import machine_ties

CONTRACTION = 0.5  # largest step relative to the one before; for the first, to 1 rad or leg length
MIN_STEP = 1.0 / 4096.0  # least step, relative to the path between readings
LONG_STEP = 1.0 / 16.0  # least step of a first attempt, with a fallback
MAX_AWAY = 20.0  # of readings and poses from home [mean leg lengths]: the unit is wrong
MAX_TURN = 2.0 * np.pi  # of readings from home [rad]
FEW_STEPS = 12  # largest number of Newton steps
NEAR = 0.01  # largest distance of the pose at which a chain closes [leg lengths, rad]
REACHED = 1e-9  # residual of a reached pose, in leg lengths
REDUNDANT_STEPS = 40  # the same for redundant motors, where convergence is linear


def forward_kinematics(
    mechanism: Machine, q: ArrayLike, start: Pose | None = None
) -> RigidTransform:
    """Return the platform pose at motor readings.

    Parameters
    ----------
    mechanism : Machine
        The machine.
    q : (n_legs,) or (n_motors,) array
        Readings [m, rad] of legs or of motors. Those of legs without a motor are ignored and may
        be NaN; of rods on one actuator the first counts.
    start : RigidTransform, SE3 or (4, 4) array, optional
        T_base_platform of a pose in the required assembly mode, by default ``mechanism.home``. For
        many poses a :class:`Follower` is faster.

    Returns
    -------
    RigidTransform
        T_base_platform, with every loop closed to 1e-12 m. With redundant motors it minimises the
        squares of the differences between readings and those of the pose.

    Raises
    ------
    NotIdentifiable
        If the motors do not determine the pose.
    DidNotConverge
        If no closed pose is reached from ``start`` without crossing a singularity, or readings of
        redundant motors contradict each other by more than the errors of a nominal model.
    UsageError
        If the readings are too few, not finite, or so large that their unit must be wrong.
    """
    _check_machine(mechanism)
    return Follower(mechanism, start).move_to(q)


class Follower:
    """A closed configuration that is moved from readings to readings, each time from the last.

    Parameters
    ----------
    mechanism : Machine
        The machine.
    start : RigidTransform, SE3 or (4, 4) array, optional
        T_base_platform of a pose in the required assembly mode, by default ``mechanism.home``.

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

    def __init__(self, mechanism: Machine, start: Pose | None = None) -> None:
        _check_machine(mechanism)
        _check_determined(mechanism)
        self._machine = mechanism
        self.configuration = mechanism.home_configuration
        if start is not None:
            self.place(start)

    @property
    def pose(self) -> RigidTransform:
        """T_base_platform at the last readings."""
        return platform_pose(self._machine, self.configuration)

    def place(self, T_base_platform: Pose) -> RigidTransform:
        """Move the platform of the closed chain to a pose, with its legs, and return it.

        Raises
        ------
        UsageError
            If the legs do not allow the pose, by more than 1 % of a leg length.
        DidNotConverge
            If the legs do not reach it; the configuration is then unchanged.
        """
        projected, problem = project_pose(self._machine, pose_of(T_base_platform))
        if problem is not None:
            raise UsageError(
                f"The pose could not be followed from its start: found {problem} there, needed "
                "a pose that the legs allow; correct the start."
            )
        self.configuration = close_at(self._machine, projected, self.configuration, exact=False)
        return self.pose

    def move_to(self, q: ArrayLike) -> RigidTransform:
        """Return the platform pose at readings, followed from the last ones.

        Parameters
        ----------
        q : (n_legs,) or (n_motors,) array
            Readings [m, rad], as for :func:`forward_kinematics`.

        Raises
        ------
        DidNotConverge
            If no closed pose is reached without crossing a singularity, or readings contradict each
            other; the configuration is then unchanged.
        UsageError
            If the readings are too few, not finite, or of a wrong unit.
        """
        readings = _readings(self._machine, _numbers(q)[None], single=True)[0]
        reached = follow(self._machine, self.configuration, readings)
        pose = platform_pose(self._machine, reached)
        failure = _disagreement(self._machine, pose, readings)
        if failure is not None:
            raise failure
        self.configuration = reached
        return pose


def forward_kinematics_many(machine: Machine, q: Array) -> list[RigidTransform]:
    """Return T_base_platform at rows of readings (n_rows, n_legs), in the mode of home.

    Readings are in m or rad. Each row is followed from the nearest solved row, or from home.

    Raises NotIdentifiable, DidNotConverge, UsageError as :func:`forward_kinematics`.
    """
    poses = []
    for pose, failure in followed_poses(machine, q):
        if failure is not None:
            raise failure
        poses.append(pose)
    return poses


def followed_poses(
    machine: Machine, q: Array, *, on_the_chain: bool = True
) -> Iterator[tuple[RigidTransform, DidNotConverge | None]]:
    """Yield the platform pose at each row of readings, with the failure if it was not reached.

    If not *on_the_chain*, the equations of the legs alone are followed if they reach all rows from
    home: in a tenth of the time, and with the errors of axes in the chain.

    If a row is not reached, its failure comes with the pose of the nearest reached row, or home.
    Arguments and other exceptions as in :func:`forward_kinematics_many`.
    """
    readings = _readings(machine, _numbers(q))
    if not on_the_chain:
        first = machine.home_configuration[slider_columns(machine, machine.motors)[0]]
        poses, part = follow_poses(machine, machine.home, first, readings, LONG_STEP)
        if np.all(part == 1.0):
            motions = motions_of(poses[:, :, :3], poses[:, :, 3])
            for i, (T, row) in enumerate(zip(motions, readings, strict=True)):
                yield T, _disagreement(machine, T, row, f" of row {i + 1}")
            return
    for configuration, failure in followed(machine, readings):
        yield platform_pose(machine, configuration), failure


def followed(
    machine: Machine, readings: Array, *, must_agree: bool = True
) -> Iterator[tuple[Array, DidNotConverge | None]]:
    """Yield the closed configuration at each row of readings (n, n_motors), with its failure.

    Each is followed from the nearest one reached before, or from home, and stays there if the row
    is not reached. Readings of redundant motors *must_agree*, if so wanted.
    """
    columns, reached = slider_columns(machine, machine.motors)[0], [machine.home_configuration]
    for i, row in enumerate(readings):
        which, failure = f" of row {i + 1}", None
        far = [float(np.abs(configuration[columns] - row).max()) for configuration in reached]
        configuration = reached[int(np.argmin(far))]
        try:
            configuration = follow(machine, configuration, row, which)
        except DidNotConverge as error:
            failure = error
        else:
            if must_agree:
                T = platform_pose(machine, configuration)
                failure = _disagreement(machine, T, row, which)
            if failure is None:
                reached.append(configuration)
        yield configuration, failure


def follow_each(machine: Machine, readings: Array) -> Iterator[Array]:
    """Yield the closed configurations at readings (n, n_motors), as :func:`followed`.

    Raises DidNotConverge at the first that is not reached.
    """
    for configuration, failure in followed(machine, readings, must_agree=False):
        if failure is not None:
            raise failure
        yield configuration


def inverse_kinematics(mechanism: Machine, T_base_platform: Pose) -> Array:
    """Return the joint value of every leg at a pose, ``q = sign (|AB| - q0)``.

    For a rod on an actuator it is the reading of the actuator, with ``|A(q) - B| = l``.

    A length is a distance, so that no leg is ever flipped. Values outside the travel are returned
    unchanged.

    Parameters
    ----------
    mechanism : Machine
        The machine.
    T_base_platform : RigidTransform, SE3 or (4, 4) array
        Pose of the platform link in the base link [m].

    Returns
    -------
    (n_legs,) array
        Joint values [m, rad]; zero for a leg of constant length on no actuator. Those of motors are
        ``q[list(mechanism.motors)]``, in the order of ``mechanism.motor_names``.

    Raises
    ------
    UsageError
        If the legs or the plane of motion do not allow the pose: a rod that is too short or too
        long, a revolute axis that is not perpendicular to its leg, a leg that would be twisted.
    """
    _check_machine(mechanism)
    T_base_platform = pose_of(T_base_platform)
    away = float(np.linalg.norm(T_base_platform.translation - mechanism.home.translation))
    if away > MAX_AWAY * mechanism.size:
        raise UsageError(
            f"The readings could not be computed: found a pose {away:g} m from home, and legs of "
            f"{mechanism.size:.3g} m; give translations in metres."
        )
    problem = violated_constraint(mechanism, T_base_platform)
    if problem is not None:
        raise UsageError(
            f"The platform cannot take this pose: {problem}, needed a pose that every leg "
            "allows; choose a pose that meets this constraint."
        )
    q = readings_at(mechanism, T_base_platform)
    q[[not leg.has_value for leg in mechanism.legs]] = 0.0
    return q


def _disagreement(
    machine: Machine, T: RigidTransform, readings: Array, which: str = ""
) -> DidNotConverge | None:
    """Return the error of contradicting readings (n_motors,), None if they agree."""
    if not machine.is_redundant:
        return None
    conflicts = contradictions(machine, [platform_in_base(machine, T)], readings[None])
    if not conflicts:
        return None
    return DidNotConverge(
        f"the pose at the readings{which} could not be computed",
        str(conflicts[0].cause(machine)),
        "",
        "check this reading, its encoder and the offset of the leg",
        machine.yaml_path,
    )


def _check_machine(machine: object) -> None:
    """Raise UsageError unless it is a machine."""
    if not isinstance(machine, Machine):
        has_one = "machine" in dir(machine)
        remedy = "give its .machine" if has_one else "load it with legcal.load_mechanism"
        raise UsageError(
            f"The machine could not be used: found a {type(machine).__name__}, needed a Machine; "
            f"{remedy}."
        )


def _numbers(q: ArrayLike) -> Array:
    """Return readings as an array."""
    try:
        return np.asarray(q, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(
            f"The pose could not be computed: found readings in a {type(q).__name__} that are no "
            "array of numbers, needed one number for each leg or motor [m, rad]; convert them."
        ) from None


def _readings(machine: Machine, q: Array, *, single: bool = False) -> Array:
    """Return the readings of the motors, (n_rows, n_motors), checked.

    Messages do not number the row of a *single* pose.
    """
    motors = list(machine.motors)
    if q.ndim != 2 or q.shape[1] not in {machine.n_legs, len(motors)}:
        of_motors = f", or ({len(motors)},), one for each motor" * (len(motors) < machine.n_legs)
        raise UsageError(
            f"The pose could not be computed: found readings of shape {q.shape[1:]}, needed "
            f"({machine.n_legs},), one for each leg{of_motors}; pass them in this order."
        )
    _check_determined(machine)
    readings = q[:, motors] if q.shape[1] == machine.n_legs else q
    legs = [machine.legs[j] for j in motors]
    home = machine.home_configuration[slider_columns(machine, machine.motors)[0]]
    most = [MAX_TURN if leg.reads_angle else MAX_AWAY * machine.size for leg in legs]
    far = np.argwhere(np.abs(readings - home) > most)
    if len(far):
        row, column = far[0]
        unit, other = ("rad", "degrees") if legs[column].reads_angle else ("m", "mm")
        raise UsageError(
            f"{_which(row, single)} could not be computed: found the reading "
            f"{readings[row, column]:g} {unit} of leg '{machine.leg_names[motors[column]]}', which "
            f"reads {home[column]:.3g} {unit} at home, probably in {other}; convert the readings."
        )
    lengths = machine.lengths_at(readings, machine.motors)
    wrong = np.argwhere(~((lengths > 0.0) & np.isfinite(lengths) & np.isfinite(readings)))
    if len(wrong):
        row, column = wrong[0]
        name = machine.leg_names[machine.motors[column]]
        raise UsageError(
            f"{_which(row, single)} could not be computed: found the reading "
            f"{readings[row, column]:g} of leg '{name}', needed a finite number above a leg length "
            "of zero; correct the reading."
        )
    return readings


def _which(row: int, single: bool) -> str:
    """Return the pose of a row in words."""
    return "The pose" if single else f"The pose of row {row + 1}"


def _check_determined(machine: Machine) -> None:
    """Refuse a mechanism whose motors do not determine the pose."""
    if not machine.is_determined:
        raise NotIdentifiable(
            "the pose cannot be computed from readings",
            f"mobility {machine.mobility} and {len(machine.motors)} motors that hold "
            f"{machine.motor_rank} of these freedoms",
            "motors that hold all",
            "correct name_mot, or do not ask for poses of this mechanism",
            machine.yaml_path,
        )


def platform_in_base(machine: Machine, T_base_platform: RigidTransform) -> RigidTransform:
    """Return T_Rb_Re, the pose of the frame on the platform joints, from the pose of the links."""
    return product(machine.T_base_Rb.inv(), T_base_platform, machine.T_platform_Re)


def platforms_in_base(
    machine: Machine, poses: Sequence[RigidTransform]
) -> tuple[RigidTransform, ...]:
    """Return T_Rb_Re for many poses of the links."""
    if len(poses) == 0:
        return ()
    stacked = RigidTransform(np.array([T.as_matrix() for T in poses]), normalize=False)
    return tuple(platform_in_base(machine, stacked))


def pose_differences(
    poses: Sequence[RigidTransform], references: Sequence[RigidTransform]
) -> tuple[Array, Array]:
    """Return displacement [m] and rotation angle [rad] between T_Rb_Re of two models, eq (20).

    The displacement, Delta X, is of the platform joint of the first frame leg, the origin of R_e;
    the angle, Delta E, is of the rotation between both orientations.
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


def follow(
    machine: Machine,
    configuration: Array,
    readings: Array,
    which: str = "",
    min_step: float = MIN_STEP,
) -> Array:
    """Return the closed configuration at readings (n_motors,), followed from a closed one.

    It is closed to 1e-12 m, in the same assembly mode, with no leg flipped. The platform is
    followed on the equations of the legs, in steps of at least the fraction *min_step* of the
    path, and the chain is closed at the end. *which* names the readings in messages. With
    redundant motors the least-squares pose is followed, and sliders are set to it. Motors with
    NaN readings are free; the others must determine the pose.

    Raises DidNotConverge if even the smallest steps do not contract or reach a singularity, or if
    joints of the chain cannot be closed at the end.
    """
    given = np.isfinite(readings)
    is_redundant = machine.is_redundant and bool(given.all())
    q_columns, v_columns = slider_columns(machine, np.array(machine.motors)[given].tolist())
    free = np.delete(np.arange(machine.chain.nv), v_columns)
    T = platform_pose(machine, configuration)
    now = configuration[slider_columns(machine, machine.motors)[0]]
    (pose,), (part,) = follow_poses(machine, T, now, readings[None], min_step)
    T = motion_of(pose[:, :3], pose[:, 3])
    if part < 1.0:
        if is_redundant:
            nearest, _ = poses_at_readings(machine, readings[None], T.as_matrix()[None, :3])
            T = motion_of(nearest[0, :, :3], nearest[0, :, 3])
            failure = _disagreement(machine, T, readings, which)
            if failure is not None:
                raise failure
        raise DidNotConverge(
            f"the pose at the readings{which} could not be reached: at "
            f"{100 * part:.1f} % of the way from the starting pose the "
            "legs no longer close or the mechanism is singular, needed a regular path; check "
            f"the readings and {machine.urdf.wording.home}.",
            file=machine.yaml_path,
        )
    sliders = {} if is_redundant else dict(zip(q_columns, readings[given].tolist(), strict=True))
    closed = _closed_at(machine, T, configuration, sliders, free)
    if closed is None:
        raise DidNotConverge(
            f"the pose at the readings{which} could not be reached",
            "a platform pose at which the legs have the right lengths, but joints "
            "that were not closed there",
            "a closed chain",
            "give the joints of the legs axes at right angles (of three revolutes, "
            "and of a universal joint and its leg), which turn anywhere, or cut "
            "spherical joints with 3d",
            machine.yaml_path,
        )
    return closed


def poses_at_readings(machine: Machine, readings: Array, near: Array) -> tuple[Array, BoolArray]:
    """Return the poses (k, 3, 4) at readings of the motors, near others, and which were reached.

    Where readings (k, n_motors) contradict each other it is the pose of least squares.
    """
    scale = machine.size
    solution = solve(
        equations_of_readings(machine, readings),
        poses_after,
        near,
        tolerance=ROUNDING * scale,
        unit=np.array([1.0 / scale] * 3 + [1.0] * 3),
    )
    return solution.points, solution.worst <= REACHED * scale


def equations_of_readings(machine: Machine, readings: Array) -> Equations:
    """Return the equations of poses at readings of the motors (k, n_motors) [m, rad]."""
    n_dependent = machine_ties(machine).n_dependent if machine.is_redundant else 0

    def equations(poses: Array) -> tuple[Array, Array]:
        rows = machine_equations(machine, poses, readings)
        if machine.is_redundant:
            return least_squares_equations(rows, n_dependent)
        return rows.values, rows.by_pose

    return equations


def follow_poses(
    machine: Machine, start: RigidTransform, first: Array, last: Array, min_step: float
) -> tuple[Array, Array]:
    """Return poses (k, 3, 4) followed from one, at *first* readings, to *last* ones (k, n_motors).

    The joints of the chain are ignored. The second result is the completed fraction of each path,
    (k,).
    """
    T = start.as_matrix()[None]
    jacobians = dimensionless(machine, T)
    poses, jacobians = (np.repeat(x, len(last), axis=0) for x in (T[:, :3], jacobians))
    scale = leg_scale(machine, start)
    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    motors = list(machine.motors)
    done, step = np.zeros(len(last)), np.ones(len(last))
    while True:
        rows = np.flatnonzero((done < 1.0) & (step >= min_step))
        if len(rows) == 0:
            return poses, done
        part = np.minimum(done[rows] + step[rows], 1.0)
        readings = first + part[:, None] * (last[rows] - first)
        if machine.is_redundant:  # from the motors at the pose: readings in between need not agree
            now = readings_at_poses(machine, poses[rows])[:, motors]
            share = ((part - done[rows]) / (1.0 - done[rows]))[:, None]
            readings = now + share * (last[rows] - now)
        solution = newton(
            equations_of_readings(machine, readings),
            poses_after,
            poses[rows],
            tolerance=TOLERANCE * scale,
            contraction=CONTRACTION,
            first=scale,
            unit=unit,
            steps=REDUNDANT_STEPS if machine.is_redundant else FEW_STEPS,
        )
        jacobian = dimensionless(machine, solution.points)
        good = solution.converged | (solution.worst < TOLERANCE * scale)
        good &= ~_is_reversed(machine, solution.points)
        for i in np.flatnonzero(good):
            if not excludes_singularity(jacobians[rows[i]], jacobian[i]):
                good[i] = is_on_same_side(jacobians[rows[i]], jacobian[i])
        reached = rows[good]
        poses[reached], jacobians[reached] = solution.points[good], jacobian[good]
        done[reached] = part[good]
        step[rows] *= np.where(good, 2.0, 0.5)


def _closed_at(
    machine: Machine, T: RigidTransform, start: Array, sliders: dict[int, float], free: IntArray
) -> Array | None:
    """Return the closed configuration at a pose with some columns set, None if joints forbid it.

    It is the one that Newton steps lead to from the start, if they lead to the pose. The platform
    is free only if slightly inexact axes require it.
    """

    def trials() -> Iterator[Array]:
        if sliders:
            yield start.copy()
        for exact in (True, False)[: 1 + is_constrained(machine)]:
            with suppress(DidNotConverge):
                yield close_at(machine, T, start, exact=exact)

    equations, retract = closure_equations(machine, None, machine.size, free)
    for trial in trials():
        trial[list(sliders)] = list(sliders.values())
        solution = newton(
            equations, retract, trial[None], tolerance=0.01 * CLOSED, contraction=CONTRACTION
        )
        closed: Array = solution.points[0]
        shift, turn = pose_error(machine, T, closed)
        if solution.worst[0] < CLOSED and shift < NEAR * machine.size and turn < NEAR:
            return closed
    return None


def _is_reversed(machine: Machine, poses: Array) -> BoolArray:
    """Return at which poses (k, 3, 4) a leg fixed to the platform points the wrong way."""
    R, t = poses[:, :, :3], poses[:, :, 3]
    reversed_poses = np.zeros(len(poses), dtype=np.bool_)
    for leg in machine.legs:
        if leg.is_fixed_to_platform and leg.platform_axis is not None:
            along = (R @ leg.platform_axis) * (R @ leg.B + t - leg.A)
            reversed_poses |= along.sum(axis=1) <= 0.0
    return reversed_poses
