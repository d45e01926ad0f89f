"""From photographs and readings to a calibrated mechanism: the whole method in one place.

1. Load the dataset; refuse it if its images cannot determine the parameters (section 2).
2. Recognise: the legs are recognised in the images and each view's camera is placed by them.
   Measure: the outlines of the legs are measured near where that has them (section 3.1).
3. Four steps: joint centres, offsets and axes (3.2 to 3.5), where the images suffice.
4. Joint fit of all parameters, started from the nominal model and from the steps.
5. Measure again: all photographs are searched close to that fit and measured with all care, and 4
   is repeated. What outlines are given, the fit of them does not depend on where it began.
   Where outlines show the gamma of a camera that is not given, this is done again with others, up
   to four times.
6. Judge what the platform gains, and write the result.

Held-out images are searched like the others, and not fitted. Phases 2 to 5 work in canonical order;
:meth:`.estimate.Estimate.in_file_order` restores the order of the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import get_args

import numpy as np

from legcal.calibration.board import board_notes, rough_placement, usable_board
from legcal.calibration.diagnosis import NONE_EXPLAINS, Diagnosis, exchanged_legs, notes_beside
from legcal.calibration.documents import Holdout
from legcal.calibration.doubts import MAX_LEFT_OUT, used_share
from legcal.calibration.estimate import (
    TRIAL,
    Estimate,
    fit_outlines,
    measure_again,
    more_views,
    not_found_again,
    shown_near,
)
from legcal.calibration.identify.identifiability import check_identifiable
from legcal.calibration.joint_fit.factors import known_gammas
from legcal.calibration.joint_fit.held_out import compare_held_out
from legcal.calibration.joint_fit.parameter_choices import (
    Choices,
    Group,
    Prior,
    choices_of,
    dataset_parameters,
)
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import DEFAULT_SETTINGS
from legcal.calibration.ordered_dataset import Options, OrderedDataset, order_dataset
from legcal.calibration.result import Calibration
from legcal.calibration.result_folder import Beside, check_overlays, with_overlays, write_result
from legcal.calibration.tuning import TWIST_SIGMA_DEG
from legcal.calibration.verdict import camera_file_notes, judge
from legcal.data.cache import (
    fingerprint,
    note_on_missing_photographs,
    plan_dataset,
    store_outlines,
)
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.dataset_file import Override, listed, overrides_of_call
from legcal.data.image_choice import chosen_images, dataset_at, own_zeros, split_images
from legcal.data.measurements import few_views, image_notes, still_encoders
from legcal.data.reading_units import legs_with_readings
from legcal.errors import (
    Code,
    DatasetError,
    DidNotConverge,
    LegcalError,
    NotIdentifiable,
    NotVisible,
    Problem,
    UsageError,
)
from legcal.files.folder import check_destination, output_path
from legcal.files.quantity import SHOWN_IN
from legcal.geometry.types import BoolArray, IntArray
from legcal.machine.leg import ParameterId
from legcal.paper.criteria import Criteria
from legcal.perception.diagnostics import hint_notes, is_measurable
from legcal.perception.photographs import (
    MeasuredImages,
    detection_settings,
    given_outlines,
    place_and_measure,
)
from legcal.progress import Progress, shown_progress
from legcal.vision.camera import stated_covariances
from legcal.workers import Workers, worker_pool

_TEETH, _UNLIKELY = 5, 60.0  # hypotheses that are fitted, and evidence against them at most
_GUESSES = 3  # horns on another tooth at which images are measured, if those before show no legs
# Share of the outlines of an image, and of a leg, below which a mistake may have lost them
_LEAST_OF_IMAGE, _LEAST_OF_LEG = 0.5, 0.33


def calibrate(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Progress = False,
    criteria: Criteria = "default",
    use_cache: bool = True,
    workers: Workers = 1,
    priors: Mapping[str, tuple[float, float] | str] | Sequence[str] = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    holdout: float | None = None,
    leave_out: str | Sequence[str] = "",
    split: Sequence[str] = (),
    overlays: bool = False,
    only: Group | None = None,
    beside: Beside | None = None,
) -> Calibration:
    """Compute joint positions and offsets of a mechanism from a dataset.

    Parameters
    ----------
    source : path or Dataset
        The dataset folder, or what :func:`legcal.load_dataset` returned.
    output : path, optional
        Write the result folder there: calibrated model, parameters, observations.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    criteria : {"default", "literal"}
        The weights of the four steps: from the covariances of the axes, or all one, as the paper
        has them.
    use_cache : bool
        Use the outlines that an earlier run left beside the dataset, if they still fit. False
        searches the images again; either way the new outlines replace those beside the dataset.
    workers : int, str or executor
        Search the images in that many processes; with more than one, the program that calls this
        must be safe to import (``if __name__ == "__main__":``). Or on a Dask cluster: the address
        of its scheduler, a client, or another object with ``submit``, as executors have it.
    priors : mapping or sequence of str
        Priors: (value, sigma) in SI units or pixels, or text such as ``420±0.1 mm``, by name or
        pattern; or texts that begin with ``NAME=``. These three win over ``dataset.yaml``.
    fixed : sequence of str
        Names or patterns of parameters left at nominal, or ``NAME=VALUE``.
    free : sequence of str
        Names or patterns of parameters to estimate that are fixed otherwise (intrinsics), and of
        radii, twists and intrinsics with a covariance to estimate without a prior.
    holdout : float, optional
        Hold out this fraction of the images, and compare them with the prediction of the fit to the
        others.
    leave_out : str or sequence of str
        Leave these images out of the fit: ``p22``, ``p22..p45`` in the order in which they were
        taken, ``c2`` for a view, ``c2:p22`` where several views have that name; by commas.
    split : sequence of str
        ``MOTOR@IMAGES``: the encoder of that motor, or of ``all``, had another zero in these images
        than in the others, whose zero the model has.
    overlays : bool
        Draw the outlines over every photograph, into ``overlays`` of the result folder.
    only : {"zeros", "lengths", "all"}, optional
        Tolerances of the model or dataset are priors of all parameters, so that few photographs are
        enough for what is worst. This group is estimated; the model keeps nominal values elsewhere.
    beside : callable, optional
        Called as ``beside(calibration, folder)`` when all other files are in the folder that
        becomes the result folder: what it writes there appears with them, or nothing does.

    Returns
    -------
    Calibration
        Look at its ``verdict`` before you use it.

    Raises
    ------
    DatasetError, ModelError, OutOfClass
        If the input is malformed or not covered.
    NotVisible
        If the images do not show the legs.
    NotIdentifiable
        If the observations do not determine the parameters.
    DidNotConverge
        If no solver reached its tolerance. Nothing is written in any of these cases.
    UsageError
        If ``output`` holds something else, or ``priors``, ``fixed`` and ``free`` name what is no
        parameter or contradict each other.
    """
    # 1. Load and identify.
    if criteria not in (*get_args(Criteria), None):
        raise UsageError(f"The criteria are {criteria!r}, needed default or literal; correct them.")
    if output is not None:
        check_destination(output_path(output))
    overrides = overrides_of_call(priors, fixed, free)
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    if overlays:
        check_overlays(dataset, None if output is None else Path(output))
    choices = chosen_parameters(dataset, overrides, only)
    leave_out = ",".join(listed(leave_out))
    left_out = chosen_images(dataset, leave_out) if leave_out else None
    if zeros := own_zeros(dataset, listed(split), left_out):
        dataset = replace(dataset, measurements=replace(dataset.measurements, own_zeros=zeros))
    fitted, held_out = _fitted_and_held_out(dataset, left_out, holdout)
    try:
        identify_notes = check_identifiable(dataset_at(dataset, fitted), choices)
    except DatasetError:  # readings out of reach are refused below, with likely mistakes
        identify_notes = ()
    except NotIdentifiable as error:
        raise _with_notes(error, error.facts, dataset, dataset.table_notes) from None

    # 2 to 5. Recognise, measure, four steps, joint fit, measure again.
    key, missing = outline_key(dataset, choices), note_on_missing_photographs(dataset)
    with shown_progress(progress) as report, worker_pool(workers) as pool:
        use = key if use_cache else ""
        data = order_dataset(dataset, pool, report, fingerprint=use, left_out=left_out)
        options = Options(choices, None if only else criteria)
        dataset = data.dataset
        estimate, turned = estimate_teeth(data, fitted, options)
    cache_notes = _store_outlines(data, estimate, key)
    prediction = _compare_held_out(data, estimate, held_out) if len(held_out) else None

    # 6. Judge and write.
    found, group = estimate.in_file_order(), None
    if only is not None and choices.built is not None:
        from legcal.calibration.only import estimate_group

        group = estimate_group(dataset.machine, found.solution, choices.built, turned, only)
    on_images = notes_beside(
        found.diagnosis, (*found.image_notes, *found.fit_notes), "legcal calibrate"
    )
    here = dataset_at(dataset, fitted)
    corners = None if found.corners is None else found.corners.at(fitted)
    notes = [
        *(one.sentence for one in found.diagnosis),
        *dataset.notes,
        *missing,
        *on_images,
        *choices.notes,
        *identify_notes,
        *cache_notes,
        *found.fitted.unreached_notes(),
        *_own_zero_notes(dataset, found.solution),
        *([f"Left out, as asked: {leave_out}."] if leave_out else ()),
        *board_notes(here, found.solution, corners),
        *found.solution.notes,
        *exact_cameras(dataset, choices),
    ]
    calibration = judge(
        here,
        found.solution,
        found.steps,
        notes,
        corners=corners,
        held_out=prediction,
        diagnosis=found.diagnosis,
        group=group,
    )
    if output is not None:
        drawing = worker_pool(workers if overlays else 1)
        with shown_progress(progress) as report, drawing as pool:
            calibration = write_result(
                with_overlays(calibration) if overlays else calibration,
                Path(output),
                run=pool,
                progress=report,
                beside=beside,
            )
    return calibration


def estimate_teeth(
    data: OrderedDataset, file_rows: IntArray, options: Options
) -> tuple[Estimate, dict[str, float]]:
    """Estimate as :func:`estimate_parameters`, with horns on other teeth where images say so.

    With tolerances as priors, and a spline that the model states. A first estimate leaves the zeros
    open by a tooth and says which horns may be on others. Each of these is fitted with readings
    corrected, so that zeros have their tolerance as prior about there, and the likeliest wins;
    images are searched again. If the first finds no legs in many images, motors are tried a tooth
    further and back, those first with which images agree best, and most outlines win.

    Return also by how much motors stand further than they read [rad].
    """
    machine, built = data.machine, options.choices.built
    if built is None:
        return estimate_parameters(data, file_rows, options), {}
    from legcal.calibration.only import RARE, joint_error, likely_teeth

    # Legs are where the model has them, as well as it is built.
    data = replace(data, joint_error=joint_error(machine, built))
    if machine.spline_teeth is None:
        return estimate_parameters(data, file_rows, options), {}
    step = 2.0 * np.pi / machine.spline_teeth
    wide = replace(built, angles_at_zero=max(step, built.angles_at_zero or 0.0))
    first = replace(options, choices=replace(options.choices, built=wide))
    failure: LegcalError | None = None
    best: tuple[int, Estimate, dict[str, float], bool] | None = None
    for guess in _guesses(data, step):
        try:
            near = estimate_parameters(data.with_zero_offsets(guess), file_rows, first)
        except (NotVisible, NotIdentifiable, DidNotConverge, DatasetError) as error:
            failure = failure or error
            continue
        ranked = likely_teeth(machine, near.solution, built, wide, step)
        likely = [teeth for against, teeth in ranked[:_TEETH] if against < _UNLIKELY]
        fits = list[tuple[float, dict[str, float], Estimate]]()
        for teeth in likely:
            turned = {m: teeth.get(m, 0.0) + guess.get(m, 0.0) for m in {**guess, **teeth}}
            turned = {m: angle for m, angle in turned.items() if angle}
            fitted = data.with_zero_offsets(turned).at(data.rows_of(file_rows))
            placement, board = rough_placement(fitted)
            cameras = near.solution.cameras_in_base(machine.T_base_Rb)
            placement = replace(placement, T_base_camera=cameras)
            try:
                fit = fit_outlines(fitted, near.outlines, placement, board, options)
            except (NotVisible, NotIdentifiable, DidNotConverge, DatasetError) as error:
                failure = failure or error
                continue
            fits.append((fit.solution.quality.cost + 0.5 * RARE * len(turned), turned, fit))
        if not fits:
            continue
        _, turned, fit = min(fits, key=lambda one: one[0])
        o = fit.solution.outlines
        if best is None or o.used.sum() > best[0]:
            found = replace(near, fitted=fit.fitted, solution=fit.solution, steps=fit.steps)
            best = int(o.used.sum()), found, turned, turned != guess
        if len(np.unique(o.row[o.used])) >= (1.0 - MAX_LEFT_OUT) * len(file_rows):
            break
    if best is None:
        assert failure is not None
        raise failure
    _, found, turned, is_elsewhere = best
    if is_elsewhere and len(data.photographs.detect):
        return estimate_parameters(data.with_zero_offsets(turned), file_rows, options), turned
    return found, turned


def _guesses(data: OrderedDataset, step: float) -> Iterator[dict[str, float]]:
    """Yield the horns as they should be, then a few with one a tooth off that images agree with."""
    yield {}
    machine = data.machine
    motors = [machine.legs[j].motor_label for j in machine.motors if machine.legs[j].reads_angle]
    tried = [{motor: side * step} for motor in motors for side in (1.0, -1.0)]
    if len(data.photographs.detect):
        from legcal.calibration.mistake_search import agreement_with_zeros

        shown = agreement_with_zeros(data, tried)
        yield from (tried[k] for k in np.argsort(-np.array(shown), kind="stable")[:_GUESSES])


def estimate_parameters(data: OrderedDataset, file_rows: IntArray, options: Options) -> Estimate:
    """Recognise and measure all images, and fit some of them: phases 2 to 5 of the method.

    A refusal names the likely mistakes of the session before their consequences, and has the notes
    on odd readings and files of photographs that contradict their camera: they may be the cause.

    Raises NotVisible, NotIdentifiable or DidNotConverge, as the phases.
    """
    rows, diagnosed = data.rows_of(file_rows), cache(_diagnosis)
    try:
        try:
            return _estimate(data, rows, options, diagnosed)
        except NotIdentifiable:
            if not data.plan.is_cached:
                raise
        # Outlines that an earlier run left do not always determine the cameras; images do.
        data = replace(data, plan=plan_dataset(data.dataset, ""))
        return _estimate(data, rows, options, diagnosed)
    except (NotVisible, NotIdentifiable, DidNotConverge, DatasetError) as error:
        is_told = isinstance(error, DatasetError) and data.machine.is_redundant  # by the readings
        tried, notes = None if is_told else diagnosed(data), data.dataset.notes
        diagnosis = tried or ()
        is_explained = any(fact.code is Code.BAD_VALUE for fact in error.facts)  # a stated value
        if tried == () and isinstance(error, NotVisible | DidNotConverge) and not is_explained:
            notes = (NONE_EXPLAINS, *notes)
        if not (diagnosis or notes):
            raise
        refused: Sequence[str | Problem] = error.facts
        if diagnosis:
            refused = notes_beside(diagnosis, error.problems, "legcal calibrate")
        said = [*(one.sentence for one in diagnosis), *refused]
        refusal = _with_notes(error, said, data.dataset, notes)
        if diagnosis:
            refusal.diagnosis = tuple(mistake.document() for mistake in diagnosis)
            refusal.consequences = error.facts
        raise refusal from error


def _diagnosis(data: OrderedDataset) -> tuple[Diagnosis, ...] | None:
    """Return the likely mistakes; a session that agrees with itself loads none of the search."""
    from legcal.calibration.mistake_search import diagnose

    return diagnose(data, usable_board(data))


def _with_notes(
    error: LegcalError,
    said: Sequence[str | Problem],
    dataset: Dataset,
    notes: Sequence[str],
) -> LegcalError:
    """Return a refusal beside notes; encoders that stand still come first as its likely cause."""
    motors, q = legs_with_readings(dataset.machine.legs), dataset.measurements.q
    still = still_encoders(dataset.table_path, motors, q[:, list(dataset.machine.motors)])
    causes = still if isinstance(error, NotIdentifiable | NotVisible | DidNotConverge) else []
    refusal = type(error)([*causes, *said])
    refusal.notes = tuple(note for note in notes if note not in causes)
    return refusal


def _estimate(
    data: OrderedDataset,
    rows: IntArray,
    options: Options,
    diagnosed: Callable[[OrderedDataset], tuple[Diagnosis, ...] | None],
) -> Estimate:
    """Go through the phases; images whose outlines are given are not searched.

    Where many images do not show the legs and a mistake explains that, nothing is searched again.
    """
    placement, board = rough_placement(data)
    fitted = data.at(rows)
    # Outlines that are kept were measured with some gamma: others of their camera must be as well.
    kept_gammas = known_gammas(data.photographs.keep, data.measurements)
    photographs = data.photographs.with_gammas(kept_gammas)
    if len(photographs.detect) == 0:  # outlines, or axes, are given
        outlines = given_outlines(photographs)
        edges = data.body_edges
        estimate = fit_outlines(fitted, outlines, placement, board, options, edges=edges)
        return replace(
            estimate,
            image_notes=data.plan.notes,
            fit_notes=_notes_on_images(estimate),
            diagnosis=_wrong_names(estimate)
            or (_leaves_out_many(estimate) and diagnosed(data))
            or (),
        )
    # 2. Recognise, and measure the outlines.
    T_board_camera = None if board is None else board.T_board_camera
    seen = place_and_measure(photographs, placement, data.progress, T_board_camera, in_brief=True)
    seen.placement.require_one()
    other_radii = seen.photographs.machine is not photographs.machine
    if other_radii:
        data = replace(data, machine=seen.photographs.machine)
    data = data.with_poses(seen.free_poses)
    fitted = data.at(rows)
    if options.every_leg and (seen.left_out or seen.placement.unplaced):
        _refuse_too_few(data, rows, seen, options.choices)
    left_out = 1.0 - len(seen.kept(rows)) / len(rows)
    diagnosis = (diagnosed(data) or ()) if left_out > MAX_LEFT_OUT else ()
    # 3 and 4. Four steps and joint fit.
    settings = TRIAL if diagnosis else DEFAULT_SETTINGS
    first = fit_outlines(fitted, seen.outlines, seen.placement, board, options, settings)
    if seen.placement.unplaced and data.machine.is_determined and not diagnosis:
        with suppress(NotVisible, NotIdentifiable, DidNotConverge):  # the others are enough
            more = more_views(data, first, seen, T_board_camera)
            if more is not seen:
                outlines, steps = more.outlines, first.steps
                first = fit_outlines(
                    fitted, outlines, more.placement, board, options, settings, steps=steps
                )
                seen = more
    # 5. Measure again near that fit, and fit again.
    try:
        estimate = first if diagnosis else measure_again(data, first, seen, board, options)
    except (NotVisible, NotIdentifiable, DidNotConverge) as error:
        # A fit with a wrong camera may lead away from outlines that were found before it.
        if not (wrong := first.solution.camera_doubts):
            raise
        cameras = (*map(str, wrong), *camera_file_notes(data.dataset, first.solution))
        raise type(error)([*cameras, *error.facts]) from error
    return replace(
        estimate,
        image_notes=(
            *shown_near(estimate, seen.placement).all_notes(data.measurements),
            *not_found_again(first, estimate),
            *estimate.image_notes,
        ),
        fit_notes=_notes_on_images(estimate),
        other_radii=other_radii,
        diagnosis=diagnosis or (_leaves_out_many(estimate) and diagnosed(data)) or (),
    )


def _wrong_names(estimate: Estimate) -> tuple[Diagnosis, ...]:
    """Return given outlines that the fit has at the place of other legs."""
    solution, m, machine = estimate.solution, estimate.fitted.measurements, estimate.fitted.machine
    placed = solution.placement(machine, m)
    cameras = solution.shown_cameras(m, machine.T_base_Rb)
    ends = placed.A_base, placed.B_base
    return exchanged_legs(solution.outlines, m, solution.legs, ends, cameras)


def _leaves_out_many(estimate: Estimate) -> bool:
    """Whether the fit uses so few outlines that common mistakes are tried.

    A mistake in readings, cameras or the model loses most of some images or legs; stripes of
    reflection lose outlines everywhere.
    """
    o = estimate.solution.outlines
    if used_share(o) >= 1.0 - MAX_LEFT_OUT:
        return False
    shown = o.choose(is_measurable(o))
    images, legs = (
        np.bincount(of, shown.used)[n > 0] / n[n > 0]
        for of, n in ((of, np.bincount(of)) for of in (shown.row, shown.leg))
    )
    return bool(np.mean(images < _LEAST_OF_IMAGE) > MAX_LEFT_OUT or legs.min() < _LEAST_OF_LEG)


def _notes_on_images(estimate: Estimate) -> tuple[str, ...]:
    m = estimate.fitted.measurements
    cameras = estimate.solution.shown_cameras(m, estimate.fitted.machine.T_base_Rb)
    hints = hint_notes(m.views, cameras, by_landmarks=m.clicked_views)
    return (*hints, *image_notes(m, estimate.outliers))


def _refuse_too_few(
    data: OrderedDataset, rows: IntArray, seen: MeasuredImages, choices: Choices
) -> None:
    """Raise NotIdentifiable if the images that are left do not determine the parameters."""
    left, notes = seen.kept(rows), seen.placement.all_notes(data.measurements)
    if not len(left):
        raise NotVisible(list(notes))
    try:
        check_identifiable(data.at(left).in_file_order()[0], choices)
    except NotIdentifiable as failure:
        raise NotIdentifiable([*failure.facts, *notes]) from None


def outline_key(dataset: Dataset, choices: Choices) -> str:
    """Return the fingerprint of everything that outlines of a dataset depend on.

    Images that disagree are searched again near the fit, which depends on the choices.
    """
    zeros = [[one.motor, one.images] for one in dataset.measurements.own_zeros]
    split = {"own_zeros": zeros} if zeros else {}
    return fingerprint(dataset, detection_settings() | choices.document() | split)


def _store_outlines(data: OrderedDataset, estimate: Estimate, key: str) -> list[str]:
    """Leave outlines and notes on images beside the dataset; return a note if that fails."""
    plan = estimate.fitted.plan  # other than that of the data where stored outlines did not suffice
    if estimate.other_radii or estimate.diagnosis or len(plan.detect) == 0:
        return []
    outlines = data.order.restore(estimate.outlines)
    edges = None if estimate.edges is None else data.order.restore(estimate.edges)
    note = store_outlines(data.dataset, outlines, key, plan.given, estimate.image_notes, edges)
    return [note] if note else []


def chosen_parameters(
    dataset: Dataset, overrides: Sequence[Override], only: Group | None = None
) -> Choices:
    """Return the choices of dataset and call for the parameters.

    Twists without an explicit choice get a prior: every leg has an error of its twist, and a twist
    fixed at nominal would bias the others.
    """
    choices = choices_of(dataset, overrides, only)
    twists = {
        name: Prior(parameter.nominal, float(np.radians(TWIST_SIGMA_DEG)))
        for name, parameter in dataset_parameters(dataset).by_name.items()
        if ParameterId.parse(name).kind == "twist"
        and choices.holds(name, by_default=True)
        and name not in choices.fixed
    }
    return replace(choices, priors={**twists, **choices.priors})


def _fitted_and_held_out(
    dataset: Dataset, left_out: BoolArray | None, holdout: float | None
) -> tuple[IntArray, IntArray]:
    rows = np.arange(dataset.measurements.n_rows)
    if left_out is not None:
        rows = rows[~left_out]
        fitted, held_out = _fitted_and_held_out(dataset_at(dataset, rows), None, holdout)
        return rows[fitted], rows[held_out]
    if holdout is None:
        return rows, rows[:0]
    if not dataset.machine.is_determined:
        raise UsageError(
            f"{dataset.folder}: --holdout needs readings that determine the pose of an image, but "
            f"{dataset.machine.undetermined}; leave it out."
        )
    return split_images(dataset, holdout)


def _compare_held_out(data: OrderedDataset, estimate: Estimate, file_rows: IntArray) -> Holdout:
    held_out, solution = data.at(data.rows_of(file_rows)), estimate.solution
    outlines, poses = held_out.of_used_legs(estimate.outlines), held_out.poses_by(solution.legs)
    return compare_held_out(solution.posterior, held_out.measurements, outlines, poses)


def _own_zero_notes(dataset: Dataset, solution: Solution) -> list[str]:
    posterior, notes = solution.posterior, list[str]()
    sigma = np.sqrt(np.diagonal(posterior.covariance)[posterior.problem.where("own_zeros")])
    values, errors = posterior.state.own_zeros.tolist(), sigma.tolist()
    unit_of = {leg.motor_label: leg.reading_unit for leg in dataset.machine.legs}
    for k, of in enumerate(dataset.measurements.own_zeros):
        scale, unit = SHOWN_IN[unit_of[of.motor]]
        if not posterior.problem.readings.by_zero[:, k].any():
            notes.append(
                f"In {of.images} the zero of the encoder of {of.motor} is not known: all of them "
                "are kept aside; keep others aside (--holdout)."
            )
            continue
        notes.append(
            f"In {of.images} the zero of the encoder of {of.motor} is {scale * values[k]:+.4f} ± "
            f"{scale * errors[k]:.4f} {unit} from that of the other images, which the model has."
        )
    return notes


def exact_cameras(dataset: Dataset, choices: Choices) -> list[str]:
    """Return a note on cameras taken as exact because no covariance is stated."""
    m = dataset.measurements
    stated = (*choices.free, *choices.priors, *choices.fixed)
    chosen = {ParameterId.parse(name).owner for name in stated}
    known = {*chosen, *stated_covariances(m.view_names, m.cameras)}
    owner_of = dict(zip(m.view_names, m.owners, strict=True))
    exact = {name: owner for name, owner in owner_of.items() if owner not in known}
    if not exact:
        return []
    whose, state = "camera", "its file states"
    if len(set(exact.values())) > 1:
        whose, state = "cameras", "their camera files state"
    return [
        f"The intrinsics of the {whose} of {few_views(list(exact))} are taken as exact, because "
        f"{state} no covariance; calibrate with legcal camera, or add a prior (--set)."
    ]
