"""The figure of a calibration: changes and standard deviations of parameters and platform."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.calibration.documents import Result
from legcal.calibration.quantities import Quantity, parameters_of
from legcal.pages.svg import Bars, Canvas, Points, log_bars, scatter, stacked


def parameter_charts(quantities: Sequence[Quantity]) -> list[Canvas]:
    """Draw changes and standard deviations of estimated quantities, a chart for each unit."""
    charts = []
    for unit in ("mm", "deg"):
        shown = [q for q in quantities if q.unit == unit and q.sigma]
        if shown:
            changes = [None if q.change is None else abs(q.change) for q in shown]
            bars = Bars("change", changes), Bars("1 sigma", [q.sigma for q in shown])
            names = [q.name for q in shown]
            charts.append(log_bars("Change against the nominal model", unit, names, *bars))
    return charts


def platform_chart(result: Result) -> list[Canvas]:
    """Draw the change of the platform at the poses, and its predicted error; none without both."""
    poses = [] if result.platform is None else result.platform.per_pose
    number = np.arange(1.0, len(poses) + 1.0)
    lines = [
        Points(number, 1e3 * np.array(values), group=k, label=label, line="")
        for k, (values, label) in enumerate(
            (
                ([pose.change_dX_m for pose in poses], "before: change against the nominal model"),
                ([pose.sigma_dX_m for pose in poses], "after: predicted error (1 sigma)"),
            )
        )
    ]
    return [scatter("Platform error", lines, "pose", "platform [mm]", log="y")] if poses else []


def uncertainty_figure(result: Result) -> Canvas:
    """Draw changes and standard deviations of all parameters, and of the platform at poses."""
    charts = parameter_charts(parameters_of(result))
    return stacked("How well the parameters are known", [*charts, *platform_chart(result)])
