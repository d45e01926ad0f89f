"""The rank of a session in the joint fit, and its weak directions in words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.identify.information import (
    WhitenedEquations,
    image_rows,
    length_rows,
    prior_of,
    prior_of_arms,
    problem_of,
    whitened_leg_equations,
)
from legcal.calibration.identify.predicted_observations import PredictedObservations
from legcal.calibration.identify.report import Ranks, RmsMotion, WeakDirection
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices
from legcal.errors import NotIdentifiable
from legcal.estimation.problem import GaussianPrior
from legcal.estimation.square_root import compress, information_rows, marginal_rows
from legcal.geometry.types import Array, IntArray
from legcal.machine.directions import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.machine.equations import pose_sensitivity
from legcal.vision.board import Link

_MAX_SIGMA = 1.0  # mean leg lengths: what is known to no better is not determined
_ERROR = 0.0025  # mean leg lengths: the largest component of a direction whose effect is reported
_HARMLESS = 1e-3  # of that: the platform does not move


@dataclass(frozen=True, eq=False)
class Analysis:
    """What a session determines, computed where it is needed."""

    predicted: PredictedObservations
    choices: Choices = NO_CHOICES  # parameters that are fixed or have priors
    # From an analysis of the same machine; None: computed here
    same_motion: PlatformMotion | None = None
    same_equations: WhitenedEquations | None = None
    same_images: Array | None = None

    def elsewhere(self, predicted: PredictedObservations, poses: IntArray) -> Analysis:
        """Return the analysis of other images of the same machine, at some of the same poses."""
        return Analysis(predicted, self.choices, self.motion, self.equations.at(poses))

    def with_board(self, *, board: bool = True, link: Link = "base") -> Analysis:
        """Return the analysis of the same images with a board on a link in all or in none."""
        predicted = self.predicted.with_board(board=board, link=link)
        other = self.elsewhere(predicted, np.arange(len(predicted.t)))
        return replace(other, same_images=self.images)

    @cached_property
    def images(self) -> Array:
        """Whitened derivatives of what images show."""
        return image_rows(self.predicted) if self.same_images is None else self.same_images

    @cached_property
    def equations(self) -> WhitenedEquations:
        """The equations of readings and legs."""
        if self.same_equations is not None:
            return self.same_equations
        return whitened_leg_equations(self.predicted)

    @cached_property
    def prior(self) -> GaussianPrior:
        """What is known of the parameters without images."""
        return prior_of(self.predicted, self.choices)

    @cached_property
    def arms(self) -> GaussianPrior:
        """What is known of the lines of arms without images."""
        return prior_of_arms(self.predicted, self.choices)

    @cached_property
    def of_cameras(self) -> Array:
        """The joint fit: rows by parameters and cameras, (m, p + 6 n_frames)."""
        return information_rows(
            *problem_of(
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
        """How the platform follows the parameters."""
        return PlatformMotion(self.predicted) if self.same_motion is None else self.same_motion

    @cached_property
    def full(self) -> Ranks:
        """The joint fit."""
        basis = undetermined(self.predicted, self.information)
        weak = weak_directions(self.predicted, self.motion, basis)
        n_p = len(self.predicted.unit) - len(self.predicted.ties)
        return Ranks(n_p - len(weak), n_p, weak)


class PlatformMotion:
    """How the platform moves with the parameters, over the poses that a session reaches."""

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
        """Return what a direction (p,) in metres does."""
        if self.by_metres is None:
            return None
        moved = self.by_metres @ direction
        turn, shift = (float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in np.split(moved, 2, 1))
        return RmsMotion(shift, turn)

    def sigma(self, information: Array) -> RmsMotion | None:
        """Return the standard deviation of the platform that information leaves."""
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
        """Return a space (w, p) as that which moves the platform and that which does not."""
        return split_by_motion(self.by_metres, basis, self.predicted.mean_length, _HARMLESS)


def undetermined(
    predicted: PredictedObservations,
    information: Array,
    sigma: float = _MAX_SIGMA,  # mean leg lengths
) -> Array:
    """Return an orthonormal basis (w, c) of the directions that rows (m, c) do not determine."""
    _, singular, basis = np.linalg.svd(compress(information))
    return np.asarray(basis[singular <= _limit(predicted, sigma)])


def missing(predicted: PredictedObservations, rows: Array, motion: PlatformMotion) -> int:
    """Return how many directions that move the platform rows of all parameters leave open."""
    return len(motion.split(undetermined(predicted, rows))[0])


def weak_directions(
    predicted: PredictedObservations,  # where names and units come from
    motion: PlatformMotion,
    basis: Array,  # (w, p): the space, in metres
) -> tuple[WeakDirection, ...]:
    """Return the directions of a space in words, those that move the platform first."""
    parts = motion.split(basis)
    return tuple(
        _direction(predicted, motion, row, harmless)
        for part, harmless in zip(parts, (False, True), strict=True)
        for row in sparse_basis(part)
    )


def _direction(
    predicted: PredictedObservations, motion: PlatformMotion, row: Array, harmless: bool
) -> WeakDirection:
    """Return a direction with its largest component at a small part of the leg length."""
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


def _limit(predicted: PredictedObservations, sigma: float = _MAX_SIGMA) -> float:
    """Return the least singular value that counts [1/m]."""
    return 1.0 / (sigma * predicted.mean_length)
