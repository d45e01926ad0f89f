"""Home: a closed pose in the required assembly mode, stated by a file or searched for.

A home may be slightly outside a travel: drawings often are, and limits are often set before the
machine is built. Up to :data:`MAX_OUTSIDE` of the travel that is a note. Further out the pose is
not reachable, and results there would be irrelevant.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, ModelError
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.motions import motion_of
from legcal.geometry.types import Array
from legcal.machine.closing import close_at, project_pose
from legcal.machine.equations import (
    PoseEquations,
    is_constrained,
    least_squares_equations,
    machine_equations,
)
from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import B_at, Machine, platform_pose, readings_at
from legcal.machine.parameters import legs_in_links
from legcal.machine.solver import Equations, Solved, poses_after, solve
from legcal.machine.topology import level_rotation

TRIALS = 200
MIN_TRIALS = 20  # least number of trials, even if one finds a pose above the base
MIN_APART = 0.05  # least height above or below the base, relative to the reach
BATCH = 21  # trials solved at once
MAX_STALLED = 5  # consecutive steps with little improvement before a trial is given up
_FAR = 0.1  # residual of constraints, in leg lengths, beyond which a pose is not near them
_DEPENDENT = 1e-7  # singular value of dependent constraints, relative to the largest
_CLOSED = 1e-9  # residual of a closed pose, in leg lengths
_REGULAR = 1e-4  # singularity measure above which motors hold the platform
# A home is refused if it is outside the travel by more than both.
MAX_OUTSIDE = 1.0  # relative to the travel
_MAX_OUTSIDE_OF_LEG = 0.01  # relative to the leg length at home, for sliders with little travel


def closed_home(machine: Machine, home: RigidTransform | None) -> tuple[RigidTransform, Array]:
    """Return the home pose, stated or searched for, and the closed configuration there.

    It is the nearest pose that meets all constraints of legs and plane. Files state home with few
    digits; sliders absorb the rounding, but rods, revolute axes and universal joints do not.

    Raises ModelError or DidNotConverge if home is more than 1 % of a leg length away from any such
    pose; and as :func:`home_at_mid_travel` and :func:`legcal.machine.closing.close_at`.
    """
    start = home_at_mid_travel(machine) if home is None else home
    projected, problem = project_pose(machine, start)
    if problem is not None:
        raise ModelError(
            f"{machine.urdf.wording.home} could not be used",
            f"{problem} there",
            "a closed pose",
            f"{machine.urdf.wording.correct_home}, or joints that are exchanged or misplaced",
            machine.yaml_path,
        )
    configuration = close_at(machine, projected, exact=False)
    constrained = is_constrained(machine)
    return platform_pose(machine, configuration) if constrained else projected, configuration


def home_at_mid_travel(machine: Machine, readings: Sequence[float] | None = None) -> RigidTransform:
    """Return a pose where every leg is at the middle of its travel, or at readings (n_legs,).

    Redundant motors are as near to it as possible, in least squares. Among the poses reached from
    seeded starts, the one with the smallest rotation of the platform is taken, measured from the
    rotation with its joints over those of the base, and of mirror images in the plane of the base
    joints the one on the positive side of the base z. Lengths of legs without a motor follow,
    within their travel if possible.

    Raises DidNotConverge if there is no such pose. Raises ModelError if rods on motors reach the
    platform on both sides of the base, so that home is ambiguous.
    """
    middle = np.array([0.5 * sum(leg.travel) for leg in machine.legs])
    if readings is not None:
        middle = np.asarray(readings, dtype=np.float64)
    rng = np.random.default_rng(1965)
    A = machine.A_at(middle)
    centre = A.mean(axis=0)
    level = level_rotation(A, machine.B_platform)
    reach = float(np.abs(machine.lengths_at(middle)).mean())
    best: tuple[float, RigidTransform] | None = None
    at_readings = partial(_at_readings, machine, readings=middle[list(machine.motors)], reach=reach)
    for first in range(0, TRIALS, BATCH):
        trials = np.arange(first, min(first + BATCH, TRIALS))
        starts = [
            (centre + rng.normal(0.0, reach, 3), rng.normal(0.0, 0.1 + trial / TRIALS, 3))
            for trial in trials
        ]
        starts = [(t, (level * Rotation.from_rotvec(turn)).as_rotvec()) for t, turn in starts]
        reached = at_readings(starts)
        for T in reached:
            if T is None:
                continue
            rank = _unlikely(machine, T) + float((level.inv() * T.rotation).magnitude())
            if best is None or rank < best[0] - 1e-6:
                best = rank, T
        if trials[-1] >= MIN_TRIALS and best is not None and best[0] < 5.0:
            break
    if best is None:
        raise DidNotConverge(
            f"no home pose was found: with all legs at mid-travel the "
            f"loops did not close from {TRIALS} starts, needed a closed pose; "
            f"{machine.urdf.wording.state_home}.",
            file=machine.yaml_path,
        )
    home = best[1]
    if machine.actuators:
        mirror = np.diag([1.0, 1.0, -1.0])
        R, t = mirror @ home.rotation.as_matrix() @ mirror, mirror @ (home.translation - centre)
        (other,) = at_readings([(centre + t, Rotation.from_matrix(R).as_rotvec())])
        sides = [_height(machine, T, centre) for T in (home, other) if T is not None]
        if len(sides) == 2 and np.prod(sides) < 0.0 and min(map(abs, sides)) > MIN_APART * reach:
            poses = " and ".join(in_yaml(T, 4) for T in (home, other) if T is not None)
            wording = machine.urdf.wording
            raise ModelError(
                "the assembly at home is ambiguous",
                f"that {wording.no_home}, and that at the same readings of the motors the "
                f"rods reach the platform at {poses}",
                "one",
                f"{wording.state_home}, as the machine is assembled",
                machine.yaml_path,
            )
    return home


def _height(machine: Machine, T: RigidTransform, centre: Array) -> float:
    """Return the mean height of platform joints above a point of the base [m]."""
    return float(np.mean(B_at(machine, T.as_matrix()[None])[0, :, 2]) - centre[2])


def in_yaml(T: RigidTransform, digits: int = 6) -> str:
    """Return a pose in the notation of models."""
    parts = T.translation, T.rotation.as_quat(canonical=True)
    xyz, quat = (", ".join(f"{x + 0.0:.{digits}g}" for x in part.round(6)) for part in parts)
    return f"{{xyz: [{xyz}], quat_xyzw: [{quat}]}}"


def home_of_legs(machine: Machine, legs: Sequence[Leg], max_error: float) -> RigidTransform | None:
    """Return the closed pose nearest to home for legs with other numbers, None if there is none.

    *legs* are in R_b and R_e, which stay in place. Their residuals at home may be *max_error* leg
    lengths. Without constraints home is unchanged.
    """
    changed = tuple(
        replace(
            leg,
            A=wanted.A,
            B=wanted.B,
            q0=wanted.q0,
            base_axis=wanted.base_axis,
            platform_axis=wanted.platform_axis,
            twist=wanted.twist,
            actuator=wanted.actuator,
        )
        for leg, wanted in zip(machine.legs, legs_in_links(machine, legs), strict=True)
    )
    home, problem = project_pose(replace(machine, legs=changed), machine.home, max_error)
    return None if problem is not None else home


def _at_readings(
    machine: Machine, starts: Sequence[tuple[Array, Array]], readings: Array, reach: float
) -> list[RigidTransform | None]:
    """Return the poses at readings (n_motors,) of the motors from starts, None if not found.

    If redundant sliders contradict each other it is the least-squares pose, if all are in travel.
    """
    t, turns = (np.array(part) for part in zip(*starts, strict=True))
    poses = np.concatenate([Rotation.from_rotvec(turns).as_matrix(), t[..., None]], axis=2)
    unit = np.array([1.0 / reach] * 3 + [1.0] * 3)

    def missed(poses: Array) -> PoseEquations:
        return machine_equations(machine, poses, readings[None])

    def exact(poses: Array) -> tuple[Array, Array]:
        rows = missed(poses)
        return rows.values, rows.by_pose

    def solved(equations: Equations, poses: Array) -> Solved:
        return solve(
            equations,
            poses_after,
            poses,
            tolerance=1e-14 * reach,
            unit=unit,
            damped=True,
            max_stalled=MAX_STALLED,
        )

    solution = solved(exact, poses)
    holds = solution.worst < _CLOSED * reach
    if solution.jacobian.shape[1] > 6 and not holds.any() and not machine.actuators:
        poses, n_dependent = _on_constraints(machine, solution.points)
        solution = solved(lambda x: least_squares_equations(missed(x), n_dependent), poses)
        singular = np.linalg.svd(solution.jacobian * unit, compute_uv=False)[:, -1]
        holds = (solution.worst < _CLOSED * reach) & (singular > _REGULAR)
        holds &= [_in_travel(machine, pose) for pose in solution.points]
    return [
        motion_of(pose[:, :3], pose[:, 3]) if held else None
        for pose, held in zip(solution.points, holds, strict=True)
    ]


def _on_constraints(machine: Machine, poses: Array) -> tuple[Array, int]:
    """Return poses (k, 3, 4) on the constraints if near, and the number of dependent ones."""
    near = [project_pose(machine, motion_of(T[:, :3], T[:, 3]), _FAR) for T in poses]
    held = np.array([problem is None for _, problem in near])
    poses = np.array([T.as_matrix()[:3] for T, _ in near])
    equations = machine_equations(machine, poses[held])
    constraints = equations.by_pose[:, ~equations.measured]
    n = constraints.shape[1]
    if n == 0 or not held.any():
        return poses, 0
    return poses, n - int(np.linalg.matrix_rank(constraints, rtol=_DEPENDENT).max())


def _in_travel(machine: Machine, pose: Array) -> bool:
    """Return whether all motors are within their travel at a pose (3, 4)."""
    q = readings_at(machine, motion_of(pose[:, :3], pose[:, 3]))
    return all(machine.legs[j].in_travel(q[j : j + 1])[0] for j in machine.motors)


def _unlikely(machine: Machine, T: RigidTransform) -> float:
    """Return a penalty: below the base, a reversed fixed leg, a passive leg outside its travel."""
    centre = machine.A_base.mean(axis=0)
    B = B_at(machine, T.as_matrix()[None])[0]
    size = float(np.abs(B - machine.A_base).max())
    below = machine.spatial and B.mean(axis=0)[2] < centre[2] - 1e-6 * size
    penalty = 10.0 * float(below)
    for j, (leg, q) in enumerate(zip(machine.legs, readings_at(machine, T), strict=True)):
        lower, upper = leg.travel
        if leg.kind is LegKind.PASSIVE and not lower <= q <= upper:
            penalty += 5.0
        if leg.is_fixed_to_platform and leg.platform_axis is not None:
            along = T.rotation.apply(leg.platform_axis) @ (B[j] - machine.A_base[j])
            penalty += 100.0 * float(along < 0.0)
    return penalty


def check_home_travel(machine: Machine) -> None:
    """Check that a stated home is not far outside the travel of its motors.

    Raises ModelError if an actuated leg is outside its travel by more than the travel itself and by
    more than 1 % of its length, or a motor that carries rods by more than its travel.
    """
    far: dict[str, tuple[float, int]] = {}  # by motor, on which several rods may hang
    q = readings_at(machine, machine.home)
    for j, excess in legs_outside(machine, MAX_OUTSIDE).items():
        leg = machine.legs[j]
        allowed = _MAX_OUTSIDE_OF_LEG * leg.length_at(float(q[j])) * (leg.actuator is None)
        if leg.is_motor and excess > allowed:
            far.setdefault(leg.motor_label, (excess, j))
    if not far:
        return
    _, worst = max(far.values(), key=lambda one: one[0])
    leg = machine.legs[worst]
    thing = "leg" if leg.actuator is None else "motor"
    more = f"{thing} is" if len(far) == 2 else f"{thing}s are"
    others = f" ({len(far) - 1} more {more} as far off)" * (len(far) > 1)
    name, reading, travel = home_reading_in_words(leg, float(q[worst]))
    raise ModelError(
        "legcal.home could not be used",
        f"{name} at {reading} there{others}",
        f"a reading near its travel of {travel}",
        f"correct legcal.home or the limits of the {'slider' if leg.actuator is None else 'motor'}",
        machine.yaml_path,
    )


def home_reading_in_words(leg: Leg, q: float) -> tuple[str, str, str]:
    """Return a leg or the motor that carries it, a reading of it, and its travel, in words."""
    size, unit = SHOWN_IN[leg.reading_unit]
    name = f"leg '{leg.name}'" if leg.actuator is None else f"motor '{leg.actuator.joint}'"
    low, high = (size * x for x in leg.travel)
    return name, f"{size * q:.2f} {unit}", f"{low:.2f} to {high:.2f} {unit}"


def legs_outside(machine: Machine, share: float = 0.0) -> dict[int, float]:
    """Return the excess of legs outside their travel at home by more than a share of it.

    The excess is in m, or in rad for rods on motors that turn.
    """
    excess_of = {}
    q = readings_at(machine, machine.home)
    for j, leg in enumerate(machine.legs):
        lower, upper = leg.travel
        excess = max(lower - float(q[j]), float(q[j]) - upper)
        if leg.has_value and excess > share * (upper - lower):
            excess_of[j] = excess
    return excess_of
