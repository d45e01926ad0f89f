"""What speaks against a calibration: one list, made once, that all answers follow.

A result is trusted where the list is empty. Grave doubts say that the result is wrong or no better
than the nominal model: it is not to be loaded. Each doubt has its effect on the platform if it were
true, where that can be computed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtri, stdtrit

from legcal.calibration.diagnosis import Diagnosis
from legcal.calibration.documents import Doubt, Holdout
from legcal.calibration.joint_fit.diagnostics import MOST_SCATTER, Scatter
from legcal.calibration.joint_fit.held_out import CrossValidation, cross_validate
from legcal.calibration.joint_fit.parameter_choices import dataset_parameters
from legcal.calibration.joint_fit.platform import (
    PlatformAccuracy,
    PlatformError,
    moved_by,
    platform_by_parameters,
    poses_at_readings,
)
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.scale import (
    BOARD,
    MODEL,
    RADII,
    TRAVEL,
    NominalSize,
    compare_scales,
    scale_witnesses,
    stated_lengths,
)
from legcal.calibration.joint_fit.sensitivity import FITTED_CAMERA
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.session_changes import (
    ALL_MOTORS,
    OF_MOTORS,
    OF_SCATTER,
    SessionTests,
    UnmodelledEffect,
)
from legcal.calibration.tuning import SCALE_BY_CHANCE
from legcal.data.corners import Corners
from legcal.data.dataset import Dataset
from legcal.data.landmarks import Landmarks, joint_name
from legcal.data.measurements import few_views, row_names
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import few
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.kinematics import pose_differences
from legcal.machine.leg import Leg, ParameterId
from legcal.machine.parameters import geometries, vector_of
from legcal.machine.rods import ends_at_poses
from legcal.perception.diagnostics import far_from_hints, images_left_out, is_measurable

CAMERA = "camera"  # code of the doubt in cameras that the measurements contradict
TOLERANCE = "tolerance"  # code of the doubt in parameters that moved far
# codes of what does not make the platform more uncertain by the covariance of the fit
BESIDE_SIGMA = frozenset(
    ("strayed_camera", "scale", "pitch", "nominal_length", TOLERANCE, "no_better", "held_out")
)
MAX_LEFT_OUT = 0.25  # of the images, beyond which something is wrong with the session
MIN_USED = 2.0 / 3.0  # of the outlines of visible legs
MOST_WIDTHS, MIN_WIDTHS = 0.55, 8  # share of the images of a part with another width; and number
MOST_OFF = 2.0  # times what was expected of held-out images, in pixels
MOST_SQUARES = 2.0  # times what was expected of left-out images, in squared sigmas
_SURE = 5.0  # standard deviations of these squares
MIN_GAIN = 0.5  # of what a change claims to predict better, by its information on left-out images
_LAST_DIGIT = 0.5e-6  # [m] half of the last digit of printed lengths
MOST_MOVED = 4.0  # standard deviations of a change by tolerance and fit; one machine in 500 has one


def model_error(doubts: Sequence[Doubt]) -> tuple[float, float]:
    """Return the displacement [m] and rotation [rad] of the platform by all doubts together."""
    displacement = float(np.hypot.reduce([one.sigma_dX_m or 0.0 for one in doubts] or [0.0]))
    return displacement, float(
        np.hypot.reduce([one.sigma_dE_rad or 0.0 for one in doubts] or [0.0])
    )


OF_CHANGES = frozenset(("noise", CAMERA, "left_out"))  # codes of what a change leaves behind


def doubts_of(
    dataset: Dataset,
    solution: Solution,
    platform: PlatformAccuracy | None,
    held_out: Holdout | None,
    diagnosis: Sequence[Diagnosis],
    corners: Corners | None,
    session: SessionTests,
) -> tuple[Doubt, ...]:
    """Return all that speaks against a result but for the size of its improvement.

    Accusations are compared here, so that nothing right is accused of what something else did: a
    mistake that explains the images explains whatever else they contradict. A change in the course
    of the session, or two scales, make outlines scatter, bend cameras and move parameters; a motor
    that is named explains the readings that disagree and the outlines of its own legs.
    """
    if diagnosis:
        return tuple(Doubt("mistake", x.finding, x.remedies, is_grave=True) for x in diagnosis)
    of = _Evidence(dataset, solution, platform, session)
    noise = of.noise()
    course = of.changes(scatters=bool(noise))
    # A scale that all motors share is one witness of the scale against the others
    is_of_scale = any(one.kind == "pitch" for one in session.findings)
    scale = [] if course and not is_of_scale else of.scale()
    causes = [*scale, *(doubt for doubt in course if not (scale and doubt.code == "pitch"))]
    codes = {doubt.code for doubt in course}
    named = [one.subject for one in session.findings if one.kind in codes]
    motors = {motor for subject in named for motor in subject.split(", ")}
    motors |= {subject.partition(".")[0] for subject in motors}  # legs of joints
    explained = {
        leg.name for leg in dataset.machine.legs if motors & {leg.motor_label, leg.name, ALL_MOTORS}
    }
    causes = [*_not_round(dataset.machine.legs, solution.outlines), *causes]
    symptoms = (
        []
        if causes
        else [
            *of.moved_parameters(),
            *_held_out(held_out),
            *(of.cameras() or [*of.left_out(), *noise]),
        ]
    )
    if session.findings and any(one.code in OF_CHANGES for one in symptoms):
        # Certain changes, too small to count by themselves, are what makes outlines scatter
        causes = [Doubt(one.kind, one.what, one.remedy) for one in session.findings]
        symptoms = [one for one in symptoms if one.code not in OF_CHANGES]
    if causes and {one.code for one in causes} <= OF_SCATTER:
        # A model that was led away scatters readings and cameras as well
        symptoms = of.left_out()
    readings = solution.quality.redundant_readings
    contradicted = () if readings is None or codes & OF_MOTORS else readings.doubts
    return (
        *(Doubt("readings", what, remedy, is_grave=True) for what, remedy in contradicted),
        *_legs_left_out(solution, explained),
        *_clicks(dataset, solution),
        *_views(dataset, solution, corners),
        *(one for one in _strayed_cameras(dataset, solution) if one.is_grave or not causes),
        *([] if causes else _few_outlines(solution.outlines)),
        *of.nominal_lengths(),
        *of.no_better(),
        *causes,
        *symptoms,
    )


def _legs_left_out(solution: Solution, explained: Collection[str]) -> list[Doubt]:
    """Return legs in views most of whose outlines were rejected, but for *explained* ones."""
    left_out = [one for one in solution.left_out if not any(f" of {j} " in one for j in explained)]
    if not left_out:
        return []
    what = (
        "most outlines of a leg that a view shows disagree with the fit "
        f"({', '.join(left_out)}), so that they are of something else or the fit is wrong"
    )
    remedy = (
        "look at them in the table of observations, and correct them or leave the leg out of the "
        "legs of that view"
    )
    return [Doubt("leg_left_out", what, remedy, is_grave=True)]


def _clicks(dataset: Dataset, solution: Solution) -> list[Doubt]:
    """Return views whose clicks the fit contradicts."""
    distances = {
        name: px for name, (px, most) in click_distances(dataset, solution).items() if px > most
    }
    if not distances:
        return []
    contradicted = [f"{name} ({px:.0f} px)" for name, px in distances.items()]
    views = zip(dataset.measurements.views, solution.T_camera_Rb, solution.cameras, strict=True)
    seen = [
        distances[view.name] * float(np.linalg.norm(T.translation)) / camera.K[0, 0]
        for view, T, camera in views
        if view.name in distances
    ]
    off = float(max(seen))  # [m] in that view
    what = (
        f"most clicks on joints in {few_views(contradicted)} are that far from where the fit has "
        "these joints, so that it is wrong or they are"
    )
    remedy = "look at the outlines in these images, and at the clicks (legcal detect --edit)"
    return [Doubt("clicks", what, remedy, off, off / dataset.machine.size, is_grave=True)]


def _strayed_cameras(dataset: Dataset, solution: Solution) -> list[Doubt]:
    """Return cameras far from where they are stated, unless that means another thing.

    It is grave where platform poses were looked for near the stated cameras.
    """
    m, machine = dataset.measurements, dataset.machine
    strayed = far_from_hints(
        [None if view.name in m.clicked_views else view.T_base_camera for view in m.views],
        solution.shown_cameras(m, machine.T_base_Rb),
    )
    if not strayed:
        return []
    of_views = few_views([m.views[v].name for v in strayed])
    if machine.is_determined:
        what = f"the fit has the camera of {of_views} far from its T_base_camera"
        remedy = (
            "look at the overlays of that view, and measure its place again; correct "
            "T_base_camera in dataset.yaml if that was wrong"
        )
        return [Doubt("strayed_camera", what, remedy)]
    what = (
        f"the fit has {of_views} far from the rough T_base_camera near which platform poses were "
        "looked for, so that these are wrong or it is"
    )
    remedy = "measure it again, or take images that show more legs"
    return [Doubt("strayed_camera", what, remedy, is_grave=True)]


def _mean(error: PlatformError | None, part: float = 1.0) -> tuple[float | None, float | None]:
    """Return a part of the mean displacement and rotation of the platform, where known."""
    if error is None:
        return None, None
    return part * error.mean_displacement, part * error.mean_rotation


def used_share(outlines: Outlines) -> float:
    """Return the share of the outlines of visible legs that are used, 1 without any.

    What people leave out, and arms that are left out as a whole, do not count.
    """
    chosen = outlines.rejected_for(Reason.BY_HAND, Reason.UNUSED_LEG, Reason.ARM_LEFT_OUT)
    shown = outlines.choose(is_measurable(outlines) & ~chosen)
    return float(shown.used.mean()) if len(shown) else 1.0


def _views(dataset: Dataset, solution: Solution, corners: Corners | None) -> list[Doubt]:
    """Return views without an image in the fit, and many images left out of the others.

    Views of one image, as a camera in the hand has, count as images.
    """
    m, outlines = dataset.measurements, solution.outlines
    chosen = outlines.rejected_for(Reason.BY_HAND, Reason.UNUSED_LEG)
    asked = set(m.view[outlines.row[~chosen]].tolist())
    rows = outlines.row[outlines.used]
    if corners is not None:
        rows = np.concatenate([rows, corners.row[corners.used]])
    fitted = set(m.view[rows].tolist())
    doubts = list[Doubt]()
    lone = set(np.flatnonzero(np.bincount(m.view, minlength=len(m.views)) == 1).tolist())
    if unplaced := sorted(asked - fitted - lone):
        names = few_views([m.views[v].name for v in unplaced])
        n = len(unplaced)
        what = f"no image of {names} could be used: {n} of {len(asked)} views have no part in it"
        remedy = "see in the notes why, take these images again, or leave the view out"
        doubts.append(Doubt("view_left_out", what, remedy))
    counted = fitted | (asked & lone)
    left_out = [row for row in images_left_out(outlines) if int(m.view[row]) in counted]
    images = int(np.isin(m.view, list(counted)).sum())
    if len(left_out) > MAX_LEFT_OUT * images:
        what = f"{len(left_out)} of {images} images were left out"
        remedy = "see in the notes why, and take them again, or leave them out"
        doubts.append(Doubt("images_left_out", what, remedy))
    return doubts


def _not_round(legs: Sequence[Leg], outlines: Outlines) -> list[Doubt]:
    """Return the parts that seldom are as wide as their cylinders, those of one radius together.

    Both edges of a body that is not round are found, and their distance changes with its roll.
    """
    alike: dict[float, list[tuple[int, str]]] = {}
    for j, leg in enumerate(legs):
        for part, radius in leg.radius_along.items():
            alike.setdefault(round(radius, 6), []).append((j, part))
    doubts = list[Doubt]()
    for radius, parts in alike.items():
        counts = np.array([width_counts(outlines, j, part) for j, part in parts])
        n, n_wrong = int(counts.sum()), int(counts[:, 0].sum())
        if n_wrong < max(MIN_WIDTHS, MOST_WIDTHS * n):
            continue
        names = [part for (_, part), (wrong, _) in zip(parts, counts, strict=True) if wrong]
        what = (
            f"the edges of {few(names)} are not as far apart as those of a cylinder of radius "
            f"{1e3 * radius:.3g} mm in {n_wrong} of the {n} times that both were seen"
        )
        remedy = (
            "if it is not round, draw it as a box in the URDF, or leave it out; else correct its "
            "radius"
        )
        doubts.append(Doubt("not_round", what, remedy))
    return doubts


def width_counts(outlines: Outlines, leg: int, part: str) -> tuple[int, int]:
    """Return in how many images a part has another width than its cylinder, and in how many not.

    Of those that show both edges.
    """
    of = (outlines.leg == leg) & (np.array(outlines.part) == part)
    is_wide = of & outlines.rejected_for(Reason.WIDTH)
    both = np.bincount(outlines.row[of & outlines.used]) > 1
    return len(np.unique(outlines.row[is_wide])), int(both.sum())


def _few_outlines(outlines: Outlines) -> list[Doubt]:
    """Return whether many outlines of legs that are in sight could not be used."""
    share = used_share(outlines)
    if share >= MIN_USED:
        return []
    what = f"only {100.0 * share:.0f} % of the outlines of visible legs could be used"
    remedy = (
        "look at the overlays (legcal detect) for reflections, shadows and other edges along the "
        "legs, and improve light and background"
    )
    return [Doubt("few_outlines", what, remedy)]


@dataclass(frozen=True, eq=False)
class _Evidence:
    """A fit, and what it does to the platform: the doubts that are computed from these."""

    dataset: Dataset
    solution: Solution
    platform: PlatformAccuracy | None
    session: SessionTests

    @cached_property
    def problem(self) -> FitProblem:
        """The joint fit."""
        return self.solution.posterior.problem

    @cached_property
    def predicted(self) -> CrossValidation | None:
        """Images left out, as the fit to the others predicts them."""
        return cross_validate(self.problem, self.solution.posterior.state)

    @cached_property
    def nominal(self) -> dict[str, float]:
        """Values of the kinematic parameters in the nominal model."""
        parametrization, legs = self.solution.kinematic.parametrization, self.nominal_legs
        values = vector_of(parametrization, legs, legs).tolist()
        return dict(zip(parametrization.names, values, strict=True))

    @cached_property
    def nominal_legs(self) -> tuple[Leg, ...]:
        """The legs of the nominal model."""
        return geometries(self.dataset.machine)

    @cached_property
    def change(self) -> Array:
        """By how much the fit moved the parameters, (p,)."""
        fitted, legs = self.solution.kinematic.parametrization, self.nominal_legs
        return vector_of(fitted, self.solution.legs, legs) - list(self.nominal.values())

    @cached_property
    def sigma(self) -> Array:
        """Standard deviations of the parameters by the fit, (p,)."""
        return np.asarray(np.sqrt(np.diagonal(self.solution.kinematic.value_covariance)))

    @cached_property
    def tolerance(self) -> Array:
        """Tolerances of the parameters, (p,); infinite without one, or if not estimated."""
        machine, status = self.dataset.machine, self.solution.estimates.status
        legs = dict(zip(machine.leg_names, self.nominal_legs, strict=True))
        stated = machine.tolerance.of_parameters(tuple(self.nominal), legs, machine.size)
        estimated = {name for name in stated if status.get(name) == "estimated"}
        return np.array([stated[n] if n in estimated else np.inf for n in self.nominal])

    @cached_property
    def nominal_size(self) -> NominalSize | None:
        """What the model says of the size of the machine; None without free lengths.

        The size is that of the nominal lengths by least squares, each with its tolerance. How much
        the other changes vary says how far that counts, with Student's distribution: a machine
        whose parts vary little is as large as its model, too. Stated tolerances are the least.
        """
        units = self.solution.kinematic.parametrization.units
        at = np.flatnonzero(np.equal(units, "m") & (self.tolerance < np.inf))
        nominal, tolerance = np.array(list(self.nominal.values()))[at], self.tolerance[at]
        information = float(np.sum((nominal / tolerance) ** 2))
        if information <= 0.0 or len(at) < 2:
            return None
        by_change = nominal / tolerance**2 / information
        excess, sigma = float(by_change @ self.change[at]), 1.0 / np.sqrt(information)
        beyond = (self.change[at] - excess * nominal) / np.hypot(tolerance, self.sigma[at])
        n, level = len(at) - 1, -float(ndtri(0.5 * SCALE_BY_CHANCE))
        part = np.sqrt(np.sum(beyond**2) / n) * -float(stdtrit(n, 0.5 * SCALE_BY_CHANCE)) / level
        sigma *= max(float(part), 1.0 if self.dataset.machine.tolerance.says_parts else 0.0)
        names, of_problem = list(self.nominal), self.problem.legs.parametrization.names
        by_parameter = np.zeros(len(of_problem))
        by_parameter[[of_problem.index(names[i]) for i in at.tolist()]] = by_change
        return NominalSize(by_parameter, excess, sigma)

    @cached_property
    def by_parameters(self) -> Array:
        """Derivative (n_poses, 6, p) of platform poses by the parameters."""
        solution, frame_legs = self.solution, self.dataset.machine.frame_legs
        parametrization = solution.kinematic.parametrization
        return platform_by_parameters(solution.legs, parametrization, frame_legs, solution.T_Rb_Re)

    def moved(self, steps: Array) -> PlatformError:
        """Return the motion of the platform by steps (p, c) of the parameters."""
        return moved_by(self.by_parameters, steps)

    def moved_in_fit(self, steps: Array) -> PlatformError:
        """Return the motion of the platform by steps (p, c), in the order of the fit."""
        of_fit = self.problem.legs.parametrization.names
        return self.moved(steps[[of_fit.index(name) for name in self.nominal]])

    def cameras(self) -> list[Doubt]:
        """Return cameras that the measurements contradict, with what their files do."""
        doubts, names = self.solution.camera_doubts, self.problem.outlines.views
        if not doubts:
            return []
        wrong_in = np.any([one.error.any(axis=1) for one in doubts], axis=0)  # that share a file
        views = [names[v] for v in np.flatnonzero(wrong_in).tolist()]
        error = None if self.platform is None else self.platform.effects.get(FITTED_CAMERA)
        wrong = max(doubts, key=lambda one: one.apart)
        kind = {"centre": "principal point"}.get(wrong.kind, wrong.kind.replace("_", " "))
        what = (
            f"the measurements contradict the camera of {few_views(views)}, above all its {kind}: "
            f"{wrong.found}"
        )
        remedy = (
            "calibrate it again at the same focus and zoom, and look for photographs that were "
            "zoomed, scaled, cropped or turned"
        )
        return [Doubt(CAMERA, what, remedy, *_mean(error))]

    def left_out(self) -> list[Doubt]:
        """Return whether images without a part in the fit are predicted as well as it claims."""
        if (predicted := self.predicted) is None:
            return []
        dof = np.maximum(predicted.dof, 1)
        most = np.maximum(MOST_SQUARES, 1.0 + _SURE * np.sqrt(2.0 / dof))
        of_blocks = predicted.squares / dof
        worst = float(of_blocks.max()) if np.any(of_blocks > most) else 0.0
        if (ratio := max(predicted.ratio, worst)) <= MOST_SQUARES:
            return []
        what = (
            f"images that are left out lie {np.sqrt(ratio):.1f} times as far from their prediction "
            "by the others as is stated"
        )
        remedy = (
            "the session does not agree with itself: look for what changed or moved between "
            "images, for play and bending, and at the worst outlines"
        )
        sigma = None if self.platform is None else self.platform.sigma
        return [Doubt("left_out", what, remedy, *_mean(sigma, float(np.sqrt(ratio - 1.0))))]

    def no_better(self) -> list[Doubt]:
        """Return whether left-out images are predicted as much better as the change claims."""
        predicted = self.predicted
        if predicted is None or predicted.gain is None:
            return []
        if predicted.gain >= min(MIN_GAIN, 1.0 - _SURE * predicted.gain_sigma):
            return []
        gain = max(predicted.gain, 0.0)
        what = (
            "images that are left out are predicted better than by the nominal model by "
            f"{100.0 * gain:.0f} % of what the change of the model claims"
        )
        remedy = "look at the overlays for edges that are not those of the legs, and at the cameras"
        change = None if self.platform is None else self.platform.change
        return [Doubt("no_better", what, remedy, *_mean(change, 1.0 - gain))]

    def changes(self, *, scatters: bool) -> list[Doubt]:
        """Return what changed in the session, and readings that do not follow motors.

        It counts where it displaces the platform by more than that is known to; scatter of readings
        also where outlines scatter by it, but not beside another cause, which leaves scatter
        behind.
        """
        doubts = []
        for finding in self.session.findings:
            effect = None if self.platform is None else self._effect_of(finding)
            if self.platform is None or effect is None:
                doubts.append(Doubt(finding.kind, finding.what, finding.remedy))
            elif effect[0] > self.platform.sigma.mean_displacement or (
                scatters and finding.kind in OF_SCATTER
            ):
                doubts.append(Doubt(finding.kind, finding.what, finding.remedy, *effect))
        return [doubt for doubt in doubts if doubt.code not in OF_SCATTER] or doubts

    def _effect_of(self, finding: UnmodelledEffect) -> tuple[float, float]:
        """Return the mean displacement [m] and rotation [rad] by a number that the fit lacks.

        Of an encoder whose zero changed on the worse side of the change.
        """
        machine, solution = self.dataset.machine, self.solution
        error = self.moved_in_fit(finding.steps)
        before = error.mean_displacement, error.mean_rotation
        if finding.kind == "joint":  # the platform follows, by about as much
            return max(before[0], finding.amount), max(before[1], finding.amount / machine.size)
        if finding.kind != "encoder":
            return before
        q = self.dataset.measurements.q_of_poses
        is_of_motor = np.array([leg.motor_label == finding.subject for leg in machine.legs])
        there = poses_at_readings(machine, solution.legs, q, solution.T_Rb_Re)
        q = q + finding.amount * is_of_motor
        moved = poses_at_readings(machine, solution.legs, q, there)
        after = (float(x.mean()) for x in pose_differences(moved, there))
        displacement, rotation = (max(b, a - b) for b, a in zip(before, after, strict=True))
        return displacement, rotation

    def moved_parameters(self) -> list[Doubt]:
        """Return parameters that moved far beyond the tolerance of the machine, as one doubt."""
        priors, names = self.problem.choices.priors, list(self.nominal)
        expected = [priors[n].mean if n in priors else x for n, x in self.nominal.items()]
        change = self.change + list(self.nominal.values()) - expected
        times = np.abs(change) / np.hypot(self.sigma, self.tolerance)
        far = np.flatnonzero(times > MOST_MOVED)
        if not len(far):
            return []
        error = None
        if self.platform is not None:
            error = self.moved(np.where(times > MOST_MOVED, change, 0.0)[:, None])
        moved = []
        for i in far[np.argsort(-times[far], kind="stable")].tolist():
            scale, unit = SHOWN_IN[self.solution.kinematic.parametrization.units[i]]
            tolerance = scale * self.tolerance[i]
            moved.append(
                f"{names[i]} by {scale * change[i]:+.3g} {unit} (tolerance {tolerance:.2g})"
            )
        what = f"the fit moved {few(moved)}, far beyond the tolerance of the machine"
        remedy = (
            "look at the worst outlines of these legs and at the model there; if the machine may "
            "be that far off its model, state so (tolerance in dataset.yaml)"
        )
        return [Doubt(TOLERANCE, what, remedy, *_mean(error))]

    def noise(self) -> list[Doubt]:
        """Return whether outlines scatter more than they claim: all, of a view, leg or period.

        What is beyond the claim may be no noise, and move the platform as much as that.
        """
        problem = self.problem
        o, scatter = problem.outlines, Scatter.of(problem, self.solution.posterior.state)
        times = {"all views": scatter.ratio()}
        if times["all views"] <= MOST_SCATTER:
            groups = {f"view {name}": o.view == v for v, name in enumerate(o.views)}
            groups |= {name: o.leg == j for j, name in enumerate(problem.legs.names)}
            groups |= self.session.periods
            times = {
                name: scatter.ratio(of) * scatter.is_beyond_chance(of, len(groups))
                for name, of in groups.items()
            }
        worst = max(times, key=times.__getitem__)
        if times[worst] <= MOST_SCATTER:
            return []
        what = (
            f"the outlines of {worst} scatter about the fit {times[worst]:.1f} times as much as "
            "their standard deviations"
        )
        remedy = (
            "something moves that should not, or edges are not those of the legs: look at the "
            "worst outlines, for play, bending, a camera or board that moved, and readings of "
            "another moment"
        )
        sigma = None if self.platform is None else self.platform.sigma
        part = float(np.sqrt(times[worst] ** 2 - 1.0))
        return [Doubt("noise", what, remedy, *_mean(sigma, part))]

    def scale(self) -> list[Doubt]:
        """Return whether witnesses of the scale contradict each other, or the only one the model.

        Where several agree, a model or radii of another size are theirs, and no doubt.
        """
        if self.nominal_size is None:
            return []
        compared = compare_scales(self.solution.posterior, self.nominal_size)
        if compared is None:
            return []
        witnesses, wrong = scale_witnesses(self.problem), compared.likelier_wrong()
        alone, names = len(witnesses) == 1, compared.witnesses
        # One ruler may have measured all that is stated, and one file has all squares of boards
        others = () if alone or not {TRAVEL, BOARD} & set(witnesses) else (MODEL,)
        explained = wrong is not None and names[wrong] in (RADII, *others)
        pairs = [
            pair
            for pair in compared.disagreements
            if not (explained and wrong in (pair.larger, pair.smaller))
        ]
        if not pairs:
            return []
        suspects = [pairs[0].larger, pairs[0].smaller] if wrong is None else [wrong]
        first = next((p for p in pairs if wrong in (p.larger, p.smaller)), pairs[0])
        if wrong is not None and names[wrong] == MODEL:  # it has no part in the fit
            both = {first.larger, first.smaller}
            suspects = list(both - {wrong}) if wrong in both else []
        clauses = [
            f"by {names[pair.larger]} the machine is {100.0 * pair.ratio:.2g} % larger than by "
            f"{names[pair.smaller]} ({pair.sigmas:.0f} standard deviations)"
            for pair in pairs
        ]
        likelier = (
            "either may be wrong"
            if wrong is None
            else f"the likelier wrong is {names[wrong]}, as the others agree without it"
        )
        rests = f"; the scale rests on {witnesses[0]} alone" if alone else ""
        what = f"{few(clauses)}: {likelier}{rests}"
        remedy = (
            "check these, and measure another length and state it "
            f"({self.dataset.machine.length_option}, --set)"
        )
        error = None
        if self.platform is not None and suspects:
            errors = [self.moved_in_fit(first.ratio * compared.steps[:, [i]]) for i in suspects]
            error = max(errors, key=lambda one: one.mean_displacement)
        return [Doubt("scale", what, remedy, *_mean(error))]

    def nominal_lengths(self) -> list[Doubt]:
        """Return whether the only witness of the scale is a stated length that is the model's.

        A measured one differs, and nothing else would show that this one was not measured.
        """
        stated = nominal_lengths(self.dataset, self.solution)
        if not stated or self.nominal_size is None or len(scale_witnesses(self.problem)) != 1:
            return []
        error = None
        if self.platform is not None:
            units = self.solution.kinematic.parametrization.units
            lengths = np.where(np.equal(units, "m"), list(self.nominal.values()), 0.0)
            error = self.moved(self.nominal_size.sigma * lengths[:, None])
            if error.mean_displacement <= self.platform.sigma.mean_displacement:
                return []
        what = (
            f"the scale rests on {few(stated)} alone, stated as in the model to all digits: was it "
            "measured?"
        )
        remedy = (
            "measure it and state that, or state a second length beside it "
            f"({self.dataset.machine.length_option})"
        )
        return [Doubt("nominal_length", what, remedy, *_mean(error))]


def nominal_lengths(dataset: Dataset, solution: Solution) -> list[str]:
    """Return stated lengths that are the nominal ones to all digits, as nobody measures them."""
    known = dataset_parameters(dataset)
    return [
        name
        for name, value in stated_lengths(solution.posterior.problem).items()
        if (":" in name or ParameterId.parse(name).kind == "length")
        and abs(value - known.parameter(name).nominal) < _LAST_DIGIT
    ]


def _held_out(held_out: Holdout | None) -> list[Doubt]:
    """Return whether images that were kept aside are predicted worse than expected."""
    if held_out is None or held_out.rms_px is None or held_out.expected_px is None:
        return []
    if held_out.rms_px <= MOST_OFF * held_out.expected_px:
        return []
    what = (
        f"images that were kept aside lie {held_out.rms_px:.3f} px from their prediction, where "
        f"{held_out.expected_px:.3f} px were expected"
    )
    remedy = "look at the worst outlines, and for play, bending or a camera that moved"
    return [Doubt("held_out", what, remedy)]


# Clicks on joints (``landmarks.csv``) against a fit


# Of half the clicks of a view from where a fit has their joints: hands are steadier
MAX_CLICK_SIGMAS = 4.0


def click_distances(dataset: Dataset, solution: Solution) -> dict[str, tuple[float, float]]:
    """Return how far clicks are from where a fit has their joints, and may be, by view [px].

    Both are medians: a click in two may be on another joint. Of a view without an outline in the
    fit nothing is said: its camera is not one of the fit.
    """
    if dataset.landmarks is None:
        return {}
    clicks, m = dataset.landmarks, dataset.measurements
    view, off = m.view[clicks.row], _off_clicks(dataset.landmarks, dataset, solution)
    own, most = off[np.arange(len(clicks)), clicks.leg, clicks.end], MAX_CLICK_SIGMAS
    outlines = solution.outlines
    fitted = np.unique(m.view[outlines.row[outlines.used]])
    return {
        m.views[v].name: (
            float(np.median(own[view == v])),
            most * float(np.median(clicks.sigma_px[view == v])),
        )
        for v in np.intersect1d(view, fitted).tolist()
    }


def _off_clicks(clicks: Landmarks, dataset: Dataset, solution: Solution) -> Array:
    """Return how far each click is from all joints as a fit has them, (n, n_legs, 2) [px]."""
    m = dataset.measurements
    joints = np.stack(ends_at_poses(solution.legs, *components(solution.T_Rb_Re)), axis=2)
    off = np.full((len(clicks), *joints.shape[1:3]), np.inf)
    for of_click, row, px in zip(off, clicks.row.tolist(), clicks.px, strict=True):
        v = int(m.view[row])
        P = solution.T_camera_Rb[v].apply(joints[m.pose[row]].reshape(-1, 3))
        P = P.reshape(*of_click.shape, 3)
        ahead = P[..., 2] > 0.0
        of_click[ahead] = np.linalg.norm(solution.cameras[v].project(P[ahead]) - px, axis=-1)
    return off


def click_notes(dataset: Dataset, solution: Solution) -> list[str]:
    """Return a note on each click that a fit contradicts, in views whose other clicks agree."""
    if dataset.landmarks is None:
        return []
    clicks, m, legs = dataset.landmarks, dataset.measurements, dataset.machine.leg_names
    agree = [name for name, (px, most) in click_distances(dataset, solution).items() if px <= most]
    names, notes = row_names(m), list[str]()
    every = zip(clicks.row_keys(), clicks.sigma_px.tolist(), strict=True)
    for ((row, leg, end), sigma), off in zip(
        every, _off_clicks(clicks, dataset, solution), strict=True
    ):
        own, most, view = float(off[leg, end]), MAX_CLICK_SIGMAS * sigma, m.views[m.view[row]].name
        if own <= most or view not in agree:
            continue
        near_leg, near_end = np.unravel_index(int(np.argmin(off)), off.shape)
        near = joint_name(legs[int(near_leg)], int(near_end))
        perhaps = f"perhaps it shows {near}; " if off.min() <= most else ""
        notes.append(
            f"The click on {joint_name(legs[leg], end)} in {names[row]} (view {view}) is {own:.0f} "
            f"px from where the fit has this joint, needed at most {most:.0f} px; {perhaps}correct "
            "or remove it."
        )
    return notes
