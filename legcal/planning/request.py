"""``legcal.plan``: options of a plan, their checks, and the fewest images for a target."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Group, Prior
from legcal.calibration.joint_fit.predicted import (
    DEFAULT_NOISE,
    PredictedNoise,
    Predictor,
    read_noise,
)
from legcal.data.dataset import Dataset, load_dataset, rows_with_image
from legcal.data.reading_units import sigmas_of, sigmas_of_legs
from legcal.errors import DatasetError, ModelError, NotIdentifiable, Problem, UsageError
from legcal.geometry.types import Array
from legcal.machine.configurations import poses_at
from legcal.machine.kinematics import follow_each
from legcal.machine.leg import SIGMA_LENGTH, SIGMA_READING
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.planning.places import (
    MAX_ANGLE,
    MAX_DRAWS,
    MAX_LENGTH,
    Place,
    Setting,
    default_setting,
    parse_bounds,
)
from legcal.planning.planner import Candidates, Task, plan_session
from legcal.planning.session import Plan
from legcal.progress import Progress, Report, shown_progress
from legcal.vision.board import Board, board_beside_machine
from legcal.vision.camera import Camera, sample_camera
from legcal.vision.camera_file import read_camera
from legcal.workers import Run, Workers, worker_pool

IMAGES_PER_VIEW = 15
MOST_IMAGES, MOST_VIEWS = 400, 12
SAME_MACHINE = 0.025  # mean leg lengths between joints of the model and of a dataset shot of it
SAME_AXES = 5.0  # [deg] the same between their axes
_ROUNDS = 5  # plans, until the fewest images are found that reach a target
_BEGIN = 24  # images of the first of them
_NEARLY = 0.9  # next number of images, over that of a plan that reaches the target


def plan(
    model: str | Path | Machine,
    *,
    images: int | None = None,
    images_per_view: int | None = None,
    cameras: int | None = None,
    target: float | None = None,
    camera: str | Path | Camera | None = None,
    noise: PredictedNoise | str | Path = DEFAULT_NOISE,
    encoder_sigma: float | str | None = None,
    bounds: Array | str | None = None,
    given: str | Path | Dataset | None = None,
    board: str | Path | Board | None = None,
    hand_held: bool = False,
    setting: Setting | None = None,
    only: Group | None = None,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress = False,
) -> Plan:
    """Plan poses and camera places of a session that determine a machine best.

    Parameters
    ----------
    model : str, Path or Machine
        The nominal model, as :func:`legcal.load_mechanism` takes it.
    images, images_per_view : int, optional
        Photographs of the whole session, 45 by default; or of each view.
    cameras : int, optional
        Camera places, 3 by default.
    target : float, optional
        Expected error of the platform, mean over the workspace [m]: the fewest images that reach
        it, in place of a number of images.
    camera : path or Camera, optional
        The camera, or its file; by default the camera of the given dataset, or 1024 x 768 pixels
        and 43 degrees wide.
    noise : PredictedNoise or path
        Noise of outlines, or the folder of an earlier result.
    encoder_sigma : float or str, optional
        One standard deviation of a reading: a number [m, of motors that turn rad], or a text with
        its unit ('0.5deg'), which is that of the motors that slide, or turn. By default 2 um,
        0.1 mrad and 0.5 deg of hobby servos, or those of the dataset.
    bounds : (3, 2) array or str, optional
        Lowest and highest x, y, z of cameras in the base link [m], or the text of ``--bounds``.
    given : path or Dataset, optional
        Existing images; the plan adds to them.
    board : str, path or Board, optional
        A calibration board on the base, visible in every image, as in ``legcal camera``.
    hand_held : bool
        Hand-held camera: a new pose for every image; requires a board.
    setting : Setting
        Tolerances of tripods and of the machine.
    only : {"zeros", "lengths", "all"}, optional
        Tolerances of the model are priors of all parts; say how well these will be known.
    seed : int
        Random seed.
    workers : int, str or executor
        Number of processes; with more than one, the calling program must be safe to import (``if
        __name__ == "__main__":``). Or a Dask cluster: the address of its scheduler, a client, or
        another object with ``submit``, like an executor.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.

    Returns
    -------
    Plan

    Raises
    ------
    UsageError
        If an option cannot be used.
    DatasetError, ModelError
        If a file cannot be used, or the dataset is of another machine.
    DidNotConverge, NotVisible, NotIdentifiable
        If there are no poses, no places that show legs, too few images, or a target that no number
        of images reaches.
    OutOfResources
        If one of the processes is ended from outside, or the cluster lost.
    """
    machine = model if isinstance(model, Machine) else load_mechanism(model)
    _check_visible(machine)
    setting = default_setting(machine) if setting is None else setting
    n_images, n_views = _counts(images, images_per_view, cameras, target, hand_held=hand_held)
    if bounds is not None:
        bounds = parse_bounds(bounds) if isinstance(bounds, str) else np.asarray(bounds, float)
    _check(target, bounds, board, hand_held, setting, seed, machine.size)
    shot = given if isinstance(given, Dataset | None) else load_dataset(given, check_images=False)
    if camera is None:
        selected_camera = sample_camera() if shot is None else shot.measurements.views[0].camera
    else:
        selected_camera = camera if isinstance(camera, Camera) else read_camera(Path(camera))
    stated = {} if encoder_sigma is None else sigmas_of(encoder_sigma, machine.legs)
    sigma_q = sigmas_of_legs(machine.legs, SIGMA_READING * machine.size, stated)
    if shot is not None and encoder_sigma is None:
        sigma_q = shot.measurements.sigma_q
    predicted_noise = noise if isinstance(noise, PredictedNoise) else read_noise(Path(noise))
    choices, scale_notes = Choices.by_tolerances(machine, only), tuple[str, ...]()
    if only is None:
        choices, scale_notes = measured_length(machine, board=board is not None)
    laid = None if board is None else board_beside_machine(board)
    task = Task(
        Predictor(machine, selected_camera, predicted_noise, sigma_q, choices),
        n_images,
        n_views,
        setting,
        bounds,
        () if shot is None else _given_candidates(machine, shot),
        "" if shot is None else str(shot.folder),
        laid,
        hand_held,
        seed,
    )
    pool = worker_pool(workers, "The session could not be planned")
    with shown_progress(progress) as report, pool as run:
        if target is None:
            result = plan_session(task, report, run)
        else:
            result = _plan_for_target(task, target, report, run)
        return replace(result, notes=(*result.notes, *scale_notes, *_notes_on_missing_images(shot)))


def measured_length(machine: Machine, *, board: bool) -> tuple[Choices, tuple[str, ...]]:
    """Assume a measured length where readings carry none; return it with a note."""
    rod_and_ends = machine.rod_for_scale(has_length=board)
    if rod_and_ends is None:
        return NO_CHOICES, ()
    rod, ends = rod_and_ends
    sigma = SIGMA_LENGTH * machine.size
    return Choices(priors={f"{rod.name}.length": Prior(rod.q0, sigma)}), (
        f"Angle readings do not determine the scale; the plan assumes that the rod of {rod.name} "
        f"is measured to {1e3 * sigma:.2g} mm (legcal calibrate --length "
        f"{ends}=MEASURED±{1e3 * sigma:.2g}mm).",
    )


def _plan_for_target(task: Task, target: float, progress: Report, run: Run) -> Plan:
    """Plan with the fewest images that reach a target [m].

    The growth of each plan predicts the number of images for the next one. An unreachable target is
    refused.
    """
    n, least, best = max(_BEGIN, 2 * task.n_views), 0, None
    for _ in range(_ROUNDS):
        candidate = plan_session(replace(task, n_images=n), progress, run)
        if candidate.error is None:
            raise UsageError(
                f"--target could not be used: {task.machine.undetermined}, so the error of the "
                "platform cannot be predicted; give --images."
            )
        error = candidate.error.mean_displacement
        if error <= target:
            best = candidate if best is None or candidate.n_images < best.n_images else best
        else:
            least = max(least, n)
        n_needed = _images_for(candidate, error, target)
        if n_needed > MOST_IMAGES and best is None:
            break
        if best is not None:
            n_needed = min(n_needed, int(_NEARLY * best.n_images))
        n_next = max(n_needed, least + 1, 2 * task.n_views)
        if n_next > MOST_IMAGES or (best is not None and n_next >= best.n_images):
            break
        n = n_next
    if best is not None:
        return best
    more = ""
    n, value = candidate.growth[candidate.growth[:, 0] <= MOST_IMAGES][-1]
    if n > candidate.n_images:
        more = f", about {1e3 * error * value / candidate.value:.3f} mm with {n:.0f} similar ones"
    raise NotIdentifiable(
        f"{task.machine.yaml_path}: the target of {1e3 * target:g} mm cannot be reached: "
        f"{1e3 * error:.3f} mm are expected with {candidate.n_images} images{more}; "
        "use better light or a longer focal length, more --cameras, --board, or a larger "
        "--target."
    )


def _images_for(planned: Plan, error: float, target: float) -> int:
    """Return the number of images for a target, interpolated in the growth of a plan."""
    n, value = np.log(planned.growth[np.isfinite(planned.growth[:, 1])]).T
    scaled = value + np.log(error) - value[n == np.log(planned.n_images)][0]
    if scaled.min() > np.log(target):
        return 10 * MOST_IMAGES
    k = int(np.argmax(scaled <= np.log(target)))
    share = 1.0 if k == 0 else (scaled[k - 1] - np.log(target)) / (scaled[k - 1] - scaled[k])
    return int(np.ceil(np.exp(n[k] if k == 0 else n[k - 1] + share * (n[k] - n[k - 1]))))


def _counts(
    images: int | None,
    per_view: int | None,
    cameras: int | None,
    target: float | None,
    *,
    hand_held: bool,
) -> tuple[int, int]:
    """Return the checked numbers of photographs of the session and of camera places."""
    numbers = {"--images": images, "--images-per-view": per_view, "--target": target}
    given = [name for name, number in numbers.items() if number is not None]
    if len(given) > 1:
        raise UsageError(
            f"{' and '.join(given)} cannot be combined, each says how many photographs there are; "
            "leave out all but one."
        )
    n_views = _checked_number("--cameras", 3 if cameras is None else cameras, MOST_VIEWS)
    if hand_held and cameras is not None and cameras > 1:
        raise UsageError(
            f"--hand-held and --cameras {cameras} cannot be combined: a hand-held camera has a new "
            "pose for every image; leave out --cameras."
        )
    n_views = 1 if hand_held else n_views
    if per_view is not None:
        each = _checked_number("--images-per-view", per_view, MOST_IMAGES // n_views)
        return n_views * each, n_views
    usual = 3 * IMAGES_PER_VIEW
    n_images = _checked_number("--images", usual if images is None else images, MOST_IMAGES)
    if n_images < n_views:
        raise UsageError(
            f"The plan could not be made: found {n_images} images for {n_views} cameras, needed "
            f"one for each at least; give --images {n_views} or more, or fewer --cameras."
        )
    return n_images, n_views


def _check_visible(machine: Machine) -> None:
    """Refuse a machine none of whose legs and arms a camera can see."""
    if not any(leg.cylinders or leg.arm for leg in machine.legs):
        raise ModelError(
            Problem(
                "no session could be planned",
                "no leg with a visible cylinder in the model",
                "the radius of one leg at least",
                "add <visual> cylinders along the legs, or write a model with: legcal "
                "inspect FILE --leg-radius MM --write DIR",
                str(machine.urdf_path),
            )
        )


def _check(
    target: float | None,
    bounds: Array | None,
    board: object,
    hand_held: bool,
    setting: Setting,
    seed: int,
    size: float,  # of the machine [m]
) -> None:
    start, problems = "The plan could not be made: found", []
    if seed < 0:
        problems.append(f"{start} {seed} as the seed, needed 0 or more; correct --seed.")
    if target is not None and not 0.0 < target < 1.0:
        problems.append(
            f"{start} a target of {target:g} m, needed more than 0 and less than 1 m; correct "
            "--target."
        )
    if bounds is not None and np.shape(bounds) != (3, 2):
        problems.append(
            f"{start} bounds of shape {np.shape(bounds)}, needed (3, 2), the lowest and highest x, "
            "y and z in the base link [m]; correct them."
        )
    if hand_held and board is None:
        problems.append(
            "--hand-held needs a calibration board on the base in every image, from which the "
            "camera poses follow; describe it with --board."
        )
    for quantity, error, most, unit in (
        ("a model error of", setting.length, MAX_LENGTH * size, "m"),
        ("axes off by", setting.angle, MAX_ANGLE, "rad"),
        ("cameras off by", setting.shift, MAX_LENGTH * size, "m"),
        ("cameras turned by", setting.turn, MAX_ANGLE, "rad"),
    ):
        if not 0.0 <= error <= most:
            problems.append(
                f"{start} {quantity} {error:g} {unit}, needed 0 to {most:.3g} {unit}; correct the "
                "setting."
            )
    if not 1 <= setting.draws <= MAX_DRAWS:
        problems.append(
            f"{start} {setting.draws} draws, needed 1 to {MAX_DRAWS}; correct the setting."
        )
    if problems:
        raise UsageError(problems)


def _notes_on_missing_images(shot: Dataset | None) -> tuple[str, ...]:
    if shot is None or shot.observations is not None:
        return ()
    n = shot.measurements.n_rows
    missing = sum(map(bool, shot.measurements.image)) - len(rows_with_image(shot))
    if not missing:
        return ()
    return (
        f"{missing} of {n} photographs of {shot.folder} are missing: the plan assumes that they "
        "will be taken.",
    )


def difference(machine: Machine, other: Machine) -> str:
    """Describe why two models are of different machines; empty if they may be the same.

    Models before and after a calibration are of the same machine.
    """
    kinds = [
        [(leg.base_joint, leg.kind, leg.platform_joint) for leg in model.legs]
        for model in (machine, other)
    ]
    if other.leg_names != machine.leg_names or kinds[0] != kinds[1]:
        return f"other legs ({other.name})"
    pairs = list(zip(machine.legs, other.legs, strict=True))
    distance = max(max(np.abs(a.A - b.A).max(), np.abs(a.B - b.B).max()) for a, b in pairs)
    if distance > SAME_MACHINE * machine.size:
        return f"joints up to {1e3 * distance:.0f} mm from those of the model"
    aligned = [
        abs(float(x @ y))
        for a, b in pairs
        for x, y in ((a.base_axis, b.base_axis), (a.platform_axis, b.platform_axis))
        if x is not None and y is not None
    ]
    turned = float(np.degrees(np.arccos(min([*aligned, 1.0]))))
    if turned > SAME_AXES:
        return f"axes of joints up to {turned:.0f} deg from those of the model"
    return ""


def _given_candidates(machine: Machine, shot: Dataset) -> tuple[Candidates, ...]:
    """Return views and poses of a dataset; DatasetError if it is of another machine."""
    m, mismatch = shot.measurements, difference(machine, shot.machine)
    if mismatch:
        raise DatasetError(
            f"{shot.folder}: the dataset could not be used for planning: found {mismatch}, needed "
            f"images of {machine.name}; correct --given or MODEL."
        )
    missing = [view.name for view in m.views if view.T_base_camera is None]
    if missing or not machine.is_determined:
        problem = f"no T_base_camera of view {missing[0]}" if missing else "readings without poses"
        raise DatasetError(
            f"{shot.folder}: the dataset could not be used for planning: found {problem}, needed "
            "the camera poses of its images; write T_base_camera of a result into dataset.yaml."
        )
    views = []
    for v, view in enumerate(m.views):
        rows = np.flatnonzero(m.view == v)
        if view.T_base_camera is None or not len(rows):
            continue
        place = Place(view.T_base_camera, view.name)
        configurations = list(follow_each(machine, m.q[rows][:, list(machine.motors)]))
        views.append(Candidates(place, poses_at(machine, configurations)))
    return tuple(views)


def _checked_number(name: str, number: int, most: int) -> int:
    """Check the number of an option against limits."""
    if not 1 <= number <= most:
        raise UsageError(
            f"The plan could not be made: found {name} {number}, needed 1 to {most}; correct it."
        )
    return number
