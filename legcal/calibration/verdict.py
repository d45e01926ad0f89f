"""Whether to trust a calibration: what the platform gains, beside how well that is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.calibration.closeness import closeness
from legcal.calibration.diagnosis.diagnosis import Diagnosis
from legcal.calibration.four_steps import Steps
from legcal.calibration.joint_fit.held_out import HeldOut
from legcal.calibration.joint_fit.parameter_choices import known_parameters
from legcal.calibration.joint_fit.platform import PlatformAccuracy, platform_accuracy
from legcal.calibration.joint_fit.scale import SCALE
from legcal.calibration.joint_fit.sensitivity import FITTED_CAMERA
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.notes import Note, Topic
from legcal.calibration.result import Calibration, Verdict
from legcal.data.corners import Corners
from legcal.data.dataset import Dataset
from legcal.data.landmarks import Landmarks, joint_name
from legcal.data.measurements import few_views, row_names
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.rods import ends_at_poses
from legcal.perception.diagnostics import far_off

_DO_NOT_LOAD = "Do not load this into the controller"
# Of half the clicks of a view from where a fit has their joints: hands are steadier
MAX_CLICK_SIGMAS = 4.0
TRUSTED_SIGMAS = 2.0  # the predicted improvement must exceed so many of its standard deviations


def judge(
    dataset: Dataset,
    solution: Solution,
    steps: Steps,
    notes: Sequence[str],
    *,
    corners: Corners | None = None,
    held_out: HeldOut | None = None,
    diagnosis: Sequence[Diagnosis] = (),
) -> Calibration:
    """Return the calibration with its verdict.

    The improvement that the fit predicts is the distance between the nominal and the
    calibrated platform at the readings of the dataset; it counts where it exceeds two of its
    standard deviations. Where readings do not determine a pose, it is that of the parameters.
    Nothing is trusted that a diagnosis of the session speaks against, nor what left out a leg of a
    view where other starts do not confirm it: either that is another leg, or the fit is at a wrong
    minimum.
    """
    machine, measurements = dataset.machine, dataset.measurements
    q = measurements.q_of_poses.copy()
    readings = solution.quality.redundant_readings
    for wrong in () if readings is None else readings.wrong:
        q[wrong.pose, np.equal(machine.reads, machine.reads[wrong.leg])] = np.nan
    platform = platform_accuracy(
        machine,
        solution.legs,
        solution.kinematic.parametrization,
        solution.kinematic.total_covariance,
        q,
        solution.T_Rb_Re,
        solution.sensitivities,
    )
    remedy = ""
    if platform is None:
        change, sigma, found = _change_of_parameters(dataset, solution)
    else:
        change, sigma, found = _change_of_platform(platform)
        if by_scale := _share_of_scale(platform):
            found += f"; {by_scale}"
            remedy = f"measure the distance of two joints and state it ({machine.length_option})"
    objection = _objection(dataset, solution, diagnosis, found)
    verdict = (
        Verdict(False, objection, remedy) if objection else _verdict(change, sigma, found, remedy)
    )
    return Calibration(
        dataset,
        solution,
        steps,
        platform,
        verdict,
        (
            *notes,
            *Note.about(Topic.IMAGES, click_notes(dataset, solution)),
            *closeness(dataset.folder, measurements.n_rows, platform),
        ),
        held_out,
        corners,
        tuple(diagnosis),
    )


def _objection(
    dataset: Dataset, solution: Solution, diagnosis: Sequence[Diagnosis], found: str
) -> str:
    """Return what speaks against a result, however large its improvement; "" where nothing does."""
    readings = solution.quality.redundant_readings
    if diagnosis:
        return f"{_DO_NOT_LOAD}: {diagnosis[0].sentence} As it is, {found}."
    if readings is not None and readings.doubts:
        return f"{_DO_NOT_LOAD}: {found}, but {', and '.join(readings.doubts)}."
    if solution.left_out:
        return (
            f"{_DO_NOT_LOAD}: {found}, but most outlines of a leg that a view shows disagree with "
            f"that ({', '.join(solution.left_out)}), so that they are of something else or the fit "
            "is wrong; look at them in the table of observations, and correct them or leave the "
            "leg out of the legs of that view."
        )
    contradicted = [
        f"{name} ({px:.0f} px)"
        for name, (px, most) in click_distances(dataset, solution).items()
        if px > most
    ]
    if contradicted:
        return (
            f"{_DO_NOT_LOAD}: {found}, but most clicks on joints in {few_views(contradicted)} are "
            f"that far from where the fit has these joints, so that it is wrong or they are; look "
            "at the outlines in these images, and at the clicks (legcal detect --edit)."
        )
    if strayed := _strayed_cameras(dataset, solution):
        return (
            f"{_DO_NOT_LOAD}: {found}, but the fit has {strayed} far from the rough T_base_camera "
            "near which platform poses were looked for, so that these are wrong or it is; measure "
            "it again, or take images that show more legs."
        )
    return ""


def click_distances(dataset: Dataset, solution: Solution) -> dict[str, tuple[float, float]]:
    """Return how far clicks are from where a fit has their joints, and may be, by view [px].

    Both are medians: a click in two may be on another joint.
    """
    if dataset.landmarks is None:
        return {}
    clicks, m = dataset.landmarks, dataset.measurements
    view, off = m.view[clicks.row], _off_clicks(dataset.landmarks, dataset, solution)
    own, most = off[np.arange(len(clicks)), clicks.leg, clicks.end], MAX_CLICK_SIGMAS
    return {
        m.views[v].name: (
            float(np.median(own[view == v])),
            most * float(np.median(clicks.sigma_px[view == v])),
        )
        for v in np.unique(view).tolist()
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


def _strayed_cameras(dataset: Dataset, solution: Solution) -> str:
    """Return the views whose cameras left the rough poses by which platforms were found, or ""."""
    if dataset.machine.is_determined:
        return ""
    cameras = solution.cameras_in_base(dataset.machine.T_base_Rb)
    views = zip(dataset.measurements.views, cameras, strict=True)
    strayed = [
        view.name
        for view, T in views
        if view.T_base_camera is not None and far_off(view.T_base_camera, T)
    ]
    return few_views(strayed) if strayed else ""


def _change_of_platform(platform: PlatformAccuracy) -> tuple[float, float, str]:
    """Return the change of the platform, its uncertainty, both displacements [m], and a clause.

    Cameras that the measurements contradict count with what they do to the platform.
    """
    change, sigma = platform.change, platform.sigma
    found = (
        f"the platform moves by {1e3 * change.mean_displacement:.3f} mm / "
        f"{np.degrees(change.mean_rotation):.4f} deg against the nominal model, known to "
        f"{1e3 * sigma.mean_displacement:.3f} mm / {np.degrees(sigma.mean_rotation):.4f} deg "
        "(1 sigma)"
    )
    of_cameras = [e.error.mean_displacement for e in platform.effects if e.what == FITTED_CAMERA]
    effect = max(of_cameras, default=0.0)
    if effect > 0.0:
        found += f"; a camera file that the measurements contradict may add {1e3 * effect:.3f} mm"
    known_to = float(np.hypot(sigma.mean_displacement, effect))
    return change.mean_displacement, known_to, found


def _share_of_scale(platform: PlatformAccuracy) -> str:
    """Return a clause on the scale where it is the largest part of the predicted error, or ""."""
    predicted = (platform.workspace or platform.sigma).mean_displacement
    parts = [e.error.mean_displacement for e in platform.effects if e.what == SCALE]
    if not parts or 2.0 * parts[0] ** 2 < predicted**2:
        return ""
    return (
        f"the largest part of that is the scale of the machine ({1e3 * parts[0]:.3f} of "
        f"{1e3 * predicted:.3f} mm over the workspace), which radii alone say"
    )


def _change_of_parameters(dataset: Dataset, solution: Solution) -> tuple[float, float, str]:
    """Return the change of joints and lengths, its uncertainty, rms [m], and a clause of both."""
    known = known_parameters(
        dataset.machine, dataset.measurements.views, boards=dataset.boards
    ).by_name
    found = solution.estimates
    lengths = [
        (found.values[name] - known[name].nominal, sigma)
        for name, sigma in zip(found.names, found.sigma.tolist(), strict=True)
        if known[name].kind == "kinematic" and known[name].unit == "m"
    ]
    change, sigma = np.sqrt(np.mean(np.square(lengths or [(0.0, 0.0)]), axis=0)).tolist()
    clause = (
        f"joints and lengths change by {1e3 * change:.3f} mm against the nominal model, known to "
        f"{1e3 * sigma:.3f} mm (1 sigma, both rms); no platform error can be predicted, because "
        f"{dataset.machine.undetermined}"
    )
    return change, sigma, clause


def _verdict(improvement: float, sigma: float, found: str, remedy: str) -> Verdict:
    """Return what an improvement with a standard deviation is worth."""
    if improvement > TRUSTED_SIGMAS * sigma:
        return Verdict(True, f"Calibrated: {found}.", remedy)
    return Verdict(
        False,
        f"{_DO_NOT_LOAD}: {found}, and a predicted improvement below two sigma is no improvement; "
        f"{remedy or 'take more images or better ones'}.",
        remedy,
    )
