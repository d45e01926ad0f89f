"""A dataset in canonical order: images and readings as every job takes them.

Rows, views and legs are sorted once, here, so that no result depends on the order of the files, and
never reordered after. A job puts its result back into the order of the files where it ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.variables import FittedLegs, fitted_legs, start_from
from legcal.causes import Cause, by_cause
from legcal.data.axes import LegAxes
from legcal.data.cache import DetectionPlan, plan_dataset
from legcal.data.dataset import Dataset
from legcal.data.holdout import dataset_at
from legcal.data.image_causes import images_in_words
from legcal.data.image_tables import (
    Order,
    canonical_order,
    inverse,
    measurements_at,
    reorder_measurements,
)
from legcal.data.landmarks import platforms_by_landmarks
from legcal.data.measurements import Measurements, few, row_names
from legcal.errors import DatasetError
from legcal.geometry.motions import components, product
from legcal.geometry.types import Array, IntArray
from legcal.machine.kinematics import followed_poses, platform_in_base, platforms_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.machine.parameters import geometries
from legcal.machine.redundancy import Contradiction, contradictions
from legcal.machine.solved_poses import solve_poses
from legcal.paper.criteria import Criteria
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.photographs import Photographs
from legcal.progress import Report
from legcal.workers import Run

MAX_NOMINAL_RESIDUAL = 0.03  # of the mean leg length: errors of a nominal model, not of readings


@dataclass(frozen=True, eq=False)
class Options:
    """What is estimated, and how."""

    choices: Choices  # of the parameters
    criteria: Criteria | None = None  # of the four steps; None leaves them out
    every_leg: bool = True  # whether every leg must be seen that views say they show


@dataclass(frozen=True, eq=False)
class OrderedDataset:
    """A dataset in canonical order, with all of its images or some."""

    dataset: Dataset  # all images, in the order of its files
    order: Order  # from the files to the canonical order
    plan: DetectionPlan  # which images are to be searched, by their rows in the files
    pool: Run
    progress: Report
    machine: Machine  # from here on in canonical order
    measurements: Measurements
    axes: LegAxes | None
    rows: IntArray  # the images that are here, among all of them
    # T_base_platform that images showed, by row among all images, where readings do not give it
    seen_poses: Mapping[int, RigidTransform] = field(default_factory=dict)
    # Edge pairs of images that were searched, by row among all images
    edge_pairs: dict[int, CandidatePairs] = field(default_factory=dict)

    @cached_property
    def photographs(self) -> Photographs:
        """All images, what to search in them and what to keep; none of views that name no leg."""
        detect, m = inverse(self.order.rows)[self.plan.detect], self.measurements
        shows = np.array([m.views[v].legs != () for v in m.view[detect].tolist()], dtype=np.bool_)
        return Photographs(
            machine=self.machine,
            measurements=self.measurements,
            load=self.dataset.image_reader(self.order.rows.tolist()),
            run=self.pool,
            detect=np.sort(detect[shows]),
            keep=self.order.reorder(self.plan.keep),
            edge_pairs=self.edge_pairs,
            clicked_poses=self._clicked_poses(),
        )

    def _clicked_poses(self) -> dict[int, tuple[RigidTransform, ...]]:
        """Return T_base_platform by clicks, by pose, where readings do not give it."""
        if self.machine.is_determined or self.dataset.landmarks is None:
            return {}
        landmarks = self.order.reorder(self.dataset.landmarks)
        return platforms_by_landmarks(self.machine, self.measurements, landmarks)

    @cached_property
    def fitted_legs(self) -> FittedLegs:
        """The legs as the joint fit sees them."""
        return fitted_legs(self.machine)

    @cached_property
    def _nominal(self) -> tuple[tuple[RigidTransform, ...], Array]:
        T, residual = nominal_poses(self.machine, self.measurements)
        if not self.seen_poses:
            return T, residual
        rows = self.rows[self.measurements.first_rows].tolist()
        seen = [
            platform_in_base(self.machine, self.seen_poses[row]) if row in self.seen_poses else own
            for row, own in zip(rows, T, strict=True)
        ]
        return tuple(seen), residual

    @property
    def T_Rb_Re(self) -> tuple[RigidTransform, ...]:
        """The platform at every pose by the nominal model."""
        return self._nominal[0]

    @property
    def T_base_platform(self) -> list[RigidTransform]:
        """The same between the links."""
        back = self.machine.T_platform_Re.inv()
        return [product(self.machine.T_base_Rb, T, back) for T in self.T_Rb_Re]

    def unreached_notes(self) -> list[str]:
        """Return a note on the poses that the nominal model does not reach, if there are any."""
        residual = self._nominal[1]
        off = np.flatnonzero(residual > 0.0).tolist()
        if not off:
            return []
        names = few([_image_of(self.measurements, pose) for pose in off])
        return [
            f"The nominal model does not reach the readings of {names}: its legs "
            f"miss them by up to {1e3 * float(residual.max()):.2f} mm at the nearest pose, from "
            "which the fit started."
        ]

    def poses_by(self, legs: Sequence[Leg]) -> tuple[RigidTransform, ...]:
        """Return T_Rb_Re of every pose by the readings and other legs, in R_b and R_e."""
        return start_from(legs, self.measurements, self.fitted_legs, (), self.T_Rb_Re, "").T_Rb_Re

    def rows_of(self, file_rows: IntArray) -> IntArray:
        """Return the rows here of images that are given by their rows in the files."""
        return np.sort(inverse(self.order.rows)[file_rows])

    def with_poses(self, T_base_platform: Mapping[int, RigidTransform]) -> OrderedDataset:
        """Return the dataset with poses that images show, by pose; as it is without any."""
        of_rows = {
            row: T_base_platform[pose]
            for row, pose in zip(self.rows.tolist(), self.measurements.pose.tolist(), strict=True)
            if pose in T_base_platform
        }
        # A field changes, so that what was cached of the poses is made anew.
        return replace(self, seen_poses={**self.seen_poses, **of_rows}) if of_rows else self

    def with_fitted_poses(self, T_Rb_Re: Sequence[RigidTransform]) -> OrderedDataset:
        """Return the dataset with the poses of a fit where readings do not give them."""
        if self.machine.is_determined:
            return self
        back = self.machine.T_platform_Re.inv()
        return self.with_poses(
            {k: self.machine.T_base_Rb * T * back for k, T in enumerate(T_Rb_Re)}
        )

    def at(self, rows: IntArray) -> OrderedDataset:
        """Return some of the images, by their rows here, rising."""
        if len(rows) == len(self.rows):
            return self
        return replace(
            self,
            measurements=measurements_at(self.measurements, rows),
            axes=None if self.axes is None else self.axes.at(rows),
            rows=self.rows[rows],
        )

    def in_file_order(self) -> tuple[Dataset, Order]:
        """Return the images that are here in the order of the files, and the order of these."""
        file_rows = self.order.rows[self.rows]
        order = replace(self.order, rows=inverse(np.argsort(file_rows)))
        return dataset_at(self.dataset, np.sort(file_rows)), order


def order_dataset(
    dataset: Dataset, pool: Run, progress: Report, *, fingerprint: str = ""
) -> OrderedDataset:
    """Put a dataset into canonical order, and see which images are to be searched.

    Outlines that an earlier run stored are used if they have this fingerprint.
    """
    names = dataset.machine.leg_names
    order = canonical_order(dataset.measurements, names)
    return OrderedDataset(
        dataset=dataset,
        order=order,
        plan=plan_dataset(dataset, fingerprint),
        pool=pool,
        progress=progress,
        machine=dataset.machine.with_leg_order([names[leg] for leg in order.legs]),
        measurements=reorder_measurements(dataset.measurements, order),
        axes=None if dataset.axes is None else order.reorder(dataset.axes),
        rows=np.arange(dataset.measurements.n_rows),
    )


def nominal_poses(
    machine: Machine, measurements: Measurements
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return T_Rb_Re of a nominal model at the readings, and its largest residual (n_poses,) [m].

    Errors of the model can put a pose out of its reach that the machine took, near a singular one
    or where its legs are stretched out. The pose with the least squared residuals of leg lengths
    stands for it. Where motors do not determine the pose, all are least-squares poses from home.

    Raises
    ------
    DatasetError
        Naming the images whose residual is more than 3 % of the mean leg length, and those at which
        readings of redundant motors contradict each other as much and do not tell which is wrong.
    """
    q = measurements.q_of_poses
    if not machine.is_determined:
        home = [platform_in_base(machine, machine.home)] * len(q)
        return _least_squares(machine, q, home)[0], np.zeros(len(q))
    followed = list(followed_poses(machine, q, on_the_chain=False))
    T = list(platforms_in_base(machine, [pose for pose, _ in followed]))
    off = [k for k, (_, failure) in enumerate(followed) if failure is not None]
    residual = np.zeros(len(q))
    if off:
        nearest, residual[off] = _least_squares(machine, q[off], [T[k] for k in off])
        for k, pose in zip(off, nearest, strict=True):
            T[k] = pose
    most, first = _largest_residual(machine), measurements.first_rows.tolist()
    found = _contradictions(machine, measurements, T)
    wrong = {
        first[k]: Cause(
            "found {}; check this reading, its encoder and the offset of the leg, or take",
            (one.cause(machine),),
        )
        for k, one in found.items()
        if _is_refused(one, machine)
    }
    for k, one in found.items():
        if len(one.legs) == 1:  # the fit says so with images; they are searched at the other ones
            others = q[[k]]
            others[:, np.equal(machine.reads, one.legs[0])] = np.nan
            T[k] = _least_squares(machine, others, [T[k]])[0][0]
    wrong |= {
        first[k]: Cause(
            "found that the legs of the nominal model miss them by {:.1f} mm at the nearest pose, "
            "needed at most {:.1f} mm; check these readings and legcal.home, or take",
            (1e3 * float(residual[k]), 1e3 * most),
        )
        for k in off
        if not residual[k] <= most and k not in found
    }
    if wrong:
        raise DatasetError(
            [
                f"The readings of {images_in_words(measurements, rows)} could not be used: {cause} "
                f"the image{'s' * (len(rows) > 1)} out."
                for cause, rows in by_cause(wrong)
            ]
        )
    return tuple(T), residual


def contradicting_readings(machine: Machine, measurements: Measurements) -> dict[int, Cause]:
    """Return what is found of readings of redundant motors that contradict each other, by row.

    They are those that :func:`nominal_poses` does not refuse.
    """
    if not machine.is_redundant:
        return {}
    followed = followed_poses(machine, measurements.q_of_poses, on_the_chain=False)
    T = platforms_in_base(machine, [pose for pose, _ in followed])
    first = measurements.first_rows.tolist()
    return {
        first[k]: one.cause(machine)
        for k, one in _contradictions(machine, measurements, T).items()
        if not _is_refused(one, machine)
    }


def _contradictions(
    machine: Machine, measurements: Measurements, T_Rb_Re: Sequence[RigidTransform]
) -> dict[int, Contradiction]:
    """Return the poses at which readings of redundant motors contradict each other."""
    motors, sigma = list(machine.motors), measurements.sigma_of(machine.legs)
    return contradictions(machine, T_Rb_Re, measurements.q_of_poses[:, motors], sigma[motors])


def _is_refused(found: Contradiction, machine: Machine) -> bool:
    """Say whether images cannot be searched at readings that contradict each other."""
    return len(found.legs) > 1 and found.distances[0] > _largest_residual(machine)


def _largest_residual(machine: Machine) -> float:
    """Return how far errors of a nominal model may put a leg from its reading [m]."""
    at_home = vectors_A_to_B(machine, machine.home)
    return MAX_NOMINAL_RESIDUAL * float(np.linalg.norm(at_home, axis=1).mean())


def _least_squares(
    machine: Machine, q: Array, nearby: list[RigidTransform]
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return the least-squares poses, and the largest residual of a leg length of each [m]."""
    R, t = components(nearby)
    found = solve_poses(geometries(machine), machine.frame_legs, R, t, machine.sign * q)
    poses = RigidTransform.from_components(found.t, Rotation.from_matrix(found.R))
    return tuple(poses), found.missed


def _image_of(measurements: Measurements, pose: int) -> str:
    """Return the first image of a pose as messages name it."""
    row = int(measurements.first_rows[pose])
    view = measurements.views[measurements.view[row]]
    return f"view {view.name}, {row_names(measurements)[row]}"
