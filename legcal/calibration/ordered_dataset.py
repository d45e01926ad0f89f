"""A dataset in canonical order: the images and readings that all jobs use.

Rows, views and legs are sorted once, here, so that no result depends on the order of the files, and
never reordered later. A job restores the order of the files at its end.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.variables import FittedLegs, fitted_legs, start_from
from legcal.data.cache import DetectionPlan, plan_dataset
from legcal.data.dataset import Dataset, rows_with_image
from legcal.data.image_choice import dataset_at, images_to_name
from legcal.data.image_tables import (
    Order,
    canonical_order,
    inverse,
    measurements_at,
    reorder_measurements,
)
from legcal.data.landmarks import platforms_by_landmarks
from legcal.data.measurements import Measurements, images_in_words, row_names
from legcal.data.outlines import Outlines, reject_unused_legs
from legcal.data.photograph_notes import notes_on_moves
from legcal.errors import Cause, DatasetError, by_cause
from legcal.files.schema import few
from legcal.geometry.motions import components, product
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.closing import solve_poses
from legcal.machine.kinematics import followed_poses, platform_in_base, platforms_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, vectors_A_to_B
from legcal.machine.parameters import geometries
from legcal.machine.redundancy import Contradiction, contradictions
from legcal.paper.criteria import Criteria
from legcal.perception.alignment import camera_moves
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.photographs import Photographs
from legcal.progress import Report
from legcal.workers import Run

# largest leg residual that errors of a nominal model explain, relative to the mean leg length
MAX_NOMINAL_RESIDUAL = 0.03
_STARTS = 12  # poses of other images near which a pose that was not reached is looked for


@dataclass(frozen=True, eq=False)
class Options:
    """Options of an estimate."""

    choices: Choices  # fixed, estimated and prior parameters
    criteria: Criteria | None = None  # criteria of the four steps; None leaves them out
    every_leg: bool = True  # whether a leg that no image shows is an error


@dataclass(frozen=True, eq=False)
class OrderedDataset:
    """A dataset in canonical order, with all of its images or some."""

    dataset: Dataset  # all images, in the order of its files
    order: Order  # from the files to the canonical order
    plan: DetectionPlan  # images to be searched, by their rows in the files
    pool: Run
    progress: Report
    machine: Machine  # in canonical order, as all following fields
    measurements: Measurements
    rows: IntArray  # indices of these images among all images
    # T_base_platform estimated from images, by row among all images, if readings do not give it
    seen_poses: Mapping[int, RigidTransform] = field(default_factory=dict)
    # edge pairs of searched images, by row among all images
    edge_pairs: dict[int, CandidatePairs] = field(default_factory=dict)
    joint_error: float = math.inf  # of joints of the model where stated, of the mean leg length
    left_out: Collection[int] = ()  # rows among all images that no fit uses

    @cached_property
    def photographs(self) -> Photographs:
        """All images, with those to be searched and the outlines to keep.

        Views that name no leg are not searched.
        """
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
            joint_error=self.joint_error,
        )

    @property
    def body_edges(self) -> Outlines | None:
        """The edges of bodies that were measured before, in all images."""
        edges = self.dataset.body_edges
        return None if edges is None else self.order.reorder(edges)

    def _clicked_poses(self) -> dict[int, tuple[RigidTransform, ...]]:
        """Return T_base_platform from clicks, by pose, if readings do not give it."""
        if self.machine.is_determined or self.dataset.landmarks is None:
            return {}
        landmarks = self.order.reorder(self.dataset.landmarks)
        return platforms_by_landmarks(self.machine, self.measurements, landmarks)

    @cached_property
    def fitted_legs(self) -> FittedLegs:
        """The legs for the joint fit."""
        return fitted_legs(self.machine)

    @cached_property
    def _nominal(self) -> tuple[tuple[RigidTransform, ...], Array]:
        unused = [k for k, row in enumerate(self.rows.tolist()) if row in self.left_out]
        T, residual = nominal_poses(self.machine, self.measurements, unused)
        if not self.seen_poses:
            return T, residual
        rows = self.rows[self.measurements.first_rows].tolist()
        seen = [
            platform_in_base(self.machine, self.seen_poses[row])
            if row in self.seen_poses
            else nominal
            for row, nominal in zip(rows, T, strict=True)
        ]
        return tuple(seen), residual

    @property
    def T_Rb_Re(self) -> tuple[RigidTransform, ...]:
        """The platform at every pose by the nominal model."""
        return self._nominal[0]

    @property
    def T_base_platform(self) -> list[RigidTransform]:
        """T_base_platform at every pose by the nominal model."""
        back = self.machine.T_platform_Re.inv()
        return [product(self.machine.T_base_Rb, T, back) for T in self.T_Rb_Re]

    def unreached_notes(self) -> list[str]:
        """Return a note on the poses that the nominal model cannot reach, if any."""
        residual = self._nominal[1]
        unreached = np.flatnonzero(residual > 0.0).tolist()
        if not unreached:
            return []
        m, images = self.measurements, row_names(self.measurements)
        first = m.first_rows[unreached].tolist()
        names = few([f"view {m.views[m.view[row]].name}, {images[row]}" for row in first])
        return [
            f"The nominal model cannot reach the readings of {names}: residuals of up to "
            f"{1e3 * float(residual.max()):.2f} mm remain at the nearest pose, from which the fit "
            "started."
        ]

    def poses_by(self, legs: Sequence[Leg]) -> tuple[RigidTransform, ...]:
        """Return T_Rb_Re of every pose by the readings and other legs, in R_b and R_e."""
        return start_from(legs, self.measurements, self.fitted_legs, (), self.T_Rb_Re, "").T_Rb_Re

    def with_zero_offsets(self, zeros: Mapping[str, float]) -> OrderedDataset:
        """Return the dataset with readings corrected by offsets of zeros.

        *zeros* say by motor how much further it stands than it reads [m or rad].
        """
        further = np.array([zeros.get(leg.motor_label, 0.0) for leg in self.machine.legs])
        if not further.any():
            return self
        corrected = replace(self.measurements, q=self.measurements.q + further)
        return replace(self, measurements=corrected)

    def rows_of(self, file_rows: IntArray) -> IntArray:
        """Return the rows of images in canonical order, given their rows in the files."""
        return np.sort(inverse(self.order.rows)[file_rows])

    def with_poses(self, T_base_platform: Mapping[int, RigidTransform]) -> OrderedDataset:
        """Return the dataset with platform poses estimated from images."""
        of_rows = {
            row: T_base_platform[pose]
            for row, pose in zip(self.rows.tolist(), self.measurements.pose.tolist(), strict=True)
            if pose in T_base_platform
        }
        # A new object, so that cached poses are recomputed.
        return replace(self, seen_poses={**self.seen_poses, **of_rows}) if of_rows else self

    def with_fitted_poses(self, T_Rb_Re: Sequence[RigidTransform]) -> OrderedDataset:
        """Return the dataset with the poses of a fit, if readings do not give them."""
        if self.machine.is_determined:
            return self
        back = self.machine.T_platform_Re.inv()
        return self.with_poses(
            {k: self.machine.T_base_Rb * T * back for k, T in enumerate(T_Rb_Re)}
        )

    def at(self, rows: IntArray) -> OrderedDataset:
        """Return the dataset with selected images, by ascending rows."""
        if len(rows) == len(self.rows):
            return self
        return replace(
            self,
            measurements=measurements_at(self.measurements, rows),
            rows=self.rows[rows],
        )

    def of_used_legs(self, outlines: Outlines) -> Outlines:
        """Return the outlines in these images of all, those of legs not named in views rejected."""
        own = outlines.at(self.rows)
        return reject_unused_legs(own, self.measurements, self.machine.leg_names)

    def in_file_order(self) -> tuple[Dataset, Order]:
        """Return the dataset of these images in the order of the files, and that order."""
        file_rows = self.order.rows[self.rows]
        order = replace(self.order, rows=inverse(np.argsort(file_rows)))
        return dataset_at(self.dataset, np.sort(file_rows)), order


def order_dataset(
    dataset: Dataset,
    pool: Run,
    progress: Report,
    *,
    fingerprint: str = "",
    left_out: BoolArray | None = None,  # (n_rows,): images that no fit will use
) -> OrderedDataset:
    """Put a dataset into canonical order, and select the images to be searched.

    Outlines stored by an earlier run are used if they have this fingerprint.
    """
    names, plan = dataset.machine.leg_names, plan_dataset(dataset, fingerprint)
    order = canonical_order(dataset.measurements, names)
    return OrderedDataset(
        dataset=_with_moves(dataset, plan, pool, progress),
        order=order,
        plan=plan,
        pool=pool,
        progress=progress,
        machine=dataset.machine.with_leg_order([names[leg] for leg in order.legs]),
        measurements=reorder_measurements(dataset.measurements, order),
        rows=np.arange(dataset.measurements.n_rows),
        left_out=() if left_out is None else np.flatnonzero(left_out[order.rows]).tolist(),
    )


def _with_moves(dataset: Dataset, plan: DetectionPlan, pool: Run, progress: Report) -> Dataset:
    """Return a dataset that reads images as if each camera had stood still between them.

    Given outlines are those of aligned images, too: all images of a view are compared with which
    others are measured, or in which boards are looked for.
    """
    m, moves = dataset.measurements, plan.moves
    if not plan.is_cached:
        is_read = np.isin(m.view, m.view[plan.detect])
        is_read |= bool(dataset.boards) and dataset.corners is None
        rows = [row for row in rows_with_image(dataset).tolist() if is_read[row]]
        load = dataset.image_reader(range(m.n_rows))
        found = camera_moves(load, m, rows, pool, progress)
        moves = {m.image[row]: move for row, move in found.items()}
    notes = (*dataset.file_notes, *notes_on_moves(m, moves))
    return replace(dataset, moves=moves, file_notes=notes) if moves else dataset


def nominal_poses(
    machine: Machine, measurements: Measurements, unused: Collection[int] = ()
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return T_Rb_Re of a nominal model at the readings, and its largest residual (n_poses,) [m].

    Errors of the model may make measured readings unreachable, near a singularity or with stretched
    legs. The pose with the least squared residuals of leg lengths is used then. If motors do not
    determine the pose, all poses are least-squares poses from home.

    Raises DatasetError if residuals of images exceed 3 % of the mean leg length, or readings of
    redundant motors contradict each other as much without showing which is wrong. Not for *unused*
    rows.
    """
    q = measurements.q_of_poses
    if not machine.is_determined:
        home = [platform_in_base(machine, machine.home)] * len(q)
        return _least_squares(machine, q, home)[0], np.zeros(len(q))
    followed = list(followed_poses(machine, q, on_the_chain=False))
    T = list(platforms_in_base(machine, [pose for pose, _ in followed]))
    unreached = [k for k, (_, failure) in enumerate(followed) if failure is not None]
    residual = np.zeros(len(q))
    if unreached:
        residual[unreached] = _solve_anew(machine, q, T, unreached)
    limit = _largest_residual(machine)
    T, contradicting = _contradictions(machine, measurements, T)
    refused = {
        k: Cause(
            "found {}; check this reading, its encoder and the offset of the leg, or leave",
            (contradiction.cause(machine),),
        )
        for k, contradiction in contradicting.items()
        if _is_refused(contradiction, machine)
    }
    for k, contradiction in contradicting.items():
        # A single wrong reading is reported by the fit; search at the pose by the other readings.
        if len(contradiction.legs) == 1:
            consistent = q[[k]]
            consistent[:, np.equal(machine.reads, contradiction.legs[0])] = np.nan
            T[k] = _least_squares(machine, consistent, [T[k]])[0][0]
    refused |= {
        k: Cause(
            "found that the nominal model cannot reach them, with a residual of {:.1f} mm at the "
            "nearest pose, needed at most {:.1f} mm; check these readings, their columns, the "
            "joints of the model and legcal.home, or leave",
            (1e3 * float(residual[k]), 1e3 * limit),
        )
        for k in unreached
        if not residual[k] <= limit and k not in contradicting
    }
    of_pose = dict[int, list[int]]()  # rows
    for row, pose in enumerate(measurements.pose.tolist()):
        if pose in refused and row not in unused:
            of_pose.setdefault(pose, []).append(row)
    problems = list[str]()
    for cause, first in by_cause({rows[0]: refused[pose] for pose, rows in of_pose.items()}):
        rows = np.array([row for k in measurements.pose[list(first)] for row in of_pose[k]])
        problems.append(
            f"The readings of {images_in_words(measurements, first)} could not be used: {cause} "
            f"the image{'s' * (len(rows) > 1)} out "
            f"(--leave-out {images_to_name(measurements, list(rows[:, None]))})."
        )
    if problems:
        raise DatasetError(problems)
    return tuple(T), residual


def contradicting_readings(machine: Machine, measurements: Measurements) -> dict[int, Cause]:
    """Return the contradictions of redundant readings in words, by row.

    Contradictions that :func:`nominal_poses` refuses are not included.
    """
    if not machine.is_redundant:
        return {}
    followed = followed_poses(machine, measurements.q_of_poses, on_the_chain=False)
    T = platforms_in_base(machine, [pose for pose, _ in followed])
    first = measurements.first_rows.tolist()
    return {
        first[k]: contradiction.cause(machine)
        for k, contradiction in _contradictions(machine, measurements, T)[1].items()
        if not _is_refused(contradiction, machine)
    }


def _contradictions(
    machine: Machine, measurements: Measurements, T_Rb_Re: Sequence[RigidTransform]
) -> tuple[list[RigidTransform], dict[int, Contradiction]]:
    """Return the poses at which readings of redundant motors contradict each other, and all poses.

    Readings have several poses, and the one that is followed from home may be the wrong one: before
    readings are accused, poses near those of the other images are tried.
    """
    T, q = list(T_Rb_Re), measurements.q_of_poses
    motors, sigma = list(machine.motors), measurements.sigma_q
    accused = contradictions(machine, T, q[:, motors], sigma[motors])
    if accused:
        _solve_anew(machine, q, T, list(accused))
        accused = contradictions(machine, T, q[:, motors], sigma[motors])
    return T, accused


def _solve_anew(
    machine: Machine, q: Array, T: list[RigidTransform], these: Sequence[int]
) -> list[float]:
    """Put the least-squares poses of some readings into T_Rb_Re; return their residuals [m].

    Each is the best one of those near the pose so far, home, and the poses of other readings.
    """
    others = [pose for k, pose in enumerate(T) if k not in these]
    others = [platform_in_base(machine, machine.home), *others[:: 1 + len(others) // _STARTS]]
    residuals = []
    for k in these:
        starts = [T[k], *others]
        poses, missed = _least_squares(machine, np.repeat(q[[k]], len(starts), axis=0), starts)
        T[k] = poses[int(np.argmin(missed))]
        residuals.append(float(missed.min()))
    return residuals


def _is_refused(contradiction: Contradiction, machine: Machine) -> bool:
    """Return whether a contradiction of readings prevents the search of the image."""
    return len(contradiction.legs) > 1 and contradiction.distances[0] > _largest_residual(machine)


def _largest_residual(machine: Machine) -> float:
    """Return the largest leg residual that errors of a nominal model explain [m]."""
    at_home = vectors_A_to_B(machine, machine.home)
    return MAX_NOMINAL_RESIDUAL * float(np.linalg.norm(at_home, axis=1).mean())


def _least_squares(
    machine: Machine, q: Array, nearby: list[RigidTransform]
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return the least-squares poses, and the largest residual of a leg length of each [m]."""
    R, t = components(nearby)
    solved = solve_poses(geometries(machine), machine.frame_legs, R, t, machine.sign * q)
    poses = RigidTransform.from_components(solved.t, Rotation.from_matrix(solved.R))
    return tuple(poses), solved.missed
