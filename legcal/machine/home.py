"""Where the legs stand at home beside their travel: inside, a little outside, or nowhere near.

A home may lie outside a travel by a little: drawings are, and limits are often set before the
machine is. Up to :data:`FAR` of the travel that is a note. Further out the pose is no pose of this
machine, and everything computed there would be judged where no motor goes.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, ModelError
from legcal.geometry import Array
from legcal.machine.closing import close_near, platform_pose, readings_at
from legcal.machine.equations import (
    Demands,
    constraints_at,
    demands_at,
    is_constrained,
    leg_scale,
    moved,
)
from legcal.machine.leg import LegGeometry, LegKind
from legcal.machine.model import Mechanism
from legcal.machine.parameters import in_links

TRIALS = 200
ENOUGH = 20  # trials, where one of them found a pose above the base
SETTLED = 1e-13  # of a leg length
FURTHEST = 0.01  # of a leg length
PATIENCE = 5  # steps that change little
_RANK = 1e-9


def find_home(mechanism: Mechanism) -> RigidTransform:
    """Return a pose where every leg is at the middle of its travel.

    Of all that seeded starts find, the one that turns the platform least is taken, and of the
    mirror images in the plane of the base joints the one on the positive side of the base's z.
    Legs without a motor take the length that is left to them, inside their travel if possible.

    Raises
    ------
    DidNotConverge
        If none is found.
    """
    middle = np.array([0.5 * sum(leg.travel) for leg in mechanism.legs])
    wanted = mechanism.sign * middle
    held = np.array([leg.kind is LegKind.ACTUATED for leg in mechanism.legs])
    rng = np.random.default_rng(1965)
    centre = mechanism.A_base.mean(axis=0)
    reach = float(np.abs(wanted + mechanism.q0).mean())
    best: tuple[float, RigidTransform] | None = None
    for trial in range(TRIALS):
        place = centre + rng.normal(0.0, reach, 3)
        turn = Rotation.from_rotvec(rng.normal(0.0, 0.1 + trial / TRIALS, 3))
        T = _solve(mechanism, RigidTransform.from_components(place, turn), wanted[held])
        if T is None:
            continue
        rank = _unlikely(mechanism, T) + float(T.rotation.magnitude())
        if best is None or rank < best[0] - 1e-6:
            best = rank, T
        if trial >= ENOUGH and best[0] < 5.0:
            break
    if best is None:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: no home pose was found: with all legs at mid-travel the "
            f"loops did not close from {TRIALS} starts, needed a closed pose; write legcal.home."
        )
    return best[1]


def settle_home(mechanism: Mechanism, home: RigidTransform) -> RigidTransform:
    """Return the pose nearest to home that meets every demand of legs and plane.

    Files give home with few digits; sliders absorb that, but rods, revolute axes and universal
    joints in a row cannot.

    Raises
    ------
    ModelError
        If home is more than 1 % of a leg length away from any such pose.
    """
    settled, problem = settle(mechanism, home)
    if problem is not None:
        raise ModelError(
            f"{mechanism.yaml_path}: legcal.home could not be used: found {problem} there, needed "
            "a closed pose; correct legcal.home."
        )
    return settled


def closed_home(mechanism: Mechanism, home: RigidTransform | None) -> tuple[RigidTransform, Array]:
    """Return the home pose and the closed configuration there, from a given pose or from none.

    Raises
    ------
    ModelError, DidNotConverge
        As :func:`settle_home`, :func:`find_home` and :func:`legcal.machine.closing.close_at`.
    """
    start = find_home(mechanism) if home is None else home
    settled = settle_home(mechanism, start)
    configuration = close_near(mechanism, settled)
    constrained = is_constrained(mechanism)
    return platform_pose(mechanism, configuration) if constrained else settled, configuration


def settle(
    mechanism: Mechanism, T: RigidTransform, furthest: float = FURTHEST
) -> tuple[RigidTransform, str | None]:
    """Return the nearest pose that meets every constraint, and what is in the way if none is near.

    Gauss-Newton steps of least norm on the constraints, angles counted at a mean leg's length.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    T : RigidTransform
        T_base_platform where the search starts.
    furthest : float
        By how much constraints may be missed there, in leg lengths.
    """
    if not is_constrained(mechanism):
        return T, None
    first = constraints_at(mechanism, T)
    scale = leg_scale(mechanism, T)
    if np.abs(first.values).max() > furthest * scale:
        return T, first.worst()
    demands, best = first, np.abs(first.values).max()
    for _ in range(20):
        if best <= SETTLED * scale:
            break
        trial = moved(T, _step(demands.jacobian, demands.values, scale))
        demands = constraints_at(mechanism, trial)
        worst = np.abs(demands.values).max()
        if worst >= best and best < 1e-12 * scale:
            break  # rounding
        T, best = trial, worst
    return T, (demands.worst() if best > 1e-9 * scale else None)


def home_with(
    mechanism: Mechanism, legs: Sequence[LegGeometry], furthest: float
) -> RigidTransform | None:
    """Return the closed pose nearest to home once the legs have other numbers.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    legs : sequence of LegGeometry
        Its legs in R_b and R_e, as they are to be; both frames stay where they are.
    furthest : float
        By how much home may miss what these legs demand, in leg lengths.

    Returns
    -------
    RigidTransform or None
        T_base_platform; home itself where the legs demand nothing else, None if no closed pose
        is near.
    """
    moved_legs = tuple(
        replace(
            leg,
            A_base=wanted.A,
            B_platform=wanted.B,
            q0=wanted.q0,
            base_axis=wanted.base_axis,
            platform_axis=wanted.platform_axis,
            twist=wanted.twist,
        )
        for leg, wanted in zip(mechanism.legs, in_links(mechanism, legs), strict=True)
    )
    home, problem = settle(replace(mechanism, legs=moved_legs), mechanism.home, furthest)
    return None if problem is not None else home


def _step(jacobian: Array, values: Array, scale: float, damping: float = 0.0) -> Array:
    """Return the step that removes values, rotations counted as displacements at a scale."""
    weights = np.array([1.0 / scale] * 3 + [1.0] * 3)
    scaled = jacobian * weights
    if damping > 0.0:
        normal = scaled.T @ scaled + damping * np.eye(6)
        return np.asarray(-weights * np.linalg.solve(normal, scaled.T @ values))
    return np.asarray(-weights * np.linalg.lstsq(scaled, values, rcond=_RANK)[0])


def _solve(
    mechanism: Mechanism, T: RigidTransform, lengths: Array, steps: int = 60
) -> RigidTransform | None:
    """Return the pose near T with those lengths of the actuated legs, None if none is reached."""
    scale = leg_scale(mechanism, T)

    def misfit(pose: RigidTransform) -> tuple[Demands, Array, float]:
        demands = demands_at(mechanism, pose)
        values = demands.values.copy()
        values[demands.measured] -= lengths
        return demands, values, float(values @ values)

    demands, values, cost = misfit(T)
    damping, stuck = 1e-3, 0
    for _ in range(steps):
        if np.abs(values).max() < 1e-14 * scale or stuck > PATIENCE:
            break
        step = _step(demands.jacobian, values, scale, damping if damping > 1e-9 else 0.0)
        size = float(np.abs(step[:3]).max())
        trial = moved(T, step / max(1.0, size))  # at most a radian
        ahead = misfit(trial)
        if ahead[2] < cost:
            stuck = stuck + 1 if ahead[2] > 0.9 * cost else 0
            T, (demands, values, cost), damping = trial, ahead, damping / 10.0
        elif damping > 1e3 or cost < (1e-13 * scale) ** 2:
            break
        else:
            damping = max(10.0 * damping, 1e-8)
    return T if np.abs(values).max() < 1e-9 else None


def _unlikely(mechanism: Mechanism, T: RigidTransform) -> float:
    """Return a penalty: below the base, a fixed leg backwards, a passive one outside its travel."""
    centre = mechanism.A_base.mean(axis=0)
    B = np.asarray(T.apply(mechanism.B_platform))
    size = float(np.abs(B - mechanism.A_base).max())
    below = mechanism.spatial and B.mean(axis=0)[2] < centre[2] - 1e-6 * size
    penalty = 10.0 * float(below)
    for j, (leg, q) in enumerate(zip(mechanism.legs, readings_at(mechanism, T), strict=True)):
        lower, upper = leg.travel
        if leg.kind is LegKind.PASSIVE and not lower <= q <= upper:
            penalty += 5.0
        if leg.platform_joint == "" and leg.platform_axis is not None:
            along = T.rotation.apply(leg.platform_axis) @ (B[j] - mechanism.A_base[j])
            penalty += 100.0 * float(along < 0.0)
    return penalty


NEAR = 0.05  # of the travel: as good as inside
FAR = 1.0  # of the travel: refused beyond, if it is also beyond
_FAR_OF_LEG = 0.01  # of the leg length at home, for sliders that hardly move


def check_home_travel(mechanism: Mechanism) -> None:
    """Check that the home that a file gives is not far outside the travel of its motors.

    Raises
    ------
    ModelError
        If an actuated leg is outside its travel by more than the travel itself and by more than
        1 % of its length.
    """
    far = {}
    q = readings_at(mechanism, mechanism.home)
    for j, excess in legs_outside(mechanism, FAR).items():
        leg = mechanism.legs[j]
        length = leg.sign * float(q[j]) + leg.q0
        if leg.kind is LegKind.ACTUATED and excess > _FAR_OF_LEG * length:
            far[j] = excess
    if not far:
        return
    worst = max(far, key=lambda j: far[j])
    leg = mechanism.legs[worst]
    others = ""
    if len(far) > 1:
        others = f" ({len(far) - 1} more {'leg is' if len(far) == 2 else 'legs are'} as far off)"
    raise ModelError(
        f"{mechanism.yaml_path}: legcal.home could not be used: found leg '{leg.name}' at "
        f"{1e3 * q[worst]:.2f} mm there{others}, needed a reading near its travel of "
        f"{1e3 * leg.travel[0]:.2f} to {1e3 * leg.travel[1]:.2f} mm; correct legcal.home or the "
        "limits of the slider."
    )


def legs_outside(mechanism: Mechanism, share: float = 0.0) -> dict[int, float]:
    """Return which legs are outside their travel at home by more than a share of it, and how far.

    Parameters
    ----------
    mechanism : Mechanism
        The machine with its home.
    share : float
        Of the travel.

    Returns
    -------
    dict of int to float
        Index of the leg, and distance of its reading from the travel [m].
    """
    found = {}
    q = readings_at(mechanism, mechanism.home)
    for j, leg in enumerate(mechanism.legs):
        lower, upper = leg.travel
        excess = max(lower - float(q[j]), float(q[j]) - upper)
        if leg.kind is not LegKind.CONSTANT and excess > share * (upper - lower):
            found[j] = excess
    return found
