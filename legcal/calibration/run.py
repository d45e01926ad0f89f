"""A dataset in canonical order, from which every job on photographs starts.

Rows, views and legs are sorted once, here, so that no result depends on the order of the files.
Everything after this works in canonical order; what is written is put back into that of the files
at the end of each job.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit import (
    Choices,
    FittedLegs,
    fitted_legs,
    start_from,
)
from legcal.data import (
    Dataset,
    DetectionPlan,
    LegAxes,
    Measurements,
    Order,
    Outlines,
    canonical_order,
    fingerprint,
    inverse,
    measurements_at,
    plan_dataset,
    reorder_measurements,
    row_names,
    store_outlines,
)
from legcal.errors import DatasetError
from legcal.geometry import Array, IntArray, components
from legcal.machine import (
    Leg,
    Machine,
    followed_poses,
    geometries,
    joined,
    platform_in_base,
    solve_poses,
)
from legcal.paper import Criteria, Transformation
from legcal.perception import Photographs, detection_settings
from legcal.progress import Report
from legcal.workers import Run

MOST_MISSED = 0.03  # of the mean leg length: errors of a nominal model, but not of readings
_SAID = 3  # images that a note names


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """A dataset in canonical order, and how it is to be worked on."""

    dataset: Dataset  # in the order of its files
    order: Order  # from the files to the canonical order
    plan: DetectionPlan  # which images are still to be searched, by their rows in the files
    fingerprint: str  # of all that detected outlines depend on
    machine: Machine  # from here on in canonical order
    measurements: Measurements
    axes: LegAxes | None
    rows: IntArray  # of all images, those that are here
    pool: Run
    progress: Report
    choices: Choices
    criteria: Criteria | None = None  # of the four steps; None leaves them out
    transformation: Transformation | None = None  # how they solve (18); None for as the criteria
    every_leg: bool = True  # whether every leg must be seen that views say they show

    @cached_property
    def photographs(self) -> Photographs:
        """All images, what to search in them and what to keep."""
        return Photographs(
            machine=self.machine,
            measurements=self.measurements,
            load=self.dataset.image_reader(self.order.rows.tolist()),
            run=self.pool,
            detect=np.sort(inverse(self.order.rows)[self.plan.detect]),
            keep=self.order.reorder(self.plan.keep),
        )

    @cached_property
    def fitted_legs(self) -> FittedLegs:
        """The legs as the joint fit sees them."""
        return fitted_legs(self.machine)

    @cached_property
    def _nominal(self) -> tuple[tuple[RigidTransform, ...], Array]:
        return nominal_poses(self.machine, self.measurements)

    @property
    def T_Rb_Re(self) -> tuple[RigidTransform, ...]:
        """The platform at every pose by the nominal model."""
        return self._nominal[0]

    @property
    def T_base_platform(self) -> list[RigidTransform]:
        """The same between the links."""
        back = self.machine.T_platform_Re.inv()
        return [self.machine.T_base_Rb * T * back for T in self.T_Rb_Re]

    def unreached_notes(self) -> list[str]:
        """Return what a reader should know of poses that the nominal model does not reach."""
        missed = self._nominal[1]
        off = np.flatnonzero(missed > 0.0).tolist()
        if not off:
            return []
        names = [_image_of(self.measurements, pose) for pose in off[:_SAID]]
        if len(off) > _SAID:
            names.append(f"{len(off) - _SAID} more")
        return [
            f"The nominal model does not reach the readings of {joined(names)}: its legs "
            f"miss them by up to {1e3 * float(missed.max()):.2f} mm at the nearest pose, from "
            "which the fit started."
        ]

    def poses_by(self, legs: Sequence[Leg]) -> tuple[RigidTransform, ...]:
        """Return T_Rb_Re of every pose by the readings and other legs, in R_b and R_e."""
        return start_from(legs, self.measurements, self.fitted_legs, (), self.T_Rb_Re, "").T_Rb_Re

    def part(self, rows: IntArray) -> CalibrationRun:
        """Return some of the images, by their rows here, rising."""
        return replace(
            self,
            measurements=measurements_at(self.measurements, rows),
            axes=None if self.axes is None else self.axes.at(rows),
            rows=self.rows[rows],
        )

    def here(self, file_rows: IntArray) -> IntArray:
        """Return the rows of images that are told by their rows in the files."""
        return np.sort(inverse(self.order.rows)[file_rows])

    @property
    def own_order(self) -> Order:
        """The order of the images that are here, as if the files had no others."""
        return replace(self.order, rows=inverse(np.argsort(self.order.rows[self.rows])))

    def searched_anew(self) -> CalibrationRun:
        """Return the same without the outlines that an earlier run left."""
        return replace(self, plan=plan_dataset(self.dataset, ""))

    def keep_outlines(self, outlines: Outlines, notes: Sequence[str]) -> list[str]:
        """Leave outlines and notes on images beside the dataset; return a note if that fails."""
        if len(self.plan.detect) == 0:
            return []
        restored = self.order.restore(outlines)
        note = store_outlines(self.dataset, restored, self.fingerprint, self.plan.given, notes)
        return [note] if note else []


def start_run(
    dataset: Dataset,
    pool: Run,
    progress: Report,
    choices: Choices,
    *,
    use_cache: bool,
    criteria: Criteria | None = None,
    transformation: Transformation | None = None,
    every_leg: bool = True,
) -> CalibrationRun:
    """Put a dataset into canonical order, and see which images are still to be searched."""
    names = dataset.machine.leg_names
    order = canonical_order(dataset.measurements, names)
    # Doubtful images are searched again near the fit, which depends on the choices.
    current = fingerprint(dataset, detection_settings() | choices.document())
    return CalibrationRun(
        dataset=dataset,
        order=order,
        plan=plan_dataset(dataset, current if use_cache else ""),
        fingerprint=current,
        machine=dataset.machine.with_leg_order([names[leg] for leg in order.legs]),
        measurements=reorder_measurements(dataset.measurements, order),
        axes=None if dataset.axes is None else order.reorder(dataset.axes),
        rows=np.arange(dataset.measurements.n_rows),
        pool=pool,
        progress=progress,
        choices=choices,
        criteria=criteria,
        transformation=transformation,
        every_leg=every_leg,
    )


def nominal_poses(
    machine: Machine, measurements: Measurements
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return T_Rb_Re of a nominal model at the readings, and what its legs miss (n_poses,) [m].

    Errors of the model can put a pose out of its reach that the machine took, near a singular one
    or where its legs are stretched out. The pose with the least squares of what the legs miss
    stands for it. Where motors do not determine the pose, all are those of least squares from home.

    Raises
    ------
    DatasetError
        With one sentence for each image whose readings the legs would miss by more than 3 % of the
        mean leg length.
    """
    q = measurements.q[measurements.first_rows]
    if not machine.is_determined:
        home = [platform_in_base(machine, machine.home)] * len(q)
        return _least_squares(machine, q, home)[0], np.zeros(len(q))
    followed = list(followed_poses(machine, q))
    T = [platform_in_base(machine, pose) for pose, _ in followed]
    off = [k for k, (_, failure) in enumerate(followed) if failure is not None]
    missed = np.zeros(len(q))
    if off:
        nearest, missed[off] = _least_squares(machine, q[off], [T[k] for k in off])
        for k, pose in zip(off, nearest, strict=True):
            T[k] = pose
    B = machine.home.apply(machine.B_platform)
    most = MOST_MISSED * float(np.linalg.norm(B - machine.A_base, axis=1).mean())
    problems = [
        f"The readings of {_image_of(measurements, k)} could not be used: found that the legs of "
        f"the nominal model miss them by {1e3 * missed[k]:.1f} mm at the nearest pose, needed at "
        f"most {1e3 * most:.1f} mm; check these readings and legcal.home, or take the image out."
        for k in off
        if not missed[k] <= most
    ]
    if problems:
        raise DatasetError(problems)
    return tuple(T), missed


def _least_squares(
    machine: Machine, q: Array, nearby: list[RigidTransform]
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return the poses at which the legs miss least, and the largest miss of each [m]."""
    R, t = components(nearby)
    found = solve_poses(geometries(machine), machine.frame_legs, R, t, machine.sign * q)
    poses = RigidTransform.from_components(found.t, Rotation.from_matrix(found.R))
    return tuple(poses), found.missed


def _image_of(measurements: Measurements, pose: int) -> str:
    """Return the first image of a pose as messages name it."""
    row = int(measurements.first_rows[pose])
    view = measurements.views[measurements.view[row]]
    return f"view {view.name}, {row_names(measurements)[row]}"
