"""The parameters of a calibration as tables and as bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.result import Calibration
from legcal.calibration.summary import UNITS
from legcal.geometry.types import Array
from legcal.machine.parameter_id import ParameterId
from legcal.pages.document import Cell, Drawing, Table, number
from legcal.pages.svg import change_bars

_BY_PRIOR = 0.7  # sigma of a parameter that its prior determines, relative to that of the prior
_PARALLEL = 1e-9
_STATUS = {
    "estimated": "estimated",
    "fixed": "fixed",
    "weak": "undetermined combination, kept nominal",
}
_JOINT = {"base": "A", "platform": "B"}


@dataclass(frozen=True)
class _Row:
    """A number of the machine, nominal and calibrated [m, rad, px]."""

    name: str
    nominal: float
    value: float
    sigma: float | None
    unit: str
    prior: float | None
    determination: str

    @property
    def parameter(self) -> ParameterId:
        """The parsed name."""
        return ParameterId.parse(self.name)

    @property
    def cells(self) -> list[Cell]:
        """The cells of the table."""
        scale, unit, digits = UNITS[self.unit]
        sigma, prior = (None if s is None else scale * s for s in (self.sigma, self.prior))
        return [
            self.name,
            number(scale * self.nominal, digits),
            number(scale * self.value, digits),
            number(scale * (self.value - self.nominal), digits, signed=True),
            number(sigma, digits),
            unit,
            number(prior, digits),
            self.determination,
        ]


def parameter_tables(calibration: Calibration) -> list[Table]:
    """Return joints in the links with all other parameters, and the rows of ``result.json``."""
    columns = ("parameter", ">nominal", ">calibrated", ">change", ">sigma", "unit", ">prior sigma",
               "how determined")  # fmt: skip
    link_rows, rows = _link_rows(calibration), _parameters(calibration)
    if not link_rows:
        return [Table(columns, [row.cells for row in rows], note=_IN_FRAMES)]
    links = [block.link for block in (calibration.result.links or {}).values()]
    others = [row for row in rows if not row.parameter.is_joint_coordinate]
    machine = calibration.dataset.machine
    motors = ""
    if any(motor.turns for motor in machine.actuators):
        motors = "; axis_point: lateral displacement of the arm axis"
        if any(motor.arm is not None for motor in machine.actuators):
            motors += ", arm_point: lateral displacement of the line of the arm"
    elif machine.actuators:
        motors = "; directions of carriages too"
    note = (
        f"A are joints of the base in the link {links[0]}{machine.at_zero}, B those of the "
        f"platform in {links[-1]}, as in calibrated.urdf; axes are turns from the nominal ones"
        f"{motors}. Sigma is one standard deviation; coordinates without sigma fix the frame R_b "
        "or R_e, which photographs of legs cannot determine. Click a heading to sort."
    )
    return [
        Table(columns, [row.cells for row in (*link_rows, *others)], note=note),
        Table(columns, [row.cells for row in rows], "The same in R_b and R_e, as in result.json",
              _IN_FRAMES, folded=True),
    ]  # fmt: skip


_IN_FRAMES = "Joints of the base in R_b, those of the platform in R_e; axes are turns from nominal."


def change_charts(calibration: Calibration) -> list[Drawing]:
    """Return the changes of the parameters as bars, a chart for each unit."""
    link_rows, rows = _link_rows(calibration), _parameters(calibration)
    if link_rows:
        rows = [
            *link_rows,
            *(row for row in rows if not row.parameter.is_joint_coordinate),
        ]
    charts = []
    for unit_of_chart in ("m", "rad"):
        shown = [
            r for r in rows if r.unit == unit_of_chart and r.sigma and r.parameter.kind != "radius"
        ]
        if shown:
            scale, unit, _ = UNITS[unit_of_chart]
            svg = change_bars(
                [row.name for row in shown],
                [scale * (row.value - row.nominal) for row in shown],
                [None if row.sigma is None else scale * row.sigma for row in shown],
                unit,
            )
            caption = "Bars are changes, lines two standard deviations to both sides."
            charts.append(Drawing(svg, caption))
    return charts


def _link_rows(calibration: Calibration) -> list[_Row]:
    """Return the rows of joint coordinates in the links of the model."""
    rows, priors = [], _prior_sigmas(calibration)
    for side, block in (calibration.result.links or {}).items():
        turn = np.abs(Rotation.from_quat(block.T_link_frame.quat_xyzw).as_matrix())
        for joint in block.joints:
            for k, axis in enumerate("xyz"):
                status, sigma = joint.status[k], joint.sigma[k]
                along = int(turn[k].argmax())  # a prior of one axis of the frame, if parallel
                prior = (
                    priors.get(f"{joint.leg}.{side}.{'xyz'[along]}")
                    if status == "estimated" and turn[k, along] > 1.0 - _PARALLEL
                    else None
                )
                how = (
                    _determination(status, sigma, prior)
                    if status in _STATUS
                    else f"the joint defines the {joint.defines} of the frame"
                )
                name = f"{joint.leg} {_JOINT[side]} {axis}"
                values = joint.nominal[k], joint.xyz[k], sigma
                rows.append(_Row(name, *values, "m", prior, how))
    return rows


def _parameters(calibration: Calibration) -> list[_Row]:
    """Return the parameters of the result."""
    priors = _prior_sigmas(calibration)
    return [
        _Row(row.name, row.nominal, row.value, row.sigma, row.unit,
             priors.get(row.name) if row.status == "estimated" else None,
             _determination(row.status, row.sigma, priors.get(row.name)))
        for row in calibration.result.parameters
        if row.is_shown
    ]  # fmt: skip


def _prior_sigmas(calibration: Calibration) -> dict[str, float]:
    """Return the standard deviations of priors by the name of their parameter [m, rad, px]."""
    problem = calibration.solution.posterior.problem
    priors, named = problem.priors, problem.named
    numbers = zip(priors.unknown.tolist(), priors.sigma.tolist(), strict=True)
    sigma_by_name = {named[i]: sigma for i, sigma in numbers if i < len(named)}
    return sigma_by_name | dict(calibration.solution.estimates.prior_sigma)


def _determination(status: str, sigma: float | None, prior: float | None) -> str:
    if status != "estimated" or sigma is None or prior is None:
        return _STATUS[status]
    if sigma > _BY_PRIOR * prior:
        return "mostly by its prior"
    return "by images, readings and its prior"


def correlation(calibration: Calibration) -> tuple[Sequence[str], Array]:
    """Return the estimated parameters and their correlation matrix."""
    result = calibration.result
    names = [row.name for row in result.parameters if row.status == "estimated"]
    covariance = np.array(result.covariance)
    sigma = np.sqrt(np.diagonal(covariance))
    return names, np.asarray(covariance / np.outer(sigma, sigma))
