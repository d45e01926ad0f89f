"""Outlier images: most of their outlines are rejected by the joint fit; the probable cause of each.

Where the outlines and all readings but one agree on a pose of the platform, that reading is wrong.
Else the outlines of such an image alone give the pose, and with it predicted readings. Where these
are the readings of another image, two images were exchanged; where one differs, it is wrong; where
all agree, the camera was moved. No reading is predicted that the travel does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.calibration.joint_fit import DISAGREES, Solution
from legcal.data import Measurements, few
from legcal.errors import DidNotConverge
from legcal.estimation import (
    Factor,
    Frames,
    Problem,
    PseudoHuber,
    Residuals,
    Variables,
    all_free,
    minimise,
    normal_equations,
)
from legcal.files import SHOWN_IN
from legcal.geometry import Array, IntArray, cross
from legcal.machine import Machine, actuator_index, joints_at, reading_of_rod

MIN_REJECTED = 0.34  # share of an image's outlines that the fit rejected
MIN_REJECTED_LEGS = 2  # of which it rejected all outlines
MIN_REJECTED_UNEXPLAINED = 0.67  # the share, if the readings agree with the image
CAMERA_MOVED = "its readings suit it, so check that nobody moved the camera"
MIN_OUTLINES, MIN_LEGS = 6, 3  # that determine a pose
MIN_NOISE = 5e-5  # of an outline at its leg [m]
LOSS = PseudoHuber(4.0)  # of outlines, in least noises
MAX_STEP = (0.3, 0.3, 0.3, np.inf, np.inf, np.inf)  # of the pose: [rad], and any displacement
# Of readings, as far as they move a joint [m]: noise beside the legs of a fit, what is named at
# least, and the tolerance for the reading of another image
READING_NOISE, MIN_READING_ERROR, SAME_READING = 6e-5, 3e-4, 1e-3
SIGNIFICANT_SIGMAS = 5.0
BEYOND_TRAVEL = 0.05  # of the travel: what joint limits of a model leave out


@dataclass(frozen=True, eq=False)
class _State:
    pose: Frames  # T_Rb_Re


@dataclass(frozen=True, eq=False)
class _Shown:
    """The pose of an image as readings, (n_legs,) [m or rad]."""

    readings: Array
    sigma: Array
    noise: float  # of the outlines at their legs [m]
    cost: float  # half the robust sum of squares, in units of that noise


def outlier_images(
    measurements: Measurements, machine: Machine, solution: Solution
) -> dict[int, str]:
    """Return what is said of every outlier image that was fitted, by row, without its name."""
    o = solution.outlines
    rejected = np.array([why.startswith(DISAGREES) for why in o.reason], dtype=np.bool_)
    notes = {}
    for row in np.unique(o.row[rejected]).tolist():
        judged = np.flatnonzero((o.row == row) & (rejected | o.used))
        wrong = judged[rejected[judged]]
        legs = [
            leg for leg in np.unique(o.leg[wrong]) if np.all(rejected[judged[o.leg[judged] == leg]])
        ]
        if len(wrong) < MIN_REJECTED * len(judged) or len(legs) < MIN_REJECTED_LEGS:
            continue
        explanation = _wrong_reading(measurements, machine, solution, row, judged)
        if not explanation:
            alone = _shown(measurements, machine, solution, row, judged)
            explanation = _explanation(measurements, machine, row, alone)
        if not explanation and len(wrong) < MIN_REJECTED_UNEXPLAINED * len(judged):
            continue  # the outlines are wrong, not the image
        notes[row] = (
            f"{len(wrong)} of its {len(judged)} outlines disagree with the fit and were "
            f"left out; {explanation or CAMERA_MOVED}."
        )
    return notes


def _shown(
    measurements: Measurements,
    machine: Machine,
    solution: Solution,
    row: int,
    chosen: IntArray,
    held: Sequence[int] = (),
) -> _Shown | None:
    """Return what outlines of an image show, with the readings of some legs or by themselves.

    None if they do not determine the pose.
    """
    o = solution.outlines
    chosen = chosen[np.isfinite(o.h[chosen]).all(axis=1)]
    legs = o.leg[chosen]
    n = len(chosen)
    if n + len(held) < MIN_OUTLINES or (not held and len(np.unique(legs)) < MIN_LEGS):
        return None
    T_camera_Rb = solution.T_camera_Rb[int(measurements.view[row])]
    B = np.array([leg.B for leg in solution.legs])
    on = actuator_index(solution.legs)
    read = [on.index(a) for a in range(max(on) + 1)]
    q_row = measurements.q[row : row + 1]
    A = joints_at(solution.legs, q_row[:, read])[0]
    T_here = solution.T_Rb_Re[int(measurements.pose[row])]
    at, slope = np.zeros(len(B)), np.ones(len(B))
    for j, leg in enumerate(solution.legs):
        if leg.actuator is not None:  # the reading at which the rod would have its length
            by_q = leg.actuator.motion(leg.A, q_row[:, j]).by_q[0]
            AB = T_here.apply(leg.B) - A[j]
            at[j], slope[j] = q_row[0, j], float(by_q @ AB) / float(np.linalg.norm(AB))
    radius = np.array([solution.radii[int(o.leg[i]), o.part[i]] for i in chosen.tolist()])
    signed = np.where(o.edge[chosen] == 1, radius, -radius)
    q0 = np.array([leg.q0 for leg in solution.legs])
    sign = np.array([leg.sign for leg in machine.legs], dtype=np.float64)
    normal_Rb = o.h[chosen] @ T_camera_Rb.rotation.as_matrix()  # of the planes of outlines

    def distances(state: _State) -> Residuals:
        arm = B @ state.pose.R[0].T
        ends = T_camera_Rb.apply(arm + state.pose.t)[legs]
        J = np.concatenate([cross(arm[legs], normal_Rb), normal_Rb], axis=1)
        return Residuals.of((np.sum(o.h[chosen] * ends, axis=1) - signed)[:, None], J[:, None])

    def readings(state: _State) -> tuple[Array, Array]:
        arm = B @ state.pose.R[0].T
        AB = arm + state.pose.t - A
        length = np.linalg.norm(AB, axis=1)
        u = (sign / slope)[:, None] * AB / length[:, None]
        return at + sign * (length - q0) / slope, np.concatenate([cross(arm, u), u], axis=1)

    def differences(state: _State) -> Residuals:
        q, J = readings(state)
        r = q[list(held)] - measurements.q[row, list(held)]
        return Residuals.of((white * r)[:, None], white[:, None, None] * J[list(held), None])

    sigma = measurements.sigma_of(machine.legs)
    white = 1.0 / np.maximum(_by(machine, READING_NOISE), sigma)[list(held)]
    zero, m = np.zeros(max(n, len(held)), dtype=np.intp), len(held)
    of_outlines, of_readings = (("pose", zero[:k], slice(None)) for k in (n, m))
    by_noise = 1.0 / MIN_NOISE
    factors = [Factor("outlines", distances, (of_outlines,), n, 1, whitening=by_noise, robust=True)]
    if held:
        factors.append(Factor("readings", differences, (of_readings,), m, 1))
    pose = Variables("pose", all_free(1, 6), Frames.moved, max_step=MAX_STEP)
    problem, loss = Problem[_State]((pose,), None, tuple(factors)), LOSS
    begin = _State(Frames.of([solution.T_Rb_Re[int(measurements.pose[row])]]))
    try:
        found = minimise(problem, begin, loss)
    except DidNotConverge:
        return None
    normal = normal_equations(problem, found.state, found.linear, loss).U
    if np.linalg.cond(normal) > 1e12:
        return None
    scale = max(1.0, 1.48 * float(np.median(np.abs(found.linear["outlines"].r))))
    q, J = readings(found.state)
    ends = (B @ found.state.pose.R[0].T + found.state.pose.t)[:, None]
    for j, leg in enumerate(solution.legs):
        if leg.actuator is not None:  # far from the given reading its slope is another one
            q[j] = reading_of_rod(leg, ends[j])[0]
    variance = scale**2 * np.einsum("ja,ab,jb->j", J, np.linalg.inv(normal), J)
    return _Shown(q, np.sqrt(variance), scale * MIN_NOISE, found.cost / scale**2)


def _wrong_reading(
    measurements: Measurements, machine: Machine, solution: Solution, row: int, chosen: IntArray
) -> str:
    """Return which reading is wrong if the outlines suit all others, and no others but these."""
    motors = list(machine.motors)
    shown: dict[int, _Shown] = {}
    for leg in motors:
        held = [other for other in motors if other != leg]
        found = _shown(measurements, machine, solution, row, chosen, held)
        if found is None:
            return ""
        shown[leg] = found
    noise = min((each.noise for each in shown.values()), default=0.0)
    cost = {leg: each.cost * (each.noise / noise) ** 2 for leg, each in shown.items()}
    best, *others = sorted(motors, key=cost.__getitem__)
    if others and cost[others[0]] - cost[best] < 0.5 * SIGNIFICANT_SIGMAS**2:
        return ""
    found, given = shown[best], float(measurements.q[row, best])
    value, sigma = float(found.readings[best]), float(found.sigma[best])
    off = np.abs(found.readings - measurements.q[row])
    least = _least(measurements, machine)
    if np.any((off > least)[[other for other in motors if other != best]]):
        return ""  # it is not the only one
    noise = machine.legs[best].reading_of(found.noise)
    if off[best] < max(SIGNIFICANT_SIGMAS * max(sigma, noise), float(least[best])):
        return ""
    if not _is_in_travel(machine, best, value, sigma):
        return ""
    return _one_wrong(machine, best, value, sigma, given)


def _one_wrong(machine: Machine, leg: int, shown: float, sigma: float, given: float) -> str:
    size, unit = SHOWN_IN[machine.legs[leg].reading_unit]
    return (
        f"it shows a reading of {machine.legs[leg].prismatic} of {size * shown:.2f} +- "
        f"{size * sigma:.2f} {unit}, given {size * given:.2f} {unit}; check that reading"
    )


def _by(machine: Machine, distance: float) -> Array:
    """Return the readings (n_legs,) [m or rad] that move a joint so far [m]."""
    return np.array([leg.reading_of(distance) for leg in machine.legs])


def _least(measurements: Measurements, machine: Machine) -> Array:
    """Return by how much readings (n_legs,) are wrong at least where they are said to be."""
    sigma = measurements.sigma_of(machine.legs)
    return np.maximum(_by(machine, MIN_READING_ERROR), SIGNIFICANT_SIGMAS * sigma)


def _is_in_travel(machine: Machine, leg: int, reading: float, sigma: float) -> bool:
    """Say whether a leg has a reading, as far as it is known."""
    low, high = machine.legs[leg].travel
    margin = BEYOND_TRAVEL * (high - low) + SIGNIFICANT_SIGMAS * sigma
    return low - margin <= reading <= high + margin


def _explanation(
    measurements: Measurements,
    machine: Machine,
    row: int,
    alone: _Shown | None,  # by its outlines alone
) -> str:
    """Return the probable cause and what to check; "" where the readings agree with the image."""
    motors = list(machine.motors)
    if alone is None or not motors:
        return "check its reading and that nobody moved camera or machine"
    given = measurements.q[row, motors]
    shown, sigma = alone.readings[motors], alone.sigma[motors]
    off = shown - given
    least = np.maximum(SIGNIFICANT_SIGMAS * sigma, _least(measurements, machine)[motors])
    wrong = np.flatnonzero(np.abs(off) > least)
    if len(wrong) == 0:
        return ""
    distance = np.abs(measurements.q[:, motors] - shown)
    alike = [
        other
        for other in range(measurements.n_rows)
        if measurements.image[other]
        and measurements.pose[other] != measurements.pose[row]
        and np.all(distance[other] < np.maximum(least, _by(machine, SAME_READING)[motors]))
    ]
    if alike:
        nearest = min(alike, key=lambda other: float(distance[other].max()))
        return (
            f"it shows the reading given for image {measurements.image[nearest]}; check which "
            "image belongs to which row"
        )
    if not all(_is_in_travel(machine, motors[k], shown[k], sigma[k]) for k in wrong):
        return (
            "its outlines suit no pose within the travel of the legs; check that it was taken with "
            "this reading and that nobody moved camera or machine"
        )
    if len(wrong) == 1:
        k = int(wrong[0])
        return _one_wrong(machine, motors[k], shown[k], sigma[k], given[k])
    names = [str(machine.legs[motors[k]].prismatic) for k in wrong]
    travel = [machine.legs[motors[k]].travel for k in wrong]
    possible = np.clip(shown[wrong], *np.transpose(travel)) - given[wrong]
    worst = dict[str, float]()
    for k, off_by in zip(wrong.tolist(), np.abs(possible).tolist(), strict=True):
        size, unit = SHOWN_IN[machine.legs[motors[k]].reading_unit]
        worst[unit] = max(worst.get(unit, 0.0), size * off_by)
    return (
        f"it shows another pose than its reading says, with readings of {few(names)} off by up to "
        f"{' and '.join(f'{most:.1f} {unit}' for unit, most in worst.items())}; check that it was "
        "taken there"
    )
