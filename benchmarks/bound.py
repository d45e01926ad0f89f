"""The joint fit beside the Cramer-Rao bound, parameter by parameter, and what its sigmas are worth.

    OMP_NUM_THREADS=1 python benchmarks/bound.py [--runs 2000] [--machine NAME ...] [--seed 0]
                                                 [--workers N] [-o OUT] [--json]

Machines: 6-spu-noncoplanar, 6-spu-coplanar, 3-upu-tilted, 3-rpr; all of them without --machine.
OUT gets the runs, which the same command goes on from, the document and the page `bound.md`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import date
from typing import ClassVar

import numpy as np
from outline_bound import (
    INSIDE,
    Bound,
    band_of_ratio,
    bound_of,
    coverage_figure,
    figure_remarks,
    nse_figure,
    ratio_figure,
)
from outline_sessions import (
    Design,
    OutlineSession,
    StartErrors,
    one_fit,
)
from outline_study import (
    Found,
    OutlineStudy,
    failures_of,
    printed,
    run,
)

from legcal.calibration.joint_fit.solution import Solution
from legcal.errors import NotIdentifiable
from legcal.machine.parameters import vector_of
from legcal.report.render import Report
from legcal.simulation.paper import Record

ERRORS = StartErrors(0.002, float(np.deg2rad(1.0)), 0.015, float(np.deg2rad(1.5)), full=False)
LARGEST_RATIO = 1.02
NSE = (0.97, 1.03)
COLUMNS = ("runs", "each/bound", "all/bound", "nse", "covered", "verdict")
_UNITS = {"m": "um", "rad": "urad"}


class BoundStudy(OutlineStudy):
    """Asks for the errors of parameters, and what the fit says of them."""

    name: ClassVar[str] = "bound"
    errors: ClassVar[StartErrors] = ERRORS
    runs: ClassVar[int] = 2000

    def record(self, design: Design, session: OutlineSession) -> Record:
        """Return the errors of the fit of a session."""
        return errors_of(design, session, one_fit(session, self.noise.radius_sigma))

    def judged(self, machine: str, records: Sequence[Record]) -> Found:
        """Return errors over the bound, normalised squared errors and coverage."""
        bound = bound_of(self.design(machine), self.noise.sigma_q, self.noise.radius_sigma)
        return judged(machine, bound, records)

    def table(self, machines: Sequence[Found]) -> Report:
        """Return one row a machine."""
        rows = [(found["machine"], *cells(found)) for found in machines]
        said = [line for found in machines for line in remarks(found)]
        return printed(COLUMNS, rows, [*said, *self.readings])

    def files(self, machines: Sequence[Found]) -> dict[str, bytes]:
        """Return the page with every parameter."""
        return {"bound.md": page(machines, self.readings).encode()}


def errors_of(design: Design, session: OutlineSession, solution: Solution) -> Record:
    """Return the errors of what was found as a record.

    ``error`` counts axes as angles from the true ones [m, rad]; ``of_sigma``, over the standard
    deviations that the fit states, and ``nse``, per parameter by its covariance, as it does.
    """
    missing = [name for name in design.names if solution.estimates.status.get(name) != "estimated"]
    if missing:
        raise NotIdentifiable(
            f"The errors of a fit could not be judged: found that {', '.join(missing)} were not "
            "estimated, needed all parameters; give the machine more images."
        )
    names, kinematic, true = design.names, design.parametrization, design.legs.nominal
    radii = np.array([design.legs.radii[part] for part in design.parts])
    found = solution.estimates.vector(names)
    truth = np.concatenate([vector_of(kinematic, true, session.legs.nominal), radii])
    of_truth, from_truth = (vector_of(kinematic, legs, true) for legs in (true, solution.legs))
    place = [solution.estimates.names.index(name) for name in names]
    sigma = solution.estimates.sigma[place]
    correlation = solution.estimates.covariance[np.ix_(place, place)] / np.outer(sigma, sigma)
    of_sigma = (found - truth) / sigma
    error = np.concatenate([from_truth - of_truth, found[len(kinematic) :] - radii])
    return {
        "error": error.tolist(),
        "of_sigma": of_sigma.tolist(),
        "nse": float(of_sigma @ np.linalg.solve(correlation, of_sigma)) / len(names),
    }


def judged(machine: str, bound: Bound, records: Sequence[Record]) -> Found:
    """Return what the records of a machine say beside its bound; no figures without any."""
    good = [record for record in records if "failure" not in record]
    n, n_parameters = len(good), len(bound.names)
    failures = failures_of(records)
    found: Found = {
        "machine": machine,
        "met": False,
        "runs": n,
        "failed": sum(failures.values()),
        "failures": failures,
        "band": list(band_of_ratio(n)),
        "pooled": {},
        "parameters": [],
    }
    if not n:
        return found
    z = np.array([record["error"] for record in good]) / bound.sigma
    of_sigma = np.array([record["of_sigma"] for record in good])
    inverse = np.linalg.inv(bound.covariance / np.outer(bound.sigma, bound.sigma))
    joint = np.einsum("ri,ij,rj->r", z, inverse, z) / n_parameters
    inside = np.abs(of_sigma) < INSIDE
    low, high = found["band"]
    ratio = np.sqrt(np.mean(z**2, axis=0))
    outside = (ratio < low) | (ratio > high)
    columns = (
        bound.names,
        bound.units,
        bound.sigma.tolist(),
        ratio.tolist(),
        np.mean(of_sigma**2, axis=0).tolist(),
        inside.mean(axis=0).tolist(),
        outside.tolist(),
    )
    keys = ("name", "unit", "bound", "ratio", "nse", "coverage", "outside_band")
    found["parameters"] = [dict(zip(keys, row, strict=True)) for row in zip(*columns, strict=True)]
    nse = float(np.mean([record["nse"] for record in good]))
    found["pooled"] = {
        "ratio": ratio_figure(float(np.sqrt(joint.mean())), n, n_parameters, LARGEST_RATIO),
        "nse": nse_figure(nse, n, n_parameters, NSE),
        "coverage": coverage_figure(inside.mean(axis=1)),
    }
    good_figures = all(figure["met"] for figure in found["pooled"].values())
    found["met"] = bool(good_figures and not failures and not outside.any())
    return found


def cells(found: Found) -> tuple[str, ...]:
    """Return the figures of a machine in the order of ``COLUMNS``."""
    if not found["runs"]:
        return ("0", "", "", "", "", "all failed")
    ratios = [row["ratio"] for row in found["parameters"]]
    ratio, nse, coverage = (found["pooled"][name]["value"] for name in ("ratio", "nse", "coverage"))
    return (
        f"{found['runs']}",
        f"{min(ratios):.3f} to {max(ratios):.3f}",
        f"{ratio:.3f}",
        f"{nse:.3f}",
        f"{100.0 * coverage:.1f} %",
        "met" if found["met"] else "not met",
    )


def remarks(found: Found) -> list[str]:
    """Return what else is to be said of a machine, one sentence each."""
    machine, n, said = found["machine"], found["runs"], []
    if found["failures"]:
        kinds = ", ".join(f"{count} {kind}" for kind, count in found["failures"].items())
        said.append(f"{machine}: {kinds}: runs that failed are in no figure.")
    if not n:
        return said
    names = [f"{x['name']} {x['ratio']:.3f}" for x in found["parameters"] if x["outside_band"]]
    told = f"outside are {', '.join(names)}" if names else "no parameter is outside"
    low, high = found["band"]
    said.append(
        f"{machine}: 99.9 % of all ratios of {n} runs are within {low:.3f} to {high:.3f} at the "
        f"bound; {told}."
    )
    return said + figure_remarks(machine, n, found["pooled"])


def page(machines: Sequence[Found], readings: Sequence[str]) -> str:
    """Return the page."""
    lines = [
        "# The fit beside the Cramer-Rao bound",
        "",
        "The Cramer-Rao bound is the least standard deviation that any unbiased estimator of the "
        "same data can\nhave. This page says, parameter by parameter, how near the joint fit comes "
        "to it and whether the\nstandard deviations that it states are right.",
        "",
        f"Written by `python benchmarks/bound.py` on {date.today()}.",
        "",
        "| machine | runs | error / bound, each parameter | all together "
        "| normalised squared error | 95 % intervals that hold the truth | verdict |",
        "|---|---|---|---|---|---|---|",
        *(f"| {' | '.join((found['machine'], *cells(found)))} |" for found in machines),
        "",
        "## How the sessions are made",
        "",
        *(f"- {line}" for line in readings),
        "",
    ]
    for found in machines:
        lines += [f"## {found['machine']}", ""]
        lines += [f"- {line.removeprefix(found['machine'] + ': ')}" for line in remarks(found)]
        lines.append("")
        if found["runs"]:
            lines += [
                "| parameter | bound, 1 sigma | error / bound | normalised squared error "
                "| covered |",
                "|---|---|---|---|---|",
                *(
                    f"| {x['name']} | {1e6 * x['bound']:.2f} {_UNITS[x['unit']]} | "
                    f"{x['ratio']:.3f}{' outside' * x['outside_band']} | {x['nse']:.3f} | "
                    f"{100.0 * x['coverage']:.1f} % |"
                    for x in found["parameters"]
                ),
                "",
            ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(run(BoundStudy, __doc__))
