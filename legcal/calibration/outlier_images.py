"""Outlier images: most of their outlines are rejected by the joint fit; the probable cause of each.

The outlines of such an image alone give the platform's pose, and with it predicted readings. Where
these are the readings of another image, two images were exchanged; where one differs, it is wrong;
where all agree, the camera was moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.calibration.joint_fit import DISAGREES, Solution
from legcal.data import Measurements
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
from legcal.geometry import Array, IntArray
from legcal.machine import Machine

MIN_REJECTED = 0.34  # share of an image's outlines that the fit rejected
MIN_REJECTED_LEGS = 2  # of which it rejected all outlines
MIN_REJECTED_UNEXPLAINED = 0.67  # the share, if the readings agree with the image
CAMERA_MOVED = "its readings suit it, so check that nobody moved the camera"
MIN_OUTLINES, MIN_LEGS = 6, 3  # that determine a pose
MIN_NOISE = 5e-5  # of an outline at its leg [m]
LOSS = PseudoHuber(4.0)  # of outlines, in least noises
MAX_STEP = (0.3, 0.3, 0.3, np.inf, np.inf, np.inf)  # of the pose: [rad], and any displacement
SIGNIFICANT_SIGMAS = 5.0
MIN_READING_ERROR = 3e-4  # [m]
SAME_READING = 1e-3  # tolerance for the reading of another image [m]
MAX_NAMED_LEGS = 4


@dataclass(frozen=True, eq=False)
class _State:
    pose: Frames  # T_Rb_Re


def outlier_images(
    measurements: Measurements, machine: Machine, solution: Solution
) -> dict[int, str]:
    """Return a note on every outlier image that was fitted, by row."""
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
        view = measurements.views[int(measurements.view[row])]
        name = f"view {view.name}, image {measurements.image[row] or f'of row {row + 1}'}"
        readings = _readings(measurements, machine, solution, row, judged)
        explanation = _explanation(measurements, machine, row, readings)
        if not explanation and len(wrong) < MIN_REJECTED_UNEXPLAINED * len(judged):
            continue  # the outlines are wrong, not the image
        notes[row] = (
            f"{name}: {len(wrong)} of its {len(judged)} outlines disagree with the fit and were "
            f"left out; {explanation or CAMERA_MOVED}."
        )
    return notes


def _readings(
    measurements: Measurements,
    machine: Machine,
    solution: Solution,
    row: int,
    chosen: IntArray,
) -> tuple[Array, Array] | None:
    """Return the readings by the outlines of an image alone, and their sigmas (n_legs,) [m].

    None if the outlines do not determine the pose.
    """
    o = solution.outlines
    chosen = chosen[np.isfinite(o.h[chosen]).all(axis=1)]
    legs = o.leg[chosen]
    n = len(chosen)
    if n < MIN_OUTLINES or len(np.unique(legs)) < MIN_LEGS:
        return None
    T_camera_Rb = solution.T_camera_Rb[int(measurements.view[row])]
    A = np.array([leg.A for leg in solution.legs])
    B = np.array([leg.B for leg in solution.legs])
    radius = np.array([solution.radii[int(o.leg[i]), o.part[i]] for i in chosen.tolist()])
    signed = np.where(o.edge[chosen] == 1, radius, -radius)
    normal_Rb = o.h[chosen] @ T_camera_Rb.rotation.as_matrix()  # of the planes of outlines

    def distances(state: _State) -> Residuals:
        arm = B @ state.pose.R[0].T
        ends = T_camera_Rb.apply(arm + state.pose.t)[legs]
        J = np.concatenate([np.cross(arm[legs], normal_Rb), normal_Rb], axis=1)
        return Residuals.of((np.sum(o.h[chosen] * ends, axis=1) - signed)[:, None], J[:, None])

    touches = (("pose", np.zeros(n, dtype=np.intp), slice(None)),)
    outlines = Factor("outlines", distances, touches, n, 1, whitening=1.0 / MIN_NOISE, robust=True)
    pose = Variables("pose", all_free(1, 6), Frames.moved, max_step=MAX_STEP)
    problem, loss = Problem[_State]((pose,), None, (outlines,)), LOSS
    begin = _State(Frames.of([solution.T_Rb_Re[int(measurements.pose[row])]]))
    try:
        found = minimise(problem, begin, loss)
    except DidNotConverge:
        return None
    normal = normal_equations(problem, found.state, found.linear, loss).U
    if np.linalg.cond(normal) > 1e12:
        return None
    scale = max(1.0, 1.48 * float(np.median(np.abs(found.linear["outlines"].r))))
    arm = B @ found.state.pose.R[0].T
    AB = arm + found.state.pose.t - A
    length = np.linalg.norm(AB, axis=1)
    u = AB / length[:, None]
    J = np.concatenate([np.cross(arm, u), u], axis=1)
    variance = scale**2 * np.einsum("ja,ab,jb->j", J, np.linalg.inv(normal), J)
    q0 = np.array([leg.q0 for leg in solution.legs])
    sign = np.array([leg.sign for leg in machine.legs])
    return sign * (length - q0), np.sqrt(variance)


def _explanation(
    measurements: Measurements,
    machine: Machine,
    row: int,
    readings: tuple[Array, Array] | None,
) -> str:
    """Return the probable cause and what to check; "" where the readings agree with the image."""
    motors = list(machine.motors)
    if readings is None or not motors:
        return "check its reading and that nobody moved camera or machine"
    given = measurements.q[row, motors]
    shown, sigma = readings[0][motors], readings[1][motors]
    off = shown - given
    wrong = np.flatnonzero(np.abs(off) > np.maximum(SIGNIFICANT_SIGMAS * sigma, MIN_READING_ERROR))
    if len(wrong) == 0:
        return ""
    distance = np.abs(measurements.q[:, motors] - shown)
    alike = [
        other
        for other in range(measurements.n_rows)
        if measurements.image[other]
        and measurements.pose[other] != measurements.pose[row]
        and np.all(distance[other] < np.maximum(SIGNIFICANT_SIGMAS * sigma, SAME_READING))
    ]
    if alike:
        nearest = min(alike, key=lambda other: float(distance[other].max()))
        return (
            f"it shows the reading given for image {measurements.image[nearest]}; check which "
            "image belongs to which row"
        )
    names = [machine.leg_names[motors[k]] for k in wrong]
    if len(wrong) == 1:
        k = int(wrong[0])
        return (
            f"it shows a reading of {names[0]} of {1e3 * shown[k]:.2f} +- {1e3 * sigma[k]:.2f} mm, "
            f"given {1e3 * given[k]:.2f} mm; check that reading"
        )
    worst = 1e3 * float(np.abs(off[wrong]).max())
    more = f" and {len(names) - MAX_NAMED_LEGS} more" if len(names) > MAX_NAMED_LEGS else ""
    return (
        "it shows another pose than its reading says, with readings of "
        f"{', '.join(names[:MAX_NAMED_LEGS])}{more} off by up to "
        f"{worst:.1f} mm; check that it was taken there"
    )
