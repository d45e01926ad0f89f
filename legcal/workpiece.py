"""A dataset in the order of work, and which of its images are still to be searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.dataset.cache import DetectionPlan, fingerprint, plan_dataset, store_outlines
from legcal.dataset.folder import Dataset
from legcal.dataset.holdout import dataset_at
from legcal.geometry.types import IntArray
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.model import Mechanism
from legcal.observations.canonical_order import (
    Order,
    canonical_order,
    inverse,
    reorder_axes,
    reorder_measurements,
    reorder_outlines,
    restore_outlines,
)
from legcal.observations.leg_axes import LegAxes
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.photographs import (
    Photographs,
    detection_settings,
)
from legcal.refinement.choices import Choices
from legcal.refinement.legs import FittedLegs, fitted_legs
from legcal.refinement.nominal_poses import NominalPoses, nominal_poses
from legcal.refinement.start import start_from
from legcal.stages.nominal import Criteria
from legcal.stages.platform_pose import Transformation
from legcal.workers import Run


@dataclass(frozen=True, eq=False)
class Workpiece:
    """A dataset in the order of work.

    Attributes
    ----------
    dataset : Dataset
        In the order of its files.
    order : Order
        The order of work.
    plan : DetectionPlan
        Which images are still to be searched.
    fingerprint : str
        Of all that detected outlines depend on.
    mechanism : Mechanism
        With its legs in the order of work.
    measurements : Measurements
    axes : LegAxes or None
    run : callable
        How images are searched.
    criteria : {"default", "literal"}
        What the four steps minimise; None to leave them out.
    choices : Choices
        Parameters that are fixed, freed or known.
    every_leg : bool
        Whether every leg must be seen that views say they show.
    transformation : {"points", "cross_product"} or None
        How the steps solve (18); None for what their criteria say.
    """

    dataset: Dataset
    order: Order
    plan: DetectionPlan
    fingerprint: str
    mechanism: Mechanism
    measurements: Measurements
    axes: LegAxes | None
    run: Run
    criteria: Criteria | None
    choices: Choices
    every_leg: bool
    transformation: Transformation | None = None

    @cached_property
    def photographs(self) -> Photographs:
        """The images, what to search in them and what to keep."""
        return Photographs(
            mechanism=self.mechanism,
            measurements=self.measurements,
            load=self.dataset.image_reader(self.order.rows.tolist()),
            run=self.run,
            detect=np.sort(inverse(self.order.rows)[self.plan.detect]),
            keep=reorder_outlines(self.plan.keep, self.order),
        )

    @cached_property
    def fitted_legs(self) -> FittedLegs:
        """The legs as the fit sees them."""
        return fitted_legs(self.mechanism)

    @cached_property
    def reached(self) -> NominalPoses:
        """The platform poses of the nominal model."""
        return nominal_poses(self.mechanism, self.measurements)

    @property
    def nominal_poses(self) -> list[RigidTransform]:
        """T_base_platform of every pose by the nominal model."""
        back = self.mechanism.T_platform_Re.inv()
        return [self.mechanism.T_base_Rb * T * back for T in self.reached.T_Rb_Re]

    def poses_by(self, legs: Sequence[LegGeometry]) -> tuple[RigidTransform, ...]:
        """Return T_Rb_Re of every pose by the readings and other legs, in R_b and R_e."""
        here = self.fitted_legs
        return start_from(legs, self.measurements, here, (), self.reached.T_Rb_Re, "").T_Rb_Re

    def part(self, rows: IntArray) -> Workpiece:
        """Return some of the images, by their rows in the files."""
        dataset = dataset_at(self.dataset, rows)
        order = canonical_order(dataset.measurements, dataset.mechanism.leg_names)
        return replace(
            self,
            dataset=dataset,
            order=order,
            measurements=reorder_measurements(dataset.measurements, order),
            axes=None if dataset.axes is None else reorder_axes(dataset.axes, order),
        )

    def keep_outlines(self, outlines: Outlines, notes: Sequence[str]) -> list[str]:
        """Leave the outlines and what is to be said of the images beside the dataset.

        Returns a note if that fails.
        """
        if len(self.plan.detect) == 0:
            return []
        restored = restore_outlines(outlines, self.order)
        note = store_outlines(self.dataset, restored, self.fingerprint, self.plan.given, notes)
        return [note] if note else []


def workpiece(
    dataset: Dataset,
    run: Run,
    criteria: Criteria | None,
    choices: Choices,
    *,
    use_cache: bool,
    every_leg: bool = True,
    transformation: Transformation | None = None,
) -> Workpiece:
    """Put a dataset into the order of work, and see which images are still to be searched.

    Parameters
    ----------
    dataset : Dataset
        In the order of its files.
    run : callable
        How images are searched.
    criteria : {"default", "literal"} or None
        What the four steps minimise; None to leave them out.
    choices : Choices
        Parameters that are fixed, freed or known.
    use_cache : bool
        Use the outlines that an earlier run left, if they still fit.
    every_leg : bool
        Whether every leg must be seen that views say they show.
    transformation : {"points", "cross_product"}, optional
        How the steps solve (18).
    """
    names = dataset.mechanism.leg_names
    order = canonical_order(dataset.measurements, names)
    # Doubtful images are searched again near the fit, which depends on the choices.
    current = fingerprint(dataset, detection_settings() | choices.document())
    return Workpiece(
        dataset=dataset,
        order=order,
        plan=plan_dataset(dataset, current if use_cache else ""),
        fingerprint=current,
        mechanism=dataset.mechanism.with_leg_order([names[leg] for leg in order.legs]),
        measurements=reorder_measurements(dataset.measurements, order),
        axes=None if dataset.axes is None else reorder_axes(dataset.axes, order),
        run=run,
        criteria=criteria,
        choices=choices,
        every_leg=every_leg,
        transformation=transformation,
    )
