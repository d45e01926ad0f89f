"""The rank of a session in the joint fit, and its weak directions in words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.identify.report import Ranks, RmsMotion, WeakDirection
from legcal.calibration.identify.session import Session
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices
from legcal.calibration.joint_fit.predicted import DEFAULT_NOISE, Contributions, PredictedNoise
from legcal.errors import NotIdentifiable
from legcal.estimation.uncertainty import compress, marginal_rows
from legcal.geometry.types import Array
from legcal.machine.directions import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.machine.equations import pose_sensitivity
from legcal.machine.parameter_id import ARMS, ParameterId
from legcal.vision.board import Link

_MAX_SIGMA = 1.0  # mean leg lengths: what is known to no better is not determined
_ERROR = 0.0025  # mean leg lengths: largest component of a reported direction
_HARMLESS = 1e-3  # motion of the platform over it, below which it is harmless


def is_of_arm(name: str) -> bool:
    """Return whether a parameter is of the line of an arm."""
    return ParameterId.parse(name).kind in ARMS


@dataclass(frozen=True, eq=False)
class Analysis:
    """Identifiability analysis of a session, computed lazily."""

    session: Session
    choices: Choices = NO_CHOICES  # parameters that are fixed or have priors
    noise: PredictedNoise = DEFAULT_NOISE
    # From an analysis of the same machine; None: computed here
    same_motion: PlatformMotion | None = None

    def elsewhere(self, session: Session) -> Analysis:
        """Analyse other images of the same machine."""
        return Analysis(session, self.choices, self.noise, self.motion)

    def with_board(self, *, board: bool = True, link: Link = "base") -> Analysis:
        """Analyse the same images with a board on a link in all of them, or in none."""
        return self.elsewhere(self.session.with_board(board=board, link=link))

    @cached_property
    def contributions(self) -> Contributions:
        """The information of the joint fit, without the unknowns of single views."""
        return self.session.contributions(self.choices, self.noise).of_shared()

    @cached_property
    def without_radii(self) -> Contributions:
        """The same if nothing is known of radii, and of lines of arms only what is stated."""
        choices, radii = self.choices, frozenset(self.session.radii)
        arms = {n for n in self.session.fitted.parametrization.names if is_of_arm(n)}
        open_arms = arms - choices.fixed - choices.priors.keys()
        open_choices = replace(
            choices,
            fixed=choices.fixed - radii,
            free=choices.free | radii | open_arms,
            priors={n: prior for n, prior in choices.priors.items() if n not in radii},
        )
        return self.session.contributions(open_choices, self.noise).of_shared()

    @cached_property
    def information(self) -> Array:
        """The joint fit: rows by parameters, (p, p)."""
        contributions = self.contributions
        rows = np.concatenate([contributions.all_gains(), contributions.known])
        return self.of_parameters(rows, contributions.basis)

    def of_parameters(self, rows: Array, basis: Array) -> Array:
        """Return information rows (p, p) by parameters in metres.

        *rows* (m, n) begin with the coordinates of the machine, of which *basis* are the
        derivatives of parameters.
        """
        session = self.session
        number = {name: i for i, name in enumerate(session.fitted.parametrization.names)}
        which = [number[name] for name in session.parametrization.names]
        by_coordinates = basis[which] / session.unit[:, None]
        free = np.flatnonzero(by_coordinates.any(axis=0))
        k, (Q, S) = len(free), np.linalg.qr(by_coordinates[:, free], mode="complete")
        # Fixed parameters, and what the mechanism ties, are known exactly.
        known = [Q[:, k:].T / session.sigma_exact]
        if k:
            known.append(np.linalg.solve(S[:k].T, marginal_rows(rows, free).T).T @ Q[:, :k].T)
        return compress(np.concatenate(known))

    @cached_property
    def motion(self) -> PlatformMotion:
        """Sensitivity of the platform to the parameters."""
        return PlatformMotion(self.session) if self.same_motion is None else self.same_motion

    @cached_property
    def full(self) -> Ranks:
        """The joint fit."""
        basis = undetermined(self.session, self.information)
        weak = weak_directions(self.session, self.motion, basis)
        n_p = len(self.session.unit) - self.session.n_ties
        return Ranks(n_p - len(weak), n_p, weak)


class PlatformMotion:
    """Sensitivity of the platform to the parameters, over the poses of a session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.by_metres: Array | None = None
        self.why_not = ""
        try:
            moved = pose_sensitivity(
                session.legs,
                session.parametrization,
                session.frame_legs,
                session.R_reached,
                session.t_reached,
            )
        except NotIdentifiable as error:
            self.why_not = str(error)
            return
        self.by_metres = moved * session.unit

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
        seen = singular > _limit(self.session)
        spread = self.by_metres @ (basis[seen].T / singular[seen])
        turn, shift = (
            float(np.sqrt(np.mean(np.sum(x**2, (1, 2))))) for x in np.split(spread, 2, 1)
        )
        return RmsMotion(shift, turn)

    def split(self, basis: Array) -> tuple[Array, Array]:
        """Split a space (w, p) into directions that move the platform and harmless ones."""
        return split_by_motion(self.by_metres, basis, self.session.mean_length, _HARMLESS)


def undetermined(
    session: Session,
    information: Array,
    sigma: float = _MAX_SIGMA,  # mean leg lengths
) -> Array:
    """Return an orthonormal basis (w, c) of the directions that rows (m, c) do not determine."""
    _, singular, basis = np.linalg.svd(compress(information))
    return np.asarray(basis[singular <= _limit(session, sigma)])


def missing(session: Session, rows: Array, motion: PlatformMotion) -> int:
    """Count the open directions of rows that move the platform."""
    return len(motion.split(undetermined(session, rows))[0])


def weak_directions(
    session: Session,  # where names and units come from
    motion: PlatformMotion,
    basis: Array,  # (w, p): the space, in metres
) -> tuple[WeakDirection, ...]:
    """Describe the directions of a space, those that move the platform first."""
    parts = motion.split(basis)
    return tuple(
        _direction(session, motion, row, harmless)
        for part, harmless in zip(parts, (False, True), strict=True)
        for row in sparse_basis(part)
    )


def _direction(
    session: Session, motion: PlatformMotion, row: Array, harmless: bool
) -> WeakDirection:
    """Describe a direction, scaled to a small largest component."""
    row = row / row[np.argmax(np.abs(row))]
    shown = np.flatnonzero(np.abs(row) > SHOWN)
    shown = shown[np.argsort(-np.abs(row[shown]).round(3), kind="stable")]
    row = row * (_ERROR * session.mean_length)
    names = tuple(session.parametrization.names[i] for i in shown)
    effect = motion.effect(row)
    return WeakDirection(
        describe_direction(names, session.leg_names),
        names,
        tuple(float((row * session.unit)[i]) for i in shown),
        None if effect is None else effect.dX_m,
        None if effect is None else effect.dE_rad,
        harmless,
    )


def _limit(session: Session, sigma: float = _MAX_SIGMA) -> float:
    """Least singular value of a determined direction [1/m]."""
    return 1.0 / (sigma * session.mean_length)
