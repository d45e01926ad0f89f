"""What is searched in the images of a dataset, and what is fitted to it.

1. The nominal model and the readings say where each leg is (section 2).
2. The legs are recognised in the images and each view's camera is placed by them; the outlines of
   the legs are measured near where that has them (section 3.1).
3. The four steps give joint centres, offsets and axes (3.2 to 3.5), where the images suffice.
4. One fit of everything, started from the nominal model and from the steps, ends the work.
5. All photographs are searched again close to that fit and measured with all care, so that nothing
   depends on where the search began, and 3 and 4 are repeated. Where outlines show that a camera
   encodes light, which nobody told, this is done once more with the gamma that they show.

Where a dataset has a table of axes in place of images, 2 and 5 have nothing to do. Images that are
kept aside are searched like the others, and not fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.identify.analysis import check_identifiable
from legcal.calibration.starts import (
    BoardViews,
    base_of_board,
    four_steps,
    observe_board,
    starts_of_fit,
)
from legcal.calibration.verdict import Steps
from legcal.calibration.workpiece import Workpiece
from legcal.data import (
    Corners,
    Measurements,
    Outlines,
    choose_outlines,
    dataset_at,
    inverse,
    join_outlines,
    outlines_at,
    plan_dataset,
    reject_unused_legs,
)
from legcal.errors import NotIdentifiable, NotVisible
from legcal.estimation import (
    DISAGREES,
    ROUNDS,
    EstimatedGamma,
    Solution,
    known_gammas,
    next_gammas,
    refine_from_best,
)
from legcal.geometry import Array, IntArray
from legcal.machine import Cylinder, Mechanism
from legcal.perception import (
    Observed,
    Photographs,
    Scene,
    detect,
    given_outlines,
    hint_notes,
    observe,
    outline_parts,
    scene_at_poses,
)
from legcal.progress import Report

MANY, SOME_LEGS = 0.34, 2  # of an image's outlines that the fit rejected, and legs altogether
MOST = 0.67  # of them, if the readings suit the image
SUITED = "its readings suit it, so check that nobody moved the camera"
LEAST_OUTLINES, LEAST_LEGS = 6, 3  # by which a pose is known
LEAST_NOISE = 5e-5  # of an outline at its leg [m]
SURE = 5.0  # standard deviations
LEAST_OFF = 3e-4  # of a reading, to be spoken of [m]
SAME = 1e-3  # readings that are those of another image [m]
SHOWN = 4  # legs that are named


@dataclass(frozen=True, eq=False)
class _Readings:
    """Readings by the outlines of an image alone, with standard deviations (n_legs,) [m]."""

    q: Array
    sigma: Array


def disagreeing_images(
    measurements: Measurements, mechanism: Mechanism, solution: Solution
) -> dict[int, str]:
    """Return a note on every image most of which the fit has rejected, by row.

    Parameters
    ----------
    measurements : Measurements
        The rows that were fitted.
    mechanism : Mechanism
        Its legs, in their order.
    solution : Solution
        The fit.
    """
    o = solution.outlines
    rejected = np.array([why.startswith(DISAGREES) for why in o.reason], dtype=np.bool_)
    notes = {}
    for row in np.unique(o.row[rejected]).tolist():
        judged = np.flatnonzero((o.row == row) & (rejected | o.used))
        wrong = judged[rejected[judged]]
        legs = [
            leg for leg in np.unique(o.leg[wrong]) if np.all(rejected[judged[o.leg[judged] == leg]])
        ]
        if len(wrong) < MANY * len(judged) or len(legs) < SOME_LEGS:
            continue
        view = measurements.views[int(measurements.view[row])]
        name = f"view {view.name}, image {measurements.image[row] or f'of row {row + 1}'}"
        found = _readings(measurements, mechanism, solution, row, judged)
        explanation = _explanation(measurements, mechanism, row, found)
        if not explanation and len(wrong) < MOST * len(judged):
            continue  # what is wrong there is not of this image
        notes[row] = (
            f"{name}: {len(wrong)} of its {len(judged)} outlines disagree with the fit and were "
            f"left out; {explanation or SUITED}."
        )
    return notes


def _readings(
    measurements: Measurements,
    mechanism: Mechanism,
    solution: Solution,
    row: int,
    chosen: IntArray,
) -> _Readings | None:
    """Return the readings at the pose that the outlines of an image show; None if they do not."""
    o = solution.outlines
    chosen = chosen[np.isfinite(o.h[chosen]).all(axis=1)]
    legs = o.leg[chosen]
    if len(chosen) < LEAST_OUTLINES or len(np.unique(legs)) < LEAST_LEGS:
        return None
    T_camera = solution.T_camera_Rb[int(measurements.view[row])]
    begin = solution.T_Rb_Re[int(measurements.pose[row])]
    A, B = (np.array([getattr(leg, name) for leg in solution.legs]) for name in "AB")
    radius = np.array([solution.radii[int(o.leg[i]), o.part[i]] for i in chosen.tolist()])
    signed = np.where(o.edge[chosen] == 1, radius, -radius)

    def pose(x: Array) -> RigidTransform:
        turn = Rotation.from_rotvec(x[:3]) * begin.rotation
        return RigidTransform.from_components(begin.translation + x[3:], turn)

    def residuals(x: Array) -> Array:
        ends = T_camera.apply(pose(x).apply(B))[legs]
        return np.asarray(np.sum(o.h[chosen] * ends, axis=1) - signed)

    def lengths(x: Array) -> Array:
        return np.asarray(np.linalg.norm(pose(x).apply(B) - A, axis=1))

    solved = least_squares(residuals, np.zeros(6), loss="soft_l1", f_scale=4.0 * LEAST_NOISE)
    J_outlines = np.asarray(solved.jac, dtype=np.float64)
    normal = J_outlines.T @ J_outlines
    if not solved.success or np.linalg.cond(normal) > 1e12:
        return None
    noise = max(LEAST_NOISE, 1.48 * float(np.median(np.abs(residuals(solved.x)))))
    step = 1e-6 * np.eye(6)
    J = np.stack([(lengths(solved.x + d) - lengths(solved.x - d)) / 2e-6 for d in step], axis=1)
    variance = np.einsum("ja,ab,jb->j", J, noise**2 * np.linalg.inv(normal), J)
    q0 = np.array([leg.q0 for leg in solution.legs])
    sign = np.array([leg.sign for leg in mechanism.legs])
    return _Readings(sign * (lengths(solved.x) - q0), np.sqrt(variance))


def _explanation(
    measurements: Measurements, mechanism: Mechanism, row: int, found: _Readings | None
) -> str:
    """Return what is to be looked for; nothing where the readings suit the image."""
    motors = list(mechanism.motors)
    if found is None or not motors:
        return "check its reading and that nobody moved camera or machine"
    given, shown, sigma = measurements.q[row, motors], found.q[motors], found.sigma[motors]
    off = shown - given
    reach = np.maximum(SURE * sigma, LEAST_OFF)
    wrong = np.flatnonzero(np.abs(off) > reach)
    names = [mechanism.leg_names[motors[k]] for k in wrong]
    alike = [
        other
        for other in range(measurements.n_rows)
        if measurements.image[other]
        and measurements.pose[other] != measurements.pose[row]
        and np.all(np.abs(measurements.q[other, motors] - shown) < np.maximum(SURE * sigma, SAME))
    ]
    if len(wrong) and alike:
        nearest = min(alike, key=lambda k: float(np.abs(measurements.q[k, motors] - shown).max()))
        return (
            f"it shows the reading given for image {measurements.image[nearest]}; check which "
            "image belongs to which row"
        )
    if len(wrong) == 0:
        return ""
    worst = 1e3 * float(np.abs(off[wrong]).max())
    if len(wrong) == 1:
        k = int(wrong[0])
        return (
            f"it shows a reading of {names[0]} of {1e3 * shown[k]:.2f} +- {1e3 * sigma[k]:.2f} mm, "
            f"given {1e3 * given[k]:.2f} mm; check that reading"
        )
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return (
        f"it shows another pose than its reading says, with readings of {', '.join(names[:SHOWN])}"
        f"{more} off by up to {worst:.1f} mm; check that it was taken there"
    )


# That of all outlines that are measured in photographs: light at the limb that no model of shading
# foresees looks like other radii, so that residuals never show it [px].
LIMB_BIAS = {"bias of many edges": 0.02}
LOST = 0.5  # of the outlines of an image: fewer were found


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
    corners : Corners or None
        Of the calibration board in all images, in the order of work; None without a board.
    notes : tuple of str
        What is to be said of the images by themselves.
    doubts : tuple of str
        What is to be said of them by the fit.
    other_radii : bool
        Whether the radii of the model were replaced by those that the images show.
    """

    outlines: Outlines
    fitted: IntArray
    part: Workpiece
    steps: Steps
    solution: Solution
    corners: Corners | None
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    other_radii: bool = False

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
    try:
        return _observe_and_fit(work, rows, progress)
    except NotIdentifiable:
        if not work.plan.is_cached:
            raise
    # Outlines that an earlier run left do not always tell where the cameras are; images do.
    anew = replace(work, plan=plan_dataset(work.dataset, ""))
    return _observe_and_fit(anew, rows, progress)


def _observe_and_fit(work: Workpiece, rows: IntArray, progress: Report) -> Found:
    """Measure the outlines of all images that have none yet, and fit everything to some."""
    photographs, part = work.photographs, work.part(rows)
    # Outlines that are kept were measured with some gamma: others of their camera must be as well.
    photographs = photographs.with_gammas(known_gammas(photographs.keep, photographs.measurements))
    fitted = inverse(work.order.rows)[rows[part.order.rows]]
    scene = scene_at_poses(work.mechanism, work.measurements, work.nominal_poses)
    board = observe_board(work, progress)
    if board is not None:
        T_base_board = base_of_board(work, board, scene.T_base_camera)
        scene = _placed_by_board(scene, board, T_base_board)
    if len(photographs.detect) == 0:
        outlines = given_outlines(photographs)
        return _noted(_fit(part, fitted, outlines, scene, board, progress), work.plan.notes)
    joined = None if board is None else board.T_board_camera
    observed = observe(photographs, scene, progress, joined, together=False)
    placement = observed.placement
    placement.require_one()
    other_radii = bool(placement.recognised.radii.factor)
    if other_radii:
        work = replace(work, mechanism=observed.photographs.mechanism)
        part = replace(part, mechanism=observed.photographs.mechanism)
    scene, outlines, notes = placement.scene, observed.outlines, placement.all_notes
    if part.every_leg and (observed.left_out or placement.unplaced):
        _refuse_too_few(work, fitted, observed)
    found = _fit(part, fitted, outlines, scene, board, progress)
    shown = np.setdiff1d(_placed_rows(photographs, scene), list(observed.left_out))
    if len(shown):
        first = disagreeing_images(part.measurements, part.mechanism, found.solution)
        scene = _fitted_scene(work, found.solution, scene)
        again = observed.photographs.narrowed(shown, found.outlines)
        cylinders = _fitted_cylinders(again.mechanism, found.solution)
        again = replace(again, mechanism=again.mechanism.with_cylinders(cylinders))
        methods = [
            outline_parts if np.isnan(blur) else partial(outline_parts, blur=blur)
            for blur in observed.blur
        ]
        given = known_gammas(again.keep, again.measurements)
        gammas: list[tuple[EstimatedGamma, ...]] = []
        for _ in range(1 + ROUNDS):
            outlines = detect(again, scene, progress, near_fit=True, method=methods)
            found = _fit(part, fitted, outlines, scene, board, progress)
            gammas.append(found.solution.gammas)
            others = {view: g for view, g in next_gammas(gammas).items() if view not in given}
            if not others:
                break
            again = again.with_gammas(others)
            scene = _fitted_scene(work, found.solution, scene)
        notes = (*notes, *_lost(found, first))
    return replace(_noted(found, notes), other_radii=other_radii)


def _lost(found: Found, first: dict[int, str]) -> list[str]:
    """Return what a first fit said of images in which hardly anything is found near it."""
    part, o = found.part, found.solution.outlines
    last = disagreeing_images(part.measurements, part.mechanism, found.solution)
    return [
        note
        for row, note in first.items()
        if row not in last and o.used[o.row == row].mean() < LOST
    ]


def _placed_rows(photographs: Photographs, scene: Scene) -> IntArray:
    """Return the searched rows whose views have a camera pose."""
    view, rows = photographs.measurements.view, photographs.detect
    placed = [scene.T_base_camera[v] is not None for v in view[rows].tolist()]
    return rows[np.array(placed, dtype=np.bool_)]


def _noted(found: Found, notes: tuple[str, ...]) -> Found:
    """Return what was found with what is to be said of the images, by themselves and by the fit."""
    part, solution = found.part, found.solution
    doubts = disagreeing_images(part.measurements, part.mechanism, solution)
    shown = set(part.measurements.view[solution.outlines.row[solution.outlines.used]].tolist())
    views = part.measurements.views
    cameras = [
        part.mechanism.T_base_Rb * T.inv() if v in shown else None
        for v, T in enumerate(solution.T_camera_Rb)
    ]
    hints = hint_notes([view.name for view in views], [v.T_base_camera for v in views], cameras)
    return replace(found, notes=notes, doubts=(*hints, *doubts.values()))


def _refuse_too_few(work: Workpiece, fitted: IntArray, observed: Observed) -> None:
    """Raise NotIdentifiable if the images that are left do not determine the parameters."""
    measurements, cameras = work.measurements, observed.placement.scene.T_base_camera
    left = [
        row
        for row in fitted.tolist()
        if row not in observed.left_out and cameras[measurements.view[row]] is not None
    ]
    notes = observed.placement.all_notes
    if not left:
        raise NotVisible(list(notes))
    try:
        check_identifiable(dataset_at(work.dataset, np.sort(work.order.rows[left])), work.choices)
    except NotIdentifiable as failure:
        raise NotIdentifiable([*failure.problems, *notes]) from None


def _placed_by_board(scene: Scene, board: BoardViews, T: RigidTransform | None) -> Scene:
    """Return a scene whose cameras stand to each other as the board at T_base_board shows them."""
    if T is None:
        return scene
    return replace(scene, T_base_camera=board.cameras(T, scene.T_base_camera))


def _fit(
    part: Workpiece,
    fitted: IntArray,
    outlines: Outlines,
    scene: Scene,
    board: BoardViews | None,
    progress: Report,
) -> Found:
    """Run the four steps, then the fit of everything from the nominal model and from the steps.

    ``fitted`` are the rows of the part among all in the order of work, that of ``outlines``.
    """
    seen = outlines_at(outlines, fitted)
    seen = reject_unused_legs(seen, part.measurements, part.mechanism.leg_names)
    if part.every_leg:
        _refuse_unseen_legs(part, seen)
    steps = four_steps(part, seen, board, progress)
    progress("Fit of everything", 0, 1)
    starts = starts_of_fit(part, seen, scene, steps, board)
    choices = part.choices
    if any(part.measurements.image) and "detected" in seen.source:
        choices = replace(choices, least_shared_px={**LIMB_BIAS, **choices.least_shared_px})
    solution = refine_from_best(
        part.fitted_legs,
        part.measurements,
        seen,
        starts,
        axes=part.axes,
        board=None if board is None else board.seen(fitted),
        choices=choices,
    )
    progress("Fit of everything", 1, 1)
    corners = None if board is None else board.judged(solution)
    return Found(outlines, fitted, part, steps, solution, corners)


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


def _fitted_cylinders(mechanism: Mechanism, solution: Solution) -> list[list[Cylinder]]:
    """Return what is seen of all legs with the radii of a fit.

    Cylinders of a leg that were equally thick stay so: they look like one.
    """
    found = []
    for j, leg in enumerate(mechanism.legs):
        fitted = {
            c.radius: solution.radii[j, c.link]
            for c in leg.cylinders
            if (j, c.link) in solution.radii
        }
        found.append([replace(c, radius=fitted.get(c.radius, c.radius)) for c in leg.cylinders])
    return found


def _fitted_scene(work: Workpiece, solution: Solution, before: Scene) -> Scene:
    """Return where a fit puts the legs; R_b is laid on the nominal R_b.

    Views that had no camera pose before have none now.
    """
    T_base_Rb = work.mechanism.T_base_Rb
    A = T_base_Rb.apply(np.array([leg.A for leg in solution.legs]))
    B = np.array([leg.B for leg in solution.legs])
    placed = np.array([(T_base_Rb * T).apply(B) for T in work.poses_by(solution.legs)])
    at_row = work.measurements.pose
    cameras = tuple(
        None if known is None else T_base_Rb * T.inv()
        for known, T in zip(before.T_base_camera, solution.T_camera_Rb, strict=True)
    )
    return Scene(np.broadcast_to(A, placed.shape)[at_row], placed[at_row], cameras)
