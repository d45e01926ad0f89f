"""Ranks of a session, step by step and in the joint fit, and its weak directions in words."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.calibration.identify.information import (
    WhitenedEquations,
    image_rows,
    length_rows,
    prior_of,
    prior_of_arms,
    session_problem,
    whitened_leg_equations,
)
from legcal.calibration.identify.predicted_observations import PredictedObservations
from legcal.calibration.identify.report import Ranks, RmsMotion, StepRank, WeakDirection
from legcal.calibration.identify.steps import (
    MAX_SIGMA,
    Located,
    StepInformation,
    consecutive_distances,
    distance_rows,
    identify_base,
    identify_platform,
    locate_joints,
    mean_distances,
    offsets_from_distances,
    scalar_products,
)
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices
from legcal.errors import NotIdentifiable
from legcal.estimation.problem import GaussianPrior
from legcal.estimation.square_root import compress, information_rows, marginal_rows
from legcal.geometry.types import Array, IntArray
from legcal.machine.directions import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.machine.equations import pose_sensitivity
from legcal.vision.board import Link

_ERROR = 0.0025  # mean leg lengths: largest component of a reported direction
_HARMLESS = 1e-3  # motion of the platform over it, below which it is harmless


@dataclass(frozen=True, eq=False)
class Analysis:
    """Identifiability analysis of a session, computed lazily."""

    predicted: PredictedObservations
    choices: Choices = NO_CHOICES  # parameters that are fixed or have priors

    def elsewhere(self, predicted: PredictedObservations, poses: IntArray) -> Analysis:
        """Analyse other images of the same machine, at a subset of its poses."""
        other = Analysis(predicted, self.choices)
        other.__dict__.update(motion=self.motion, equations=self.equations.at(poses))
        return other

    def with_board(self, *, board: bool = True, link: Link = "base") -> Analysis:
        """Analyse the same images with a board on a link in all of them, or in none."""
        predicted = self.predicted.with_board(board=board, link=link)
        other = self.elsewhere(predicted, np.arange(len(predicted.t)))
        other.__dict__.update(images=self.images)
        if link == "platform":  # the steps do without it
            other.__dict__.update(default_steps=self.default_steps, staged=self.staged)
        return other

    @cached_property
    def images(self) -> Array:
        """Whitened derivatives of the measured bodies."""
        return image_rows(self.predicted)

    @cached_property
    def equations(self) -> WhitenedEquations:
        """The equations of readings and legs."""
        return whitened_leg_equations(self.predicted)

    @cached_property
    def prior(self) -> GaussianPrior:
        """Prior of the parameters."""
        return prior_of(self.predicted, self.choices)

    @cached_property
    def arms(self) -> GaussianPrior:
        """Prior of the lines of arms."""
        return prior_of_arms(self.predicted, self.choices)

    @cached_property
    def located(self) -> Located:
        """Step 1."""
        return locate_joints(self.predicted)

    @cached_property
    def distances(self) -> tuple[Array, Array, IntArray]:
        """The distances of steps 3 and 4."""
        return distance_rows(self.predicted, self.located)

    @cached_property
    def default_steps(self) -> tuple[StepInformation, ...]:
        """Steps 2, 3 and 4, default criteria."""
        return (
            identify_base(self.predicted, self.located),
            offsets_from_distances(self.predicted, *self.distances),
            identify_platform(
                self.predicted,
                self.located,
                self.images[:, : self.predicted.n_legs],  # no step uses arms
                self.equations,
            ),
        )

    @cached_property
    def literal_steps(self) -> tuple[StepInformation, ...]:
        """Steps 2, 3 and 4 as printed."""
        rows, weight, key = self.distances
        return (
            scalar_products(self.predicted, self.located),
            consecutive_distances(rows, weight, key, self.default_steps[1].columns),
            mean_distances(self.predicted, weight, key),
        )

    @cached_property
    def of_cameras(self) -> Array:
        """The joint fit: rows by parameters and cameras, (m, p + 6 n_frames)."""
        return information_rows(
            *session_problem(
                self.predicted,
                self.images,
                self.equations,
                self.prior,
                lengths=length_rows(self.predicted, self.choices),
                arms=self.arms,
            )
        )

    @cached_property
    def information(self) -> Array:
        """The joint fit: rows by parameters, (p, p)."""
        return marginal_rows(self.of_cameras, np.arange(len(self.predicted.unit)))

    @cached_property
    def motion(self) -> PlatformMotion:
        """Sensitivity of the platform to the parameters."""
        return PlatformMotion(self.predicted)

    @cached_property
    def staged(self) -> Ranks:
        """The four default steps together."""
        weak = tuple(
            direction
            for step in self.default_steps
            for direction in weak_directions(
                self.predicted,
                self.motion,
                undetermined(self.predicted, step.information),
                step.columns,
            )
        )
        n_p = len(self.predicted.unit) - len(self.predicted.ties)
        return Ranks(n_p - len(weak), n_p, weak)

    @cached_property
    def full(self) -> Ranks:
        """The joint fit."""
        basis = undetermined(self.predicted, self.information)
        weak = weak_directions(self.predicted, self.motion, basis)
        n_p = len(self.predicted.unit) - len(self.predicted.ties)
        return Ranks(n_p - len(weak), n_p, weak)

    @cached_property
    def step_ranks(self) -> tuple[StepRank, ...]:
        """The rank of each step, default and as printed."""
        first = ("joints_in_cameras", self.located.rank, self.located.of)
        found = [
            StepRank(first[0], "default", *first[1:]),
            StepRank(first[0], "literal", *first[1:]),
        ]
        for default, printed in zip(self.default_steps, self.literal_steps, strict=True):
            for criteria, step in (("default", default), ("literal", printed)):
                rank = determined(self.predicted, step.information)
                found.append(StepRank(step.name, criteria, rank, len(step.columns)))
        return tuple(found)


class PlatformMotion:
    """Sensitivity of the platform to the parameters, over the poses of a session."""

    def __init__(self, predicted: PredictedObservations) -> None:
        self.predicted = predicted
        self.by_metres: Array | None = None
        self.why_not = ""
        try:
            moved = pose_sensitivity(
                predicted.legs,
                predicted.parametrization,
                predicted.frame_legs,
                predicted.R_reached,
                predicted.t_reached,
            )
        except NotIdentifiable as error:
            self.why_not = str(error)
            return
        self.by_metres = moved * predicted.unit

    def effect(self, direction: Array) -> RmsMotion | None:
        """Motion of the platform by a direction (p,) in metres."""
        if self.by_metres is None:
            return None
        moved = self.by_metres @ direction
        turn, shift = (float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in np.split(moved, 2, 1))
        return RmsMotion(shift, turn)

    def sigma(self, information: Array) -> RmsMotion | None:
        """Return the standard deviation of the platform for the information of parameters."""
        if self.by_metres is None:
            return None
        _, singular, basis = np.linalg.svd(information)
        seen = singular > _limit(self.predicted)
        spread = self.by_metres @ (basis[seen].T / singular[seen])
        turn, shift = (
            float(np.sqrt(np.mean(np.sum(x**2, (1, 2))))) for x in np.split(spread, 2, 1)
        )
        return RmsMotion(shift, turn)

    def split(self, basis: Array) -> tuple[Array, Array]:
        """Split a space (w, p) into directions that move the platform and harmless ones."""
        return split_by_motion(self.by_metres, basis, self.predicted.mean_length, _HARMLESS)


def determined(predicted: PredictedObservations, information: Array) -> int:
    """Return the rank of whitened rows: directions with a sigma below a leg's length."""
    singular = np.linalg.svd(compress(information), compute_uv=False)
    return int(np.sum(singular > _limit(predicted)))


def undetermined(
    predicted: PredictedObservations,
    information: Array,
    sigma: float = MAX_SIGMA,  # mean leg lengths
) -> Array:
    """Return an orthonormal basis (w, c) of the directions that rows (m, c) do not determine."""
    _, singular, basis = np.linalg.svd(compress(information))
    return np.asarray(basis[singular <= _limit(predicted, sigma)])


def missing(predicted: PredictedObservations, rows: Array, motion: PlatformMotion) -> int:
    """Count the open directions of rows that move the platform."""
    return len(motion.split(undetermined(predicted, rows))[0])


def weak_directions(
    predicted: PredictedObservations,  # where names and units come from
    motion: PlatformMotion,
    basis: Array,  # (w, c): the space, in metres
    columns: IntArray | None = None,  # (c,): which parameters; all without it
) -> tuple[WeakDirection, ...]:
    """Describe the directions of a space, those that move the platform first."""
    wide = basis
    if columns is not None:
        wide = np.zeros((len(basis), len(predicted.unit)))
        wide[:, columns] = basis
    parts = motion.split(wide)
    return tuple(
        _direction(predicted, motion, row, harmless)
        for part, harmless in zip(parts, (False, True), strict=True)
        for row in sparse_basis(part)
    )


def _direction(
    predicted: PredictedObservations, motion: PlatformMotion, row: Array, harmless: bool
) -> WeakDirection:
    """Describe a direction, scaled to a small largest component."""
    row = row / row[np.argmax(np.abs(row))]
    shown = np.flatnonzero(np.abs(row) > SHOWN)
    shown = shown[np.argsort(-np.abs(row[shown]).round(3), kind="stable")]
    row = row * (_ERROR * predicted.mean_length)
    names = tuple(predicted.parametrization.names[i] for i in shown)
    effect = motion.effect(row)
    return WeakDirection(
        describe_direction(names, predicted.leg_names),
        names,
        tuple(float((row * predicted.unit)[i]) for i in shown),
        None if effect is None else effect.dX_m,
        None if effect is None else effect.dE_rad,
        harmless,
    )


def _limit(predicted: PredictedObservations, sigma: float = MAX_SIGMA) -> float:
    """Least singular value of a determined direction [1/m]."""
    return 1.0 / (sigma * predicted.mean_length)
