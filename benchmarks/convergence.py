"""Where joint fits end that start 5 mm and 3 deg off in everything.

    OMP_NUM_THREADS=1 python benchmarks/convergence.py [--runs 100] [--machine NAME ...] [--seed 0]
                                                       [--workers N] [-o OUT] [--json]

A run is right where every parameter is within five of the standard deviations that the fit states,
and the platform within five of those that follow from them. It is refused where the fit raises an
error. What is left is wrong with a small sigma: nothing is worse. Machines as in ``bound.py``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from bound import errors_of
from outline_sessions import (
    Design,
    OutlineSession,
    StartErrors,
    one_fit,
    platform_errors,
)
from outline_study import (
    Found,
    OutlineStudy,
    failures_of,
    printed,
    run,
)

from legcal.calibration.joint_fit.solution import Solution
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import Leg
from legcal.report.render import Report
from legcal.simulation.paper import Record

FAR = 5.0  # standard deviations
ENOUGH = 0.99  # of the runs must be right
_PLACES = ("before", "after", "predicted")
_COLUMNS = ("right", "refused", "wrong", "before", "after", "1 sigma", "verdict")


class ConvergenceStudy(OutlineStudy):
    """Asks where fits end from nominal models and camera poses that are wrong in everything."""

    name: ClassVar[str] = "convergence"
    runs: ClassVar[int] = 100
    errors: ClassVar[StartErrors] = StartErrors(
        0.005, float(np.deg2rad(3.0)), 0.005, float(np.deg2rad(3.0)), full=True
    )

    def record(self, design: Design, session: OutlineSession) -> Record:
        """Return where the fit of a session ends: largest error, and those of the platform."""
        solution = one_fit(session, self.noise.radius_sigma)
        errors = errors_of(design, session, solution)
        return {
            "worst": float(np.abs(errors["of_sigma"]).max()),
            "before": _misses(design, session.legs.nominal),
            "after": _misses(design, solution.legs),
            "predicted": _predicted(design, solution),
        }

    def judged(self, machine: str, records: Sequence[Record]) -> Found:
        """Return how many fits are right, refused and wrong, and errors of those that ended."""
        ended = [record for record in records if "failure" not in record]
        right = [record["worst"] for record in ended if _is_right(record)]
        wrong, refusals = len(ended) - len(right), failures_of(records)
        figures: dict[str, Any] = dict.fromkeys(_PLACES)
        for key in _PLACES if ended else ():
            shift, turn = np.sqrt(np.mean(np.square([record[key] for record in ended]), axis=0))
            figures[key] = {"dX_mm": 1e3 * float(shift), "dE_deg": float(np.rad2deg(turn))}
        return {
            "machine": machine,
            "met": len(records) > 0 and not wrong and len(right) >= ENOUGH * len(records),
            "runs": len(records),
            "right": len(right),
            "wrong": wrong,
            "refused": sum(refusals.values()),
            "refusals": refusals,
            "worst_sigma": max(right, default=None),
            **figures,
        }

    def table(self, machines: Sequence[Found]) -> Report:
        """Return one row a machine."""
        notes = [
            f"right: every parameter is within {FAR:g} of the standard deviations that the fit "
            "states, and the platform within as many of those that follow. Refused: the fit ends "
            "with an error. Wrong: with a sigma that is too small.",
            "before, after, 1 sigma: displacement of the platform at the poses measured, root mean "
            "square over all fits that ended [mm]: of the nominal model, of the fitted one, and "
            "what the fit predicts of that.",
            *(
                f"{found['machine']}: refused with "
                f"{', '.join(f'{count} {kind}' for kind, count in found['refusals'].items())}."
                for found in machines
                if found["refused"]
            ),
            *self.readings,
        ]
        return printed(_COLUMNS, [_cells(found) for found in machines], notes)


def _misses(design: Design, legs: Sequence[Leg]) -> list[float]:
    """Return displacement [m] and rotation [rad] of the platform, root mean squares over poses."""
    return [float(np.sqrt(np.mean(error**2))) for error in platform_errors(design, legs)]


def _predicted(design: Design, solution: Solution) -> list[float]:
    """Return one standard deviation of them by the covariance of the fit."""
    follow = pose_sensitivity(
        solution.legs,
        solution.kinematic.parametrization,
        design.legs.frame_legs,
        design.R,
        design.t,
    )
    variance = np.einsum(
        "kia,ab,kib->ki", follow, solution.kinematic.covariance, follow, optimize=True
    )
    turn, shift = variance[:, :3].sum(axis=1), variance[:, 3:].sum(axis=1)
    return [float(np.sqrt(shift.mean())), float(np.sqrt(turn.mean()))]


def _is_right(record: Record) -> bool:
    """Return whether a fit that ended found the truth, within what it states."""
    platform = zip(record["after"], record["predicted"], strict=True)
    return bool(record["worst"] <= FAR and all(miss <= FAR * sigma for miss, sigma in platform))


def _cells(found: Found) -> tuple[str, ...]:
    """Return a row of the table."""
    counts = (found["machine"], *(f"{found[key]}" for key in ("right", "refused", "wrong")))
    verdict = "met" if found["met"] else "not met"
    if found["before"] is None:
        return (*counts, "", "", "", verdict)
    before, after, predicted = (found[key]["dX_mm"] for key in _PLACES)
    return (*counts, f"{before:.2f}", f"{after:.4f}", f"{predicted:.4f}", verdict)


if __name__ == "__main__":
    sys.exit(run(ConvergenceStudy, __doc__))
