"""From photographs and readings to a calibrated mechanism: the whole method in one place.

1. The nominal model and the readings say where each leg is (section 2).
2. Each view's camera is aligned with what its images show, and the outlines of the legs are
   measured near where they should be (section 3.1).
3. The four steps give joint centres and offsets (3.2 to 3.5).
4. One fit of everything, started from the nominal model and from the steps, ends the work.
5. Photographs in which anything was left in doubt are searched again close to that fit, and 3
   and 4 are repeated.

Where a dataset has a table of axes in place of images, 2 and 5 have nothing to do.

Everything runs in an order of rows, views and legs that does not depend on the files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration import Calibration, Steps, in_file_order, judge
from legcal.dataset.cache import DetectionPlan, fingerprint, plan_dataset, store_outlines
from legcal.dataset.folder import Dataset, load_dataset
from legcal.dataset.wishes import Wish, wishes_of_call
from legcal.detection.observe import (
    Photographs,
    Scene,
    align,
    detect,
    detection_settings,
    doubtful_rows,
    given_outlines,
    scene_at_poses,
)
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible, OutOfClass
from legcal.identify.check import check_identifiable
from legcal.mechanism.kinematics import forward_kinematics_many
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism
from legcal.observations.canonical_order import (
    Order,
    canonical_order,
    inverse,
    reorder_axes,
    reorder_measurements,
    reorder_outlines,
    restore_outlines,
)
from legcal.observations.leg_axes import LegAxes, axes_from_outlines
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.observations.sets import reject_unused_legs
from legcal.progress import Report, no_progress
from legcal.refinement.choices import Choices
from legcal.refinement.known_parameters import known_parameters
from legcal.refinement.legs import FittedLegs, fitted_legs
from legcal.refinement.refine import refine_from_best
from legcal.refinement.resolution import resolve
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start, start_from, with_joints
from legcal.report.destination import check_destination, output_path
from legcal.report.result import write_result
from legcal.stages.nominal import Criteria
from legcal.stages.run import run_steps
from legcal.workers import Run, worker_pool


def calibrate(
    source: str | Path | Dataset,
    *,
    output: str | Path | None = None,
    progress: Report = no_progress,
    criteria: Criteria = "default",
    use_cache: bool = True,
    workers: int = 1,
    priors: Mapping[str, tuple[float, float] | str] | Sequence[str] = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
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
        Names or patterns of parameters to look for that are fixed otherwise (intrinsics,
        twists), and of radii to look for without a prior.

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
    wishes = wishes_of_call(priors, fixed, free)
    dataset = source if isinstance(source, Dataset) else load_dataset(source)
    choices = _choices(dataset, wishes)
    _refuse_other_legs(dataset.mechanism)
    left_open = check_identifiable(dataset)
    with worker_pool(workers) as run:
        work = _workpiece(dataset, run, criteria, choices, use_cache=use_cache)
        outlines, steps, solution = _observe_and_fit(work, progress)
    notes = [*dataset.notes, *choices.notes, *left_open, *_keep_outlines(work, outlines)]
    calibration = judge(
        dataset,
        in_file_order(solution, work.order, dataset),
        steps.in_file_order(work.order),
        (*notes, *solution.notes),
    )
    if output is not None:
        write_result(calibration, Path(output))
    return calibration


def _observe_and_fit(work: _Workpiece, progress: Report) -> tuple[Outlines, Steps, Solution]:
    """Return the outlines of all images, what the four steps make of them, and the fit."""
    photographs, scene = work.photographs, _nominal_scene(work)
    if len(photographs.detect) == 0:
        outlines = given_outlines(photographs)
        return outlines, *_steps_and_fit(work, outlines, scene, progress)
    scene = align(photographs, scene, progress)
    outlines = detect(photographs, scene, progress)
    steps, solution = _steps_and_fit(work, outlines, scene, progress)
    doubtful = doubtful_rows(photographs, solution.outlines)
    if len(doubtful) == 0:
        return outlines, steps, solution
    scene = _fitted_scene(work, solution)
    again = photographs.narrowed(doubtful, outlines)
    outlines = detect(again, scene, progress, near_fit=True)
    return outlines, *_steps_and_fit(work, outlines, scene, progress)


@dataclass(frozen=True, eq=False)
class _Workpiece:
    """A dataset in the order of work."""

    dataset: Dataset
    order: Order
    plan: DetectionPlan
    fingerprint: str
    mechanism: Mechanism
    measurements: Measurements
    axes: LegAxes | None
    run: Run
    criteria: Criteria
    choices: Choices

    @cached_property
    def photographs(self) -> Photographs:
        """The images, what to search in them and what to keep."""
        return Photographs(
            mechanism=self.mechanism,
            measurements=self.measurements,
            load=self.dataset.image_reader(self.order.rows.tolist()),
            run=self.run,
            detect=np.sort(inverse(self.order.rows)[self.plan.detect]),
            keep=reorder_outlines(self.plan.keep, self.order),
        )

    @cached_property
    def fitted_legs(self) -> FittedLegs:
        """The legs as the fit sees them."""
        return fitted_legs(self.mechanism)

    @cached_property
    def nominal_poses(self) -> list[RigidTransform]:
        """T_base_platform of every pose by the nominal model."""
        q = self.measurements.q[self.measurements.first_rows]
        return forward_kinematics_many(self.mechanism, q)


def _choices(dataset: Dataset, wishes: Sequence[Wish]) -> Choices:
    """Return what dataset and run choose of the parameters."""
    views, axes_given = dataset.measurements.views, dataset.axes is not None
    known = known_parameters(dataset.mechanism, views, axes_given=axes_given)
    return resolve([*dataset.wishes, *wishes], known)


def _workpiece(
    dataset: Dataset, run: Run, criteria: Criteria, choices: Choices, *, use_cache: bool
) -> _Workpiece:
    """Put a dataset into the order of work, and see which images are still to be searched."""
    names = dataset.mechanism.leg_names
    order = canonical_order(dataset.measurements, names)
    # Doubtful images are searched again near the fit, which depends on the choices.
    current = fingerprint(dataset, detection_settings() | choices.document())
    plan = plan_dataset(dataset, current if use_cache else "")
    return _Workpiece(
        dataset=dataset,
        order=order,
        plan=plan,
        fingerprint=current,
        mechanism=dataset.mechanism.with_leg_order([names[leg] for leg in order.legs]),
        measurements=reorder_measurements(dataset.measurements, order),
        axes=None if dataset.axes is None else reorder_axes(dataset.axes, order),
        run=run,
        criteria=criteria,
        choices=choices,
    )


def _refuse_other_legs(mechanism: Mechanism) -> None:
    """Raise OutOfClass if a leg is not of the kind that the fit has equations for."""
    others = [
        f"{leg.name} ({leg.kind}, {leg.type})"
        for leg in mechanism.legs
        if leg.kind is LegKind.CONSTANT or "S" not in leg.type or "R" in leg.type
    ]
    if others:
        raise OutOfClass(
            f"{mechanism.yaml_path}: the mechanism could not be calibrated: found the legs "
            f"{', '.join(others)}, needed legs with a slider, an S joint at one end and an S or "
            "a U at the other (SPU, UPS, SPS); this version identifies and moves such machines "
            "and does not calibrate them yet."
        )


def _nominal_scene(work: _Workpiece) -> Scene:
    """Return where the nominal model and the readings put the legs."""
    return scene_at_poses(work.mechanism, work.measurements, work.nominal_poses)


def _fitted_scene(work: _Workpiece, solution: Solution) -> Scene:
    """Return where a fit puts the legs; R_b is laid on the nominal R_b."""
    T_base_Rb = work.mechanism.T_base_Rb
    A = T_base_Rb.apply(solution.parameters.base_joints)
    B = np.array(
        [(T_base_Rb * T).apply(solution.parameters.platform_joints) for T in solution.T_Rb_Re]
    )
    at_row = work.measurements.pose
    cameras = tuple(T_base_Rb * T.inv() for T in solution.T_camera_Rb)
    return Scene(np.broadcast_to(A, B.shape)[at_row], B[at_row], cameras)


def _steps_and_fit(
    work: _Workpiece, outlines: Outlines, scene: Scene, progress: Report
) -> tuple[Steps, Solution]:
    """Run the four steps, then the fit of everything from the nominal model and from the steps."""
    outlines = reject_unused_legs(outlines, work.measurements, work.mechanism.leg_names)
    progress("Four steps", 0, 1)
    steps = _four_steps(work, outlines)
    progress("Four steps", 1, 1)
    progress("Fit of everything", 0, 1)
    starts = _starts(work, outlines, scene, steps)
    solution = refine_from_best(
        work.fitted_legs, work.measurements, outlines, starts, axes=work.axes, choices=work.choices
    )
    progress("Fit of everything", 1, 1)
    return steps, solution


def _four_steps(work: _Workpiece, outlines: Outlines) -> Steps:
    """Return what the four steps give, or why they give nothing: the fit may do without."""
    radii = {part: r for leg in work.mechanism.legs for part, r in leg.radius_of_part.items()}
    try:
        axes = work.axes
        if axes is None:
            axes = axes_from_outlines(outlines, work.measurements, radii)
        found = run_steps(work.mechanism, axes, work.measurements, criteria=work.criteria)
    except (NotIdentifiable, NotVisible, DidNotConverge) as failure:
        return Steps(None, None, str(failure))
    return Steps(found.parameters, found.T_Rb_camera, "", found.diagnostics)


def _starts(work: _Workpiece, outlines: Outlines, scene: Scene, steps: Steps) -> list[Start]:
    """Return the starts of the fit: the nominal model, and the steps where they gave a result."""
    T_base_Rb, T_platform_Re = work.mechanism.T_base_Rb, work.mechanism.T_platform_Re
    platform = [T_base_Rb.inv() * T * T_platform_Re for T in work.nominal_poses]
    rough = [None if T is None else T.inv() * T_base_Rb for T in scene.T_base_camera]
    staged = [None if T is None else T.inv() for T in steps.T_Rb_camera or [None] * len(rough)]
    nominal_cameras = _cameras(work, outlines, rough, staged, steps)
    nominal = work.fitted_legs.nominal
    starts = [(nominal, nominal_cameras, "nominal")]
    if steps.parameters is not None:
        found = with_joints(nominal, steps.parameters)
        starts.append((found, _cameras(work, outlines, staged, rough, steps), "staged"))
    return [
        start_from(legs, work.measurements, work.fitted_legs, cameras, platform, label)
        for legs, cameras, label in starts
    ]


def _cameras(
    work: _Workpiece,
    outlines: Outlines,
    first: Sequence[RigidTransform | None],
    second: Sequence[RigidTransform | None],
    steps: Steps,
) -> list[RigidTransform]:
    """Return a camera pose for every view, the first choice where there is one."""
    cameras = [a if a is not None else b for a, b in zip(first, second, strict=True)]
    shown = outlines.row[outlines.used] if work.axes is None else work.axes.row
    needed = set(work.measurements.view[shown].tolist())
    problems = [
        f"view {view.name}: its camera could not be placed: found no T_base_camera, and the four "
        f"steps do not locate it ({steps.failure or 'fewer than three base joints are seen'}); "
        "needed one of them; add a rough T_base_camera to dataset.yaml."
        for v, view in enumerate(work.measurements.views)
        if v in needed and cameras[v] is None
    ]
    if problems:
        raise NotIdentifiable(problems)
    return [T if T is not None else RigidTransform.identity() for T in cameras]


def _keep_outlines(work: _Workpiece, outlines: Outlines) -> list[str]:
    """Leave the outlines beside the dataset for the next run; return a note if that fails."""
    if len(work.plan.detect) == 0:
        return []
    restored = restore_outlines(outlines, work.order)
    note = store_outlines(work.dataset, restored, work.fingerprint, work.plan.given)
    return [note] if note else []
