"""From outlines to parameters: the four steps, then the joint fit that starts from them.

In: a dataset in canonical order, outlines of all of its images and their placement.
Out: an :class:`Estimate`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.board import BoardViews
from legcal.calibration.diagnosis.diagnosis import Diagnosis
from legcal.calibration.four_steps import Steps, four_steps, starts
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution, in_file_order
from legcal.calibration.joint_fit.variables import DEFAULT_SETTINGS, RefinementSettings
from legcal.calibration.ordered_dataset import Options, OrderedDataset
from legcal.calibration.outlier_images import outlier_images
from legcal.calibration.tuning import LIMB_BIAS_PX
from legcal.causes import Cause
from legcal.data.corners import Corners
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, along_legs, reject_unused_legs
from legcal.errors import NotVisible
from legcal.machine.model import Machine
from legcal.perception.placement import Placement

# Least common bias of all outlines in photographs [px]: limb shading outside of the model acts like
# a change of the radii, so that residuals never show it.
LIMB_BIAS = {"bias of many edges": LIMB_BIAS_PX}
# Settings for a session with a suspected mistake: other starts and more iterations would not help,
# and contradictions to stated values are expected.
TRIAL = replace(DEFAULT_SETTINGS, other_starts=0, judges_stated_values=False, max_iterations=40)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Measured outlines and the parameters fitted to them, in canonical order."""

    fitted: OrderedDataset  # the fitted images
    outlines: Outlines  # outlines in all images
    steps: Steps
    solution: Solution
    corners: Corners | None  # board corners in all images; None without a board
    image_notes: tuple[str, ...] = ()  # notes on the images, before the fit
    fit_notes: tuple[str, ...] = ()  # notes on the images, by the fit
    other_radii: bool = False  # whether the images show other radii than the model has
    diagnosis: tuple[Diagnosis, ...] = ()  # suspected mistakes if many images were left out

    @cached_property
    def outliers(self) -> dict[int, Cause]:
        """Causes for images that contradict the fit, by row."""
        return outlier_images(self.fitted.measurements, self.fitted.machine, self.solution)

    def in_file_order(self) -> Estimate:
        """Return a copy with legs, views and images in the order of the files."""
        dataset, order = self.fitted.in_file_order()
        restore = self.fitted.order.restore
        return replace(
            self,
            outlines=restore(self.outlines),
            steps=self.steps.in_file_order(order),
            solution=in_file_order(self.solution, order, dataset),
            corners=None if self.corners is None else restore(self.corners),
        )


def fit_outlines(
    fitted: OrderedDataset,
    outlines: Outlines,
    placement: Placement,
    board: BoardViews | None,
    options: Options,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    steps: Steps | None = None,
) -> Estimate:
    """Run the four steps, then the joint fit, with the outlines of all images.

    ``steps`` is the result of the four steps from an earlier measurement; it is not recomputed.

    Raises
    ------
    NotVisible
        If no image shows a leg that its view should show.
    NotIdentifiable, DidNotConverge
        As the joint fit.
    """
    fitted_outlines = outlines.at(fitted.rows)
    fitted_outlines = reject_unused_legs(
        fitted_outlines, fitted.measurements, fitted.machine.leg_names
    )
    if options.every_leg:
        _refuse_unseen_legs(fitted, fitted_outlines)
    if steps is None:
        steps = four_steps(fitted, fitted_outlines, board, options)
    fitted.progress("Joint fit", 0, 1)
    choices = options.choices
    if any(fitted.measurements.image) and "detected" in fitted_outlines.source:
        choices = replace(choices, least_shared_px={**LIMB_BIAS, **choices.least_shared_px})
    solution = refine(
        fitted.fitted_legs,
        fitted.measurements,
        fitted_outlines,
        starts(fitted, fitted_outlines, placement, steps, board),
        settings,
        axes=fitted.axes,
        board=None if board is None else board.at(fitted.rows),
        choices=choices,
    )
    fitted.progress("Joint fit", 1, 1)
    corners = None if board is None else board.reject_outliers(solution, fitted)
    return Estimate(fitted, outlines, steps, solution, corners)


def _refuse_unseen_legs(fitted: OrderedDataset, outlines: Outlines) -> None:
    """Raise NotVisible if no image shows a leg that its view should show."""
    if fitted.axes is not None:
        return
    unseen = unseen_legs(fitted.machine, fitted.measurements, outlines)
    if unseen:
        raise NotVisible(
            f"{fitted.dataset.folder}: the machine could not be calibrated: no image has a usable "
            f"outline of {', '.join(unseen)}; add images that show it, or list the visible legs of "
            "each view in dataset.yaml, so that it relies on readings."
        )


def unseen_legs(machine: Machine, measurements: Measurements, outlines: Outlines) -> list[str]:
    """Return the legs that views should show and that have no used outline."""
    along = along_legs(outlines, machine.legs)
    shown = set(along.leg[along.used].tolist())
    views = [measurements.views[v] for v in np.unique(measurements.view).tolist()]
    return [
        leg.name
        for j, leg in enumerate(machine.legs)
        if j not in shown and leg.cylinders and any(view.uses(leg.name) for view in views)
    ]
