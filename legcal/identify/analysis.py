"""What a calibration can find out: conditions, ranks, what is missing and what would mend it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from legcal.geometry.types import Array
from legcal.identify.conditions import (
    Condition,
    count_conditions,
    three_legs_at_once,
    two_directions,
)
from legcal.identify.known import known_rows
from legcal.identify.planned import THIN, planned_session
from legcal.identify.ranks import Analysis, StepRank
from legcal.identify.recommend import Recommendation, recommend
from legcal.identify.remedies import ENOUGH_IMAGES, Remedy, Replanning, find_remedies
from legcal.identify.session import Session
from legcal.identify.views import read_views
from legcal.identify.weak import PlatformError, Ranks
from legcal.identify.words import legs_in_words
from legcal.mechanism.home_travel import NEAR, legs_outside
from legcal.mechanism.model import Mechanism
from legcal.mechanism.notes import singular_note
from legcal.mechanism.parametrization import geometries
from legcal.refinement.choices import NO_CHOICES, Choices

if TYPE_CHECKING:
    from legcal.dataset.folder import Dataset


@dataclass(frozen=True)
class Paper:
    """What the paper's conditions say together.

    Attributes
    ----------
    ok : bool
        Whether all of them hold.
    """

    ok: bool


@dataclass(frozen=True)
class Identifiability:
    """An identifiability report.

    Attributes
    ----------
    spatial : bool
        Whether the platform moves in space and not in a plane.
    legs : tuple of str
        Their names.
    n, n_d, r, n_ac : int
        Legs; joint centres that define a frame; legs with a revolute joint at the base; legs whose
        length is measured or constant.
    conditions : tuple of Condition
        The paper's, as printed.
    paper : Paper
        All of them together.
    staged, full : Ranks
        The four default steps, and everything at once.
    identifiable : bool
        Whether everything at once determines all directions that move the platform.
    steps : tuple of StepRank
        Each step, by legcal's criteria and by the printed ones.
    views : tuple of tuples of str
        The legs that each view shows.
    images : tuple of int
        Number of images of each view.
    platform_sigma : PlatformError or None
        Standard deviation of the platform that is to be expected from outlines good to 0.1 px,
        rms over the poses. None where something that moves the platform is not determined, or the
        motors do not determine its pose.
    remedies : tuple of Remedy
        What would mend what is missing; each was tried.
    recommendation : tuple of Recommendation or None
        The smallest sets of views, fewest first; None where views were given.
    notes : tuple of str
        What the reader should know.
    """

    spatial: bool
    legs: tuple[str, ...]
    n: int
    n_d: int
    r: int
    n_ac: int
    conditions: tuple[Condition, ...]
    paper: Paper
    staged: Ranks
    full: Ranks
    identifiable: bool
    steps: tuple[StepRank, ...]
    views: tuple[tuple[str, ...], ...]
    images: tuple[int, ...]
    platform_sigma: PlatformError | None
    remedies: tuple[Remedy, ...]
    recommendation: tuple[Recommendation, ...] | None
    notes: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the report as plain JSON types; see the documentation of the files."""
        document = asdict(self)
        document["conditions"] = [_condition(c, self.legs) for c in self.conditions]
        return {key: _plain(value) for key, value in document.items()}


def identifiability(
    mechanism: Mechanism, views: Sequence[Sequence[str]] = (), images: int = 15
) -> Identifiability:
    """Judge what images of some views can tell of a mechanism's parameters.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal model.
    views : sequence of sequences of str
        Names of the legs that each camera position shows; without any, the smallest sets of
        views that suffice are recommended and the first of them is judged.
    images : int
        Images a view, each of another pose.

    Returns
    -------
    Identifiability

    Raises
    ------
    UsageError
        If a view names no leg, an unknown one or one twice, or images is not positive.
    DidNotConverge
        If the machine cannot move inside its travel.

    Notes
    -----
    Counts are the paper's. Ranks are those of linearised observations of a machine that is nearly
    the nominal one, from cameras in default places and at random poses inside the travel: a
    direction counts as determined if its predicted standard deviation is less than the
    mean leg length (angles count at that length). Well-determined directions lie below a
    tenth of it, undetermined ones above a multiple.
    """
    legs = read_views(views, mechanism.leg_names, images)
    recommendation = None
    if not legs:
        recommendation = recommend(mechanism, images)
        names = recommendation[0].views if recommendation else (mechanism.leg_names,)
        legs = read_views(names, mechanism.leg_names, images)
    session = planned_session(mechanism, legs, images)
    replanning = Replanning(
        lambda more: planned_session(mechanism, legs, more),
        lambda: recommend(mechanism, max(images, ENOUGH_IMAGES)),
    )
    return _judge(mechanism, session, recommendation, replanning)


def identifiability_of_dataset(dataset: Dataset, choices: Choices = NO_CHOICES) -> Identifiability:
    """Judge what a dataset can tell: its readings, its cameras and the legs of its views.

    Parameters
    ----------
    dataset : Dataset
        Nothing is detected: every view is taken to show the legs that it names, or all.
    choices : Choices
        Parameters that are fixed or known from elsewhere, and twists that are looked for.

    Raises
    ------
    DidNotConverge
        If the readings do not lead to closed poses.
    """
    from legcal.identify.recorded import recorded_session

    twists = any(name.endswith(".twist") for name in (*choices.free, *choices.priors))
    session = recorded_session(dataset, twists=twists)
    report = _judge(dataset.mechanism, session, None, None, known_rows(session, choices))
    if dataset.mechanism.is_determined:
        return report
    note = "The readings do not give the poses of the images: random ones stand for them."
    return replace(report, notes=(*report.notes, note))


def _judge(
    mechanism: Mechanism,
    session: Session,
    recommendation: tuple[Recommendation, ...] | None,
    replanning: Replanning | None,
    known: Array | None = None,
) -> Identifiability:
    """Return the report on a session."""
    analysis = Analysis(session, known=known)
    conditions = conditions_of(mechanism, session)
    staged, full = analysis.staged, analysis.full
    enough = staged.complete and full.complete
    notes = []
    if analysis.motion.why_not:
        why = "the machine is singular at poses inside its travel"
        if not mechanism.is_determined:
            why = (
                f"{len(mechanism.motors)} motors do not determine the pose of a platform with "
                f"mobility {mechanism.mobility}"
            )
        notes.append(f"Platform errors are not predicted: {why}.")
    notes += _machine_notes(mechanism)
    return Identifiability(
        spatial=mechanism.spatial,
        legs=mechanism.leg_names,
        n=mechanism.n_legs,
        n_d=len(mechanism.frame_legs),
        r=sum(leg.base_joint == "R" for leg in mechanism.legs),
        n_ac=int(session.with_length.sum()),
        conditions=conditions,
        paper=Paper(all(c.ok for c in conditions)),
        staged=staged,
        full=full,
        identifiable=full.complete,
        steps=analysis.step_ranks,
        views=tuple(tuple(session.leg_names[j] for j in view) for view in session.views),
        images=tuple(int((session.view == v).sum()) for v in range(session.n_views)),
        platform_sigma=analysis.motion.sigma(analysis.information) if full.complete else None,
        remedies=() if enough else find_remedies(analysis, replanning),
        recommendation=recommendation,
        notes=tuple(notes),
    )


def _machine_notes(mechanism: Mechanism) -> list[str]:
    """Return what is odd about a machine, whatever views show of it."""
    hidden = [j for j, leg in enumerate(mechanism.legs) if not leg.cylinders]
    notes = []
    if hidden:
        which = legs_in_words(hidden, mechanism.leg_names)
        notes.append(
            f"The model has no <visual> cylinder along {which}: they were taken as visible, with "
            f"{100 * THIN:g} % of the mean leg length as radius; add one to each."
        )
    outside = list(legs_outside(mechanism, NEAR))
    if outside:
        which = legs_in_words(outside, mechanism.leg_names)
        stand = "stand outside their" if len(outside) > 1 else "stands outside its"
        notes.append(
            f"At home {which} {stand} travel by more than {100 * NEAR:g} % of it: poses between "
            "home and travel were judged too, which the machine may not reach; correct "
            "legcal.home or the limits."
        )
    singular = singular_note(mechanism)
    return notes if singular is None else [*notes, singular[0].upper() + singular[1:]]


def conditions_of(mechanism: Mechanism, session: Session) -> tuple[Condition, ...]:
    """Return the paper's conditions for a session."""
    image, leg = session.seen[session.view].nonzero()
    return (
        *count_conditions(
            session.views,
            session.n_legs,
            spatial=session.spatial,
            revolute=[j for j, x in enumerate(session.legs) if x.base_joint == "R"],
            passive=[j for j, has in enumerate(session.with_length) if not has],
        ),
        two_directions(
            session.view[image], leg, session.u[session.pose[image], leg], session.n_legs
        ),
        three_legs_at_once(session.views, geometries(mechanism), spatial=session.spatial),
    )


def _condition(condition: Condition, legs: Sequence[str]) -> dict[str, Any]:
    """Return a condition as a document: a count with its numbers, or the legs that fail it."""
    document: dict[str, Any] = {"name": condition.name, "ok": condition.ok}
    if condition.equations is not None:
        document |= {"equations": condition.equations, "unknowns": condition.unknowns}
    else:
        document["failing"] = [legs[j] for j in condition.legs]
    return document


def _plain(value: Any) -> Any:
    """Return tuples as lists, all the way down."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(inner) for inner in value]
    return value
