"""Identifiability of the parameters from planned views, or a dataset: ``legcal identify``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from legcal.calibration.documents import Result
from legcal.calibration.identify.report import (
    ConditionBlock,
    Identifiability,
    PaperBlock,
    Ranks,
    Remedy,
    RmsMotion,
    WeakDirection,
)
from legcal.calibration.identify.session import (
    THIN,
    Session,
    default_cameras,
    legs_around,
    neighbours,
    planned_session,
    recorded_session,
)
from legcal.calibration.joint_fit.parameter_choices import (
    NO_CHOICES,
    Choices,
    Group,
    choices_of,
)
from legcal.calibration.joint_fit.part_errors import PartSigma, predicted_sigmas, sigmas_in_words
from legcal.calibration.joint_fit.platform import (
    expected_error,
    moved_by,
    platform_by_parameters,
    written_covariance,
)
from legcal.calibration.joint_fit.predicted import (
    DEFAULT_NOISE,
    WHITE,
    Contributions,
    PredictedNoise,
    fitted_covariance,
    read_noise,
)
from legcal.calibration.joint_fit.variables import RefinementSettings
from legcal.data.dataset import Dataset
from legcal.data.measurements import Measurements, few_views
from legcal.data.outlines import join_outlines
from legcal.errors import NotIdentifiable, UsageError
from legcal.estimation.uncertainty import compress, marginal_rows
from legcal.files.schema import closest
from legcal.geometry.types import Array
from legcal.machine.files import DATASET_YAML
from legcal.machine.inspection import singularity_note
from legcal.machine.leg import ARMS, JointType, LegColumns, Link, ParameterId
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    SHOWN,
    describe_direction,
    geometries,
    is_held_by_default,
    leg_labels,
    legs_in_words,
    list_in_words,
    sparse_basis,
    split_by_motion,
)
from legcal.machine.ties import by_step, independent, ties_in_words
from legcal.paper.conditions import (
    Condition,
    count_conditions,
    three_legs_at_once,
    two_directions,
)

_MAX_SIGMA = 1.0  # mean leg lengths: what is known to no better is not determined
_ERROR = 0.0025  # mean leg lengths: largest component of a reported direction
_HARMLESS = 1e-3  # motion of the platform over it, below which it is harmless
_OPEN = 1e-6  # of their mean, in directions that are not determined: lengths are open
_EXACT = 2.5e-7  # mean leg lengths: standard deviation of what is known exactly
_KNOWN = 2.5e-9  # mean leg lengths: of a radius that is known
_VAGUE = RefinementSettings.radius_sigma / 2.0  # of the scale


@dataclass(frozen=True, eq=False)
class Analysis:
    """Identifiability analysis of a session, computed lazily."""

    session: Session
    choices: Choices = NO_CHOICES  # parameters that are fixed or have priors
    noise: PredictedNoise = DEFAULT_NOISE

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
    def covariance(self) -> Array:
        """The covariance of all parameters of the fit."""
        session = self.session
        found = session.contributions(self.choices, self.noise, known_length=session.mean_length)
        return fitted_covariance([found], session.fitted, session.reached, session.mean_length)

    @property
    def platform_sigma(self) -> RmsMotion | None:
        """The predicted error of the platform; None where readings do not determine its pose."""
        fitted, session = self.session.fitted, self.session
        if session.motion is None:
            return None
        by_parameters = platform_by_parameters(
            fitted.nominal, fitted.parametrization, session.machine.frame_legs, session.reached
        )
        C = written_covariance(session.machine, fitted, self.choices, self.covariance)
        return RmsMotion(*expected_error(by_parameters, C).rms)

    @cached_property
    def parts(self) -> tuple[PartSigma, ...]:
        """What is expected of the parts, with tolerances as priors; () without these."""
        if self.choices.built is None:
            return ()
        return predicted_sigmas(self.session.fitted, self.choices, self.covariance)

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
        known = [Q[:, k:].T / (_EXACT * session.mean_length)]
        if k:
            known.append(np.linalg.solve(S[:k].T, marginal_rows(rows, free).T).T @ Q[:, :k].T)
        return compress(np.concatenate(known))

    @cached_property
    def full(self) -> Ranks:
        """The joint fit."""
        basis = undetermined(self.session, self.information)
        weak = weak_directions(self.session, basis)
        session = self.session
        ties = session.fitted.ties.at(session.legs)
        by_metres = by_step(ties, session.parametrization.place) * session.unit
        n_p = len(session.unit) - len(independent(ties, by_metres)[1])
        return Ranks(n_p - len(weak), n_p, weak)


def _split(session: Session, basis: Array) -> tuple[Array, Array]:
    """Split a space (w, p) into directions that move the platform and harmless ones."""
    return split_by_motion(session.motion, basis, session.mean_length, _HARMLESS)


def undetermined(
    session: Session,
    information: Array,
    sigma: float = _MAX_SIGMA,  # mean leg lengths
) -> Array:
    """Return an orthonormal basis (w, c) of the directions that rows (m, c) do not determine."""
    _, singular, basis = np.linalg.svd(compress(information))
    return np.asarray(basis[singular * sigma * session.mean_length <= 1.0])


def missing(session: Session, rows: Array) -> int:
    """Count the open directions of rows that move the platform."""
    return len(_split(session, undetermined(session, rows))[0])


def weak_directions(
    session: Session,  # where names and units come from
    basis: Array,  # (w, p): the space, in metres
) -> tuple[WeakDirection, ...]:
    """Describe the directions of a space, those that move the platform first."""
    parts = _split(session, basis)
    return tuple(
        _direction(session, row, harmless)
        for part, harmless in zip(parts, (False, True), strict=True)
        for row in sparse_basis(part)
    )


def _direction(session: Session, row: Array, harmless: bool) -> WeakDirection:
    """Describe a direction, scaled to a small largest component."""
    row = row / row[np.argmax(np.abs(row))]
    shown = np.flatnonzero(np.abs(row) > SHOWN)
    shown = shown[np.argsort(-np.abs(row[shown]).round(3), kind="stable")]
    row = row * (_ERROR * session.mean_length)
    names = tuple(session.parametrization.names[i] for i in shown)
    dX_m, dE_rad = None, None
    if session.motion is not None:
        dX_m, dE_rad = moved_by(session.motion, row[:, None]).rms
    return WeakDirection(
        describe_direction(names, session.machine.leg_names),
        names,
        tuple(float((row * session.unit)[i]) for i in shown),
        dX_m,
        dE_rad,
        harmless,
    )


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


# Ranks and weak directions, and the scale
#
# Encoders of arms measure angles: such a machine at twice the size, with rods twice as thick and
# cameras twice as far, gives the same images and readings. A measured length, a board, or radii fix
# the scale; a default prior on radii, or on lines of arms, must not do so silently.


MOST_VIEWS = 50
MOST_IMAGES = 2000  # of a session; more add nothing and take minutes
_VIEWS, _IMAGES = 3, 15  # where none are given
_ROUGH = 0.1  # mean leg lengths: above, a calibration rejects a direction


def answer(
    # A machine as :func:`legcal.machine.loader.load_mechanism` takes it, or a dataset folder or its
    # ``dataset.yaml``
    source: str,
    views: Sequence[Sequence[str]],  # legs of each view; none for a dataset
    images: int | None,  # images a view; None for 15, and for a dataset
    *,
    # calibration board on the base, on the platform; another camera pose for every image
    board: bool = False,
    platform_board: bool = False,
    hand_held: bool = False,
    # earlier result whose errors of outlines are to be expected, of a dataset also its cameras
    noise: Path | None = None,
    only: Group | None = None,  # parts whose tolerances are priors
) -> Identifiability:
    """Return the report on a model with views, or on a dataset.

    Raises UsageError if an option is given for a dataset, or does not fit the model.
    """
    path = Path(source)
    expected = DEFAULT_NOISE if noise is None else read_noise(noise)
    if not (path.name == DATASET_YAML or (path / DATASET_YAML).is_file()):
        return identifiability(
            load_mechanism(source),
            views,
            _IMAGES if images is None else images,
            board=board,
            platform_board=platform_board,
            hand_held=hand_held,
            noise=expected,
            only=only,
        )
    options = {
        "--view": bool(views),
        "--images": images is not None,
        "--board": board,
        "--platform-board": platform_board,
        "--hand-held": hand_held,
    }
    for option in (name for name, is_given in options.items() if is_given):
        raise UsageError(
            f"{source}: the dataset could not be judged with {option}: a dataset has its own views "
            f"and images; leave {option} out, or name a model instead."
        )
    from legcal.data.dataset import load_dataset

    dataset = load_dataset(path, check_images=False)
    if noise is not None:
        dataset = replace(dataset, measurements=_placed_by(noise, dataset.measurements))
    return identifiability_of_dataset(dataset, choices_of(dataset, only=only), expected)


def _placed_by(result: Path, measurements: Measurements) -> Measurements:
    """Return measurements whose cameras stand, where nothing says that, as in an earlier result."""
    found = Result.read(result / "result.json" if result.is_dir() else result).views
    places = {name: view.T_base_camera.motion() for name, view in found.items()}
    views = tuple(
        replace(view, T_base_camera=view.T_base_camera or places.get(view.name))
        for view in measurements.views
    )
    return replace(measurements, views=views)


def identifiability(
    mechanism: Machine,
    views: Sequence[Sequence[str]] = (),
    images: int = 15,
    *,
    board: bool = False,
    hand_held: bool = False,
    platform_board: bool = False,
    noise: PredictedNoise = DEFAULT_NOISE,
    only: Group | None = None,
) -> Identifiability:
    """Judge the identifiability of a mechanism's parameters from planned views.

    Parameters
    ----------
    mechanism : Machine
        The nominal model.
    views : sequence of sequences of str
        Names of the legs visible from each camera position; without any, three positions that show
        all legs are judged. Where cameras should stand is for :func:`legcal.plan` to say.
    images : int
        Images a view, each of another pose.
    board : bool
        A calibration board on the base, visible in every image, relates the cameras.
    platform_board : bool
        A calibration board on the platform, visible in every image, at an unknown pose.
    hand_held : bool
        Hand-held camera: a new camera pose for every image.
    noise : PredictedNoise
        Errors of outlines.
    only : {"zeros", "lengths", "all"}, optional
        Tolerances of the model are priors; say how well these parts will be known.

    Returns
    -------
    Identifiability

    Raises
    ------
    UsageError
        If a view names no leg, an unknown one or one twice, images is not positive, or
        hand-held images are without a board or without views.
    DidNotConverge
        If the machine cannot move inside its travel.

    Notes
    -----
    Counts are the paper's. Ranks are of linearised observations of a machine close to the nominal
    one, with cameras at default places and random poses inside the travel: a direction is
    determined if its predicted standard deviation is less than the mean leg length (angles times
    that length). Well-determined directions lie below a tenth of it, undetermined ones above a
    multiple.
    """
    legs = read_views(views, mechanism.leg_names, images)
    boards = {"board": board, "platform_board": platform_board}
    if hand_held:
        if not board or not legs:
            missing = "no board" if not board else "no views"
            raise UsageError(
                f"Hand-held images could not be judged: found {missing}; the camera poses come "
                "from a calibration board on the base in every image, and the visible legs from "
                "the views; give --board and --view."
            )
        legs, images = tuple(view for view in legs for _ in range(images)), 1
    elif not legs:
        legs = read_views([mechanism.leg_names] * _VIEWS, mechanism.leg_names, images)

    def planned(images: int) -> Session:
        return planned_session(mechanism, legs, images, **boards, hand_held=hand_held)

    choices = Choices.by_tolerances(mechanism, only)
    analysis = Analysis(planned(images), choices, noise=noise)
    return _report_on(analysis, None if hand_held else planned)


def identifiability_of_dataset(
    # images are not read: without outlines every view shows the legs that it names, or all
    dataset: Dataset,
    # fixed parameters, priors, and estimated twists
    choices: Choices = NO_CHOICES,
    noise: PredictedNoise = DEFAULT_NOISE,
) -> Identifiability:
    """Judge the identifiability from the readings, cameras and outlines of a dataset.

    Raises DidNotConverge if the forward kinematics at the readings fail.
    """
    analysis = _analysis_of(dataset, choices)
    session = analysis.session.with_outlines_of(dataset)
    analysis = replace(analysis, session=session, noise=noise)
    report, m, notes = _report_on(analysis, None), dataset.measurements, list[str]()
    unplaced = [m.view_names[v] for v in np.unique(m.view) if m.views[v].T_base_camera is None]
    if unplaced:
        notes.append(
            f"{few_views(unplaced)}: no T_base_camera; assumed where the camera would see the legs."
        )
    if not dataset.machine.is_determined:
        notes.append(
            "The readings do not determine the poses of the images; random poses are used instead."
        )
    return report.model_copy(update={"notes": (*report.notes, *notes)})


def _analysis_of(dataset: Dataset, choices: Choices) -> Analysis:
    chosen = (*choices.free, *choices.priors)
    twists = any(is_held_by_default(name) for name in chosen)
    return Analysis(recorded_session(dataset, twists=twists), choices)


def check_identifiable(
    # every view shows the legs that it names, or all: an optimistic assumption
    dataset: Dataset,
    # fixed parameters and priors
    choices: Choices = NO_CHOICES,
) -> tuple[str, ...]:
    """Return notes on undetermined directions that do not move the platform.

    Raises NotIdentifiable if the joint fit cannot determine a direction that moves the platform.
    """
    # A rank does not depend on errors that edges share, and many images have many of these.
    analysis = replace(_analysis_of(dataset, choices), noise=WHITE)
    full = analysis.full
    is_open = bool(analysis.session.machine.actuators) and is_scale_open(analysis)
    n_harmless = sum(direction.harmless for direction in full.weak)
    if is_open and n_open_with_radii(analysis) <= n_harmless:  # nothing else is open
        raise NotIdentifiable(refusal_of_scale(dataset, analysis))
    if not full.complete:
        raise NotIdentifiable(_refusal(dataset, identifiability_of_dataset(dataset, choices)))
    tied = ties_in_words(dataset.machine)
    notes = [] if tied is None else [tied]
    if full.weak:  # only harmless ones are left
        notes.append(
            f"Undetermined, but without effect on the platform: {_directions(full, harmless=True)}."
        )
    return tuple(notes)


def _report_on(
    analysis: Analysis,
    replanned: Callable[[int], Session] | None,  # as :func:`find_remedies` takes it
) -> Identifiability:
    session, machine = analysis.session, analysis.session.machine
    conditions = tuple(ConditionBlock.of(one, machine.leg_names) for one in conditions_of(session))
    on_platform = np.unique(session.view[np.flatnonzero(session.platform_board)])
    full = analysis.full
    notes = []
    if session.motion is None:
        reason = "the machine is singular at poses inside its travel"
        if not machine.is_determined:
            reason = machine.undetermined
        notes.append(f"Platform errors are not predicted: {reason}.")
    notes += _machine_notes(machine)
    if full.complete:
        notes += _rough_notes(analysis)
        if analysis.noise is DEFAULT_NOISE and session.motion is not None:
            notes.append(
                f"Errors of outlines are {DEFAULT_NOISE.source}; --noise RESULT takes those of an "
                "earlier result."
            )
    notes += sigmas_in_words(analysis.parts)
    return Identifiability(
        spatial=machine.spatial,
        legs=machine.leg_names,
        n=machine.n_legs,
        n_d=len(machine.frame_legs),
        r=sum(leg.base_joint is JointType.REVOLUTE for leg in machine.legs),
        n_ac=int(session.with_length.sum()),
        conditions=conditions,
        full=full,
        identifiable=full.complete,
        views=tuple(tuple(session.machine.leg_names[j] for j in view) for view in session.views),
        images=tuple(int((session.view == v).sum()) for v in range(session.n_views)),
        board=bool(session.board.all()),
        platform_board=len(on_platform) == session.n_views,
        platform_sigma=analysis.platform_sigma if full.complete else None,
        remedies=() if full.complete else find_remedies(analysis, replanned),
        notes=tuple(notes),
        scale_is_open=bool(machine.actuators) and is_scale_open(analysis),
        parts=analysis.parts or None,
        paper=PaperBlock(ok=not any(condition.fails for condition in conditions)),
    )


def _rough_notes(analysis: Analysis) -> list[str]:
    """Note on directions so uncertain that calibrate may reject the dataset."""
    session = analysis.session
    rough = undetermined(session, analysis.information, _ROUGH)
    harmful = [w for w in weak_directions(session, rough) if not w.harmless]
    if not harmful:
        return []
    direction = min((weak.direction for weak in harmful), key=len)
    others = f" and {len(harmful) - 1} more" if len(harmful) > 1 else ""
    known = f"{1e3 * _ROUGH * session.mean_length:.0f} mm (a tenth of a leg, 1 sigma)"
    return [
        f"calibrate may reject this dataset: the predicted uncertainty of {direction}{others} "
        f"exceeds {known}. Add images from other directions, or at poses that differ more."
    ]


def _machine_notes(machine: Machine) -> list[str]:
    notes = []
    if machine.unseen_legs:
        which = legs_in_words(machine.unseen_legs, machine.leg_names)
        notes.append(
            f"The model has no <visual> cylinder along {which}: visible cylinders with a radius of "
            f"{100 * THIN:g} % of the mean leg length are assumed; add one to each."
        )
    tied = ties_in_words(machine)
    notes += [] if tied is None else [tied]
    singular = singularity_note(machine)
    return notes if singular is None else [*notes, singular[0].upper() + singular[1:]]


def conditions_of(session: Session) -> tuple[Condition, ...]:
    """Return the paper's conditions for a session.

    Counts are by views, as printed. Views of a board count as one frame for the directions of a
    leg.
    """
    image, leg = session.seen[session.view].nonzero()
    spatial = session.machine.spatial
    counts = count_conditions(
        session.views,
        session.n_legs,
        spatial=spatial,
        revolute=[j for j, x in enumerate(session.legs) if x.base_joint is JointType.REVOLUTE],
        passive=[j for j, has in enumerate(session.with_length) if not has],
        board=bool(session.board.all()),
        actuators=session.on_actuators,
    )
    frame, pose = session.frame[session.view[image]], session.pose[image]
    still = np.flatnonzero(session.carried_by[leg] < 0)
    directions = two_directions(
        frame[still], leg[still], session.u[pose[still], leg[still]], session.n_legs
    )
    standing = tuple(j for j in directions.legs if session.carried_by[j] < 0)
    return (
        *counts,
        replace(directions, ok=not standing, legs=standing),
        three_legs_at_once(session.views, geometries(session.machine), spatial=spatial),
    )


def read_views(
    # Names of the legs visible from each camera position, or their numbers as reports show them
    views: Sequence[Sequence[str]],
    leg_names: Sequence[str],
    images: int,  # number of images a view
) -> tuple[tuple[int, ...], ...]:
    """Return the legs of each view as indices.

    Raises UsageError with one sentence for each problem.
    """
    problems, known = [], list[list[str]]()
    name_of = {label: name for name, label in leg_labels(leg_names).items()}
    if images < 1:
        problems.append(
            f"The views could not be judged: found {images} images a view, needed at least 1; "
            "pass --images 15 or leave it out."
        )
    if len(views) > MOST_VIEWS:
        raise UsageError(
            f"The views could not be judged: found {len(views)} of them, needed at most "
            f"{MOST_VIEWS}; leave out views of the same legs."
        )
    if images * max(len(views), 1) > MOST_IMAGES:
        problems.append(
            f"The views could not be judged: found {images} images a view, needed at most "
            f"{MOST_IMAGES} in all views together; pass fewer --images."
        )
    for v, view in enumerate(views, start=1):
        if isinstance(view, str):
            problems.append(
                f"View {v} could not be used: found the text '{view}', needed a sequence of leg "
                "names; pass one list of names a view."
            )
            continue
        names = [str(name).strip() for name in view]
        names = [name if name in leg_names else name_of.get(name, name) for name in names]
        known.append(names)
        if not any(names):
            problems.append(
                f"View {v} could not be used: found no leg, needed at least one; name its legs, "
                f"such as --view {','.join(leg_names[:3])}."
            )
            continue
        for name in dict.fromkeys(names):
            if name not in leg_names:
                problems.append(
                    f"View {v} could not be used: found '{name}', needed a leg of the model; "
                    f"{closest(name, leg_names)}"
                )
            elif names.count(name) > 1:
                problems.append(
                    f"View {v} could not be used: found leg '{name}' {names.count(name)} times, "
                    "needed every leg at most once; name it once."
                )
    if problems:
        raise UsageError(problems)
    return tuple(tuple(sorted(leg_names.index(name) for name in view)) for view in known)


def _refusal(dataset: Dataset, report: Identifiability) -> str:
    """Describe why a dataset cannot be calibrated, and the remedies."""
    remedies = [remedy.remedy for remedy in report.remedies if remedy.enough]
    if unseen := dataset.machine.unseen_legs:
        names = legs_in_words(unseen, report.legs)
        remedies.insert(0, f"add a <visual> cylinder along {names}: without it, no image shows it")
    remedy = remedies[0] if remedies else "add images of other poses, and of more legs at once"
    return (
        f"{dataset.folder}: the parameters cannot be identified: these views and poses determine "
        f"at most {report.full.rank} of {report.full.of} combinations; undetermined: "
        f"{_directions(report.full, harmless=False)}, which moves the platform; {remedy}, or state "
        "known values with --set."
    )


def _directions(ranks: Ranks, *, harmless: bool) -> str:
    """Describe the simplest undetermined direction, and count them."""
    words = [weak.direction for weak in ranks.weak if weak.harmless == harmless]
    simplest = min(words, key=len)
    if len(words) == 1:
        return simplest
    return f"{len(words)} independent combinations of them, such as {simplest}"


# Remedies: each is tested by computing the ranks again


_MOST_OF_A_KIND = 2
_SEED = 2003  # of a further camera
_MOST_TRIED = 8  # of a kind
_MOST_FIXED = 4  # parameters
_ENOUGH_IMAGES = 15  # a view
_WELL_KNOWN = 4e11  # 1 / mean leg length


def find_remedies(
    analysis: Analysis,  # of the session
    # plans the session with another number of images a view; None for a recorded one
    replanned: Callable[[int], Session] | None,
) -> tuple[Remedy, ...]:
    """Return remedies for undetermined directions.

    Remedies that determine all parameters, else those sufficient for the platform, else those that
    raise a rank.
    """
    n_parameters = analysis.full.of
    _, before = _score(analysis)
    images, more = int(np.bincount(analysis.session.view).min()), list[_Candidate]()
    if replanned is not None and images < _ENOUGH_IMAGES:
        text = f"take {_ENOUGH_IMAGES} images a view instead of {images}"
        more = [(text, replace(analysis, session=replanned(_ENOUGH_IMAGES)), ())]
    kinds: list[Iterable[_Candidate]] = [
        more,
        _further_cameras(analysis),
        _board(analysis),
        _known_parameters(analysis),
    ]
    helpful = tuple(r for kind in kinds for r in _try_kind(kind, before, n_parameters))
    sufficient = tuple(r for r in helpful if r.enough)
    everything = tuple(r for r in sufficient if r.full_rank == n_parameters)
    return everything or sufficient or helpful


# What to do, the analysis with that, and parameters that are known then
_Candidate = tuple[str, Analysis, Sequence[int]]


def _score(analysis: Analysis, known: Sequence[int] = ()) -> tuple[int, int]:
    """Count the open directions with some parameters *known*, and those that move the platform."""
    session = analysis.session
    extra = np.zeros((len(known), len(session.unit)))
    extra[np.arange(len(known)), list(known)] = _WELL_KNOWN / session.mean_length
    rows = np.concatenate([analysis.information, extra])
    return len(undetermined(session, rows)), missing(session, rows)


def _try_kind(kind: Iterable[_Candidate], before: int, n_parameters: int) -> list[Remedy]:
    """Return the first few sufficient candidates of a kind, else the most helpful one."""
    sufficient, helpful = list[Remedy](), list[tuple[int, Remedy]]()
    for tried, (text, changed, known) in enumerate(kind):
        n_open, harmful = _score(changed, known)
        gain = before - harmful
        if gain <= 0:
            continue
        complete = harmful == 0
        remedy = Remedy(text, n_parameters - n_open, complete)
        if complete:
            sufficient.append(remedy)
        else:
            helpful.append((gain, remedy))
        if len(sufficient) == _MOST_OF_A_KIND or tried + 1 >= _MOST_TRIED:
            break
    return sufficient or [r for _, r in sorted(helpful, key=lambda pair: -pair[0])[:1]]


def _further_cameras(analysis: Analysis) -> Iterator[_Candidate]:
    """Yield further camera positions that show weak legs and their neighbours."""
    session, touched = analysis.session, {p for d in _harmful(analysis) for p in d.parameters}
    names = enumerate(session.machine.leg_names)
    weak = {j for j, name in names if any(p.startswith(f"{name}.") for p in touched)}
    ring = legs_around(session)
    largest = max(len(view) for view in session.views)
    for size in sorted({min(k, session.n_legs) for k in (3, 4, largest)}):
        groups = [legs for legs in neighbours(ring, size) if weak & set(legs)]
        groups.sort(key=lambda legs: -len(weak & set(legs)))
        for legs in groups:
            named = legs_in_words(legs, session.machine.leg_names)
            more = replace(analysis, session=_extended(session, legs))
            yield f"add a camera position ({named})", more, ()


def _board(analysis: Analysis) -> Iterator[_Candidate]:
    """Yield a calibration board on the base, and one on the platform."""
    session, links = analysis.session, list[Link]()
    if len(set(session.frame.tolist())) > 1:
        links.append("base")
    if not session.platform_board.any():
        links.append("platform")
    for link in links:
        text = f"put a calibration board on the {link}, visible to every camera"
        yield text, replace(analysis, session=session.with_board(link)), ()


def _known_parameters(analysis: Analysis) -> Iterator[_Candidate]:
    """Yield parameters to measure otherwise and fix: one of each direction, or all of them."""
    names = analysis.session.parametrization.names
    first = list(dict.fromkeys(d.parameters[0] for d in _harmful(analysis)))
    choices: list[tuple[str, ...]] = [(name,) for name in first[:_MOST_FIXED]]
    if 1 < len(first) <= _MOST_FIXED:
        choices.append(tuple(first))
    for which in choices:
        known = [names.index(name) for name in which]
        yield f"fix {list_in_words(which)}", analysis, known


def _harmful(analysis: Analysis) -> list[WeakDirection]:
    return [d for d in analysis.full.weak if not d.harmless]


def _extended(session: Session, legs: Sequence[int]) -> Session:
    """Add a camera with as many images as the first."""
    images = session.pose[session.view == 0]
    new = len(session.t) + np.arange(len(images))
    seen = np.zeros((1, session.n_legs), dtype=np.bool_)
    seen[0, list(legs)] = True
    A, B = (end.mean(axis=0) for end in session.ends)
    rng = np.random.default_rng(_SEED)
    (further,) = default_cameras(A, B, [legs], session.machine.spatial, rng)
    extended = replace(
        session,
        found=None,
        found_edges=None,
        R=np.concatenate([session.R, session.R[images]]),
        t=np.concatenate([session.t, session.t[images]]),
        unread=np.concatenate([session.unread, session.unread[images]]),
        view=np.concatenate([session.view, np.full(len(images), session.n_views)]),
        pose=np.concatenate([session.pose, new]),
        seen=np.concatenate([session.seen, seen]),
        cameras=(*session.cameras, replace(further, name="further")),
        board=np.append(session.board, session.board.all()),
        platform_board=np.append(
            session.platform_board,
            np.full(len(images), session.platform_board.all())[: len(session.platform_board)],
        ),
    )
    found = [
        None if there is None else join_outlines([there, new.choose(new.row >= len(session.view))])
        for there, new in (
            (session.found, extended.outlines),
            (session.found_edges, extended.edges),
        )
    ]
    return replace(extended, found=found[0], found_edges=found[1])
