"""What the joint fit of a session determines: its rank, weak directions, the scale.

Encoders of arms measure angles: such a machine at twice the size, with rods twice as thick and
cameras twice as far, gives the same images and readings. A measured length, a board, or radii fix
the scale; a default prior on radii, or on lines of arms, must not do so silently.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.identify.report import (
    Ranks,
    RmsMotion,
    WeakDirection,
)
from legcal.calibration.identify.session import Session
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices
from legcal.calibration.joint_fit.part_errors import PartSigma, predicted_sigmas
from legcal.calibration.joint_fit.predicted import (
    DEFAULT_NOISE,
    WHITE,
    Contributions,
    PredictedNoise,
)
from legcal.calibration.joint_fit.variables import RefinementSettings
from legcal.data.dataset import Dataset
from legcal.errors import NotIdentifiable
from legcal.estimation.uncertainty import compress, marginal_rows
from legcal.geometry.types import Array
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import ARMS, LegColumns, ParameterId
from legcal.machine.parameters import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.vision.board import Link

_MAX_SIGMA = 1.0  # mean leg lengths: what is known to no better is not determined
_ERROR = 0.0025  # mean leg lengths: largest component of a reported direction
_HARMLESS = 1e-3  # motion of the platform over it, below which it is harmless
_OPEN = 1e-6  # of their mean, in directions that are not determined: lengths are open
_KNOWN = 2.5e-9  # mean leg lengths: of a radius that is known
_VAGUE = RefinementSettings.radius_sigma / 2.0  # of the scale


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

    def with_board(self, link: Link = "base") -> Analysis:
        """Analyse the same images with a board on a link in all of them."""
        return self.elsewhere(self.session.with_board(link))

    @cached_property
    def contributions(self) -> Contributions:
        """The information of the joint fit, without the unknowns of single views."""
        return self.session.contributions(self.choices, self.noise).of_shared()

    @cached_property
    def without_radii(self) -> Contributions:
        """The same if nothing is known of radii, and of lines of arms only what is stated."""
        choices, radii = self.choices, frozenset(self.session.radii)
        names = self.session.fitted.parametrization.names
        arms = {name for name in names if ParameterId.parse(name).kind in ARMS}
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

    @cached_property
    def parts(self) -> tuple[PartSigma, ...]:
        """What is expected of the parts, with tolerances as priors; () without these."""
        if self.choices.built is None:
            return ()
        found = self.contributions
        rows, p = np.concatenate([found.all_gains(), found.known]), found.basis.shape[1]
        C = np.linalg.pinv(rows.T @ rows, hermitian=True)[:p, :p]
        C = found.basis @ C @ found.basis.T
        return predicted_sigmas(self.session.fitted, self.choices, C)

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
    return 1.0 / (sigma * session.mean_length)


# The scale


def is_scale_open(analysis: Analysis) -> bool:
    """Whether the scale comes from default priors on radii alone.

    Fixed radii and radii with a stated prior count as known. A stated length or radius that fixes
    the scale no better than half of the default prior of radii does not count: the default prior
    would dominate silently.
    """
    analysis = replace(analysis, noise=WHITE)  # what is known of lengths, and not of edges
    stated = _stated_radii(analysis)
    if _n_open(analysis, stated) > n_open_with_radii(analysis):
        return True
    if not analysis.choices.priors:
        return False
    known, seen = (
        _sigma(analysis, _information(analysis, radii)) for radii in (stated, _all_known(analysis))
    )
    if known is None or seen is None or known**2 - seen**2 <= _VAGUE**2:
        return False
    nothing = replace(analysis, choices=replace(analysis.choices, priors={}))
    return _n_open(nothing, _stated_radii(nothing)) > _n_open(nothing, _all_known(nothing))


def _n_open(analysis: Analysis, sigma_radii: Mapping[str, float]) -> int:
    """Count the open directions for standard deviations of radii [m]."""
    return len(undetermined(analysis.session, _information(analysis, sigma_radii)))


def n_open_with_radii(analysis: Analysis) -> int:
    """Count the directions that stay open where radii are known exactly."""
    return _n_open(analysis, _all_known(analysis))


def _all_known(analysis: Analysis) -> dict[str, float]:
    """Return standard deviations of radii that are known exactly [m]."""
    return dict.fromkeys(analysis.session.radii, _KNOWN * analysis.session.mean_length)


def _sigma(analysis: Analysis, information: Array) -> float | None:
    """Relative standard deviation of the scale; None if it is open."""
    session = analysis.session
    columns = session.columns(LegColumns.LENGTH)
    lengths = np.array([leg.q0 for leg in session.legs])[: len(columns)]
    mean = np.zeros(len(session.unit))  # of the relative errors of lengths
    mean[columns] = 1.0 / (len(columns) * lengths)
    undetermined_directions = undetermined(session, information)
    leaves_more = len(undetermined_directions) > n_open_with_radii(analysis)
    if leaves_more or np.linalg.norm(undetermined_directions @ mean) > _OPEN * np.linalg.norm(mean):
        return None
    _, singular, basis = np.linalg.svd(information, full_matrices=False)
    seen = singular > 0.0
    return float(np.linalg.norm(basis[seen] @ mean / singular[seen]))


def _information(
    analysis: Analysis,
    sigma_radii: Mapping[str, float],
) -> Array:
    """Information rows by parameters, for standard deviations [m] of radii.

    Lines of arms have stated priors only.
    """
    found = analysis.without_radii
    rows = np.concatenate([found.all_gains(), found.known])
    column = {name.removeprefix("radii "): i for i, name in enumerate(found.names)}
    known = [name for name in sigma_radii if name in column]
    prior = np.zeros((len(known), rows.shape[1]))
    for row, name in zip(prior, known, strict=True):
        row[column[name]] = 1.0 / sigma_radii[name]
    return analysis.of_parameters(np.concatenate([rows, prior]), found.basis)


def _stated_radii(analysis: Analysis) -> dict[str, float]:
    """Return stated standard deviations of radii [m]."""
    choices, exact = analysis.choices, _all_known(analysis)
    stated = {name: sigma for name, sigma in exact.items() if name in choices.fixed}
    return stated | {name: choices.priors[name].sigma for name in exact if name in choices.priors}


def refusal_of_scale(dataset: Dataset, analysis: Analysis) -> str:
    """Describe why the scale of a session is open, and the remedies."""
    machine = dataset.machine
    reason, fix_gain = "readings of arms are angles", ""
    if machine.readings_carry_length:  # but for gains
        reason, fix_gain = (
            "the gains of all motors that slide are free",
            "fix one of these gains, or ",
        )
    if _n_open(analysis, _stated_radii(analysis)) == _n_open(
        analysis, _all_known(analysis)
    ):  # something is stated
        reason += f", and the stated values determine the scale no better than {100 * _VAGUE:g} %"
    stated = (
        f"state a measured length ({machine.length_option}), or radii that you know better than "
        "the model (--set '*.radius.*=VALUE±SIGMAmm')"
    )
    return (
        f"{dataset.folder}: the parameters cannot be identified: {reason}, so the overall scale is "
        f"undetermined; {fix_gain}{stated}, or put a calibration board on base or platform, seen "
        "in every view."
    )
