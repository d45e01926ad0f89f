"""Photographs measured again close to a fit, and fitted again.

What is measured there depends little on where the search for the fit began: fits that agree give
the same outlines, others give edges that light leaves open at one or another place. Where the
outlines show the gamma of a camera that is not given, all is done again with that.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.board import BoardViews
from legcal.calibration.estimate import Estimate, fit_outlines
from legcal.calibration.joint_fit.factors import known_gammas
from legcal.calibration.joint_fit.gammas import GammaTrials, loses_outlines
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.ordered_dataset import Options, OrderedDataset
from legcal.data.image_causes import image_notes
from legcal.data.measurements import few
from legcal.data.outlines import Outlines, no_outlines, polished_parts, through_cameras
from legcal.data.photograph_notes import compression_notes
from legcal.data.reasons import Reason, Rejection
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.model import Machine
from legcal.machine.rods import ends_in_base, measured_readings
from legcal.perception.diagnostics import is_visible, reject_images
from legcal.perception.outline import used_as_before
from legcal.perception.photographs import (
    MeasuredImages,
    Photographs,
    measure_photographs,
    with_measured_radii,
)
from legcal.perception.placement import Placement, placed_arms

# Of joints between two fits, from where on outlines are measured again: this percentile of all
MOVED_PX, MOST_JOINTS, MOST_ROUNDS = 1.0, 90.0, 4
MIN_FOUND_AGAIN = 0.5  # of the outlines of an image, or of all


def measure_again(
    data: OrderedDataset,
    estimate: Estimate,
    seen: MeasuredImages,
    board: BoardViews | None,
    options: Options,
) -> Estimate:
    """Search photographs again, close to a fit, and fit again.

    Those that were kept, and those in which nothing like the legs was found before any fit: they
    count if most outlines are found now.
    """
    rows = seen.kept(seen.photographs.detect)
    if not len(rows):
        return estimate
    rows = np.sort(np.append(rows, np.array(seen.unlike, dtype=np.intp)))
    photographs = seen.photographs.narrowed(rows, estimate.outlines)
    search = _SearchNearFit(data, photographs, seen, board, options)
    first = best = search.converged(estimate)
    trials = GammaTrials.begun(
        first.solution, known_gammas(photographs.keep, photographs.measurements)
    )
    while gammas := trials.next():
        try:
            there = search.fitted(best, gammas, like=first.outlines)
        except (DidNotConverge, NotIdentifiable, NotVisible):
            trials = trials.tried(gammas, None)
            continue
        trials = trials.tried(gammas, there.solution)
        if trials.best == len(trials.solutions) - 1:
            best = there
    last, refused = first, trials.found()
    if refused:
        found = search.fitted(best, refused)
        if not loses_outlines(first.outlines, found.outlines):
            last, refused = found, {}
    measured = {data.measurements.image[row] for row in photographs.detect.tolist()}
    facts = {image: found for image, found in data.dataset.facts.items() if image in measured}
    notes = compression_notes(data.measurements, facts)
    return replace(last, image_notes=(*trials.notes(refused), *notes))


@dataclass(frozen=True, eq=False)
class _SearchNearFit:
    """Photographs that are measured close to a fit, and what else fits have in common."""

    data: OrderedDataset
    photographs: Photographs  # those that are searched again
    seen: MeasuredImages  # what was found before any fit
    board: BoardViews | None
    options: Options

    def at(self, near: Estimate, gammas: Mapping[str, float]) -> tuple[Photographs, Placement]:
        """Return the photographs with the radii and cameras of a fit, and where it has the legs."""
        machine = _with_fitted_radii(self.photographs.machine, near.solution)
        photographs = replace(self.photographs, machine=machine)
        photographs = photographs.with_intrinsics(near.solution.cameras).with_gammas(gammas)
        here = near.fitted.with_fitted_poses(near.solution.T_Rb_Re)
        every = replace(self.data, seen_poses=here.seen_poses)
        return photographs, _fitted_placement(every, near.solution, self.seen)

    def converged(self, near: Estimate) -> Estimate:
        """Measure near a fit and fit again, until outlines are where they were looked for."""
        joints = self._joints(near)
        for _ in range(MOST_ROUNDS):
            near, before = self.fitted(near, {}), joints
            joints = self._joints(near)
            away = np.linalg.norm(joints - before, axis=-1)
            if not np.isfinite(away).any() or np.nanpercentile(away, MOST_JOINTS) <= MOVED_PX:
                break
        return near

    def _joints(self, near: Estimate) -> Array:
        """Return where photographs show the joints of a fit, (n, 2 n_legs, 2) [px], or NaN."""
        m, rows = self.data.measurements, self.photographs.detect
        _, placement = self.at(near, {})
        joints = np.concatenate([placement.A_base, placement.B_base], axis=1)[rows]
        pixels = np.full((*joints.shape[:2], 2), np.nan)
        for of_row, own, v in zip(pixels, joints, m.view[rows].tolist(), strict=True):
            T = placement.T_base_camera[v]
            if T is not None:
                X = T.inv().apply(own)
                ahead = X[:, 2] > 0.0
                of_row[ahead] = m.views[v].camera.project(X[ahead])
        return pixels

    def fitted(
        self, near: Estimate, gammas: Mapping[str, float], *, like: Outlines | None = None
    ) -> Estimate:
        """Measure near a fit and fit again, with the same outlines used as in *like*, if given."""
        photographs, placement = self.at(near, gammas)
        stage = "Measuring outlines near the fit"
        if gammas:
            stage += f", gamma {few(sorted({f'{gamma:.2f}' for gamma in gammas.values()}))}"
        search, progress = replace(photographs, keep=no_outlines()), self.data.progress
        outlines = measure_photographs(search, placement, progress, stage=stage)
        other = None if like is not None else with_measured_radii(search, placement, outlines)
        if other is not None:
            stage += " with other radii"
            with_other = measure_photographs(other, placement, progress, stage=stage)
            outlines = max(outlines, with_other, key=lambda found: int(found.used.sum()))
        # The table and the next fit have the cameras of the files.
        both, view = (photographs, self.photographs), self.data.measurements.view
        lenses = [[one.camera for one in p.measurements.views] for p in both]
        outlines = through_cameras(outlines, view[outlines.row], *lenses)
        still = hardly_shown(outlines, self.seen.unlike)
        outlines = reject_images(outlines, dict.fromkeys(still, Rejection(Reason.OTHER_SCENE)))
        outlines = self.photographs.with_found(outlines)
        if like is not None:
            outlines = used_as_before(outlines, like)
        here = near.fitted.with_fitted_poses(near.solution.T_Rb_Re)
        return fit_outlines(here, outlines, placement, self.board, self.options, steps=near.steps)


def _with_fitted_radii(machine: Machine, solution: Solution) -> Machine:
    """Return the visible cylinders of the legs with the radii of a fit.

    Cylinders of a leg that were equally thick stay so: they look like one.
    """
    fitted = [
        {
            c.radius: solution.radii[j, c.link]
            for c in leg.cylinders
            if (j, c.link) in solution.radii
        }
        for j, leg in enumerate(machine.legs)
    ]
    return machine.with_radii(lambda j, c: fitted[j].get(c.radius, c.radius))


def _fitted_placement(data: OrderedDataset, solution: Solution, seen: MeasuredImages) -> Placement:
    """Return where a fit puts the legs, R_b laid on the nominal one; no camera is placed anew."""
    T_base_Rb, poses = data.machine.T_base_Rb, components(data.poses_by(solution.legs))
    m = data.measurements
    q = measured_readings(solution.legs, *poses, m.q_of_poses)
    A, B = ends_in_base(solution.legs, T_base_Rb, *poses, q)
    pose = data.measurements.pose
    cameras = tuple(
        None if known is None else T
        for known, T in zip(
            seen.placement.T_base_camera, solution.cameras_in_base(T_base_Rb), strict=True
        )
    )
    arms = placed_arms(solution.legs, q, pose, T_base=T_base_Rb, radii=solution.radii)
    polished = polished_parts(solution.outlines)
    return Placement.of_fit(A[pose], B[pose], cameras, seen.blur, arms, polished)


def shown_near(estimate: Estimate, placement: Placement) -> Placement:
    """Return the placement without what was said of images most of which a fit uses after all."""
    still = hardly_shown(estimate.solution.outlines, placement.barely)
    return replace(placement, barely={row: placement.barely[row] for row in still})


def hardly_shown(outlines: Outlines, rows: Iterable[int]) -> list[int]:
    """Return the images of some of which less than half of the visible outlines is used."""
    shown = outlines.choose(is_visible(outlines))
    used = {row: shown.used[shown.row == row] for row in rows}
    return [row for row, own in used.items() if not len(own) or own.mean() < MIN_FOUND_AGAIN]


def not_found_again(first: Estimate, again: Estimate) -> list[str]:
    """Return the notes of a first fit on images in which hardly anything is found near it.

    Those on cameras as well, where that is so of all images together.
    """
    before, found = first.outliers, again.solution.outlines
    gone = hardly_shown(found, [row for row in before if row not in again.outliers])
    few_found = found.used.sum() < MIN_FOUND_AGAIN * first.solution.outlines.used.sum()
    cameras = first.solution.camera_doubts.notes if few_found else ()
    notes = image_notes(first.fitted.measurements, {row: before[row] for row in gone})
    return [*cameras, *notes]
