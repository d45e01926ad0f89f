"""From photographs and readings to a calibrated mechanism: the whole method in one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.board import board_notes
from legcal.calibration.fitting import Found, observe_and_fit
from legcal.calibration.identify.judge import check_identifiable
from legcal.calibration.joint_fit import (
    DEFAULT_SETTINGS,
    Choices,
    HeldOut,
    Prior,
    Solution,
    compare_held_out,
    in_file_order,
    known_parameters,
    resolve,
)
from legcal.calibration.result import write_result
from legcal.calibration.run import CalibrationRun, start_run
from legcal.calibration.verdict import Calibration, judge
from legcal.data import (
    Dataset,
    Override,
    Split,
    dataset_at,
    load_dataset,
    overrides_of_call,
    reject_unused_legs,
    split_images,
)
from legcal.errors import UsageError
from legcal.files import check_destination, output_path
from legcal.geometry import IntArray
from legcal.paper import Criteria, Transformation
from legcal.progress import Report, no_progress
from legcal.workers import worker_pool

TWIST_SIGMA = float(np.radians(1.0))  # of the twist of a leg about its nominal one [rad]


def calibrate(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Report = no_progress,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    use_cache: bool = True,
    workers: int = 1,
    priors: Mapping[str, tuple[float, float] | str] | Sequence[str] = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    holdout: float | None = None,
) -> Calibration:
    """Compute joint positions and offsets of a mechanism from a dataset.

    Parameters
    ----------
    source : path or Dataset
        The dataset folder, or what :func:`legcal.load_dataset` returned.
    output : path, optional
        Write the result folder there: calibrated model, parameters, observations.
    progress : callable
        Called as ``progress(stage, done, total)``.
    criteria : {"default", "literal"}
        What the four steps minimise: legcal's criteria, or the paper's as printed.
    transformation : {"points", "cross_product"}, optional
        How they compute where the platform is, eq (18): by point equality, or as printed. By
        default as the criteria are.
    use_cache : bool
        Use the outlines that an earlier run left beside the dataset, if they still fit.
    workers : int
        Search the images in that many processes. With more than one, the program that calls
        this must be safe to import (``if __name__ == "__main__":``).
    priors : mapping or sequence of str
        What is known of parameters: (value, sigma) in SI units or pixels, or text such as
        ``420±0.1 mm``, by name or pattern; or texts that begin with ``NAME=``. These three
        win over what ``dataset.yaml`` says.
    fixed : sequence of str
        Names or patterns of parameters left at nominal, or ``NAME=VALUE``.
    free : sequence of str
        Names or patterns of parameters to estimate that are fixed otherwise (intrinsics), and of
        radii and twists to estimate without a prior.
    holdout : float, optional
        Keep this part of the images aside, and tell how well the fit of the others predicts them.

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
    if output is not None:
        check_destination(output_path(output))
    overrides = overrides_of_call(priors, fixed, free)
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    choices = _choices(dataset, overrides)
    split = _split(dataset, holdout)
    fitted = dataset_at(dataset, split.fitted)
    left_open = check_identifiable(fitted, choices)
    with worker_pool(workers) as pool:
        run = start_run(
            dataset,
            pool,
            progress,
            choices,
            use_cache=use_cache,
            criteria=criteria,
            transformation=transformation,
        )
        found = observe_and_fit(run, split.fitted)
    kept = [] if found.other_radii else run.keep_outlines(found.outlines, found.notes)
    # From here on in the order of the files.
    solution = in_file_order(found.solution, found.part.own_order, fitted)
    corners = None if found.corners is None else run.order.restore(found.corners)
    notes = (
        *dataset.notes,
        *found.notes,
        *found.doubts,
        *choices.notes,
        *left_open,
        *kept,
        *found.part.unreached_notes(),
        *board_notes(dataset, solution, corners),
        *solution.notes,
        *_camera_notes(dataset, solution),
    )
    held_out = _compare_held_out(run, found, split.kept_aside) if len(split.kept_aside) else None
    steps = found.steps.in_file_order(found.part.order)
    calibration = replace(judge(fitted, solution, steps, notes), corners=corners, held_out=held_out)
    if output is not None:
        write_result(calibration, Path(output))
    return calibration


def _choices(dataset: Dataset, overrides: Sequence[Override]) -> Choices:
    """Return what dataset and call choose of the parameters.

    Twists that nobody chooses anything of are estimated with a prior: no leg is built without an
    error of its twist, and one that was left at nominal would spoil the others.
    """
    known = known_parameters(
        dataset.machine,
        dataset.measurements.views,
        axes_given=dataset.axes is not None,
        with_board=dataset.board is not None,
    )
    choices = resolve([*dataset.overrides, *overrides], known)
    twists = {
        name: Prior(parameter.nominal, TWIST_SIGMA)
        for name, parameter in known.by_name.items()
        if name.endswith(".twist")
        and choices.holds(name, by_default=True)
        and name not in choices.fixed
    }
    return replace(choices, priors={**twists, **choices.priors})


def _split(dataset: Dataset, holdout: float | None) -> Split:
    """Return which images to fit and which to keep aside."""
    if holdout is None:
        rows = np.arange(dataset.measurements.n_rows)
        return Split(rows, rows[:0])
    if dataset.axes is not None:
        raise UsageError(
            f"{dataset.folder}: no images could be kept aside: found a table of axes, needed "
            "images or outlines, in which a fit is compared with what it did not see; leave out "
            "--holdout."
        )
    return split_images(dataset, holdout)


def _camera_notes(dataset: Dataset, solution: Solution) -> list[str]:
    """Return which files hold the focal lengths that the measurements contradict."""
    names = [view.name for view in dataset.measurements.views]
    return [
        f"The focal length of {view} that does not agree is that of "
        f"{dataset.camera_paths[names.index(view)]}."
        for view in solution.doubtful_cameras
    ]


def _compare_held_out(run: CalibrationRun, found: Found, file_rows: IntArray) -> HeldOut:
    """Return what the images that were kept aside say of the fit."""
    aside, solution = run.part(run.here(file_rows)), found.solution
    outlines = found.outlines.at(aside.rows)
    outlines = reject_unused_legs(outlines, aside.measurements, aside.machine.leg_names)
    poses = aside.poses_by(solution.legs)
    return compare_held_out(
        solution.posterior, aside.measurements, outlines, poses, DEFAULT_SETTINGS.rejection
    )
