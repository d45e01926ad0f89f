"""Outlier images, whose outlines are mostly rejected by the joint fit, and their probable causes.

If the outlines and all readings but one agree on a platform pose, that reading is wrong. Otherwise
the outlines alone give the pose and predicted readings. If these match another image, two images
were swapped; if one reading differs, it is wrong; if all agree, the camera was moved. Predicted
readings outside of the travel are not reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.solution import Solution
from legcal.causes import Cause
from legcal.data.measurements import Measurements, few
from legcal.data.reasons import Reason
from legcal.errors import DidNotConverge
from legcal.estimation.loss import PseudoHuber
from legcal.estimation.problem import (
    EstimationProblem,
    Factor,
    Frames,
    Residuals,
    Variables,
    all_free,
)
from legcal.estimation.solver import minimise, normal_equations
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, IntArray
from legcal.machine.model import Machine
from legcal.machine.rods import actuator_index, joints_at, reading_of_rod

MIN_REJECTED = 0.34  # smallest share of rejected outlines of an outlier image
MIN_REJECTED_LEGS = 2  # smallest number of legs with all outlines rejected
MIN_REJECTED_UNEXPLAINED = 0.67  # smallest share if the readings agree with the image
POSE_IN_DOUBT = Cause(
    "its readings do not determine the pose of the platform, and its outlines fit several poses; "
    "take it again with more legs in sight"
)
CAMERA_MOVED = Cause("its readings are consistent, so the camera may have moved")
MIN_OUTLINES, MIN_LEGS = 6, 3  # smallest numbers that determine a pose
# Lengths are relative to the mean leg length.
MIN_NOISE = 1.25e-4  # smallest noise of an outline at its leg
LOSS = PseudoHuber(4.0)  # loss of outlines, in units of the smallest noise
MAX_STEP = (0.3, 0.3, 0.3, np.inf, np.inf, np.inf)  # of the pose: [rad], and any displacement
# Displacements of a joint by readings: noise due to errors of the fit, smallest reported error,
# tolerance for the reading of another image
READING_NOISE, MIN_READING_ERROR, SAME_READING = 1.5e-4, 7.5e-4, 2.5e-3
SIGNIFICANT_SIGMAS = 5.0
BEYOND_TRAVEL = 0.05  # tolerance of the joint limits, relative to the travel


@dataclass(frozen=True, eq=False)
class _State:
    pose: Frames  # T_Rb_Re


@dataclass(frozen=True, eq=False)
class _PoseEstimate:
    """Estimated pose of an image as readings, (n_legs,) [m or rad]."""

    readings: Array
    sigma: Array
    noise: float  # noise of the outlines at their legs [m]
    cost: float  # half the robust sum of squares, in units of that noise


def outlier_images(
    measurements: Measurements, machine: Machine, solution: Solution
) -> dict[int, Cause]:
    """Return the cause of every outlier image that was fitted, by row."""
    o = solution.outlines
    rejected = o.rejected_for(Reason.DISAGREES)
    notes = {}
    for row in np.unique(o.row[rejected]).tolist():
        judged = np.flatnonzero((o.row == row) & (rejected | o.used))
        left_out = judged[rejected[judged]]
        legs = [
            leg
            for leg in np.unique(o.leg[left_out])
            if np.all(rejected[judged[o.leg[judged] == leg]])
        ]
        if len(left_out) < MIN_REJECTED * len(judged) or len(legs) < MIN_REJECTED_LEGS:
            continue
        if machine.is_determined:
            image = _Image(measurements, machine, solution, row)
            explanation = image.wrong_reading(judged) or image.explanation(judged)
        else:
            explanation = POSE_IN_DOUBT
        if not explanation and len(left_out) < MIN_REJECTED_UNEXPLAINED * len(judged):
            continue  # the outlines are wrong, not the image
        notes[row] = Cause(
            "{} of its {} outlines disagree with the fit and were left out; {}.",
            (len(left_out), len(judged), explanation or CAMERA_MOVED),
        )
    return notes


@dataclass(frozen=True, eq=False)
class _Image:
    """A fitted image, and the readings predicted by its outlines."""

    measurements: Measurements
    machine: Machine
    solution: Solution
    row: int

    @property
    def given_readings(self) -> Array:
        """The readings of its row, (n_legs,) [m or rad]."""
        return np.asarray(self.measurements.q[self.row])

    @property
    def fitted_pose(self) -> RigidTransform:
        """T_Rb_Re of the fit."""
        return self.solution.T_Rb_Re[int(self.measurements.pose[self.row])]

    @cached_property
    def _joints(self) -> tuple[Array, Array]:
        """A and B of the fit, (n_legs, 3), in R_b and R_e [m]."""
        legs, on = self.solution.legs, actuator_index(self.solution.legs)
        read = [on.index(a) for a in range(max(on) + 1)]
        return joints_at(legs, self.given_readings[None, read])[0], np.array(
            [leg.B for leg in legs]
        )

    @cached_property
    def _length_laws(self) -> tuple[Array, Array]:
        """Reference readings (n_legs,) and derivatives of leg lengths by readings.

        Rods on an actuator are linearised about the given reading.
        """
        A, B = self._joints
        reference, slope = np.zeros(len(B)), np.ones(len(B))
        for j, leg in enumerate(self.solution.legs):
            if leg.actuator is not None:
                by_q = leg.actuator.motion(leg.A, self.given_readings[j : j + 1]).by_q[0]
                AB = self.fitted_pose.apply(leg.B) - A[j]
                reference[j], slope[j] = (
                    self.given_readings[j],
                    float(by_q @ AB) / float(np.linalg.norm(AB)),
                )
        return reference, slope

    def readings_at(self, pose: Frames) -> tuple[Array, Array]:
        """Return the readings (n_legs,) at a pose, and their derivatives (n_legs, 6) by it."""
        (A, B), (reference, slope) = self._joints, self._length_laws
        q0 = np.array([leg.q0 for leg in self.solution.legs])
        sign = np.array([leg.sign for leg in self.machine.legs], dtype=np.float64)
        arm = B @ pose.R[0].T
        AB = arm + pose.t - A
        length = np.linalg.norm(AB, axis=1)
        u = (sign / slope)[:, None] * AB / length[:, None]
        return reference + sign * (length - q0) / slope, np.concatenate([cross(arm, u), u], axis=1)

    def _distances(self, chosen: IntArray, pose: Frames) -> Residuals:
        """Return the distances of B at a pose from the chosen outlines [m]."""
        o, (_, B) = self.solution.outlines, self._joints
        legs = o.leg[chosen]
        radii = [self.solution.radii[int(o.leg[i]), o.part[i]] for i in chosen.tolist()]
        signed = np.where(o.edge[chosen] == 1, radii, np.negative(radii))
        T = self.solution.T_camera_Rb[int(self.measurements.view[self.row])]
        normal_Rb = o.h[chosen] @ T.rotation.as_matrix()  # normals of the planes of outlines
        arm = B @ pose.R[0].T
        ends = T.apply(arm + pose.t)[legs]
        J = np.concatenate([cross(arm[legs], normal_Rb), normal_Rb], axis=1)
        return Residuals.of((np.sum(o.h[chosen] * ends, axis=1) - signed)[:, None], J[:, None])

    def pose_from_outlines(
        self, chosen: IntArray, used_readings: Sequence[int] = ()
    ) -> _PoseEstimate | None:
        """Return the pose by outlines, optionally with the readings of some legs.

        None if they do not determine the pose.
        """
        o, legs, readings_used = self.solution.outlines, self.solution.legs, list(used_readings)
        chosen = chosen[np.isfinite(o.h[chosen]).all(axis=1)]
        n, m = len(chosen), len(readings_used)
        if n + m < MIN_OUTLINES or (not readings_used and len(np.unique(o.leg[chosen])) < MIN_LEGS):
            return None
        noise = np.maximum(
            self._readings_for(READING_NOISE), self.measurements.sigma_of(self.machine.legs)
        )
        white = 1.0 / noise[readings_used]
        least_noise = MIN_NOISE * self.machine.size

        def differences(state: _State) -> Residuals:
            q, J = self.readings_at(state.pose)
            r = q[readings_used] - self.given_readings[readings_used]
            return Residuals.of((white * r)[:, None], white[:, None, None] * J[readings_used, None])

        zero = np.zeros(max(n, m), dtype=np.intp)
        of_outlines, of_readings = (("pose", zero[:k], slice(None)) for k in (n, m))
        factors: list[Factor[_State]] = [
            Factor(
                "outlines",
                lambda state: self._distances(chosen, state.pose),
                (of_outlines,),
                n,
                1,
                whitening=1.0 / least_noise,
                robust=True,
            )
        ]
        if readings_used:
            factors.append(Factor("readings", differences, (of_readings,), m, 1))
        pose = Variables("pose", all_free(1, 6), Frames.moved, max_step=MAX_STEP)
        problem = EstimationProblem[_State]((pose,), None, tuple(factors))
        try:
            minimum = minimise(problem, _State(Frames.of([self.fitted_pose])), LOSS)
        except DidNotConverge:
            return None
        normal = normal_equations(problem, minimum.state, minimum.linear, LOSS).U
        unit = np.repeat([1.0, 1.0 / self.machine.size], 3)  # lengths in leg lengths
        if np.linalg.cond(normal / np.outer(unit, unit)) > 1e12:
            return None
        scale = max(1.0, 1.48 * float(np.median(np.abs(minimum.linear["outlines"].r))))
        q, J = self.readings_at(minimum.state.pose)
        ends = (self._joints[1] @ minimum.state.pose.R[0].T + minimum.state.pose.t)[:, None]
        for j, leg in enumerate(legs):
            if leg.actuator is not None:  # far from the given reading its slope is another one
                q[j] = reading_of_rod(leg, ends[j])[0]
        variance = scale**2 * np.einsum("ja,ab,jb->j", J, np.linalg.inv(normal), J)
        return _PoseEstimate(q, np.sqrt(variance), scale * least_noise, minimum.cost / scale**2)

    def wrong_reading(self, chosen: IntArray) -> Cause | None:
        """Return the wrong reading if the outlines agree with exactly all others; else None."""
        motors = list(self.machine.motors)
        estimates: dict[int, _PoseEstimate] = {}
        for leg in motors:
            estimate = self.pose_from_outlines(chosen, [other for other in motors if other != leg])
            if estimate is None:
                return None
            estimates[leg] = estimate
        noise = min((estimate_of_leg.noise for estimate_of_leg in estimates.values()), default=0.0)
        cost = {
            leg: estimate_of_leg.cost * (estimate_of_leg.noise / noise) ** 2
            for leg, estimate_of_leg in estimates.items()
        }
        best, *others = sorted(motors, key=cost.__getitem__)
        if others and cost[others[0]] - cost[best] < 0.5 * SIGNIFICANT_SIGMAS**2:
            return None
        estimate = estimates[best]
        value, sigma = float(estimate.readings[best]), float(estimate.sigma[best])
        error, min_error = np.abs(estimate.readings - self.given_readings), self._min_errors
        if np.any((error > min_error)[[other for other in motors if other != best]]):
            return None  # it is not the only one
        noise = self.machine.legs[best].reading_of(estimate.noise)
        if error[best] < max(SIGNIFICANT_SIGMAS * max(sigma, noise), float(min_error[best])):
            return None
        in_travel = self._is_in_travel(best, value, sigma)
        return self._wrong_reading_cause(best, value, sigma) if in_travel else None

    def explanation(self, chosen: IntArray) -> Cause | None:
        """Return the probable cause by the outlines alone, with the remedy.

        None if the readings agree with the image.
        """
        m, motors, estimate = (
            self.measurements,
            list(self.machine.motors),
            self.pose_from_outlines(chosen),
        )
        if estimate is None or not motors:
            return Cause("check its reading and that nobody moved camera or machine")
        readings, sigma, given = (
            estimate.readings[motors],
            estimate.sigma[motors],
            self.given_readings[motors],
        )
        min_error = np.maximum(SIGNIFICANT_SIGMAS * sigma, self._min_errors[motors])
        differing = np.flatnonzero(np.abs(readings - given) > min_error)
        if len(differing) == 0:
            return None
        distance = np.abs(m.q[:, motors] - readings)
        tolerance = np.maximum(min_error, self._readings_for(SAME_READING)[motors])
        matching = [
            other
            for other in range(m.n_rows)
            if m.image[other]
            and m.pose[other] != m.pose[self.row]
            and np.all(distance[other] < tolerance)
        ]
        if matching:
            nearest = min(matching, key=lambda other: float(distance[other].max()))
            return Cause(
                "it shows the reading given for image {}; check which image belongs to which row",
                (m.image[nearest],),
            )
        if not all(self._is_in_travel(motors[k], readings[k], sigma[k]) for k in differing):
            return Cause(
                "its outlines suit no pose within the travel of the legs; check that it was taken "
                "with this reading and that nobody moved camera or machine"
            )
        if len(differing) == 1:
            k = int(differing[0])
            return self._wrong_reading_cause(motors[k], readings[k], sigma[k])
        legs = [self.machine.legs[motors[k]] for k in differing]
        travel = np.transpose([leg.travel for leg in legs])
        possible = np.abs(np.clip(readings[differing], *travel) - given[differing])
        worst = dict[str, float]()
        for leg, error in zip(legs, possible.tolist(), strict=True):
            size, unit = SHOWN_IN[leg.reading_unit]
            worst[unit] = max(worst.get(unit, 0.0), size * error)
        return Cause(
            "it shows another pose than its reading says, with readings of {} off by up to "
            f"{' and '.join(f'{{:.1f}} {unit}' for unit in worst)}; check that it was taken there",
            (few([str(leg.prismatic) for leg in legs]), *worst.values()),
        )

    def _wrong_reading_cause(self, leg: int, predicted: float, sigma: float) -> Cause:
        joint, given = self.machine.legs[leg].prismatic, float(self.given_readings[leg])
        size, unit = SHOWN_IN[self.machine.legs[leg].reading_unit]
        return Cause(
            f"it shows a reading of {{}} of {{:.2f}} +- {{:.2f}} {unit}, given {{:.2f}} {unit}; "
            "check that reading",
            (str(joint), size * predicted, size * sigma, size * given),
        )

    def _readings_for(self, distance: float) -> Array:
        """Return readings (n_legs,) [m or rad] for a displacement, relative to the leg length."""
        size = self.machine.size
        return np.array([leg.reading_of(distance * size) for leg in self.machine.legs])

    @property
    def _min_errors(self) -> Array:
        """Smallest reported errors of readings, (n_legs,) [m or rad]."""
        sigma = self.measurements.sigma_of(self.machine.legs)
        return np.maximum(self._readings_for(MIN_READING_ERROR), SIGNIFICANT_SIGMAS * sigma)

    def _is_in_travel(self, leg: int, reading: float, sigma: float) -> bool:
        """Return whether a reading is within the travel, with tolerances."""
        low, high = self.machine.legs[leg].travel
        margin = BEYOND_TRAVEL * (high - low) + SIGNIFICANT_SIGMAS * sigma
        return low - margin <= reading <= high + margin
