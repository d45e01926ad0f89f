"""A dataset in the order of work, and which of its images are still to be searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import (
    Dataset,
    DetectionPlan,
    LegAxes,
    Measurements,
    Order,
    Outlines,
    canonical_order,
    dataset_at,
    fingerprint,
    inverse,
    plan_dataset,
    reorder_axes,
    reorder_measurements,
    reorder_outlines,
    restore_outlines,
    row_names,
    store_outlines,
)
from legcal.errors import DatasetError
from legcal.estimation import (
    Choices,
    FittedLegs,
    components,
    fitted_legs,
    platform_poses,
    pose_rows,
    start_from,
)
from legcal.geometry import Array, IntArray
from legcal.machine import (
    LegGeometry,
    Mechanism,
    followed_poses,
    geometries,
    joined,
    platform_in_base,
)
from legcal.paper import Criteria, Transformation
from legcal.perception import Photographs, detection_settings
from legcal.workers import Run

MOST_MISSED = 0.03  # of the mean leg length: errors of a nominal model, but not of readings
_SAID = 3  # images that a note names


@dataclass(frozen=True, eq=False)
class NominalPoses:
    """Poses of the nominal model at readings.

    Attributes
    ----------
    T_Rb_Re : tuple of RigidTransform
        One a pose.
    missed : (n_poses,) array
        By how much legs miss what the readings and the mechanism demand, the worst of them [m];
        zero where the model reaches the readings.
    """

    T_Rb_Re: tuple[RigidTransform, ...]
    missed: Array

    def notes(self, measurements: Measurements) -> tuple[str, ...]:
        """Return what a reader should know of poses that the nominal model does not reach."""
        off = np.flatnonzero(self.missed > 0.0).tolist()
        if not off:
            return ()
        names = [_image_of(measurements, pose) for pose in off[:_SAID]]
        if len(off) > _SAID:
            names.append(f"{len(off) - _SAID} more")
        return (
            f"The nominal model does not reach the readings of {joined(names)}: its legs "
            f"miss them by up to {1e3 * float(self.missed.max()):.2f} mm at the nearest pose, from "
            "which the fit started.",
        )


def nominal_poses(mechanism: Mechanism, measurements: Measurements) -> NominalPoses:
    """Return the platform poses of a nominal model at the readings of a dataset.

    Errors of the model can put a pose out of its reach that the machine took, near a singular one
    or where its legs are stretched out. The pose with the least squares of what the legs miss
    stands for it.

    Parameters
    ----------
    mechanism : Mechanism
        The machine. Where its motors do not determine its pose, all poses are those of least
        squares from home.
    measurements : Measurements
        The readings.

    Raises
    ------
    DatasetError
        With one sentence for each image whose readings the legs would miss by more than 3 % of the
        mean leg length.
    """
    q = measurements.q[measurements.first_rows]
    if not mechanism.is_determined:
        home = [platform_in_base(mechanism, mechanism.home)] * len(q)
        return NominalPoses(_least_squares(mechanism, q, home)[0], np.zeros(len(q)))
    followed = list(followed_poses(mechanism, q))
    T = [platform_in_base(mechanism, pose) for pose, _ in followed]
    failures = [failure for _, failure in followed]
    off = [k for k, failure in enumerate(failures) if failure is not None]
    missed = np.zeros(len(q))
    if not off:
        return NominalPoses(tuple(T), missed)
    nearest, missed[off] = _least_squares(mechanism, q[off], [T[k] for k in off])
    for k, pose in zip(off, nearest, strict=True):
        T[k] = pose
    length = _mean_length(mechanism)
    problems = [
        f"The readings of {_image_of(measurements, k)} could not be used: found that the legs of "
        f"the nominal model miss them by {1e3 * missed[k]:.1f} mm at the nearest pose, needed at "
        f"most {1e3 * MOST_MISSED * length:.1f} mm; check these readings and legcal.home, or take "
        "the image out."
        for k in off
        if not missed[k] <= MOST_MISSED * length
    ]
    if problems:
        raise DatasetError(problems)
    return NominalPoses(tuple(T), missed)


def _least_squares(
    mechanism: Mechanism, q: Array, nearby: list[RigidTransform]
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return the poses at which the legs miss least, and the largest miss of each [m]."""
    legs = geometries(mechanism)
    lengths = mechanism.sign * q + mechanism.q0
    poses = platform_poses(legs, lengths, nearby, mechanism.frame_legs)
    rows = pose_rows(legs, *components(poses))
    wanted = np.where(rows.measured, (mechanism.sign * q)[:, rows.leg], 0.0)
    return poses, np.nanmax(np.abs(rows.values - wanted), axis=1, initial=0.0)


def _mean_length(mechanism: Mechanism) -> float:
    """Return the mean length of the legs at home [m]."""
    B = mechanism.home.apply(mechanism.B_platform)
    return float(np.linalg.norm(B - mechanism.A_base, axis=1).mean())


def _image_of(measurements: Measurements, pose: int) -> str:
    """Return the first image of a pose as messages name it."""
    row = int(measurements.first_rows[pose])
    view = measurements.views[measurements.view[row]]
    return f"view {view.name}, {row_names(measurements)[row]}"


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
