"""The parameters of a calibration as a table and as bars."""

from __future__ import annotations

import numpy as np

from legcal.calibration import UNITS, Calibration, ParameterRow
from legcal.report.page.document import Cell, Drawing, Table, number
from legcal.report.page.svg import change_bars

_BY_PRIOR = 0.7  # of the standard deviation of a prior: beyond it the images say little
COLUMNS = ("parameter", ">nominal", ">calibrated", ">change", ">sigma", "unit", ">prior sigma",
           "how determined")  # fmt: skip


def parameter_table(calibration: Calibration) -> Table:
    """Return all parameters in mm, degrees and pixels."""
    priors = prior_sigmas(calibration)
    rows = [_row(row, priors.get(row.name)) for row in calibration.result.parameters]
    return Table(
        COLUMNS,
        rows,
        note="Joints of the base in R_b, those of the platform in R_e; axes are turns from the "
        "nominal ones. Sigma is one standard deviation. A click on a heading sorts.",
    )


def prior_sigmas(calibration: Calibration) -> dict[str, float]:
    """Return the standard deviations of priors by the name of their parameter [m, rad, px]."""
    problem = calibration.solution.posterior.problem
    priors, named = problem.priors, problem.named
    found = {
        named[i]: sigma
        for i, sigma in zip(priors.unknown.tolist(), priors.sigma.tolist(), strict=True)
        if i < len(named)
    }
    return found | dict(calibration.solution.prior_sigma)


def _row(row: ParameterRow, prior: float | None) -> list[Cell]:
    scale, unit, digits = UNITS[row.unit]
    sigma = None if row.sigma is None else scale * row.sigma
    is_estimated = row.status == "estimated"
    return [
        row.name,
        number(scale * row.nominal, digits),
        number(scale * row.value, digits),
        number(scale * (row.value - row.nominal), digits, signed=True),
        number(sigma, digits),
        unit,
        number(None if prior is None or not is_estimated else scale * prior, digits),
        _how(row, prior),
    ]


def _how(row: ParameterRow, prior: float | None) -> str:
    if row.status == "fixed":
        return "fixed"
    if row.status == "weak" or row.sigma is None:
        return "held at nominal: nothing determines it"
    if prior is None:
        return "by images and readings"
    if row.sigma > _BY_PRIOR * prior:
        return "mostly by its prior"
    return "by images, readings and its prior"


def change_charts(calibration: Calibration) -> list[Drawing]:
    """Return the changes of the parameters as bars, a chart for each unit."""
    charts = []
    for of in ("m", "rad"):
        rows = [
            row
            for row in calibration.result.parameters
            if row.unit == of and row.status == "estimated" and ".radius." not in row.name
        ]
        if rows:
            scale, unit, _ = UNITS[of]
            svg = change_bars(
                [row.name for row in rows],
                [scale * (row.value - row.nominal) for row in rows],
                [None if row.sigma is None else scale * row.sigma for row in rows],
                unit,
            )
            caption = "Bars are changes, lines two standard deviations to both sides."
            charts.append(Drawing(svg, caption))
    return charts


def correlation(calibration: Calibration) -> tuple[list[str], np.ndarray]:
    """Return the estimated parameters and their correlation matrix."""
    result = calibration.result
    names = [row.name for row in result.parameters if row.status == "estimated"]
    covariance = np.array(result.covariance)
    sigma = np.sqrt(np.diagonal(covariance))
    return names, covariance / np.outer(sigma, sigma)
