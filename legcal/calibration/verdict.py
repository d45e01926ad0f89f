"""Whether to trust a calibration: what the platform gains, beside how well that is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from legcal.calibration.diagnosis import Diagnosis
from legcal.calibration.documents import Doubt, Holdout
from legcal.calibration.doubts import (
    BESIDE_SIGMA,
    CAMERA,
    TOLERANCE,
    click_notes,
    doubts_of,
    model_error,
    nominal_lengths,
)
from legcal.calibration.four_steps import Steps
from legcal.calibration.joint_fit.outlier_readings import reading_notes
from legcal.calibration.joint_fit.parameter_choices import dataset_parameters
from legcal.calibration.joint_fit.platform import PlatformAccuracy, platform_accuracy
from legcal.calibration.joint_fit.scale import ALL_READINGS, SCALE, scale_witnesses
from legcal.calibration.joint_fit.sensitivity import EXACT_CAMERAS, SIGMA_EXACT
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.result import REFUSED, Calibration, Verdict
from legcal.calibration.session_changes import MIN_IMAGES, SessionTests, session_tests
from legcal.calibration.summary import mm_deg
from legcal.data.corners import Corners
from legcal.data.dataset import POSES_NAME, Dataset
from legcal.data.image_choice import sequences_of
from legcal.data.measurements import few_views
from legcal.data.reading_units import legs_with_readings
from legcal.errors import DatasetError
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import few
from legcal.files.table import Column, read_table
from legcal.geometry.types import IntArray
from legcal.machine.tolerance import Tolerance

if TYPE_CHECKING:
    from legcal.calibration.only import GroupEstimate

MOST_HIDDEN = 3.0  # predicted errors of the platform, that a slip may have without showing
NEGLIGIBLE = 0.3  # of the predicted error: it adds less than a twentieth to that
MOST_MORE = 5.0  # times as many images, beyond which their number is no advice
TRUSTED_SIGMAS = 2.0  # the predicted improvement must exceed so many of its standard deviations
MAX_BEYOND = 0.05  # largest share of the outlines of a view beyond the boards without a note
_ALONG = 9  # points along an outline
_ROUNDED = 0.51e-4  # [mm or deg] of the commands there


def judge(
    dataset: Dataset,
    solution: Solution,
    steps: Steps,
    notes: Sequence[str],
    *,
    corners: Corners | None = None,
    held_out: Holdout | None = None,
    diagnosis: Sequence[Diagnosis] = (),
    group: GroupEstimate | None = None,
) -> Calibration:
    """Return the calibration with its verdict; of a *group* of its parameters, if given.

    The improvement that the fit predicts is the distance between the nominal and the
    calibrated platform at the readings of the dataset; it counts where it exceeds two of its
    standard deviations. Where readings do not determine a pose, it is that of the parameters.
    Cameras that the measurements contradict count there with what they do to the platform. What
    speaks against the result (:mod:`legcal.calibration.doubts`) keeps it from being trusted, and
    refuses it where that may move the platform by more than the calibration does.
    """
    machine, measurements = dataset.machine, dataset.measurements
    q = measurements.q_of_poses.copy()
    readings = solution.quality.redundant_readings
    for wrong in () if readings is None else readings.wrong:
        q[wrong.pose, np.equal(machine.reads, machine.reads[wrong.leg])] = np.nan
    motors = np.array([leg.motor_label for leg in machine.legs], dtype=object)
    for of, zero in zip(
        measurements.own_zeros, solution.posterior.state.own_zeros.tolist(), strict=True
    ):
        q[np.ix_(of.rows[measurements.first_rows], motors == of.motor)] -= zero
    reported = solution if group is None else group.solution
    platform = platform_accuracy(
        machine,
        reported.legs,
        reported.kinematic.parametrization,
        reported.kinematic.total_covariance,
        q,
        reported.T_Rb_Re,
        reported.sensitivities,
    )
    remedy = ""
    if platform is None:
        change, sigma, found = _change_of_parameters(dataset, reported)
    else:
        change, sigma, found = _change_of_platform(platform)
        clauses, by_radii = _assumed_errors(platform, solution, machine.tolerance)
        found = "; ".join([found, *clauses])
        if by_radii:
            remedy = f"measure the distance of two joints and state it ({machine.length_option})"
    sequences = sequences_of(dataset)
    session = session_tests(solution.posterior, measurements, sequences)
    doubts = doubts_of(dataset, solution, platform, held_out, diagnosis, corners, session)
    if group is not None:
        found = f"{group.sentence}; {found}"
        others = (doubt for doubt in doubts if doubt.code != TOLERANCE)
        doubts = (*others, *group.doubts)
    doubts = tuple(
        replace(doubt, is_grave=doubt.is_grave or (doubt.sigma_dX_m or 0.0) > change)
        for doubt in doubts
    )
    displacement, rotation = model_error(doubts)
    if displacement > 0.0:
        found += f"; what is in doubt may add {mm_deg(displacement, rotation)}"
    of_cameras, _ = model_error([doubt for doubt in doubts if doubt.code == CAMERA])
    known_to = float(np.hypot(sigma, of_cameras))
    if change <= TRUSTED_SIGMAS * known_to:
        changed = "joints and lengths" if platform is None else "the platform"
        if change > TRUSTED_SIGMAS * sigma:  # more images do not mend a camera
            remedy = remedy or "calibrate the camera again"
        doubts = (*doubts, _no_improvement(changed, change, known_to, measurements.n_rows, remedy))
    doubts = _worst_first(doubts)
    sentence = f"Calibrated: {found}."
    if doubts:
        n_more = len(doubts) - 1
        beside = f" {n_more} more doubt{'s' * (n_more > 1)} beside that." if n_more else ""
        heading = REFUSED if any(doubt.is_grave for doubt in doubts) else "In doubt"
        sentence = f"{heading}: {found}. {doubts[0].sentence}{beside}"
    causes = {finding.what for finding in session.findings}
    if any(doubt.what in causes or doubt.code in ("scale", "mistake") for doubt in doubts):
        # What a named cause does to cameras and readings accuses neither
        accused = {*map(str, solution.camera_doubts), *reading_notes(readings)}
        notes = [note for note in notes if note not in accused]
    else:
        notes = [*notes, *camera_file_notes(dataset, solution)]
    return Calibration(
        dataset,
        reported,
        steps,
        platform,
        Verdict(doubts, sentence, remedy),
        (
            *notes,
            *_beyond_boards(dataset, solution),
            *click_notes(dataset, solution),
            *commanded(dataset),
            *_asked_lengths(dataset, solution, doubts),
            *_overstated(session),
            *_untested(dataset, sequences, session, platform),
        ),
        held_out,
        corners,
        tuple(diagnosis),
        group=group,
    )


def _no_improvement(of: str, change: float, sigma: float, n_images: int, remedy: str) -> Doubt:
    """Return the doubt in a change [m] of something that is not surely one for the better."""
    times = change / sigma if sigma > 0.0 else 0.0
    what = (
        f"the change of {of} is {times:.2f} times its standard deviation, needed more than "
        f"{TRUSTED_SIGMAS:g}: these images do not show that this model is better than the nominal "
        "one"
    )
    more = (TRUSTED_SIGMAS / max(times, 1e-9)) ** 2  # the variance falls with their number
    number = "many more" if more > MOST_MORE else f"{math.ceil(more * n_images)} or more"
    remedy = remedy or f"take {number} images (now {n_images}), or better ones"
    return Doubt("no_improvement", what, f"keep the nominal one, or {remedy}", is_grave=True)


def _worst_first(doubts: Sequence[Doubt]) -> tuple[Doubt, ...]:
    """Return grave doubts, then others, by their effect on the platform.

    Too small an improvement follows what may make the platform uncertain, and is before what does
    not.
    """
    is_uncertain = any(one.code == "no_improvement" for one in doubts)

    def place(one: Doubt) -> tuple[int, float]:
        place = 0 if one.is_grave else 3 if is_uncertain and one.code in BESIDE_SIGMA else 1
        return 2 if one.code == "no_improvement" else place, -(one.sigma_dX_m or 0.0)

    return tuple(sorted(doubts, key=place))


def camera_file_notes(dataset: Dataset, solution: Solution) -> list[str]:
    """Return a note on the file of each camera that the measurements contradict."""
    names = dataset.measurements.view_names
    return [
        f"View {view} uses the camera file {dataset.camera_paths[names.index(view)]}."
        for view in dict.fromkeys(wrong.view for wrong in solution.camera_doubts)
    ]


def _beyond_boards(dataset: Dataset, solution: Solution) -> list[str]:
    """Return a note on views whose outlines leave the part of the image that boards covered."""
    outlines, measurements = solution.outlines, dataset.measurements
    view, along = measurements.view[outlines.row], np.linspace(0.0, 1.0, _ALONG)[:, None, None]
    points = outlines.ends[:, 0] + along * (outlines.ends[:, 1] - outlines.ends[:, 0])
    outside = dict[str, float]()
    for v in np.unique(view[outlines.used]).tolist():
        covered = measurements.views[v].camera.covered.astype(np.float32)
        if len(covered):
            pixels = points[:, (view == v) & outlines.used].reshape(-1, 2).tolist()
            is_out = [cv2.pointPolygonTest(covered, pixel, False) < 0.0 for pixel in pixels]
            outside[measurements.views[v].name] = float(np.mean(is_out))
    far = [name for name, share in outside.items() if share > MAX_BEYOND]
    if not far:
        return []
    share = 100.0 * max(outside[name] for name in far)
    return [
        f"Up to {share:.0f} % of the outlines of {few_views(far)} lie where the calibration of the "
        "camera has seen no board: the lens is extrapolated there, beyond what its covariance "
        "says; photograph the board there too, and calibrate the camera again."
    ]


def _asked_lengths(dataset: Dataset, solution: Solution, doubts: Sequence[Doubt]) -> list[str]:
    """Return a note on stated lengths that are the nominal ones, where no doubt asks for them."""
    stated = nominal_lengths(dataset, solution)
    if not stated or any(doubt.code == "nominal_length" for doubt in doubts):
        return []
    return [
        f"{few(stated)}: the stated length is the nominal one to all digits; state a measured one, "
        "or leave it out if there is another."
    ]


def _overstated(session: SessionTests) -> list[str]:
    """Return a note on readings that scatter far less than is stated."""
    notes = []
    for of, sizes in session.overstated.items():
        scale, unit = SHOWN_IN[of]
        found, stated = (f"{scale * size:.2g} {unit}" for size in sizes)
        notes.append(
            f"Readings scatter by about {found} or less, where {stated} are stated or assumed: "
            "the result is less certain than it need be; state encoder_sigma as it is."
        )
    return notes


def _untested(
    dataset: Dataset,
    sequences: Sequence[IntArray],
    session: SessionTests,
    platform: PlatformAccuracy | None,
) -> list[str]:
    """Return notes on changes in the course of a session that would not show."""
    m = dataset.measurements
    if m.n_rows < 2 * MIN_IMAGES or session.findings:
        return []
    if not sequences:
        return [
            "Changes in the course of the session could not be tested: images have neither times "
            "nor numbers in their names; add a column time to measurements.csv."
        ]
    leg_of = {leg.motor_label: leg for leg in dataset.machine.legs if leg.is_motor}
    if unseen := [motor for motor in leg_of if motor not in session.least_slips]:
        return [
            f"A slip of the encoder of {few(unseen)} would not show in these images, however large "
            "it was; take more images, which show all legs."
        ]
    at_joint = {  # [m]
        motor: size / leg_of[motor].reading_of(1.0) for motor, size in session.least_slips.items()
    }
    motor = max(at_joint, key=at_joint.__getitem__, default="")
    if platform is None or not motor:
        return []
    if at_joint[motor] <= MOST_HIDDEN * platform.sigma.mean_displacement:
        return []
    scale, unit = SHOWN_IN[leg_of[motor].reading_unit]
    return [
        f"A slip of an encoder below {scale * session.least_slips[motor]:.2g} {unit} ({motor}) "
        "would not show in these images."
    ]


def _change_of_platform(platform: PlatformAccuracy) -> tuple[float, float, str]:
    """Return the change of the platform, its uncertainty, both displacements [m], and a clause."""
    change, sigma = platform.change, platform.sigma
    found = (
        f"the platform moves by {mm_deg(change.mean_displacement, change.mean_rotation)} against "
        f"the nominal model, known to {mm_deg(sigma.mean_displacement, sigma.mean_rotation)} "
        "(1 sigma)"
    )
    return change.mean_displacement, sigma.mean_displacement, found


def _assumed_errors(
    platform: PlatformAccuracy, solution: Solution, tolerance: Tolerance
) -> tuple[list[str], bool]:
    """Return clauses on errors that no sigma of the fit has, where these are not negligible.

    Also whether radii alone say the scale, as the largest part of the predicted error.
    """
    predicted = (platform.workspace or platform.sigma).mean_displacement
    effects = {
        what: (error.mean_displacement, error.mean_rotation)
        for what, error in platform.effects.items()
        if error.mean_displacement > NEGLIGIBLE * predicted
    }
    clauses, scale = list[str](), platform.effects.get(SCALE)
    by_radii = scale is not None and 2.0 * scale.mean_displacement**2 >= predicted**2
    if scale is not None and by_radii:
        clauses.append(
            "the largest part of that is the scale of the machine "
            f"({1e3 * scale.mean_displacement:.3f} of "
            f"{1e3 * predicted:.3f} mm over the workspace), which radii alone say"
        )
    if ALL_READINGS in effects:
        problem = solution.posterior.problem
        witnesses = scale_witnesses(problem)
        rests = f"{witnesses[0]} alone; " if len(witnesses) == 1 else f"{few(witnesses)}; of "
        assumed = "" if tolerance.travel else ", assumed: state tolerance: {travel: ...}"
        clauses.append(
            f"the scale rests on {rests}an error of {problem.legs.sigma_travel:.2%} of the travel "
            f"(1 sigma{assumed}) "
            + ("" if len(witnesses) == 1 else "what these leave ")
            + f"moves the platform by {mm_deg(*effects[ALL_READINGS])}"
        )
    if EXACT_CAMERAS in effects:
        clauses.append(
            f"no covariance of the camera is stated; an error of {SIGMA_EXACT:.1%} of its focal "
            f"length (1 sigma, assumed) moves the platform by {mm_deg(*effects[EXACT_CAMERAS])}"
        )
    return clauses, by_radii


def _change_of_parameters(dataset: Dataset, solution: Solution) -> tuple[float, float, str]:
    """Return the change of joints and lengths, its uncertainty, rms [m], and a clause of both."""
    known = dataset_parameters(dataset).by_name
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


# The plan of a session


def commanded(dataset: Dataset) -> tuple[str, ...]:
    """Return a sentence on readings that are all the commands of a plan; () without a plan."""
    file, m, machine = dataset.folder / POSES_NAME, dataset.measurements, dataset.machine
    shown = [SHOWN_IN[machine.legs[j].reading_unit] for j in machine.motors]
    motors = zip(legs_with_readings(machine.legs), shown, strict=True)
    names = [f"{leg.prismatic} [{unit}]" for leg, (_, unit) in motors]
    columns = [Column("image", "text"), *(Column(name) for name in names)]
    if not file.exists():
        return ()
    try:
        table = read_table(file, "plan", "row", columns)
        commands = dict(zip(table.text("image"), table.numbers(names), strict=True))
    except (OSError, DatasetError):
        return ()
    rows = [row for row, image in enumerate(m.image) if image in commands]
    scale = np.array([size for size, _ in shown])
    apart = [scale * m.q[row, machine.motors] - commands[m.image[row]] for row in rows]
    if not rows or not np.all(np.abs(apart) <= _ROUNDED):
        return ()
    return (
        f"All readings equal the commands in {file}: write down what the encoders read at each "
        "pose; without encoders, state how well the motors reach a command as encoder_sigma.",
    )
