"""Every shipped machine calibrated many times, by the four steps and by the joint fit.

    OMP_NUM_THREADS=1 python benchmarks/classes_study.py [--runs 200] [--machine NAME ...]
                                                         [--seed 0] [--workers N] [-o OUT] [--json]

The errors of the fit are judged by what it states of them and by the Cramer-Rao bound, on all that
is determined. What errors do to the platform tells of the rest, and compares the fit with the
nominal model and with the four steps, as printed and with legcal's criteria. OUT gets the runs, the
document and the page `classes.md`.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import date
from functools import lru_cache, partial
from typing import Any, ClassVar

import numpy as np
from bound import ERRORS
from outline_bound import (
    INSIDE,
    Determined,
    across,
    at_best,
    coverage_figure,
    figure_remarks,
    nse_figure,
    ratio_figure,
    tied_directions,
    unit_of,
)
from outline_sessions import (
    SHIPPED,
    Design,
    Noise,
    OutlineSession,
    StartErrors,
    one_fit,
    platform_errors,
    staged_legs,
)
from outline_study import (
    Found,
    OutlineStudy,
    failures_of,
    printed,
    run,
)

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import Start
from legcal.errors import DidNotConverge, LegcalError
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.leg import Leg, radius_name
from legcal.machine.parameters import vector_of
from legcal.paper.criteria import Criteria
from legcal.report.render import Report, report
from legcal.simulation.paper import Record, failure_of

NOMINAL, FIT = "nominal", "fit"
STEPS: tuple[Criteria, ...] = ("literal", "default")
ESTIMATORS = (NOMINAL, *STEPS, FIT)
HEADINGS = {
    NOMINAL: "nominal model",
    "literal": "four steps as printed",
    "default": "four steps, weighted",
    FIT: "joint fit",
}
NSE = (0.9, 1.1)
LARGEST_RATIO = 1.05
_EXACT = 1e-6  # squared standard deviations
_JUDGED = 0.1  # least part of a direction that is one of the parameters that are judged
WORTH = ("determined", "runs", "error/bound", "nse", "covered", "verdict")
NOTES = (
    "Directions determined: those of the kinematic parameters. The others do not move the platform "
    "and are held where the nominal model has them. Errors are judged on what is determined, from "
    "the machine that shows exactly the same as the true one and stands there.",
    "Error / bound: these errors together, in units of the Cramer-Rao bound (root mean square).",
    "Normalised squared error (nse): by the covariance that the fit states; 0.9 to 1.1 is asked "
    "for.",
    "Covered: stated 95 % intervals of estimated parameters that hold the truth.",
    "Errors of the platform: displacement [mm] and rotation [deg] at the poses measured, mean over "
    "poses and over all sessions of which the estimator made something; in brackets how many "
    "sessions it failed in.",
    "The four steps take the axes that these outlines give with the nominal radii, the readings "
    "and the nominal model. They look at no camera pose. They take radii as true: an error of 2 % "
    "of a radius is one of 2 % of the distance.",
)


class ClassesStudy(OutlineStudy):
    """Asks what steps and fit make of machines of every class."""

    name: ClassVar[str] = "classes"
    errors: ClassVar[StartErrors] = ERRORS
    known: ClassVar[tuple[str, ...]] = SHIPPED
    runs: ClassVar[int] = 200

    def record(self, design: Design, session: OutlineSession) -> Record:
        """Return errors of the platform by estimator, and of the parameters of the fit."""

        def fit() -> Record:
            solution = one_fit(session, self.noise.radius_sigma)
            errors = errors_of_fit(design, session, solution, self.noise)
            return {**_platform(design, solution.legs), **errors}

        found: Record = {NOMINAL: _platform(design, session.legs.nominal)}
        for criteria in STEPS:
            found[criteria] = _kept(partial(_steps, design, session, criteria))
        found[FIT] = _kept(fit)
        return found

    def judged(self, machine: str, records: Sequence[Record]) -> Found:
        """Return what estimators made of the sessions of a machine, and what the fit is worth."""
        return judged(machine, len(self.design(machine).parametrization), records)

    def table(self, machines: Sequence[Found]) -> Report:
        """Return two rows a machine: what the fit is worth, and errors of the platform."""
        said = [line for found in machines for line in remarks(found)]
        worth = printed(WORTH, [(found["machine"], *worth_cells(found)) for found in machines])
        platform = [(found["machine"], *platform_cells(found, "dX_mm", "dE_deg"))
                    for found in machines]  # fmt: skip
        return report(worth, printed(ESTIMATORS, platform, [*NOTES, *said, *self.readings]))

    def files(self, machines: Sequence[Found]) -> dict[str, bytes]:
        """Return the page with both tables."""
        return {"classes.md": page(machines, self.readings).encode()}


def _platform(design: Design, legs: Sequence[Leg]) -> Record:
    """Return mean errors of the platform [m], [rad]."""
    shift, turn = platform_errors(design, legs)
    return {"dX": float(shift.mean()), "dE": float(turn.mean())}


def _steps(design: Design, session: OutlineSession, criteria: Criteria) -> Record:
    """Return mean errors of the platform by the four steps."""
    return _platform(design, staged_legs(session, criteria))


def _kept(estimate: Callable[[], Record]) -> Record:
    """Return what an estimator finds, or how it fails."""
    try:
        return estimate()
    except LegcalError as error:
        return {"failure": failure_of(error)}


# Errors of a fit, judged on what is determined


def errors_of_fit(
    design: Design, session: OutlineSession, solution: Solution, noise: Noise
) -> Record:
    """Return rank, normalised squared errors (stated, and by the bound), and errors over sigmas."""
    parametrization, n_held = design.parametrization, len(held_of(design, solution))
    there = standing_where_held(design, session, solution)
    best = (_same_bound if n_held == 0 else at_best)(
        there, noise.sigma_q, noise.radius_sigma, n_held
    )
    stated = as_stated(there, solution)
    true = there.legs.nominal
    values, true_values = (
        vector_of(parametrization, legs, session.legs.nominal) for legs in (solution.legs, true)
    )
    from_truth = vector_of(parametrization, solution.legs, true)
    errors = dict(zip(parametrization.names, (values - true_values).tolist(), strict=True))
    sigma = dict(zip(solution.estimates.names, solution.estimates.sigma.tolist(), strict=True))
    return {
        "rank": stated.rank,
        "nse": stated.nse(values - true_values),
        "of_bound": best.nse(from_truth - vector_of(parametrization, true, true)),
        "of_sigma": [errors[name] / sigma[name] for name in errors if name in sigma],
    }


def held_of(design: Design, solution: Solution) -> Array:
    """Return what a fit holds of the parameters that are judged, (w, p) in ``unit_of``.

    Lines of arms are none of these: where one alone is held, all of them are judged.
    """
    _, held = solution.kinematic.of_values(design.parametrization.names)
    held = held / unit_of(design)
    return np.asarray(held[np.linalg.norm(held, axis=1) > _JUDGED])


_same_bound = lru_cache(maxsize=32)(at_best)  # of the true machines, the same in all runs


def standing_where_held(design: Design, session: OutlineSession, solution: Solution) -> Design:
    """Return the machine of the true one's family that stands where a fit holds what is open.

    It is fitted to the exact outlines and readings, from the solution: without noise nothing is
    left of what is determined, and what is open stays.
    """
    if not len(held_of(design, solution)):
        return design
    true = design.legs
    radii = (radius_name(true.names[leg], part) for leg, part in solution.radii)
    free = frozenset([*radii, *design.arms.names])
    exact = refine(
        replace(true, nominal=solution.legs, radii={**true.radii, **solution.radii}),
        replace(session.measurements, q=design.q[design.pose]),
        design.outlines,
        Start(solution.legs, solution.T_camera_Rb, solution.T_Rb_Re, "found"),
        choices=Choices(free=free),
    )
    if exact.quality.cost > _EXACT or len(exact.kinematic.held) != len(solution.kinematic.held):
        raise DidNotConverge(
            "The errors of a fit could not be judged: found no machine that stands where it holds "
            "what is open and shows the same as the true one, needed one; this is a mistake in "
            "legcal, please report it."
        )
    R, t = components(exact.T_Rb_Re)
    return replace(
        design,
        legs=replace(true, nominal=exact.legs, radii={**true.radii, **exact.radii}),
        R=np.asarray(R),
        t=np.asarray(t),
        T_Rb_camera=tuple(T.inv() for T in exact.T_camera_Rb),
    )


def as_stated(design: Design, solution: Solution) -> Determined:
    """Return what a fit says of the errors of its values; axes as angles from the nominal ones."""
    covariance, _ = solution.kinematic.of_values(design.parametrization.names)
    unit, tied = unit_of(design), tied_directions(design)
    parts = across(np.concatenate([held_of(design, solution), tied])) / unit
    return Determined(parts, np.asarray(parts @ covariance @ parts.T))


# What all sessions of a machine showed


def judged(machine: str, n_parameters: int, records: Sequence[Record]) -> Found:
    """Return what the records of a machine say; every determined direction counts alike."""
    estimators = {name: _estimates([record[name] for record in records]) for name in ESTIMATORS}
    fits = [record[FIT] for record in records if "failure" not in record[FIT]]
    ranks = Counter(fit["rank"] for fit in fits)
    figures: dict[str, Any] = {}
    if fits:
        total = sum(rank * count for rank, count in ranks.items())
        joint, nse = (
            sum(fit["rank"] * fit[key] for fit in fits) / total for key in ("of_bound", "nse")
        )
        shares = np.array([np.mean(np.abs(fit["of_sigma"]) < INSIDE) for fit in fits])
        figures = {
            "ratio": ratio_figure(float(np.sqrt(joint)), 1, total, LARGEST_RATIO),
            "nse": nse_figure(float(nse), 1, total, NSE),
            "coverage": coverage_figure(shares),
        }
    good = len(fits) > 0 and not estimators[FIT]["failures"]
    return {
        "machine": machine,
        "met": good and all(figure["met"] for figure in figures.values()),
        "rank": min(ranks, default=0),
        "of": n_parameters,
        "figures": figures,
        "estimators": estimators,
    }


def _estimates(records: Sequence[Record]) -> dict[str, Any]:
    """Return mean errors of the platform by one estimator, and how it failed."""
    good = [record for record in records if "failure" not in record]
    failures = failures_of(records)
    reasons: dict[str, str] = {}
    for record in records:
        if "failure" in record:
            reasons.setdefault(record["failure"]["kind"], record["failure"]["message"])
    shift, turn = (sum(record[key] for record in good) / max(len(good), 1) for key in ("dX", "dE"))
    return {
        "runs": len(good),
        "dX_mm": 1e3 * shift if good else None,
        "dE_deg": float(np.rad2deg(turn)) if good else None,
        "failed": sum(failures.values()),
        "failures": failures,
        "reasons": reasons,
    }


def worth_cells(found: Found) -> tuple[str, ...]:
    """Return what the fit is worth, in the order of ``WORTH``."""
    if not found["figures"]:
        return (f"? of {found['of']}", "0", "", "", "", "all failed")
    ratio, nse, coverage = (figure["value"] for figure in found["figures"].values())
    return (
        f"{found['rank']} of {found['of']}",
        f"{found['estimators'][FIT]['runs']}",
        f"{ratio:.3f}",
        f"{nse:.3f}",
        f"{100.0 * coverage:.1f} %",
        "met" if found["met"] else "not met",
    )


def platform_cells(found: Found, *keys: str) -> tuple[str, ...]:
    """Return errors of the platform, in the order of ``ESTIMATORS``."""
    told = []
    for estimates in (found["estimators"][name] for name in ESTIMATORS):
        failed = f" ({estimates['failed']})" if estimates["failed"] else ""
        figures = "failed"
        if estimates["runs"]:
            figures = " ".join(_three(estimates[key]) for key in keys)
        told.append(f"{figures}{failed}")
    return tuple(told)


def _three(value: float) -> str:
    """Return a number with three figures, more than four decimals aside."""
    decimals = 2 - int(np.floor(np.log10(value))) if value > 0.0 else 4
    return f"{value:.{min(max(decimals, 0), 4)}f}"


def remarks(found: Found) -> list[str]:
    """Return what else is to be said of a machine, one sentence each."""
    said = [
        f"{found['machine']}: the {name}{' steps' if name in STEPS else ''} failed in {count} of "
        f"{estimates['failed'] + estimates['runs']} sessions with {kind}, the first time: "
        f"{estimates['reasons'][kind]}"
        for name, estimates in found["estimators"].items()
        for kind, count in estimates["failures"].items()
    ]
    n = found["estimators"][FIT]["runs"]
    return said + figure_remarks(found["machine"], n, found["figures"])


def page(machines: Sequence[Found], readings: Sequence[str]) -> str:
    """Return the page."""
    limits, failed = dict[str, list[str]](), []
    there = {found["machine"] for found in machines}
    left = [name for name in SHIPPED if name not in there]
    for found in machines:
        name, n = found["machine"], found["estimators"][FIT]["runs"]
        for line in figure_remarks(name, n, found["figures"]):
            limits.setdefault(line.removeprefix(f"{name}: "), []).append(name)
        for estimator, estimates in found["estimators"].items():
            failed += [
                (name, HEADINGS[estimator], f"{count}", kind, _why(estimates["reasons"][kind]))
                for kind, count in estimates["failures"].items()
            ]
    worth = ("directions determined", "runs", "error / bound", "normalised squared error",
             "95 % intervals that hold the truth", "verdict")  # fmt: skip
    estimators = [HEADINGS[name] for name in ESTIMATORS]
    reasons = ("estimator", "sessions", "error", "the first time")
    blocks = [
        "# Machines of every class, calibrated",
        "",
        "What is the joint fit worth on each class of machine, and what do the paper's four steps "
        "give by\nthemselves? This page has both, for simulated machines whose truth is known.",
        "",
        f"Written by `python benchmarks/classes_study.py` on {date.today()}."
        + (f" Not in these runs: {', '.join(left)}." if left else ""),
        "",
        "## What the fit is worth",
        "",
        *_markdown(worth, [(found["machine"], *worth_cells(found)) for found in machines]),
    ]
    for title, key in (
        ("Displacement of the platform, mm", "dX_mm"),
        ("Rotation of the platform, deg", "dE_deg"),
    ):
        rows = [(found["machine"], *platform_cells(found, key)) for found in machines]
        blocks += [f"## {title}", "", *_markdown(estimators, rows)]
    said = [*NOTES, *readings, *(f"{', '.join(names)}: {line}" for line, names in limits.items())]
    blocks += ["## How the figures are made", "", *(f"- {line}" for line in said), ""]
    if failed:
        blocks += ["## What failed", "", *_markdown(reasons, failed)]
    return "\n".join(blocks)


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with a row for each machine, and an empty one."""
    heading = [f"| machine | {' | '.join(columns)} |", f"|{'---|' * (len(columns) + 1)}"]
    return [*heading, *(f"| {' | '.join(row)} |" for row in rows), ""]


def _why(message: str) -> str:
    """Return what an error found, without what was needed and what is to be done."""
    return re.split("[,;] needed ", message)[0]


if __name__ == "__main__":
    sys.exit(run(ClassesStudy, __doc__))
