"""Whether planned views, or a dataset, can determine the parameters: ``legcal identify``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.identify.information import expected_intrinsics
from legcal.calibration.identify.predicted_observations import (
    THIN,
    PredictedObservations,
    cameras_of,
    legs_in_words,
    orientations_of,
    planned_observations,
    recorded_observations,
)
from legcal.calibration.identify.ranks import Analysis, undetermined, weak_directions
from legcal.calibration.identify.remedies import (
    ENOUGH_IMAGES,
    Replanning,
    find_remedies,
    judge_board,
    recommend,
)
from legcal.calibration.identify.report import Identifiability, Ranks, Recommendation
from legcal.calibration.identify.scale import is_scale_open, refusal_of_scale, scale_sources
from legcal.calibration.joint_fit.parameter_choices import (
    NO_CHOICES,
    Choices,
    known_parameters,
    resolve,
)
from legcal.data.dataset import Dataset
from legcal.errors import NotIdentifiable, UsageError
from legcal.files.schema import closest
from legcal.machine.diagnostics import singularity_note
from legcal.machine.files import DATASET_YAML
from legcal.machine.home import legs_outside
from legcal.machine.leg import TRAVEL_MARGIN, JointType
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, is_held_by_default
from legcal.machine.ties import ties_in_words
from legcal.paper.conditions import (
    Condition,
    count_conditions,
    enough_readings,
    three_legs_at_once,
    two_directions,
)

MOST_VIEWS = 50
MOST_IMAGES = 2000  # of a session; more says nothing new and takes minutes
_IMAGES = 15
_ROUGH = 0.1  # mean leg lengths: calibrations do not accept directions known to no better


def answer(
    # A machine as :func:`legcal.machine.loader.load_mechanism` takes it, or a dataset folder or its
    # ``dataset.yaml``
    source: str,
    views: Sequence[Sequence[str]],  # legs of each view; none for a dataset
    images: int | None,  # images a view; None for 15, and for a dataset
    *,
    # board, platform_board, hand_held: whether there is a calibration board on the base, one on the
    # platform, and whether every image has a place of its own
    board: bool = False,
    platform_board: bool = False,
    hand_held: bool = False,
) -> Identifiability:
    """Return the report on a model with views, or on a dataset.

    Raises UsageError if any of these is given for a dataset, or does not fit the model.
    """
    path = Path(source)
    if not (path.name == DATASET_YAML or (path / DATASET_YAML).is_file()):
        return identifiability(
            load_mechanism(source),
            views,
            _IMAGES if images is None else images,
            board=board,
            platform_board=platform_board,
            hand_held=hand_held,
        )
    given = {
        "--view": bool(views),
        "--images": images is not None,
        "--board": board,
        "--platform-board": platform_board,
        "--hand-held": hand_held,
    }
    for option in (name for name, is_given in given.items() if is_given):
        raise UsageError(
            f"{source}: the dataset could not be judged with {option}: found a dataset, which has "
            f"its own views and images, needed a model for that; leave {option} out, or name the "
            "model."
        )
    from legcal.data.dataset import load_dataset

    dataset = load_dataset(path, check_images=False)
    known = known_parameters(
        dataset.machine,
        dataset.measurements.views,
        axes_given=dataset.axes is not None,
        boards=dataset.boards,
    )
    return identifiability_of_dataset(dataset, resolve(dataset.overrides, known))


def identifiability(
    mechanism: Machine,
    views: Sequence[Sequence[str]] = (),
    images: int = 15,
    *,
    board: bool = False,
    hand_held: bool = False,
    platform_board: bool = False,
) -> Identifiability:
    """Judge what images of some views determine of a mechanism's parameters.

    Parameters
    ----------
    mechanism : Machine
        The nominal model.
    views : sequence of sequences of str
        Names of the legs that each camera position shows; without any, the smallest sets of
        views that suffice are recommended and the first of them is judged.
    images : int
        Images a view, each of another pose.
    board : bool
        A calibration board on the base is seen in every image and ties the cameras to each other.
    platform_board : bool
        A calibration board on the platform is seen in every image; where it is fixed is unknown.
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
        return _judge_hand_held(mechanism, legs, images, board=board, platform_board=platform_board)
    recommendation = None
    boards = {"board": board, "platform_board": platform_board}
    if not legs:
        recommendation = recommend(mechanism, images, **boards)
        names = recommendation[0].views if recommendation else (mechanism.leg_names,)
        legs = read_views(names, mechanism.leg_names, images)
    predicted = planned_observations(mechanism, legs, images, **boards)
    replanning = Replanning(
        lambda more: planned_observations(mechanism, legs, more, **boards),
        lambda: recommend(mechanism, max(images, ENOUGH_IMAGES), **boards),
    )
    return _judge(mechanism, Analysis(predicted), recommendation, replanning)


def identifiability_of_dataset(
    # nothing is detected: every view is taken to show the legs that it names, or all
    dataset: Dataset,
    # parameters that are fixed or known from elsewhere, and twists that are looked for
    choices: Choices = NO_CHOICES,
) -> Identifiability:
    """Judge what a dataset determines: its readings, its cameras and the legs of its views.

    Raises DidNotConverge if the readings do not lead to closed poses.
    """
    analysis = _analysis_of(dataset, choices)
    predicted, report = analysis.predicted, _judge(dataset.machine, analysis, None, None)
    if dataset.axes is None:
        found = expected_intrinsics(
            predicted,
            analysis.images,
            analysis.equations,
            analysis.prior,
            orientations_of(dataset, predicted),
            cameras_of(dataset),
            analysis.arms,
        )
        report = replace(report, intrinsics=found)
    if dataset.machine.is_determined:
        return report
    note = "The readings do not give the poses of the images: random ones stand for them."
    return replace(report, notes=(*report.notes, note))


def ranks_of_dataset(
    dataset: Dataset, choices: Choices = NO_CHOICES
) -> tuple[tuple[Condition, ...], Ranks]:
    """Return the paper's conditions, and the rank of the joint fit, of what a dataset records.

    They are those of :func:`identifiability_of_dataset`, without what would change them.
    """
    analysis = _analysis_of(dataset, choices)
    return conditions_of(dataset.machine, analysis.predicted), analysis.full


def _analysis_of(dataset: Dataset, choices: Choices) -> Analysis:
    """Return the analysis of what a dataset records."""
    chosen = (*choices.free, *choices.priors)
    twists = any(is_held_by_default(name) for name in chosen)
    return Analysis(recorded_observations(dataset, twists=twists), choices)


def check_identifiable(
    # its views are taken to show the legs that they name, or all: what even then stays open cannot
    # be found
    dataset: Dataset,
    # parameters that are fixed or known from elsewhere: they are no longer open
    choices: Choices = NO_CHOICES,
) -> tuple[str, ...]:
    """Return what a dataset leaves open that does no harm, one sentence each.

    Raises NotIdentifiable if a direction that moves the platform is not determined by everything at
    once.
    """
    analysis = _analysis_of(dataset, choices)
    full = analysis.full
    if not full.complete:
        raise NotIdentifiable(_refusal(dataset, identifiability_of_dataset(dataset, choices)))
    if analysis.predicted.actuators and is_scale_open(analysis):
        raise NotIdentifiable(refusal_of_scale(dataset, analysis))
    tied = ties_in_words(dataset.machine)
    notes = [] if tied is None else [tied]
    if full.weak:  # what is left is harmless
        notes.append(
            "Not determined, and without effect on the platform: "
            f"{_directions(full, harmless=True)}."
        )
    return tuple(notes)


def _judge_hand_held(
    machine: Machine,
    legs: tuple[tuple[int, ...], ...],
    images: int,
    *,
    board: bool,
    platform_board: bool,
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
    predicted = planned_observations(machine, each, 1, board=True, platform_board=platform_board)
    return _judge(machine, Analysis(predicted), None, None)


def _judge(
    machine: Machine,
    analysis: Analysis,
    recommendation: tuple[Recommendation, ...] | None,
    replanning: Replanning | None,
) -> Identifiability:
    """Return the report on a session."""
    predicted = analysis.predicted
    conditions = conditions_of(machine, predicted)
    board = judge_board(
        analysis,
        *(conditions_of(machine, predicted.with_board(board=b)) for b in (False, True)),
    )
    platform_board = judge_board(analysis, (), (), link="platform")
    full = analysis.full
    notes = []
    if analysis.motion.why_not:
        why = "the machine is singular at poses inside its travel"
        if not machine.is_determined:
            why = machine.undetermined
        notes.append(f"Platform errors are not predicted: {why}.")
    notes += _machine_notes(machine)
    if full.complete:
        notes += _rough_notes(analysis)
    return Identifiability(
        spatial=machine.spatial,
        legs=machine.leg_names,
        n=machine.n_legs,
        n_d=len(machine.frame_legs),
        r=sum(leg.base_joint is JointType.REVOLUTE for leg in machine.legs),
        n_ac=int(predicted.with_length.sum()),
        conditions=conditions,
        full=full,
        identifiable=full.complete,
        views=tuple(tuple(predicted.leg_names[j] for j in view) for view in predicted.views),
        images=tuple(int((predicted.view == v).sum()) for v in range(predicted.n_views)),
        board=board,
        platform_board=platform_board,
        platform_sigma=analysis.motion.sigma(analysis.information) if full.complete else None,
        remedies=() if full.complete else find_remedies(analysis, replanning),
        recommendation=recommendation,
        notes=tuple(notes),
        scale=scale_sources(analysis),
    )


def _rough_notes(analysis: Analysis) -> list[str]:
    """Return which directions are determined so roughly that a fit may be refused."""
    predicted, motion = analysis.predicted, analysis.motion
    rough = undetermined(predicted, analysis.information, _ROUGH)
    found = [w for w in weak_directions(predicted, motion, rough) if not w.harmless]
    if not found:
        return []
    words = min((weak.direction for weak in found), key=len)
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    known = f"{1e3 * _ROUGH * predicted.mean_length:.0f} mm (a tenth of a leg, 1 sigma)"
    return [
        f"calibrate may refuse this dataset: outlines good to 0.1 px determine {words}{more} no "
        f"better than {known}. Add images from other directions, or at poses that differ more."
    ]


def _machine_notes(machine: Machine) -> list[str]:
    """Return what is odd about a machine, whatever views show of it."""
    hidden = [j for j, leg in enumerate(machine.legs) if not leg.cylinders]
    notes = []
    if hidden:
        which = legs_in_words(hidden, machine.leg_names)
        notes.append(
            f"The model has no <visual> cylinder along {which}: they were taken as visible, with "
            f"{100 * THIN:g} % of the mean leg length as radius; add one to each."
        )
    outside = list(legs_outside(machine, TRAVEL_MARGIN))
    if outside:
        which = legs_in_words(outside, machine.leg_names)
        stand = "stand outside their" if len(outside) > 1 else "stands outside its"
        notes.append(
            f"At home {which} {stand} travel by more than {100 * TRAVEL_MARGIN:g} % of it: "
            "poses between home and travel were judged too, which the machine may not reach; "
            "correct legcal.home or the limits."
        )
    tied = ties_in_words(machine)
    notes += [] if tied is None else [tied]
    singular = singularity_note(machine)
    return notes if singular is None else [*notes, singular[0].upper() + singular[1:]]


def conditions_of(machine: Machine, predicted: PredictedObservations) -> tuple[Condition, ...]:
    """Return the paper's conditions for a session.

    Counts are those of the views, as printed. Directions of a leg may differ between views that
    show a board: they are known in one frame.
    """
    image, leg = predicted.seen[predicted.view].nonzero()
    counts = count_conditions(
        predicted.views,
        predicted.n_legs,
        spatial=predicted.spatial,
        revolute=[j for j, x in enumerate(predicted.legs) if x.base_joint is JointType.REVOLUTE],
        passive=[j for j, has in enumerate(predicted.with_length) if not has],
        board=bool(predicted.board.all()),
        actuators=predicted.on_actuators,
    )
    frame, pose = predicted.frame[predicted.view[image]], predicted.pose[image]
    moves = predicted.carried_by[leg] >= 0
    still, rods = np.flatnonzero(~moves), np.flatnonzero(moves)
    q = predicted.q[pose[rods], predicted.carried_by[leg[rods]]]
    directions = two_directions(
        frame[still], leg[still], predicted.u[pose[still], leg[still]], predicted.n_legs
    )
    standing = tuple(j for j in directions.legs if predicted.carried_by[j] < 0)
    return (
        *counts,
        replace(directions, ok=not standing, legs=standing),
        *enough_readings(frame[rods], leg[rods], q, predicted.legs),
        three_legs_at_once(predicted.views, geometries(machine), spatial=predicted.spatial),
    )


def read_views(
    views: Sequence[Sequence[str]],  # names of the legs that each camera position shows
    leg_names: Sequence[str],
    images: int,  # number of images a view
) -> tuple[tuple[int, ...], ...]:
    """Return the legs of each view as indices.

    Raises UsageError with one sentence for each thing that is wrong.
    """
    problems = []
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
        unnamed = [name for name in view if not isinstance(name, str)]
        if unnamed:
            problems.append(
                f"View {v} could not be used: found {unnamed[0]!r}, needed names of legs; pass "
                "texts."
            )
            continue
        names = [name.strip() for name in view]
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
    return tuple(tuple(sorted(leg_names.index(name.strip()) for name in view)) for view in views)


def _refusal(dataset: Dataset, report: Identifiability) -> str:
    """Return why a dataset cannot be calibrated, and the remedies."""
    remedies = [remedy.remedy for remedy in report.remedies if remedy.enough]
    unseen = [leg.name for leg in dataset.machine.legs if not leg.cylinders]
    if unseen and dataset.axes is None:
        names = legs_in_words([dataset.machine.leg_names.index(n) for n in unseen], report.legs)
        remedies.insert(0, f"add a <visual> cylinder along {names}, which no image shows without")
    remedy = remedies[0] if remedies else "add images of other poses, and of more legs at once"
    return (
        f"{dataset.folder}: the parameters cannot be identified: found that these views and poses "
        f"determine {report.full.rank} of {report.full.of} at best and leave open "
        f"{_directions(report.full, harmless=False)}, needed everything that moves the platform; "
        f"{remedy}, or state what is known of them with --set."
    )


def _directions(ranks: Ranks, *, harmless: bool) -> str:
    """Return the simplest direction that stays open, in words, and how many there are."""
    words = [weak.direction for weak in ranks.weak if weak.harmless == harmless]
    simplest = min(words, key=len)
    if len(words) == 1:
        return simplest
    return f"{len(words)} independent changes of them, such as {simplest}"
