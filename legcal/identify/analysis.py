"""What a calibration can find out: conditions, ranks, what is missing and what would mend it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from legcal.errors import UsageError
from legcal.identify.board import judge_board
from legcal.identify.conditions import (
    Condition,
    count_conditions,
    three_legs_at_once,
    two_directions,
)
from legcal.identify.identifiability import Identifiability, Paper
from legcal.identify.intrinsics import judge_intrinsics
from legcal.identify.known import known_rows
from legcal.identify.planned import THIN, planned_session
from legcal.identify.ranks import Analysis
from legcal.identify.recommend import Recommendation, recommend
from legcal.identify.remedies import ENOUGH_IMAGES, Replanning, find_remedies
from legcal.identify.session import Session
from legcal.identify.views import read_views
from legcal.identify.words import legs_in_words
from legcal.mechanism.home_travel import NEAR, legs_outside
from legcal.mechanism.model import Mechanism
from legcal.mechanism.notes import singular_note
from legcal.mechanism.parametrization import geometries
from legcal.refinement.choices import NO_CHOICES, Choices

if TYPE_CHECKING:
    from legcal.dataset.folder import Dataset


def identifiability(
    mechanism: Mechanism,
    views: Sequence[Sequence[str]] = (),
    images: int = 15,
    *,
    board: bool = False,
    hand_held: bool = False,
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
    board : bool
        A calibration board on the base is seen in every image and ties the cameras to each other.
    hand_held : bool
        Every image of a view is taken from a place of its own.

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
    Counts are the paper's. Ranks are those of linearised observations of a machine that is nearly
    the nominal one, from cameras in default places and at random poses inside the travel: a
    direction counts as determined if its predicted standard deviation is less than the
    mean leg length (angles count at that length). Well-determined directions lie below a
    tenth of it, undetermined ones above a multiple.
    """
    legs = read_views(views, mechanism.leg_names, images)
    if hand_held:
        return _judge_hand_held(mechanism, legs, images, board=board)
    recommendation = None
    if not legs:
        recommendation = recommend(mechanism, images, board=board)
        names = recommendation[0].views if recommendation else (mechanism.leg_names,)
        legs = read_views(names, mechanism.leg_names, images)
    session = planned_session(mechanism, legs, images, board=board)
    replanning = Replanning(
        lambda more: planned_session(mechanism, legs, more, board=board),
        lambda: recommend(mechanism, max(images, ENOUGH_IMAGES), board=board),
    )
    return _judge(mechanism, Analysis(session), recommendation, replanning)


def _judge_hand_held(
    mechanism: Mechanism, legs: tuple[tuple[int, ...], ...], images: int, *, board: bool
) -> Identifiability:
    """Return the report on images each of which has a place of its own."""
    if not board or not legs:
        found = "no board" if not board else "no views"
        raise UsageError(
            f"Hand-held images could not be judged: found {found}, needed a calibration board on "
            "the base in every image, which alone tells where a hand-held camera was, and the legs "
            "that the images show; give --board and --view."
        )
    each = tuple(view for view in legs for _ in range(images))
    session = planned_session(mechanism, each, 1, board=True)
    return _judge(mechanism, Analysis(session), None, None)


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
    from legcal.identify.recorded import cameras_of, orientations_of, recorded_session

    twists = any(name.endswith(".twist") for name in (*choices.free, *choices.priors))
    session = recorded_session(dataset, twists=twists)
    analysis = Analysis(session, known=known_rows(session, choices))
    report = _judge(dataset.mechanism, analysis, None, None)
    if dataset.axes is None:
        found = judge_intrinsics(analysis, orientations_of(dataset, session), cameras_of(dataset))
        report = replace(report, intrinsics=found)
    if dataset.mechanism.is_determined:
        return report
    note = "The readings do not give the poses of the images: random ones stand for them."
    return replace(report, notes=(*report.notes, note))


def _judge(
    mechanism: Mechanism,
    analysis: Analysis,
    recommendation: tuple[Recommendation, ...] | None,
    replanning: Replanning | None,
) -> Identifiability:
    """Return the report on a session."""
    session = analysis.session
    conditions = conditions_of(mechanism, session)
    board = judge_board(
        analysis,
        *(conditions_of(mechanism, session.with_board(board=b)) for b in (False, True)),
    )
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
        paper=Paper(not any(c.fails for c in conditions)),
        staged=staged,
        full=full,
        identifiable=full.complete,
        steps=analysis.step_ranks,
        views=tuple(tuple(session.leg_names[j] for j in view) for view in session.views),
        images=tuple(int((session.view == v).sum()) for v in range(session.n_views)),
        board=board,
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
    """Return the paper's conditions for a session.

    Counts are those of the views, as printed. Directions of a leg may differ between views that
    show a board: they are known in one frame.
    """
    image, leg = session.seen[session.view].nonzero()
    counts = count_conditions(
        session.views,
        session.n_legs,
        spatial=session.spatial,
        revolute=[j for j, x in enumerate(session.legs) if x.base_joint == "R"],
        passive=[j for j, has in enumerate(session.with_length) if not has],
        board=bool(session.board.all()),
    )
    return (
        *counts,
        two_directions(
            session.frame[session.view[image]],
            leg,
            session.u[session.pose[image], leg],
            session.n_legs,
        ),
        three_legs_at_once(session.views, geometries(mechanism), spatial=session.spatial),
    )
