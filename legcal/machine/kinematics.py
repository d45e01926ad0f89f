"""The pose at readings, the readings at a pose, and the closed chain at both.

Poses are found from the equations of the legs, configurations from the closures of the URDF's tree
in Pinocchio; both have one solver. Forward kinematics follows the closed chain from a known
configuration in steps that cannot cross a singularity, so that the assembly mode is kept and no leg
is flipped. Where the joints of the spanning tree stand in the way, the pose alone is followed
and the chain closed where it ends.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry import Array, BoolArray, IntArray, motion_of, product
from legcal.machine.equations import (
    constraints_at,
    describe_worst,
    freedoms,
    is_constrained,
    machine_equations,
    pose_equations,
    violated_constraint,
)
from legcal.machine.leg import Leg, LegKind
from legcal.machine.mobility import (
    CLOSED,
    determinant_sign,
    dimensionless,
    excludes_singularity,
    leg_scale,
)
from legcal.machine.model import Machine, leg_vectors
from legcal.machine.solver import Equations, Retraction, moved, newton, solve, walk_in_steps

POSE_TOLERANCE = 1e-11  # [m, rad]: of a pose at which the chain is closed
AXIS_TOLERANCE = 2e-3  # [m, rad]: what axes may be off; no other posture of a leg is as near
RESTARTS = 60
CONTRACTION = 0.5  # of the step before; of 1 rad or a leg length for the first
TOLERANCE = 1e-13  # of a leg length
MIN_STEP = 1.0 / 4096.0  # of the way from known readings to the wanted ones
RANDOM_ANGLES = 6  # other angles of all legs that are tried
FEW_RESTARTS = 2  # of legs that do not close from there
DEPENDENT = 1e-7  # of the largest singular value: equations that say the same
MAX_POSE_ERROR = 0.01  # of a leg length: how far a given pose may be from a closed one


def forward_kinematics(
    mechanism: Machine, q: Array, start: RigidTransform | None = None
) -> RigidTransform:
    """Return the platform pose at motor readings.

    Parameters
    ----------
    mechanism : Machine
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
    mechanism : Machine
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

    def __init__(self, mechanism: Machine, start: RigidTransform | None = None) -> None:
        _check_determined(mechanism)
        self._machine = mechanism
        self.configuration = mechanism.home_configuration
        if start is not None:
            projected, problem = project_pose(mechanism, start)
            if problem is not None:
                raise UsageError(
                    f"The pose could not be followed from its start: found {problem} there, needed "
                    "a pose that the legs allow; correct the start."
                )
            self.configuration = close_at(mechanism, projected, self.configuration, exact=False)

    @property
    def pose(self) -> RigidTransform:
        """T_base_platform at the last readings."""
        return platform_pose(self._machine, self.configuration)

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
        readings = _readings(self._machine, np.asarray(q, dtype=np.float64)[None])[0]
        self.configuration = follow(self._machine, self.configuration, readings)
        return self.pose


def forward_kinematics_many(machine: Machine, q: Array) -> list[RigidTransform]:
    """Return T_base_platform of many rows of readings (n_rows, n_legs) [m], in the mode of home.

    Each row starts from the nearest one that is solved already, or from home.

    Raises
    ------
    NotIdentifiable, DidNotConverge, UsageError
        As :func:`forward_kinematics`.
    """
    poses = []
    for pose, failure in followed_poses(machine, q):
        if failure is not None:
            raise failure
        poses.append(pose)
    return poses


def followed_poses(
    machine: Machine, q: Array
) -> Iterator[tuple[RigidTransform, DidNotConverge | None]]:
    """Yield the platform pose at each of many rows of readings, and no failure.

    Where a row is not reached, the pose of the nearest row that is, or home, comes with the
    failure. Arguments and other exceptions are those of :func:`forward_kinematics_many`.
    """
    known = [machine.home_configuration[slider_columns(machine, machine.motors)[0]]]
    configurations = [machine.home_configuration]
    for i, row in enumerate(_readings(machine, np.asarray(q, dtype=np.float64))):
        nearest = configurations[int(np.argmin(np.abs(np.array(known) - row).max(axis=1)))]
        try:
            configuration = follow(machine, nearest, row, f" of row {i + 1}")
        except DidNotConverge as failure:
            yield platform_pose(machine, nearest), failure
            continue
        known.append(row)
        configurations.append(configuration)
        yield platform_pose(machine, configuration), None


def inverse_kinematics(mechanism: Machine, T_base_platform: RigidTransform) -> Array:
    """Return the joint value of every leg at a pose, q = sign (|AB| - q0).

    A length is a distance, so that no leg is ever flipped. Values outside the travel are
    returned as they are.

    Parameters
    ----------
    mechanism : Machine
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
    problem = violated_constraint(mechanism, T_base_platform)
    if problem is not None:
        raise UsageError(
            f"The platform cannot stand there: {problem}, needed a pose that every leg "
            "allows; choose one that keeps it."
        )
    q = readings_at(mechanism, T_base_platform)
    q[[leg.kind is LegKind.CONSTANT for leg in mechanism.legs]] = 0.0
    return q


def _readings(machine: Machine, q: Array) -> Array:
    """Return the readings of the motors, (n_rows, n_motors), checked."""
    if q.ndim != 2 or q.shape[1] != machine.n_legs:
        raise UsageError(
            f"The pose could not be computed: found readings of shape {q.shape[1:]}, needed "
            f"({machine.n_legs},), one for each leg; pass them in the order of the legs."
        )
    _check_determined(machine)
    readings = q[:, list(machine.motors)]
    lengths = machine.lengths_at(readings, machine.motors)
    wrong = np.argwhere(~((lengths > 0.0) & np.isfinite(lengths)))
    if len(wrong):
        row, column = wrong[0]
        name = machine.leg_names[machine.motors[column]]
        raise UsageError(
            f"The pose of row {row + 1} could not be computed: found the reading "
            f"{readings[row, column]:g} of leg '{name}', needed a finite number above a leg length "
            "of zero; correct the reading."
        )
    return readings


def _check_determined(machine: Machine) -> None:
    """Refuse a mechanism whose motors do not determine the pose."""
    if not machine.is_determined:
        raise NotIdentifiable(
            f"{machine.yaml_path}: the pose cannot be computed from readings: found mobility "
            f"{machine.mobility} and {len(machine.motors)} motors, needed as many motors as "
            "mobility; correct name_mot, or do not ask for poses of this mechanism."
        )


def platform_in_base(machine: Machine, T_base_platform: RigidTransform) -> RigidTransform:
    """Return T_Rb_Re, the pose of the frame on the platform joints, from that of the links."""
    return product(machine.T_base_Rb.inv(), T_base_platform, machine.T_platform_Re)


def pose_differences(
    poses: Sequence[RigidTransform], references: Sequence[RigidTransform]
) -> tuple[Array, Array]:
    """Return displacement [m] and rotation angle [rad] between T_Rb_Re of two models, eq (20).

    The displacement, Delta X, is that of the platform joint of the first frame leg, the origin of
    R_e; the angle, Delta E, that of the rotation between both orientations.
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


def readings_at(machine: Machine, T_base_platform: RigidTransform) -> Array:
    """Return the joint value of every leg at a pose, q = sign (|AB| - q0), (n_legs,) [m]."""
    lengths = np.linalg.norm(leg_vectors(machine, T_base_platform), axis=1)
    return np.asarray(machine.sign * (lengths - machine.q0))


def platform_pose(machine: Machine, configuration: Array) -> RigidTransform:
    """Return T_base_platform at a configuration."""
    return machine.chain.pose(configuration, machine.base, machine.platform)


def slider_columns(machine: Machine, legs: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return where the sliders of some legs stand in configurations and in tangent vectors."""
    names = [machine.legs[j].prismatic for j in legs]
    joints = [name for name in names if name is not None]
    chain = machine.chain
    return [chain.q_index(j) for j in joints], [chain.v_index(j) for j in joints]


def joint_values(machine: Machine, configuration: Array) -> Array:
    """Return the joint value of every leg at a configuration, zero for rods, (n_legs,) [m]."""
    values = np.zeros(machine.n_legs)
    sliding = [j for j, leg in enumerate(machine.legs) if leg.kind is not LegKind.CONSTANT]
    values[sliding] = configuration[slider_columns(machine, sliding)[0]]
    return values


class SolvedPoses(NamedTuple):
    """Platform poses of R_e in R_b at which legs miss least."""

    R: Array  # (k, 3, 3)
    t: Array  # (k, 3) [m]
    missed: Array  # (k,) the largest of what legs still miss [m]
    size: Array  # (k,) the last step [m, rad]: not small where a pose has not come to rest


def solve_poses(
    legs: Sequence[Leg],
    frame_legs: Sequence[int],
    R: Array,
    t: Array,
    lengthening: Array | None = None,
    steps: int = 60,
) -> SolvedPoses:
    """Return the poses near R, t of R_e in R_b where the equations of legs hold at readings.

    *lengthening* (k, n_legs) is s q of actuated legs [m], NaN where unknown; without it poses move
    to the nearest at which the constraints hold. Where no pose meets all (parameters far from the
    truth) the one with least squares is found. After few *steps* poses are only nearer.
    """
    fixed = np.ones(6, dtype=np.bool_)
    fixed[list(freedoms(frame_legs))] = False

    def equations(poses: Array) -> tuple[Array, Array]:
        found = pose_equations(legs, poses[:, :, :3], poses[:, :, 3], by_local=False)
        if lengthening is None:
            found = found.of(~found.measured)
            values, jacobian = found.values, found.by_pose.copy()
        else:
            wanted = np.where(found.measured, lengthening[:, found.leg], 0.0)
            known = np.isfinite(wanted)
            values = np.where(known, found.values - wanted, 0.0)
            jacobian = found.by_pose * known[..., None]
        jacobian[:, :, fixed] = 0.0
        return values, jacobian

    poses = np.concatenate([R, t[..., None]], axis=2)
    found = solve(equations, moved, poses, tolerance=1e-15, rank=DEPENDENT, steps=steps)
    return SolvedPoses(found.points[:, :, :3], found.points[:, :, 3], found.worst, found.size)


def project_pose(
    machine: Machine, T: RigidTransform, max_error: float = MAX_POSE_ERROR
) -> tuple[RigidTransform, str | None]:
    """Return the nearest pose that meets every constraint, and what is in the way if none is near.

    Constraints may be missed by *max_error* leg lengths at the start, T_base_platform.
    """
    if not is_constrained(machine):
        return T, None
    scale = leg_scale(machine, T)
    first = constraints_at(machine, T)
    worst = np.abs(first.values).max()
    if worst <= TOLERANCE * scale:
        return T, None
    if worst > max_error * scale:
        return T, describe_worst(machine, first)

    def equations(poses: Array) -> tuple[Array, Array]:
        found = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
        constraints = ~found.measured
        return found.values[:, constraints], found.by_pose[:, constraints]

    unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
    found = solve(equations, moved, T.as_matrix()[None, :3], tolerance=TOLERANCE * scale, unit=unit)
    projected = motion_of(found.points[0, :, :3], found.points[0, :, 3])
    if found.worst[0] <= 1e-9 * scale:
        return projected, None
    return projected, describe_worst(machine, constraints_at(machine, projected))


def close_at(
    machine: Machine,
    T_base_platform: RigidTransform,
    start: Array | None = None,
    restarts: int = RESTARTS,
    *,
    exact: bool = True,
) -> Array:
    """Return the configuration (nq,) that closes every loop to 1e-12 m with the platform at a pose.

    Sliders are set from the distance of their joints, so that no leg is ever flipped; joint angles
    are solved from ``start``, and from seeded random ones for legs that do not close from there.
    The pose must meet the constraints. Where it is not *exact* it need meet them but for rounding:
    in the end the platform is free too, and moves by what the axes of the model are off.

    Raises
    ------
    DidNotConverge
        If a leg does not close, naming its closure and the distance left.
    """
    chain, tolerance = machine.chain, POSE_TOLERANCE if exact else AXIS_TOLERANCE
    angles = np.zeros(chain.nv, dtype=np.bool_)
    for joint in machine.urdf.joints.values():
        if joint.type in ("revolute", "continuous"):
            angles[chain.v_index(joint.name)] = True
    # Gaps of legs shorter than a metre count in leg lengths: beside angles in radians they would
    # weigh too little to be closed, and AXIS_TOLERANCE would be a large part of a leg.
    metre = min(1.0, leg_scale(machine, T_base_platform))
    configuration = _placed(machine, T_base_platform, start, tolerance)
    rng = np.random.default_rng(20020701)
    for _ in range(restarts):
        equations, retract = _closure_equations(machine, T_base_platform, metre, angles)
        found = solve(equations, retract, configuration[None], tolerance=0.01 * CLOSED, damped=True)
        configuration = found.points[0]
        stuck = np.abs(found.values[0]) > AXIS_TOLERANCE
        if not stuck.any():
            break
        columns = np.zeros(chain.nv, dtype=np.bool_)
        columns[angles] = np.abs(found.jacobian[0, stuck]).max(axis=0) > 1e-9
        step = np.where(columns, rng.uniform(-np.pi, np.pi, chain.nv), 0.0)
        configuration = chain.integrate(configuration, step)
    everything = _closure_equations(machine, T_base_platform, 1.0, angles)
    left = everything[0](configuration[None])[0][0]
    if np.abs(left).max(initial=0.0) >= CLOSED:
        angles[slider_columns(machine, range(machine.n_legs))[1]] = True  # and sliders
        pose = T_base_platform if exact else None
        every = angles if exact else np.ones(chain.nv, dtype=np.bool_)
        equations, retract = _closure_equations(machine, pose, 1.0, every)
        found = solve(equations, retract, configuration[None], tolerance=0.01 * CLOSED, damped=True)
        configuration, left = found.points[0], found.values[0]
    off = _off(machine, T_base_platform, configuration)
    if np.abs(left).max(initial=0.0) >= CLOSED:
        problem = f"{worst_closure(machine, left)}, needed less than 1e-12 m"
    elif max(off) > tolerance:
        problem = f"the platform went {_away(off)} away, needed a pose that the legs allow"
    else:
        return configuration
    raise _not_closed(machine, T_base_platform, problem)


def worst_closure(machine: Machine, residual: Array) -> str:
    """Return which closure is most open, in words."""
    row = 0
    worst = (0.0, "the platform pose")
    for closure in machine.chain.closures:
        gap = float(np.abs(residual[row : row + closure.rows]).max())
        worst = max(worst, (gap, f"'{closure.frame_1}' and '{closure.frame_2}'"))
        row += closure.rows
    return f"{worst[1]} stay {worst[0]:.3g} m apart"


def _placed(
    machine: Machine, T_base_platform: RigidTransform, start: Array | None, tolerance: float
) -> Array:
    """Return a configuration with the platform and the sliders set."""
    chain = machine.chain
    configuration = chain.neutral() if start is None else start.copy()
    if machine.platform_joint is not None:
        configuration = chain.with_platform(
            configuration,
            machine.platform_joint,
            machine.base,
            machine.platform,
            T_base_platform,
        )
        off = _off(machine, T_base_platform, configuration)
        if max(off) > tolerance:
            raise _not_closed(
                machine,
                T_base_platform,
                f"the virtual joint '{machine.platform_joint}' leaves it {_away(off)} away, "
                "needed a joint that reaches it",
            )
    q = readings_at(machine, T_base_platform)
    sliding = [j for j, leg in enumerate(machine.legs) if leg.prismatic is not None]
    configuration[slider_columns(machine, sliding)[0]] = q[sliding]
    return configuration


def _closure_equations(
    machine: Machine, T: RigidTransform | None, metre: float, free: BoolArray | IntArray
) -> tuple[Equations, Retraction]:
    """Return the closures by free tangent coordinates; the platform fixed at T where legs carry it.

    Lengths are divided by ``metre``.
    """
    chain = machine.chain
    weld = T if machine.platform_joint is None else None
    weights = np.ones(chain.n_rows + 6 * (weld is not None))
    row = 0
    for rows in [closure.rows for closure in chain.closures] + [6]:
        weights[row : row + 3] = 1.0 / metre
        row += rows

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        if weld is not None:
            of_weld, by_joints = chain.welded(machine.base, machine.platform, weld)
            residual = np.concatenate([residual, of_weld])
            jacobian = np.concatenate([jacobian, by_joints])
        return (residual * weights)[None], (jacobian[:, free] * weights[:, None])[None]

    def retract(points: Array, step: Array) -> Array:
        full = np.zeros(chain.nv)
        full[free] = step[0]
        return chain.integrate(points[0], full)[None]

    return equations, retract


def _off(
    machine: Machine, T_base_platform: RigidTransform, configuration: Array
) -> tuple[float, float]:
    """Return how far the platform is from where it should be [m], and how far turned [rad]."""
    R, t = machine.chain.placement(configuration, machine.base, machine.platform)
    matrix = T_base_platform.as_matrix()
    chord = float(np.linalg.norm(R - matrix[:3, :3]))  # of small turns as good as of large ones
    turn = 2.0 * float(np.arcsin(min(1.0, chord / np.sqrt(8.0))))
    return float(np.linalg.norm(t - matrix[:3, 3])), turn


def _away(off: tuple[float, float]) -> str:
    """Return a distance and a turn in words, without the one that is rounding beside the other."""
    said = f"{1e3 * off[0]:.3g} mm", f"{np.degrees(off[1]):.3g} deg"
    return " and ".join(text for text, x in zip(said, off, strict=True) if x > 1e-6 * max(off))


def _not_closed(machine: Machine, T_base_platform: RigidTransform, problem: str) -> DidNotConverge:
    """Return the error of a pose at which the chain does not close."""
    place = "(" + ", ".join(f"{1e3 * x:.1f}" for x in T_base_platform.translation) + ")"
    return DidNotConverge(
        f"{machine.yaml_path}: the legs could not be closed with the platform at {place} mm: "
        f"{problem}; check that the legs reach this pose (legcal.home)."
    )


def follow(
    machine: Machine,
    configuration: Array,
    readings: Array,
    which: str = "",
    min_step: float = MIN_STEP,
    on_the_chain: bool = False,
) -> Array:
    """Return the closed configuration at readings (n_motors,), followed from a closed one.

    It is closed to 1e-12 m, in the same assembly mode, with no leg flipped. Steps are no shorter
    than a part *min_step* of the way. *on_the_chain* stops where the joints of the chain do: soon,
    but in a place that depends on the spanning tree. *which* names the readings in the message.

    Raises
    ------
    DidNotConverge
        If the steps stop contracting or reach a singularity, even tiny ones.
    """
    q_columns, v_columns = slider_columns(machine, machine.motors)
    free = np.delete(np.arange(machine.chain.nv), v_columns)
    first = configuration[q_columns]
    known = machine.chain.linearize(configuration)[1][:, free]
    here: float | None = None

    def attempt(part: float) -> bool:
        nonlocal configuration, known, here
        trial = configuration.copy()
        trial[q_columns] = readings if part == 1.0 else first + part * (readings - first)
        reached, jacobian = _closed_from(machine, trial, free)
        if reached is None or _is_flipped(machine, reached):
            return False
        if not excludes_singularity(known, jacobian):
            if here is None:
                here = determinant_sign(machine, platform_pose(machine, configuration))
            there = determinant_sign(machine, platform_pose(machine, reached))
            if not here == there != 0.0:  # not square: only ways on which little changes
                return False
        configuration, known = reached, jacobian
        return True

    done = walk_in_steps(attempt, min_step)
    if done == 1.0:
        return configuration
    T = platform_pose(machine, configuration)
    part = 0.0
    if not on_the_chain:
        T, part = follow_pose(machine, T, configuration[q_columns], readings, min_step)
    if part < 1.0:
        raise DidNotConverge(
            f"{machine.yaml_path}: the pose at the readings{which} could not be reached: at "
            f"{100 * (done + part * (1.0 - done)):.1f} % of the way from the starting pose the "
            "legs meet no more or the mechanism is singular, needed a regular path; check the "
            "readings and legcal.home."
        )
    closed = _closed_at(machine, T, configuration, readings, free)
    if closed is None:
        raise DidNotConverge(
            f"{machine.yaml_path}: the pose at the readings{which} could not be reached: found a "
            "platform pose at which the legs have the right lengths, but joints that were not "
            "closed there, needed a closed chain; give the joints of the legs axes at right angles "
            "(of three revolutes, and of a universal joint and its leg), which turn anywhere, or "
            "cut spherical joints with 3d."
        )
    return closed


def follow_pose(
    machine: Machine, T: RigidTransform, first: Array, last: Array, min_step: float
) -> tuple[RigidTransform, float]:
    """Return the pose followed from T at first to last readings, and which part of it is done."""
    pose, known = T.as_matrix()[:3], dimensionless(machine, T)
    motors = list(machine.motors)

    def attempt(part: float) -> bool:
        nonlocal pose, known
        readings = last if part == 1.0 else first + part * (last - first)
        lengthening = machine.sign[motors] * readings

        def equations(poses: Array) -> tuple[Array, Array]:
            found = machine_equations(machine, poses[:, :, :3], poses[:, :, 3])
            found.values[:, found.measured] -= lengthening
            return found.values, found.by_pose

        scale = leg_scale(machine, motion_of(pose[:, :3], pose[:, 3]))
        unit = np.array([1.0 / scale] * 3 + [1.0] * 3)
        found = newton(
            equations,
            moved,
            pose,
            tolerance=TOLERANCE * scale,
            contraction=CONTRACTION,
            first=scale,
            unit=unit,
        )
        there = motion_of(found.points[0, :, :3], found.points[0, :, 3])
        if not (found.converged[0] or found.worst[0] < TOLERANCE * scale) or _is_reversed(
            machine, there
        ):
            return False
        jacobian = dimensionless(machine, there)
        if not excludes_singularity(known, jacobian):
            if known.shape[0] != known.shape[1]:
                return False
            signs = [float(np.sign(np.linalg.det(J))) for J in (known, jacobian)]
            if not signs[0] == signs[1] != 0.0:
                return False
        pose, known = found.points[0], jacobian
        return True

    done = walk_in_steps(attempt, min_step)
    return motion_of(pose[:, :3], pose[:, 3]), done


def _closed_from(
    machine: Machine, configuration: Array, free: IntArray
) -> tuple[Array | None, Array]:
    """Return the configuration closed with the motors fixed, None if not near, and its Jacobian."""
    equations, retract = _closure_equations(machine, None, 1.0, free)
    found = newton(
        equations, retract, configuration, tolerance=0.01 * CLOSED, contraction=CONTRACTION
    )
    return found.points[0] if found.worst[0] < CLOSED else None, found.jacobian[0]


def _closed_at(
    machine: Machine, T: RigidTransform, start: Array, readings: Array, free: IntArray
) -> Array | None:
    """Return the closed configuration at readings whose pose is known, None if joints forbid it.

    The platform is free only where axes that are a little off leave no other way.
    """
    rng = np.random.default_rng(1965)
    angles = machine.chain.rotation_columns()
    turns = np.zeros((1 + RANDOM_ANGLES, machine.chain.nv))
    turns[1:, angles] = rng.uniform(-np.pi, np.pi, (RANDOM_ANGLES, machine.chain.nv))[:, angles]
    tries = [(turn, True) for turn in turns] + [(turns[0], False)] * is_constrained(machine)
    for turn, exact in tries:
        there = machine.chain.integrate(start, turn)
        try:
            trial = close_at(machine, T, there, FEW_RESTARTS, exact=exact)
        except DidNotConverge:
            continue
        trial[slider_columns(machine, machine.motors)[0]] = readings
        closed, _ = _closed_from(machine, trial, free)
        if closed is not None:
            return closed
    return None


def _is_flipped(machine: Machine, configuration: Array) -> bool:
    """Say whether a leg without a motor has shrunk through its base joint."""
    rows = [j for j, leg in enumerate(machine.legs) if leg.kind is LegKind.PASSIVE]
    if not rows:
        return False
    q = configuration[slider_columns(machine, rows)[0]]
    return bool(np.any(machine.lengths_at(q, rows) <= 0.0))


def _is_reversed(machine: Machine, T: RigidTransform) -> bool:
    """Say whether a leg that is fixed to the platform points the wrong way."""
    return any(
        leg.is_fixed_to_platform
        and leg.platform_axis is not None
        and float(T.rotation.apply(leg.platform_axis) @ vector) <= 0.0
        for leg, vector in zip(machine.legs, leg_vectors(machine, T), strict=True)
    )
