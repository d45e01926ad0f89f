"""From a dataset to the joint fit: the phases that calibration and check share.

1. The nominal model and the readings say where each leg is (section 2).
2. Recognise: the legs are recognised in the images and each view's camera is placed by them.
   Measure: the outlines of the legs are measured near where that has them (section 3.1).
3. Four steps: joint centres, offsets and axes (3.2 to 3.5), where the images suffice.
4. Joint fit of all parameters, started from the nominal model and from the steps.
5. Measure again: all photographs are searched close to that fit and measured with all care, so
   that nothing depends on where the search began, and 3 and 4 are repeated; once more where
   outlines show the gamma of a camera that nobody told.

Where a dataset has a table of axes in place of images, 2 and 5 have nothing to do. Images that are
kept aside are searched like the others, and not fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.board import BoardViews, Poses, base_of_board, in_one_camera, observe_board
from legcal.calibration.disagreement import disagreeing_images
from legcal.calibration.identify.judge import check_identifiable
from legcal.calibration.joint_fit import (
    ROUNDS,
    EstimatedGamma,
    Solution,
    Start,
    known_gammas,
    next_gammas,
    refine_from_best,
    start_from,
)
from legcal.calibration.run import CalibrationRun
from legcal.calibration.verdict import Steps
from legcal.data import (
    Corners,
    Outlines,
    axes_from_outlines,
    dataset_at,
    few_views,
    reject_unused_legs,
)
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.geometry import IntArray
from legcal.machine import Cylinder, Machine, geometries
from legcal.paper import nominal_mechanism, run_base_steps, run_platform_steps
from legcal.perception import (
    Observed,
    Placement,
    given_outlines,
    hint_notes,
    measure_photographs,
    nominal_placement,
    observe,
)

# That of all outlines that are measured in photographs: light at the limb that no model of shading
# foresees looks like other radii, so that residuals never show it [px].
LIMB_BIAS = {"bias of many edges": 0.02}
LOST = 0.5  # of the outlines of an image: fewer were found


@dataclass(frozen=True, eq=False)
class Found:
    """What the images show and what was fitted to it, in canonical order."""

    outlines: Outlines  # of all images
    part: CalibrationRun  # the images that were fitted
    steps: Steps
    solution: Solution
    corners: Corners | None  # of the calibration board in all images; None without a board
    notes: tuple[str, ...] = ()  # on the images by themselves
    doubts: tuple[str, ...] = ()  # on the images by the fit
    other_radii: bool = False  # whether the images show other radii than the model has


def observe_and_fit(run: CalibrationRun, file_rows: IntArray) -> Found:
    """Search all images, and fit some of them.

    Raises
    ------
    NotVisible, NotIdentifiable, DidNotConverge
        As the phases.
    """
    rows = run.here(file_rows)
    try:
        return _observe_and_fit(run, rows)
    except NotIdentifiable:
        if not run.plan.is_cached:
            raise
    # Outlines that an earlier run left do not always tell where the cameras are; images do.
    return _observe_and_fit(run.searched_anew(), rows)


def _observe_and_fit(run: CalibrationRun, rows: IntArray) -> Found:
    """Search the images that have no outlines yet, and fit some."""
    scene, board = rough_scene(run)
    # Outlines that are kept were measured with some gamma: others of their camera must be as well.
    kept_gammas = known_gammas(run.photographs.keep, run.measurements)
    photographs = run.photographs.with_gammas(kept_gammas)
    if len(photographs.detect) == 0:
        found = _fit(run.part(rows), given_outlines(photographs), scene, board)
        return replace(found, notes=run.plan.notes, doubts=_doubts(found))
    T_board_camera = None if board is None else board.T_board_camera
    seen = observe(photographs, scene, run.progress, T_board_camera, together=False)
    seen.placement.require_one()
    other_radii = bool(seen.placement.radii.factor)
    if other_radii:
        run = replace(run, machine=seen.photographs.machine)
    if run.every_leg and (seen.left_out or seen.placement.unplaced):
        _refuse_too_few(run, rows, seen)
    found = _fit(run.part(rows), seen.outlines, seen.placement, board)
    found, lost = _measure_again(run, found, seen, board)
    notes = (*seen.placement.all_notes, *lost)
    return replace(found, notes=notes, doubts=_doubts(found), other_radii=other_radii)


def rough_scene(run: CalibrationRun) -> tuple[Placement, BoardViews | None]:
    """Return where the nominal model has the legs, with rough cameras, and what shows the board."""
    scene = nominal_placement(run.machine, run.measurements, run.T_base_platform)
    board = observe_board(run)
    if board is not None:
        T_base_board = base_of_board(run.dataset, board, scene.T_base_camera)
        if T_base_board is not None:
            cameras = board.cameras(T_base_board, scene.T_base_camera)
            scene = replace(scene, T_base_camera=cameras)
    return scene, board


def _fit(
    part: CalibrationRun, outlines: Outlines, scene: Placement, board: BoardViews | None
) -> Found:
    """Run the four steps, then the joint fit, with the outlines of all images."""
    seen = outlines.at(part.rows)
    seen = reject_unused_legs(seen, part.measurements, part.machine.leg_names)
    if part.every_leg:
        _refuse_unseen_legs(part, seen)
    steps = _four_steps(part, seen, board)
    part.progress("Joint fit", 0, 1)
    choices = part.choices
    if any(part.measurements.image) and "detected" in seen.source:
        choices = replace(choices, least_shared_px={**LIMB_BIAS, **choices.least_shared_px})
    solution = refine_from_best(
        part.fitted_legs,
        part.measurements,
        seen,
        _starts(part, seen, scene, steps, board),
        axes=part.axes,
        board=None if board is None else board.seen(part.rows),
        choices=choices,
    )
    part.progress("Joint fit", 1, 1)
    corners = None if board is None else board.judged(solution)
    return Found(outlines, part, steps, solution, corners)


def _measure_again(
    run: CalibrationRun, found: Found, seen: Observed, board: BoardViews | None
) -> tuple[Found, list[str]]:
    """Search the photographs again close to the fit, and fit again.

    Returns the fit, and what the first one said of images in which hardly anything is found near.
    """
    scene, view = seen.placement, run.measurements.view
    rows = seen.photographs.detect
    shown = [
        row
        for row in rows.tolist()
        if scene.T_base_camera[view[row]] is not None and row not in seen.left_out
    ]
    if not shown:
        return found, []
    before = _disagreeing(found)
    again = seen.photographs.narrowed(np.array(shown, dtype=np.intp), found.outlines)
    again = replace(again, machine=_with_fitted_radii(again.machine, found.solution))
    told = known_gammas(again.keep, again.measurements)
    gammas: list[tuple[EstimatedGamma, ...]] = []
    for _ in range(1 + ROUNDS):
        scene = _fitted_placement(run, found.solution, seen)
        outlines = measure_photographs(again, scene, run.progress)
        found = _fit(found.part, outlines, scene, board)
        gammas.append(found.solution.gammas)
        others = {name: gamma for name, gamma in next_gammas(gammas).items() if name not in told}
        if not others:
            break
        again = again.with_gammas(others)
    after, o = _disagreeing(found), found.solution.outlines
    lost = [
        note
        for row, note in before.items()
        if row not in after and o.used[o.row == row].mean() < LOST
    ]
    return found, lost


def _with_fitted_radii(machine: Machine, solution: Solution) -> Machine:
    """Return what is seen of the legs with the radii of a fit.

    Cylinders of a leg that were equally thick stay so: they look like one.
    """
    cylinders: list[list[Cylinder]] = []
    for j, leg in enumerate(machine.legs):
        fitted = {
            c.radius: solution.radii[j, c.link]
            for c in leg.cylinders
            if (j, c.link) in solution.radii
        }
        cylinders.append([replace(c, radius=fitted.get(c.radius, c.radius)) for c in leg.cylinders])
    return machine.with_cylinders(cylinders)


def _fitted_placement(run: CalibrationRun, solution: Solution, seen: Observed) -> Placement:
    """Return where a fit puts the legs, R_b laid on the nominal one; no camera is placed anew."""
    T_base_Rb = run.machine.T_base_Rb
    A = T_base_Rb.apply(np.array([leg.A for leg in solution.legs]))
    B = np.array([leg.B for leg in solution.legs])
    placed = np.array([(T_base_Rb * T).apply(B) for T in run.poses_by(solution.legs)])
    pose = run.measurements.pose
    cameras = tuple(
        None if known is None else T_base_Rb * T.inv()
        for known, T in zip(seen.placement.T_base_camera, solution.T_camera_Rb, strict=True)
    )
    A_base = np.broadcast_to(A, placed.shape)[pose]
    return Placement.of_fit(A_base, placed[pose], cameras, seen.blur)


def _four_steps(part: CalibrationRun, outlines: Outlines, board: BoardViews | None) -> Steps:
    """Return what the four steps give, or why they give nothing: the fit may do without.

    Cameras alone where only the later steps fail.
    """
    if part.criteria is None:
        return Steps(None, None, "They were left out.")
    part.progress("Four steps", 0, 1)
    axes, measurements = part.axes, part.measurements
    try:
        nominal = nominal_mechanism(part.machine)
        if axes is None:
            radii = {p: r for leg in part.machine.legs for p, r in leg.radius_of_part.items()}
            axes = axes_from_outlines(outlines, measurements, radii)
        if board is not None:
            axes, measurements, T_first_camera, new_view = in_one_camera(
                axes, measurements, board.T_board_camera
            )
        base = run_base_steps(nominal, axes, measurements, criteria=part.criteria)
        cameras = tuple(base.T_Rb_camera)
        if board is not None:
            moved = zip([cameras[v] for v in new_view.tolist()], T_first_camera, strict=True)
            cameras = tuple(T if T is None or own is None else T * own for T, own in moved)
        try:
            found = run_platform_steps(
                nominal,
                axes,
                measurements,
                base,
                criteria=part.criteria,
                transformation=part.transformation,
                free_twists=any(name.endswith(".twist") for name in part.choices.free),
            )
        except (NotIdentifiable, DidNotConverge) as failure:
            return Steps(None, cameras, str(failure))
        return Steps(found.legs, cameras, "", found.diagnostics)
    except (NotIdentifiable, NotVisible, DidNotConverge) as failure:
        return Steps(None, None, str(failure))
    finally:
        part.progress("Four steps", 1, 1)


def _starts(
    part: CalibrationRun,
    outlines: Outlines,
    scene: Placement,
    steps: Steps,
    board: BoardViews | None,
) -> list[Start]:
    """Return the starts of the fit: the nominal model, and the steps where they gave a result."""
    machine = part.machine
    rough = [None if T is None else T.inv() * machine.T_base_Rb for T in scene.T_base_camera]
    staged = [None if T is None else T.inv() for T in steps.T_Rb_camera or [None] * len(rough)]
    starts = [(geometries(machine), rough, staged, "nominal")]
    if steps.legs is not None:
        starts.append((steps.legs, staged, rough, "staged"))
    found = []
    for legs, first, second, label in starts:
        cameras = _start_cameras(part, outlines, first, second, steps)
        start = start_from(legs, part.measurements, part.fitted_legs, cameras, part.T_Rb_Re, label)
        if board is not None:
            T_Rb_board = board.placed([T.inv() for T in cameras])
            start = start if T_Rb_board is None else replace(start, T_Rb_board=T_Rb_board)
        found.append(start)
    return found


def _start_cameras(
    part: CalibrationRun, outlines: Outlines, first: Poses, second: Poses, steps: Steps
) -> list[RigidTransform]:
    """Return a camera pose for every view, the first choice where there is one."""
    cameras = [a if a is not None else b for a, b in zip(first, second, strict=True)]
    shown = outlines.row[outlines.used] if part.axes is None else part.axes.row
    needed = set(part.measurements.view[shown].tolist())
    unknown = [
        view.name
        for v, view in enumerate(part.measurements.views)
        if v in needed and cameras[v] is None
    ]
    if unknown:
        raise NotIdentifiable(
            f"{few_views(unknown)}: no camera could be placed: found no "
            "T_base_camera, and the four steps do not locate it "
            f"({steps.failure or 'fewer than three base joints are seen'}); needed one of them; "
            "add a rough T_base_camera to dataset.yaml"
            + (", or T_base_board to its block board." if part.dataset.board else ".")
        )
    return [T if T is not None else RigidTransform.identity() for T in cameras]


def _disagreeing(found: Found) -> dict[int, str]:
    return disagreeing_images(found.part.measurements, found.part.machine, found.solution)


def _doubts(found: Found) -> tuple[str, ...]:
    """Return rough camera poses that the fit contradicts, and images that contradict the fit."""
    part, o = found.part, found.solution.outlines
    shown = set(part.measurements.view[o.row[o.used]].tolist())
    views = part.measurements.views
    cameras = [
        part.machine.T_base_Rb * T.inv() if v in shown else None
        for v, T in enumerate(found.solution.T_camera_Rb)
    ]
    hints = hint_notes([view.name for view in views], [v.T_base_camera for v in views], cameras)
    return (*hints, *_disagreeing(found).values())


def _refuse_too_few(run: CalibrationRun, rows: IntArray, seen: Observed) -> None:
    """Raise NotIdentifiable if the images that are left do not determine the parameters."""
    cameras, notes = seen.placement.T_base_camera, seen.placement.all_notes
    left = [
        row
        for row in rows.tolist()
        if row not in seen.left_out and cameras[run.measurements.view[row]] is not None
    ]
    if not left:
        raise NotVisible(list(notes))
    try:
        check_identifiable(dataset_at(run.dataset, np.sort(run.order.rows[left])), run.choices)
    except NotIdentifiable as failure:
        raise NotIdentifiable([*failure.problems, *notes]) from None


def _refuse_unseen_legs(part: CalibrationRun, outlines: Outlines) -> None:
    """Raise NotVisible if no image shows a leg that its view says it does."""
    if part.axes is not None:
        return
    shown = set(outlines.leg[outlines.used].tolist())
    views = [part.measurements.views[v] for v in np.unique(part.measurements.view).tolist()]
    unseen = [
        leg.name
        for j, leg in enumerate(part.machine.legs)
        if j not in shown
        and leg.cylinders
        and any(view.legs is None or leg.name in view.legs for view in views)
    ]
    if unseen:
        raise NotVisible(
            f"{part.dataset.folder}: the machine could not be calibrated: found no used outline of "
            f"{', '.join(unseen)} in any image, needed some of every leg; add images that show it, "
            "or name the legs of each view in dataset.yaml to leave it to the readings."
        )
