"""The parameters of a calibration as tables and as bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.documents import Result
from legcal.calibration.quantities import FRAMES, Quantity, joints_of, parameters_of
from legcal.calibration.result import Calibration
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import Array
from legcal.pages.document import Cell, Drawing, Table, number
from legcal.pages.svg import change_bars

_BY_PRIOR = 0.7  # sigma of a parameter that its prior determines, relative to that of the prior
_PARALLEL = 1e-9
_STATUS = {
    "estimated": "estimated",
    "fixed": "fixed",
    "weak": "undetermined combination, kept nominal",
}
_BY_ALL = "by images, readings and its prior"
_JOINT = {"base": "A", "platform": "B"}


def parameter_tables(calibration: Calibration) -> list[Table]:
    """Return joints in the links with all other parameters, and the rows of ``result.json``."""
    columns = ("parameter", ">nominal", ">calibrated", ">change", ">sigma", "unit", ">prior sigma",
               "how determined")  # fmt: skip
    priors, result = _prior_sigmas(calibration), calibration.result
    rows = [_cells(q.name, q, priors.get(q.name)) for q in parameters_of(result)]
    if not result.links:
        return [Table(columns, rows, note=_IN_FRAMES)]
    links = [block.link for block in result.links.values()]
    turns: dict[str, Array] = {
        side: np.abs(Rotation.from_quat(block.T_link_frame.quat_xyzw).as_matrix())
        for side, block in result.links.items()
    }
    in_links = []
    for q in _in_links(result):
        prior = priors.get(q.name)
        if (name := q.parameter).is_joint_coordinate:
            row = turns[name.kind]["xyz".index(name.component)]
            along = int(row.argmax())  # a prior of one axis of the frame, if parallel
            prior = None
            if row[along] > 1.0 - _PARALLEL:
                prior = priors.get(str(replace(name, component="xyz"[along])))
        in_links.append(_cells(_label(q), q, prior))
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
        Table(columns, in_links, note=note),
        Table(columns, rows, "The same in R_b and R_e, as in result.json",
              _IN_FRAMES, folded=True),
    ]  # fmt: skip


_IN_FRAMES = "Joints of the base in R_b, those of the platform in R_e; axes are turns from nominal."


def change_charts(calibration: Calibration) -> list[Drawing]:
    """Return the changes of the parameters as bars, a chart for each unit."""
    charts = []
    for unit in ("mm", "deg"):
        shown = [
            q
            for q in _in_links(calibration.result)
            if q.unit == unit and q.sigma and q.parameter.kind != "radius"
        ]
        if shown:
            names, changes = [_label(q) for q in shown], [q.change or 0.0 for q in shown]
            svg = change_bars(names, changes, [q.sigma for q in shown], unit)
            caption = "Bars are changes, lines two standard deviations to both sides."
            charts.append(Drawing(svg, caption))
    return charts


def _in_links(result: Result) -> list[Quantity]:
    """Return joints in the links of the model, where they are known, and all other parameters."""
    joints, parameters = list(joints_of(result)), parameters_of(result)
    others = [q for q in parameters if not (joints and q.parameter.is_joint_coordinate)]
    return [*joints, *others]


def _label(q: Quantity) -> str:
    """Return the name of a quantity: ``leg1 A x`` of a joint in its link."""
    name = q.parameter
    if q.frame in ("", *FRAMES.values()):
        return q.name
    return f"{name.owner} {_JOINT[name.kind]} {name.component}"


def _cells(name: str, q: Quantity, prior: float | None) -> list[Cell]:
    """Return the cells of a row."""
    prior = prior if q.status == "estimated" else None
    return [
        name,
        number(q.nominal, q.digits),
        number(q.value, q.digits),
        number(q.change, q.digits, signed=True),
        number(q.sigma, q.digits),
        q.unit,
        number(prior, q.digits),
        _determination(q, prior),
    ]


def _prior_sigmas(calibration: Calibration) -> dict[str, float]:
    """Return the standard deviations of priors by the name of their parameter [mm, deg, px]."""
    problem = calibration.solution.posterior.problem
    priors, named = problem.priors, problem.named
    numbers = zip(priors.unknown.tolist(), priors.sigma.tolist(), strict=True)
    sigma_by_name = {named[i]: sigma for i, sigma in numbers if i < len(named)}
    sigma_by_name |= dict(calibration.solution.estimates.prior_sigma)
    units = {row.name: row.unit for row in calibration.result.parameters}
    return {k: SHOWN_IN[units[k]][0] * sigma for k, sigma in sigma_by_name.items() if k in units}


def _determination(q: Quantity, prior: float | None) -> str:
    if q.status == "frame":
        return f"the joint defines the {q.defines} of the frame"
    if q.sigma is None or prior is None:
        return _STATUS[q.status]
    return "mostly by its prior" if q.sigma > _BY_PRIOR * prior else _BY_ALL


def correlation(calibration: Calibration) -> tuple[Sequence[str], Array]:
    """Return the estimated parameters and their correlation matrix."""
    result = calibration.result
    names = [row.name for row in result.parameters if row.status == "estimated"]
    covariance = np.array(result.covariance)
    sigma = np.sqrt(np.diagonal(covariance))
    return names, np.asarray(covariance / np.outer(sigma, sigma))
