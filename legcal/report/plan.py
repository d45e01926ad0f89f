"""What is said of a plan: camera places, images, expected accuracy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import RenderableType

from legcal.errors import printable
from legcal.planning import Plan
from legcal.report.render import heading, report, table


def plan_table(plan: Plan, output: Path) -> RenderableType:
    """Return what a plan is and what it is expected to give."""
    rows = []
    for view in plan.views:
        x, y, z = view.T_base_camera.translation
        seen = ", ".join(
            f"{name} {n}"
            for name, n in zip(plan.machine.leg_names, view.shows.sum(axis=0), strict=True)
        )
        rows.append(
            (view.name, str(len(view.poses.poses)), f"{x:.3f}", f"{y:.3f}", f"{z:.3f}", seen)
        )
    return report(
        heading(
            printable(plan.machine.name),
            f": a session of {plan.n_images} photographs from {len(plan.views)} places",
        ),
        table(
            "view", ">images", ">x [m]", ">y [m]", ">z [m]", "images of each leg",
            rows=[tuple(map(printable, row)) for row in rows],
        ),
        [expectation(plan), *map(printable, plan.notes)],
        [printable(f"written: {output}"), printable(f"calibrate with: legcal calibrate {output}")],
    )  # fmt: skip


def expectation(plan: Plan) -> str:
    """Return the accuracy that is expected, as a sentence."""
    if plan.error is None:
        return "The error of the platform is not predicted: readings do not give its pose."
    return (
        f"Expected: predicted error {1e3 * plan.error.mean_displacement:.3f} mm / "
        f"{np.degrees(plan.error.mean_rotation):.4f} deg (1 sigma) over the workspace, the mean of "
        f"{plan.setting.draws} sessions with tripods {1e2 * plan.setting.shift:g} cm and "
        f"{np.degrees(plan.setting.turn):g} deg off and the machine "
        f"{1e3 * plan.setting.length:g} mm."
    )
