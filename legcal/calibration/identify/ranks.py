"""What the joint fit of a session determines: its rank, weak directions, intrinsics, the scale.

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
    CameraIntrinsics,
    Ranks,
    RmsMotion,
    ScaleSource,
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
from legcal.machine.leg import ARMS, SIGMA_LENGTH, LegColumns, ParameterId
from legcal.machine.parameters import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.vision.board import Link
from legcal.vision.camera import shared_cameras

_MAX_SIGMA = 1.0  # mean leg lengths: what is known to no better is not determined
_ERROR = 0.0025  # mean leg lengths: largest component of a reported direction
_HARMLESS = 1e-3  # motion of the platform over it, below which it is harmless
INTRINSICS = ("fx", "fy", "cx", "cy")
_MAX_SIGMA_OF_INTRINSICS = 0.1  # focal lengths: above, intrinsics are not determined
_OPEN_INTRINSIC = 0.05  # least component of an intrinsic in an open direction
_OPEN = 1e-6  # of their mean, in directions that are not determined: lengths are open
_KNOWN = 2.5e-9  # mean leg lengths: of a radius that is known
_VAGUE = RefinementSettings.radius_sigma / 2.0  # of the scale
_LINKS: tuple[Link, ...] = ("base", "platform")


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


def expected_intrinsics(analysis: Analysis) -> tuple[CameraIntrinsics, ...]:
    """Return the uncertainty of all intrinsics, estimated jointly with all other unknowns."""
    session, choices = analysis.session, analysis.choices
    cameras = {view.name: view.camera for view in session.cameras}
    owners = tuple(dict.fromkeys(shared_cameras(list(cameras), list(cameras.values()))))
    names = [f"{owner}.{key}" for owner in owners for key in INTRINSICS]
    estimated = replace(
        choices,
        fixed=choices.fixed.difference(names),
        free=choices.free.union(names),
        priors={name: prior for name, prior in choices.priors.items() if name not in names},
    )
    found = session.contributions(estimated, analysis.noise).of_shared()
    of_names = {name.removeprefix("camera "): i for i, name in enumerate(found.names)}
    columns = [of_names[name if name in of_names else name.rpartition(".")[2]] for name in names]
    focal = np.repeat([np.sqrt(cameras[o].K[0, 0] * cameras[o].K[1, 1]) for o in owners], 4)
    rows = np.concatenate([found.all_gains(), found.known])
    _, singular, basis = np.linalg.svd(marginal_rows(rows, np.array(columns)) * focal)
    is_determined = singular > 1.0 / _MAX_SIGMA_OF_INTRINSICS
    spread = np.sqrt(np.sum((basis[is_determined].T / singular[is_determined]) ** 2, axis=1))
    is_open = np.sqrt(np.sum(basis[~is_determined] ** 2, axis=0)) > _OPEN_INTRINSIC
    sigmas, opens = (x.reshape(len(owners), -1).tolist() for x in (spread * focal, is_open))
    return tuple(
        CameraIntrinsics(
            owner,
            not any(open_),
            {k: None if o else s for k, s, o in zip(INTRINSICS, sigma, open_, strict=True)},
        )
        for owner, sigma, open_ in zip(owners, sigmas, opens, strict=True)
    )


# The scale


def scale_sources(analysis: Analysis) -> tuple[ScaleSource, ...]:
    """Return possible sources of scale with their accuracy; empty if the scale is known."""
    if not analysis.session.actuators or not is_scale_open(analysis):
        return ()
    names = analysis.session.parametrization.names
    measured = analysis.session.columns(LegColumns.LENGTH)[:1]
    length = SIGMA_LENGTH * analysis.session.mean_length
    radius = RefinementSettings.radius_sigma
    row = np.zeros((1, len(names)))
    row[0, measured] = 1.0 / length
    with_length = np.concatenate([_information(analysis), row])
    tried = (
        ("length", f"{names[measured[0]]} measured to {1e3 * length:.2g} mm", with_length),
        *(
            (
                f"{link}_board",
                f"a calibration board on the {link} in every view",
                _information(analysis.with_board(link=link)),
            )
            for link in _LINKS
        ),
        (
            "radii",
            f"radii known to {100 * radius:g} %, all wrong alike",
            _information(analysis, common=radius),
        ),
    )
    return tuple(_source(analysis, *each) for each in tried)


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


def _source(analysis: Analysis, name: str, words: str, information: Array) -> ScaleSource:
    """Accuracy of the scale and the platform with a source; None where lengths stay open."""
    sigma = _sigma(analysis, information)
    motion = None if sigma is None else analysis.motion.sigma(information)
    return ScaleSource(name, words, sigma, motion)


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
    sigma_radii: Mapping[str, float] | None = None,
    *,
    common: float | None = None,
) -> Array:
    """Information rows by parameters, for standard deviations [m] of radii, or a *common* error.

    That is relative, and the same for all. Lines of arms have stated priors only.
    """
    found, radii = analysis.without_radii, analysis.session.radii
    rows = np.concatenate([found.all_gains(), found.known])
    column = {name.removeprefix("radii "): i for i, name in enumerate(found.names)}
    if common is not None:
        seen = [name for name in radii if name in column]
        by_common = rows[:, [column[name] for name in seen]] @ [radii[name] for name in seen]
        rows = np.column_stack([np.delete(rows, [column[name] for name in seen], 1), by_common])
        prior = np.eye(1, rows.shape[1], rows.shape[1] - 1) / common
        return analysis.of_parameters(np.concatenate([rows, prior]), found.basis)
    sigma_radii = sigma_radii or {}
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
    sources = scale_sources(analysis)
    fixing = [source.assumed for source in sources if source.sigma is not None]
    options = ", or ".join(fixing or [source.assumed for source in sources])
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
        f"undetermined; any of these would determine it: {options}; {fix_gain}{stated}."
    )
