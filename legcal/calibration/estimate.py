"""From outlines to parameters: four steps and joint fit; then photographs measured near the fit.

In: a dataset in canonical order, outlines of all of its images and their placement.
Out: an :class:`Estimate`.

**Measured again.** Outlines measured near a fit hardly depend on the start of the search: fits that
agree give the same outlines; others give edges that light leaves open at one or another place.

**Gammas.** Where the gamma of a camera is not given, outlines are measured with a few gammas, and
the joint fit is repeated for each. With a wrong gamma, outlines are displaced by different amounts,
and residuals increase. The restricted likelihoods of the fits are compared, each with its estimated
noise and common-mode biases, over the outlines that all fits use; otherwise a gamma that loses
outlines would look right for the remaining ones. Linear photographs have a gamma of 1, sRGB ones
about 2.2: trials begin at 1 and go on in steps of :data:`GAMMA_STEP` until the likelihood falls.
No trial is made where the first fit, which estimates gamma as well, finds one that is significantly
below the next trial. The estimate is the vertex of a parabola through the best three. Where the
likelihood is flat, the first gamma stays.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.calibration.board import BoardViews
from legcal.calibration.diagnosis import Diagnosis
from legcal.calibration.four_steps import Steps, four_steps, starts, without_lost_images
from legcal.calibration.joint_fit.factors import known_gammas
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.rounds import with_edge_biases
from legcal.calibration.joint_fit.solution import Solution, in_file_order
from legcal.calibration.joint_fit.variables import DEFAULT_SETTINGS, RefinementSettings
from legcal.calibration.ordered_dataset import Options, OrderedDataset
from legcal.calibration.tuning import GAMMA_SIGMA, LIMB_BIAS_PX
from legcal.data.corners import Corners
from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.measurements import Measurements, few_views, image_notes
from legcal.data.outlines import (
    Outlines,
    along_legs,
    join_outlines,
    no_outlines,
    through_cameras,
)
from legcal.data.photograph_notes import compression_notes
from legcal.data.reasons import Reason, Rejection
from legcal.errors import Cause, DidNotConverge, NotIdentifiable, NotVisible
from legcal.estimation.solver import minimise
from legcal.estimation.uncertainty import restricted_log_likelihood
from legcal.files.schema import few
from legcal.geometry.types import Array
from legcal.machine.model import Machine
from legcal.perception.body_edges import measure_body_edges
from legcal.perception.diagnostics import is_visible, reject_images
from legcal.perception.outline import used_as_before
from legcal.perception.photographs import (
    MeasuredImages,
    Photographs,
    measure_photographs,
    place_and_measure,
    with_measured_radii,
)
from legcal.perception.placement import Joined, Placement

# Least common bias of all outlines in photographs [px]: limb shading outside of the model acts like
# a change of the radii, so that residuals never show it.
LIMB_BIAS = {"bias of many edges": LIMB_BIAS_PX}
MIN_REJECTED, MIN_REJECTED_LEGS = 0.5, 2  # share of outlines, and whole legs, of an outlier image
# Settings for a session with a suspected mistake: other starts and more iterations would not help,
# and contradictions to stated values are expected.
TRIAL = replace(DEFAULT_SETTINGS, other_starts=0, judges_stated_values=False, max_iterations=40)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Measured outlines and the parameters fitted to them, in canonical order."""

    fitted: OrderedDataset  # the fitted images
    outlines: Outlines  # outlines in all images
    steps: Steps
    solution: Solution
    corners: Corners | None  # board corners in all images; None without a board
    image_notes: tuple[str, ...] = ()  # notes on the images, before the fit
    fit_notes: tuple[str, ...] = ()  # notes on the images, by the fit
    other_radii: bool = False  # whether the images show other radii than the model has
    diagnosis: tuple[Diagnosis, ...] = ()  # suspected mistakes if many images were left out
    edges: Outlines | None = None  # of bodies, in all images

    @cached_property
    def outliers(self) -> dict[int, Cause]:
        """Causes for images that contradict the fit, by row."""
        m, boards = self.fitted.measurements, self.solution.posterior.problem.boards
        shown = np.concatenate([np.zeros(0, dtype=np.intp), *(board.view for board in boards)])
        lone = (np.bincount(m.view)[m.view] == 1) & ~np.isin(m.view, shown)
        return outlier_images(self.solution.outlines, np.flatnonzero(lone).tolist())

    def in_file_order(self) -> Estimate:
        """Return a copy with legs, views and images in the order of the files."""
        dataset, order = self.fitted.in_file_order()
        restore = self.fitted.order.restore
        return replace(
            self,
            outlines=restore(self.outlines),
            edges=None if self.edges is None else restore(self.edges),
            steps=self.steps.in_file_order(order),
            solution=in_file_order(self.solution, order, dataset),
            corners=None if self.corners is None else restore(self.corners),
        )


def outlier_images(outlines: Outlines, lone: Collection[int] = ()) -> dict[int, Cause]:
    """Return the images most of whose outlines a fit rejects, of two legs all, by row.

    Wrong readings of photographs are told before any fit, where legs are recognised. *lone* images
    have a camera pose of their own, by their legs alone.
    """
    rejected, causes = outlines.rejected_for(Reason.DISAGREES), dict[int, Cause]()
    for row in np.unique(outlines.row[rejected]).tolist():
        judged = (outlines.row == row) & (rejected | outlines.used)
        n, n_out = int(judged.sum()), int(rejected[judged].sum())
        legs = set(outlines.leg[judged & rejected].tolist())
        legs -= set(outlines.leg[judged & outlines.used].tolist())
        if n_out >= MIN_REJECTED * n and len(legs) >= MIN_REJECTED_LEGS:
            remedy = (
                "no board places its camera, and its legs may have placed it wrongly: show the "
                f"board, or click its joints ({LANDMARKS_NAME})"
                if row in lone
                else "check its readings, which image belongs to which row, and that nobody moved "
                "camera or machine"
            )
            said = f"{{}} of its {{}} outlines disagree with the fit and were left out; {remedy}."
            causes[row] = Cause(said, (n_out, n))
    return causes


def fit_outlines(
    fitted: OrderedDataset,
    outlines: Outlines,
    placement: Placement,
    board: BoardViews | None,
    options: Options,
    settings: RefinementSettings = DEFAULT_SETTINGS,
    *,
    steps: Steps | None = None,
    edges: Outlines | None = None,
) -> Estimate:
    """Run the four steps, then the joint fit, with the outlines of all images.

    ``steps`` is the result of the four steps from an earlier measurement; it is not recomputed.
    ``edges`` are those of bodies.

    Raises NotVisible if no image shows a leg that its view should show; NotIdentifiable or
    DidNotConverge, as the joint fit.
    """
    fitted_outlines = fitted.of_used_legs(outlines)
    unseen = unseen_legs(fitted.machine, fitted.measurements, fitted_outlines)
    if options.every_leg and unseen:
        raise NotVisible(
            f"{fitted.dataset.folder}: the machine could not be calibrated: no image has a usable "
            f"outline of {', '.join(unseen)}; add images that show it, or list the visible legs of "
            "each view in dataset.yaml, so that it relies on readings."
        )
    if steps is None:
        steps = four_steps(fitted, fitted_outlines, placement, board, options)
    fitted_outlines, board = without_lost_images(fitted, fitted_outlines, placement, steps, board)
    fitted.progress("Joint fit", 0, 1)
    choices = options.choices
    if any(fitted.measurements.image) and "detected" in fitted_outlines.source:
        least_px = {**LIMB_BIAS, **choices.least_shared_px}
        choices = replace(choices, least_shared_px=least_px, of_photographs=True)
    solution = refine(
        fitted.fitted_legs,
        fitted.measurements,
        fitted_outlines,
        starts(fitted, fitted_outlines, placement, steps, board),
        settings,
        board=None if board is None else board.at(fitted.rows),
        choices=choices,
        edges=None if edges is None else fitted.of_used_legs(edges),
    )
    fitted.progress("Joint fit", 1, 1)
    corners = None if board is None else board.reject_outliers(solution, fitted)
    return Estimate(fitted, outlines, steps, solution, corners, edges=edges)


def unseen_legs(machine: Machine, measurements: Measurements, outlines: Outlines) -> list[str]:
    """Return the legs that views should show and that have no used outline."""
    along = along_legs(outlines, machine.legs)
    shown = set(along.leg[along.used].tolist())
    views = [measurements.views[v] for v in np.unique(measurements.view).tolist()]
    return [
        leg.name
        for j, leg in enumerate(machine.legs)
        if j not in shown and leg.cylinders and any(view.uses(leg.name) for view in views)
    ]


def more_views(
    data: OrderedDataset, first: Estimate, seen: MeasuredImages, joined: Joined
) -> MeasuredImages:
    """Place views that have no camera yet where the fit to the others has the legs.

    Joints are known far better then than in the nominal model. Return *seen* itself where that
    places none. *joined* are T_board_camera of views that are placed together.
    """
    view = data.measurements.view
    missing = [k for k, T in enumerate(seen.placement.T_base_camera) if T is None]
    rows = seen.photographs.detect[np.isin(view[seen.photographs.detect], missing)]
    here = first.fitted.with_fitted_poses(first.solution.T_Rb_Re)
    near = _fitted_placement(replace(data, seen_poses=here.seen_poses), first.solution, seen)
    hints = [
        view.T_base_camera if T is None else T
        for T, view in zip(near.T_base_camera, data.measurements.views, strict=True)
    ]
    near = replace(near, T_base_camera=tuple(hints))
    search = replace(seen.photographs.narrowed(rows, seen.outlines), joint_error=0.0)
    again = place_and_measure(search, near, data.progress, joined, in_brief=True)
    cameras = tuple(
        found if T is None else T
        for T, found in zip(
            seen.placement.T_base_camera, again.placement.T_base_camera, strict=True
        )
    )
    if all(cameras[k] is None for k in missing) or again.photographs is not search:
        return seen  # nothing, or only with other radii than those of the fit
    placed = replace(
        seen.placement,
        T_base_camera=cameras,
        unplaced=again.placement.unplaced,
        notes=tuple(dict.fromkeys((*seen.placement.notes, *again.placement.notes))),
        barely={**seen.placement.barely, **again.placement.barely},
    )
    of_others = {row: why for row, why in seen.left_out.items() if row not in set(rows.tolist())}
    blur = tuple(
        other if k in missing else own
        for k, (own, other) in enumerate(zip(seen.blur, again.blur, strict=True))
    )
    return replace(
        seen,
        placement=placed,
        outlines=again.outlines,
        left_out=of_others | again.left_out,
        blur=blur,
    )


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
        used, still = (one.outlines.used_keys() for one in (first, with_gammas))
        lost, gained = len(used - still), len(still - used)
        if lost - gained <= SIGNIFICANCE * np.sqrt(lost + gained):  # McNemar's test
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
        edges = near.edges
        if like is None and any(photographs.machine.bodies):
            stage = "Measuring edges of bodies near the fit"
            edges = measure_body_edges(photographs, placement, progress, stage)
            if (given := self.data.body_edges) is not None:
                edges = join_outlines(
                    [edges, given.choose(~np.isin(given.row, photographs.detect))]
                )
        here = near.fitted.with_fitted_poses(near.solution.T_Rb_Re)
        return fit_outlines(
            here, outlines, placement, self.board, self.options, steps=near.steps, edges=edges
        )


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
    """Return the legs and cameras of a fit in all images; none of views without any before it."""
    poses = data.poses_by(solution.legs)
    placed = solution.placement(data.machine, data.measurements, poses, seen.blur)
    both = zip(seen.placement.T_base_camera, placed.T_base_camera, strict=True)
    return replace(placed, T_base_camera=tuple(None if known is None else T for known, T in both))


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


GAMMA_RANGE = (1.0, 3.0)  # of trials: from linear to beyond sRGB
GAMMA_STEP = 0.4  # in ln gamma
GAMMA_TOLERANCE = 0.12  # in ln gamma; smaller than LIMB_GAMMA_SIGMA
MAX_GAMMA_TRIALS = 4  # after the first one
SIGNIFICANCE = 2.0  # standard deviations

Views = tuple[str, ...]  # of one camera


@dataclass(frozen=True, eq=False)
class GammaTrials:
    """Fits to outlines measured with several gammas, in the order of trials."""

    cameras: tuple[Views, ...]  # views of each camera with an unknown gamma
    solutions: tuple[Solution | None, ...]  # the fit of each trial; None where it failed
    log_gamma: Array  # (n_trials, n_cameras)

    @classmethod
    def begun(cls, first: Solution, given: Mapping[str, float]) -> GammaTrials:
        """Start with the first fit; gammas of views in *given* are fixed by earlier outlines.

        A gamma stays where the fit itself estimates one significantly below the next trial.
        """
        unknown = [
            estimate
            for estimate in first.gammas
            if not any(view in given for view in estimate.views)
            and np.log(estimate.gamma / estimate.measured_with) + SIGNIFICANCE * estimate.sigma
            > GAMMA_STEP
        ]
        logs = np.log([estimate.measured_with for estimate in unknown])
        return cls(tuple(estimate.views for estimate in unknown), (first,), logs[None])

    def tried(self, gammas: Mapping[str, float], solution: Solution | None) -> GammaTrials:
        """Append a trial with gammas by view."""
        row = np.log([[gammas[views[0]] for views in self.cameras]])
        return replace(
            self,
            solutions=(*self.solutions, solution),
            log_gamma=np.concatenate([self.log_gamma, row]),
        )

    @property
    def best(self) -> int:
        """Index of the most likely trial."""
        return int(np.argmax(self.likelihoods.sum(axis=1)))

    @cached_property
    def likelihoods(self) -> Array:
        """Log-likelihoods by camera with the prior of gamma, (n_trials, n_cameras).

        Minus infinity where the fit failed.
        """
        if not self.cameras:
            return np.zeros(self.log_gamma.shape)
        fitted = [solution for solution in self.solutions if solution is not None]
        log_likelihood = np.full(self.log_gamma.shape, -np.inf)
        is_fitted = np.array([solution is not None for solution in self.solutions])
        log_likelihood[is_fitted] = log_likelihoods(fitted, self.cameras)
        return np.asarray(log_likelihood - 0.5 * (self.log_gamma / GAMMA_SIGMA) ** 2)

    def next(self) -> dict[str, float]:
        """Return the gammas of the next trial, by view; empty if no trial is needed."""
        if not self.cameras or len(self.solutions) > MAX_GAMMA_TRIALS:
            return {}
        merits = self.likelihoods.T
        trials = list(zip(self.log_gamma.T, merits, strict=True))
        next_logs = [next_trial(*trial) for trial in trials]
        if all(trial is None for trial in next_logs):
            return {}
        best_logs = [float(tried[np.argmax(merit)]) for tried, merit in trials]
        return self._by_view(
            [b if a is None else a for a, b in zip(next_logs, best_logs, strict=True)]
        )

    def found(self) -> dict[str, float]:
        """Return the most likely gammas by view; empty if the first trial is close enough."""
        peaks = [
            most_likely(tried, merit)
            for tried, merit in zip(self.log_gamma.T, self.likelihoods.T, strict=True)
        ]
        moved = np.abs(np.array(peaks) - self.log_gamma[0]) > GAMMA_TOLERANCE
        return self._by_view(peaks) if np.any(moved) else {}

    def notes(self, refused: Mapping[str, float]) -> tuple[str, ...]:
        """Return notes on cameras with an undecided gamma; *refused* gammas lose outlines."""
        notes = []
        for views, tried, merit in zip(
            self.cameras, self.log_gamma.T, self.likelihoods.T, strict=True
        ):
            if views[0] in refused:
                why = f"with {refused[views[0]]:.2f}, fewer of its outlines are usable"
            elif np.isfinite(merit).sum() == 1 < len(merit):
                why = "the fit failed with every other gamma"
            elif (rival := _rival(tried, merit)) is not None:
                why = f"its outlines are about as likely with {np.exp(rival):.2f}"
            else:
                continue
            notes.append(
                f"The gamma of the camera of {few_views(views)} could not be determined: {why}; "
                "in-camera processing is a common cause; state gamma of the views in dataset.yaml, "
                "or switch the processing off."
            )
        return tuple(notes)

    def _by_view(self, log_gammas: Sequence[float]) -> dict[str, float]:
        return {
            view: float(np.exp(log_gamma))
            for views, log_gamma in zip(self.cameras, log_gammas, strict=True)
            for view in views
        }


def next_trial(log_gamma: Array, merit: Array) -> float | None:
    """Return ln gamma of the next trial beside the most likely one, if any."""
    best = float(log_gamma[np.argmax(merit)])
    least, most = np.log(GAMMA_RANGE).tolist()
    neighbours = [float(np.clip(best + side * GAMMA_STEP, least, most)) for side in (1.0, -1.0)]
    for candidate, side in zip(neighbours, (1.0, -1.0), strict=True):
        is_new = abs(candidate - best) > GAMMA_TOLERANCE
        if is_new and not np.any(side * (log_gamma - best) > GAMMA_TOLERANCE):
            return candidate
    return None


def most_likely(log_gamma: Array, merit: Array) -> float:
    """Return the most likely ln gamma, by a parabola through the best three trials.

    The first trial wins unless another one is significantly better.
    """
    x, y, i = _in_order(log_gamma, merit)
    if y[i] - merit[0] <= 0.5 * SIGNIFICANCE**2:
        return float(log_gamma[0])
    if not 0 < i < len(x) - 1 or not np.all(np.isfinite(y[i - 1 : i + 2])):
        return float(x[i])
    left, right = (y[i] - y[i - 1]) / (x[i] - x[i - 1]), (y[i + 1] - y[i]) / (x[i + 1] - x[i])
    midpoints = 0.5 * (x[i - 1] + x[i]), 0.5 * (x[i] + x[i + 1])
    return (
        float(midpoints[0] + (midpoints[1] - midpoints[0]) * left / (left - right))
        if left > right
        else float(x[i])
    )


def _rival(log_gamma: Array, merit: Array) -> float | None:
    """Return ln gamma of another trial nearly as likely as the best one, if any."""
    x, y, i = _in_order(log_gamma, merit)
    near = [k for k in range(len(x)) if k != i and y[i] - y[k] <= 0.5 * SIGNIFICANCE**2]
    return float(x[near[0]]) if near else None


def _in_order(log_gamma: Array, merit: Array) -> tuple[Array, Array, int]:
    """Sort trials by gamma, the most likely one of equal gammas; also return the best index."""
    order = sorted(range(len(merit)), key=lambda k: (log_gamma[k], -merit[k]))
    distinct = [k for n, k in enumerate(order) if n == 0 or log_gamma[k] > log_gamma[order[n - 1]]]
    return log_gamma[distinct], merit[distinct], int(np.argmax(merit[distinct]))


def log_likelihoods(solutions: Sequence[Solution], cameras: Sequence[Views]) -> Array:
    """Return restricted log-likelihoods (n_solutions, n_cameras) of the outlines used in all fits.

    Noise and biases are the most likely ones of each fit. The terms that do not belong to single
    outlines are divided among cameras by their numbers of outlines.
    """
    common_keys = set.intersection(*(solution.outlines.used_keys() for solution in solutions))
    log_likelihood = np.zeros((len(solutions), len(cameras)))
    for i, solution in enumerate(solutions):
        fit, key_of_row = solution.posterior, solution.outlines.row_keys()
        o = fit.problem.outlines
        kept = np.array([key_of_row[k] in common_keys for k in o.index.tolist()], dtype=np.bool_)
        problem, state = with_edge_biases(fit.problem, fit.state, fit.edge_biases.likeliest)
        problem = problem.weighted(fit.noise, kept)
        minimum = minimise(problem, state, is_near=True)
        norms = minimum.linear["outlines"].squared_norms
        log_determinants = np.linalg.slogdet(fit.noise.covariance(o.covariance))[1]
        log_densities = -0.5 * (norms + log_determinants) * kept
        shared = restricted_log_likelihood(minimum) + 0.5 * float(norms.sum())
        for c, views in enumerate(cameras):
            of_camera = np.array([name in views for name in o.views], dtype=np.bool_)[o.view]
            share = float(np.sum(of_camera & kept)) / max(float(np.sum(kept)), 1.0)
            log_likelihood[i, c] = log_densities[of_camera].sum() + share * shared
    return log_likelihood
