"""What is searched in the images of a dataset, and what is fitted to it.

1. The nominal model and the readings say where each leg is (section 2).
2. Each view's camera is aligned with what its images show, and the outlines of the legs are
   measured near where they should be (section 3.1).
3. The four steps give joint centres, offsets and axes (3.2 to 3.5), where the images suffice.
4. One fit of everything, started from the nominal model and from the steps, ends the work.
5. Photographs in which anything was left in doubt are searched again close to that fit, and 3
   and 4 are repeated.

Where a dataset has a table of axes in place of images, 2 and 5 have nothing to do. Images that are
kept aside are searched like the others, and not fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration import Steps
from legcal.detection.observe import (
    Scene,
    align,
    detect,
    doubtful_rows,
    given_outlines,
    scene_at_poses,
)
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.geometry.types import IntArray
from legcal.mechanism.parametrization import geometries
from legcal.mechanism.platform import platform_in_base
from legcal.observations.canonical_order import (
    inverse,
)
from legcal.observations.leg_axes import axes_from_outlines
from legcal.observations.outlines import Outlines
from legcal.observations.parts import outlines_at
from legcal.observations.sets import choose_outlines, join_outlines, reject_unused_legs
from legcal.progress import Report
from legcal.refinement.refine import refine, refine_from_best
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start, start_from
from legcal.stages.nominal import nominal_mechanism
from legcal.stages.run import run_steps
from legcal.workpiece import Workpiece


@dataclass(frozen=True, eq=False)
class Found:
    """What the work gave.

    Attributes
    ----------
    outlines : Outlines
        Of all images, in the order of work.
    fitted : (n,) array of int
        Rows of the part among all, in the order of work.
    part : Workpiece
        The images that were fitted.
    steps : Steps
        What the four steps make of them.
    solution : Solution
        The fit, in the order of the part.
    """

    outlines: Outlines
    fitted: IntArray
    part: Workpiece
    steps: Steps
    solution: Solution

    @property
    def judged(self) -> Outlines:
        """The outlines of all images, those that the fit rejected among them."""
        others = choose_outlines(self.outlines, ~np.isin(self.outlines.row, self.fitted))
        judged = self.solution.outlines
        return join_outlines([others, replace(judged, row=self.fitted[judged.row])])


def observe_and_fit(work: Workpiece, rows: IntArray, progress: Report) -> Found:
    """Measure the outlines of all images, and fit everything to some of them.

    Parameters
    ----------
    work : Workpiece
        All images.
    rows : (n,) array of int
        Rows of the files to fit, rising.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    NotVisible, NotIdentifiable, DidNotConverge
        As the steps of the work.
    """
    photographs, part = work.photographs, work.part(rows)
    fitted = inverse(work.order.rows)[rows[part.order.rows]]
    scene = scene_at_poses(work.mechanism, work.measurements, work.nominal_poses)
    if len(photographs.detect) == 0:
        return _fit(part, fitted, given_outlines(photographs), scene, progress)
    scene = align(photographs, scene, progress)
    found = _fit(part, fitted, detect(photographs, scene, progress), scene, progress)
    doubtful = doubtful_rows(photographs, found.judged)
    if len(doubtful) == 0:
        return found
    scene = _fitted_scene(work, found.solution)
    again = photographs.narrowed(doubtful, found.outlines)
    outlines = detect(again, scene, progress, near_fit=True)
    return _fit(part, fitted, outlines, scene, progress)


def _fit(
    part: Workpiece, fitted: IntArray, outlines: Outlines, scene: Scene, progress: Report
) -> Found:
    """Run the four steps, then the fit of everything from the nominal model and from the steps.

    ``fitted`` are the rows of the part among all in the order of work, that of ``outlines``.
    """
    seen = outlines_at(outlines, fitted)
    seen = reject_unused_legs(seen, part.measurements, part.mechanism.leg_names)
    if part.every_leg:
        _refuse_unseen_legs(part, seen)
    steps = _four_steps(part, seen, progress)
    progress("Fit of everything", 0, 1)
    starts = _starts(part, seen, scene, steps)
    everything = part.fitted_legs, part.measurements, seen
    if len(starts) == 1:
        solution = refine(*everything, starts[0], axes=part.axes, choices=part.choices)
    else:
        solution = refine_from_best(*everything, starts, axes=part.axes, choices=part.choices)
    progress("Fit of everything", 1, 1)
    return Found(outlines, fitted, part, steps, solution)


def _refuse_unseen_legs(work: Workpiece, outlines: Outlines) -> None:
    """Raise NotVisible if no image shows a leg that its view says it does."""
    if work.axes is not None:
        return
    shown = set(outlines.leg[outlines.used].tolist())
    views = [work.measurements.views[v] for v in np.unique(work.measurements.view).tolist()]
    unseen = [
        leg.name
        for j, leg in enumerate(work.mechanism.legs)
        if j not in shown
        and leg.cylinders
        and any(view.legs is None or leg.name in view.legs for view in views)
    ]
    if unseen:
        raise NotVisible(
            f"{work.dataset.folder}: the machine could not be calibrated: found no used outline of "
            f"{', '.join(unseen)} in any image, needed some of every leg; add images that show it, "
            "or name the legs of each view in dataset.yaml to leave it to the readings."
        )


def _fitted_scene(work: Workpiece, solution: Solution) -> Scene:
    """Return where a fit puts the legs; R_b is laid on the nominal R_b."""
    T_base_Rb = work.mechanism.T_base_Rb
    A = T_base_Rb.apply(np.array([leg.A for leg in solution.legs]))
    B = np.array([leg.B for leg in solution.legs])
    placed = np.array([(T_base_Rb * T).apply(B) for T in work.poses_by(solution.legs)])
    at_row = work.measurements.pose
    cameras = tuple(T_base_Rb * T.inv() for T in solution.T_camera_Rb)
    return Scene(np.broadcast_to(A, placed.shape)[at_row], placed[at_row], cameras)


def _four_steps(work: Workpiece, outlines: Outlines, progress: Report) -> Steps:
    """Return what the four steps give, or why they give nothing: the fit may do without."""
    if work.criteria is None:
        return Steps(None, None, "They were left out.")
    progress("Four steps", 0, 1)
    radii = {part: r for leg in work.mechanism.legs for part, r in leg.radius_of_part.items()}
    try:
        axes = work.axes
        if axes is None:
            axes = axes_from_outlines(outlines, work.measurements, radii)
        nominal = nominal_mechanism(work.mechanism)
        found = run_steps(
            nominal,
            axes,
            work.measurements,
            criteria=work.criteria,
            transformation=work.transformation,
            free_twists=any(name.endswith(".twist") for name in work.choices.free),
        )
    except (NotIdentifiable, NotVisible, DidNotConverge) as failure:
        return Steps(None, None, str(failure))
    finally:
        progress("Four steps", 1, 1)
    return Steps(found.legs, found.T_Rb_camera, "", found.diagnostics)


def _starts(work: Workpiece, outlines: Outlines, scene: Scene, steps: Steps) -> list[Start]:
    """Return the starts of the fit: the nominal model, and the steps where they gave a result."""
    mechanism = work.mechanism
    legs = geometries(mechanism)
    platform = [platform_in_base(mechanism, T) for T in work.nominal_poses]
    rough = [None if T is None else T.inv() * mechanism.T_base_Rb for T in scene.T_base_camera]
    staged = [None if T is None else T.inv() for T in steps.T_Rb_camera or [None] * len(rough)]
    starts = [(legs, _cameras(work, outlines, rough, staged, steps), "nominal")]
    if steps.legs is not None:
        starts.append((steps.legs, _cameras(work, outlines, staged, rough, steps), "staged"))
    return [
        start_from(legs, work.measurements, work.fitted_legs, cameras, platform, label)
        for legs, cameras, label in starts
    ]


def _cameras(
    work: Workpiece,
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
