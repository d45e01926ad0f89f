"""Second measurement of the photographs near a fit, and a second fit.

Outlines measured there hardly depend on the start of the search: fits that agree give the same
outlines; others give edges that light leaves open at one or another place. Where outlines show the
gamma of a camera that is not given, they are measured and fitted again with that gamma.
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

# Outlines are measured again while this percentile of the joints moves by more, at most so often
MAX_JOINT_SHIFT_PX, JOINT_PERCENTILE, MAX_ROUNDS = 1.0, 90.0, 4
MIN_FOUND_AGAIN = 0.5  # least share of the outlines of an image, or of all


def measure_again(
    data: OrderedDataset,
    estimate: Estimate,
    seen: MeasuredImages,
    board: BoardViews | None,
    options: Options,
) -> Estimate:
    """Measure photographs again near a fit, and fit again.

    Photographs that show nothing like the legs before any fit are searched as well; they count if
    most outlines are found now.
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
        with_gammas = search.fitted(best, refused)
        if not loses_outlines(first.outlines, with_gammas.outlines):
            last, refused = with_gammas, {}
    measured = {data.measurements.image[row] for row in photographs.detect.tolist()}
    facts = {image: fact for image, fact in data.dataset.facts.items() if image in measured}
    notes = compression_notes(data.measurements, facts)
    return replace(last, image_notes=(*trials.notes(refused), *notes))


@dataclass(frozen=True, eq=False)
class _SearchNearFit:
    """Photographs that are measured near fits, with the data and options of these fits."""

    data: OrderedDataset
    photographs: Photographs  # those that are searched again
    seen: MeasuredImages  # the first measurement, before any fit
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
        for _ in range(MAX_ROUNDS):
            near, before = self.fitted(near, {}), joints
            joints = self._joints(near)
            away = np.linalg.norm(joints - before, axis=-1)
            if (
                not np.isfinite(away).any()
                or np.nanpercentile(away, JOINT_PERCENTILE) <= MAX_JOINT_SHIFT_PX
            ):
                break
        return near

    def _joints(self, near: Estimate) -> Array:
        """Return the images of the joints of a fit, (n, 2 n_legs, 2) [px]; NaN behind a camera."""
        m, rows = self.data.measurements, self.photographs.detect
        _, placement = self.at(near, {})
        joints = np.concatenate([placement.A_base, placement.B_base], axis=1)[rows]
        pixels = np.full((*joints.shape[:2], 2), np.nan)
        for of_row, joints_of_row, v in zip(pixels, joints, m.view[rows].tolist(), strict=True):
            T = placement.T_base_camera[v]
            if T is not None:
                X = T.inv().apply(joints_of_row)
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
        lenses = [[seen.camera for seen in p.measurements.views] for p in both]
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

    Cylinders of a leg with the same radius keep the same radius.
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
    """Return the legs and cameras of a fit, with R_b on the nominal one."""
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
    return [row for row, flags in used.items() if not len(flags) or flags.mean() < MIN_FOUND_AGAIN]


def not_found_again(first: Estimate, again: Estimate) -> list[str]:
    """Return the notes of a first fit on images in which hardly anything is found near it.

    Those on cameras as well, where that is so of all images together.
    """
    before, outlines = first.outliers, again.solution.outlines
    gone = hardly_shown(outlines, [row for row in before if row not in again.outliers])
    few_found = outlines.used.sum() < MIN_FOUND_AGAIN * first.solution.outlines.used.sum()
    cameras = map(str, first.solution.camera_doubts if few_found else ())
    notes = image_notes(first.fitted.measurements, {row: before[row] for row in gone})
    return [*cameras, *notes]
