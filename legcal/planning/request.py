"""``legcal.plan``: what is asked of a plan, checked, and the plan that answers it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Prior
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.reading_units import sigmas_of
from legcal.errors import DatasetError, NotIdentifiable, UsageError
from legcal.geometry.types import Array
from legcal.machine.feasibility import poses_at
from legcal.machine.kinematics import follow_each
from legcal.machine.leg import SIGMA_LENGTH, SIGMA_READING
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.planning.information import DEFAULT_NOISE, PredictedNoise, Predictor
from legcal.planning.noise import read_noise
from legcal.planning.places import (
    MAX_ANGLE,
    MAX_DRAWS,
    MAX_LENGTH,
    Place,
    Setting,
    usual_setting,
)
from legcal.planning.planned_session import Plan
from legcal.planning.planner import Candidates, Task, plan_session
from legcal.progress import Progress, Report, shown_progress
from legcal.vision.board import Board
from legcal.vision.board_file import board_document, board_of, parse_board
from legcal.vision.camera import Camera, sample_camera
from legcal.vision.camera_file import read_camera
from legcal.workers import Run, Workers, worker_pool

IMAGES_PER_VIEW = 15
MOST_IMAGES, MOST_VIEWS = 400, 12
SAME_MACHINE = 0.025  # mean leg lengths between joints of the model and of a dataset shot of it
SAME_AXES = 5.0  # [deg] the same between their axes
_ROUNDS = 5  # plans, until the fewest images are found that reach a target
_BEGIN = 24  # images of the first of them
_NEARLY = 0.9  # of the images of a plan that reaches it: another with so many is tried


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
    bounds: Array | None = None,
    places: Sequence[Place] = (),
    given: str | Path | Dataset | None = None,
    board: str | Path | Board | None = None,
    hand_held: bool = False,
    setting: Setting | None = None,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress = False,
    stop: Callable[[], bool] = lambda: False,
) -> Plan:
    """Choose poses and camera places of a session that determine a machine best.

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
        The camera, or its file; 1024 x 768 pixels and 43 degrees wide by default, or that of the
        dataset that is given.
    noise : PredictedNoise or path
        Errors of outlines, or the folder of an earlier result that has them.
    encoder_sigma : float or str, optional
        One standard deviation of a reading: a number [m, of motors that turn rad], or a text with
        its unit ('0.5deg'), which is that of the motors that slide, or turn. By default 2 um,
        0.1 mrad and 0.5 deg of hobby servos, or those of the dataset.
    bounds : (3, 2) array, optional
        Lowest and highest x, y, z of cameras in the base link [m].
    places : sequence of Place
        Tripods with their names, to choose from in place of those around the machine.
    given : path or Dataset, optional
        What was shot already; the plan says what to add.
    board : str, path or Board, optional
        A calibration board on the base that every image shows, as ``legcal camera`` takes it.
    hand_held : bool
        Every image from a place of its own; with a board.
    setting : Setting
        How well tripods are set, and what is known of the machine before.
    seed : int
        Of everything that is drawn: the same gives the same plan.
    workers : int, str or executor
        Work in that many processes; with more than one, the program that calls this must be safe
        to import (``if __name__ == "__main__":``). Or on a Dask cluster: the address of its
        scheduler, a client, or another object with ``submit``, as executors have it.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    stop : callable
        Asked between steps: once it is true, the best so far is the plan.

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
    setting = usual_setting(machine.size) if setting is None else setting
    listed = tuple(replace(place, fixed=True) for place in places)
    n_views = _n_views(cameras, len(listed), hand_held=hand_held)
    n_images = _n_images(images, images_per_view, n_views, target)
    _check(target, bounds, listed, board, hand_held, setting, seed, machine.size)
    shot = given if isinstance(given, Dataset) or given is None else _shot(Path(given))
    before = () if shot is None else _given(machine, shot)
    if camera is None:
        chosen = sample_camera() if shot is None else shot.measurements.views[0].camera
    else:
        chosen = camera if isinstance(camera, Camera) else read_camera(Path(camera))
    usual_q = SIGMA_READING * machine.size
    sigma_q, sigma_by_joint = usual_q, dict[str, float]()
    if encoder_sigma is not None:
        sigma_by_joint = sigmas_of(encoder_sigma, machine.legs)
        sliding = [str(leg.prismatic) for leg in machine.legs if not leg.reads_angle]
        sigma_q = min((s for name, s in sigma_by_joint.items() if name in sliding), default=usual_q)
    elif shot is not None:
        sigma_q = shot.measurements.sigma_q
        sigma_by_joint = dict(shot.measurements.sigma_by_joint)
    errors = noise if isinstance(noise, PredictedNoise) else read_noise(Path(noise))
    lengths, counted = _measured_length(machine, board=board is not None)
    task = Task(
        Predictor(machine, chosen, errors, sigma_q, lengths, sigma_by_joint),
        n_images,
        n_views,
        setting,
        bounds,
        listed,
        before,
        "" if shot is None else str(shot.folder),
        None if board is None else _on_base(board),
        hand_held,
        seed,
    )
    pool = worker_pool(workers, "The session could not be planned")
    with shown_progress(progress) as report, pool as run:
        if target is None:
            found = plan_session(task, report, stop, run)
        else:
            found = _fewest(task, target, report, stop, run)
        return replace(found, notes=(*found.notes, *counted, *_to_come(shot)))


def _measured_length(machine: Machine, *, board: bool) -> tuple[Choices, tuple[str, ...]]:
    """Return the length that a plan counts on where readings carry none, and a note on it."""
    found = machine.rod_for_scale(has_length=board)
    if found is None:
        return NO_CHOICES, ()
    rod, ends = found
    sigma = SIGMA_LENGTH * machine.size
    return Choices(priors={f"{rod.name}.length": Prior(rod.q0, sigma)}), (
        f"Readings of motors that turn carry no length: the plan counts on the rod of {rod.name} "
        f"measured to {1e3 * sigma:.2g} mm (legcal calibrate --length "
        f"{ends}={1e3 * rod.q0:.3f}+-{1e3 * sigma:.2g}mm, with what you measure).",
    )


def _fewest(
    task: Task, target: float, progress: Report, stop: Callable[[], bool], run: Run
) -> Plan:
    """Return the plan with the fewest images that reaches a target [m].

    The error of a plan says how many images the next one needs; what limits plans of any size is
    told where none reaches it.
    """
    n, least, best = max(_BEGIN, 2 * task.n_views), 0, None
    for _ in range(_ROUNDS):
        found = plan_session(replace(task, n_images=n), progress, stop, run)
        if found.error is None:
            raise UsageError(
                f"--target could not be used: found that {task.machine.undetermined}, needed a "
                "machine whose readings give the pose; give --images."
            )
        error = found.error.mean_displacement
        if error <= target:
            best = found if best is None or found.n_images < best.n_images else best
        else:
            least = max(least, n)
        if stop():
            if best is not None:
                return best
            missed = f"It is expected to reach {1e3 * error:.3f} mm, not {1e3 * target:g} mm."
            return replace(found, notes=(*found.notes, missed))
        enough = _images_for(found, error, target)
        if enough > MOST_IMAGES and best is None:
            break
        if best is not None:
            enough = min(enough, int(_NEARLY * best.n_images))
        wanted = max(enough, least + 1, 2 * task.n_views)
        if wanted > MOST_IMAGES or (best is not None and wanted >= best.n_images):
            break
        n = wanted
    if best is not None:
        return best
    raise NotIdentifiable(_unreached(task, found, target))


def _images_for(found: Plan, error: float, target: float) -> int:
    """Return with how many images an error goes down to a target, as the growth of a plan says."""
    n, value = np.log(found.growth[np.isfinite(found.growth[:, 1])]).T
    scaled = value + np.log(error) - value[n == np.log(found.n_images)][0]
    if scaled.min() > np.log(target):
        return 10 * MOST_IMAGES
    k = int(np.argmax(scaled <= np.log(target)))
    share = 1.0 if k == 0 else (scaled[k - 1] - np.log(target)) / (scaled[k - 1] - scaled[k])
    return int(np.ceil(np.exp(n[k] if k == 0 else n[k - 1] + share * (n[k] - n[k - 1]))))


def _unreached(task: Task, found: Plan, target: float) -> str:
    """Return why no number of images reaches a target, and what limits it."""
    without = min(found.limits, key=lambda what: found.limits[what], default="")
    error = 0.0 if found.error is None else found.error.mean_displacement
    limit = "the noise of single outlines"
    if without and found.limits[without] < 0.8 * found.value:
        share = error * found.limits[without] / found.value
        limit = f"{without} (without them {1e3 * share:.3f} mm)"
    more = ""
    n, value = found.growth[found.growth[:, 0] <= MOST_IMAGES][-1]
    if n > found.n_images:
        more = f" and about {1e3 * error * value / found.value:.3f} mm with {n:.0f} of their kind"
    return (
        f"{task.machine.yaml_path}: the target of {1e3 * target:g} mm could not be planned: found "
        f"{1e3 * error:.3f} mm with {found.n_images} images{more}, limited by {limit}, needed "
        "fewer such errors; use better light or a camera of a longer focal length, more --cameras, "
        "--board, or a larger --target."
    )


def _n_views(cameras: int | None, n_places: int, *, hand_held: bool) -> int:
    """Return the number of camera places."""
    n = min(3, n_places) if cameras is None and n_places else (cameras or 3)
    n = _whole("--cameras", n if cameras is None else cameras, 1, MOST_VIEWS)
    if n_places and n > n_places:
        raise UsageError(
            f"The plan could not be made: found {n_places} place{'s' * (n_places != 1)} for {n} "
            "cameras, needed one for each; add places or give fewer --cameras."
        )
    if hand_held and cameras is not None and cameras > 1:
        raise UsageError(
            f"The plan could not be made: found --hand-held and {cameras} cameras, needed one of "
            "the two, a camera in the hand takes every image from a place of its own; leave out "
            "--cameras."
        )
    return 1 if hand_held else n


def _n_images(images: int | None, per_view: int | None, n_views: int, target: float | None) -> int:
    """Return the number of photographs of the session."""
    if images is not None and per_view is not None:
        raise UsageError(
            f"The plan could not be made: found {images} images and {per_view} images per view, "
            "needed one of the two; leave out --images-per-view, or --images."
        )
    if target is not None and (images is not None or per_view is not None):
        raise UsageError(
            "The plan could not be made: found a target and a number of images, needed one of the "
            "two; leave out --target, or the number."
        )
    if per_view is not None:
        return n_views * _whole("--images-per-view", per_view, 1, MOST_IMAGES // n_views)
    n = 3 * IMAGES_PER_VIEW if images is None else _whole("--images", images, 1, MOST_IMAGES)
    if n < n_views:
        raise UsageError(
            f"The plan could not be made: found {n} images for {n_views} cameras, needed one for "
            f"each at least; give {n_views} --images or more, or fewer --cameras."
        )
    return n


def _check(
    target: float | None,
    bounds: Array | None,
    places: Sequence[Place],
    board: object,
    hand_held: bool,
    setting: Setting,
    seed: int,
    size: float,  # of the machine [m]
) -> None:
    """Refuse what contradicts itself."""
    start, problems = "The plan could not be made: found", []
    if seed < 0:
        problems.append(f"{start} {seed} as the seed, needed 0 or more; correct --seed.")
    if target is not None and not 0.0 < target < 1.0:
        problems.append(
            f"{start} a target of {target:g} m, needed more than 0 and less than 1 m; correct "
            "--target."
        )
    if bounds is not None and places:
        problems.append(
            f"{start} bounds and a list of places, needed one of the two; leave out --bounds."
        )
    if hand_held and board is None:
        problems.append(
            f"{start} a camera in the hand without a board, needed a calibration board on the base "
            "in every image, which alone tells where it was; describe it with --board."
        )
    for what, off, most, unit in (
        ("a model error of", setting.length, MAX_LENGTH * size, "m"),
        ("axes off by", setting.angle, MAX_ANGLE, "rad"),
        ("cameras off by", setting.shift, MAX_LENGTH * size, "m"),
        ("cameras turned by", setting.turn, MAX_ANGLE, "rad"),
    ):
        if not 0.0 <= off <= most:
            problems.append(
                f"{start} {what} {off:g} {unit}, needed 0 to {most:.3g} {unit}; correct the "
                "setting."
            )
    if not 1 <= setting.draws <= MAX_DRAWS:
        problems.append(
            f"{start} {setting.draws} draws, needed 1 to {MAX_DRAWS}; correct the setting."
        )
    if problems:
        raise UsageError(problems)


def _on_base(board: str | Path | Board) -> Board:
    """Return a board. Raises DatasetError if a dataset could not use it."""
    found = board_of(board)
    parse_board(board_document(found), Path("--board"))
    return found


def _shot(folder: Path) -> Dataset:
    """Return a dataset, whose images are not looked at."""
    return load_dataset(folder, check_images=False)


def _to_come(shot: Dataset | None) -> tuple[str, ...]:
    """Return a note on photographs of a given dataset that are not there."""
    if shot is None or shot.observations is not None:
        return ()
    n = shot.measurements.n_rows
    paths = [shot.image_path(row) for row in range(n)]
    missing = sum(path is not None and not path.is_file() for path in paths)
    if not missing:
        return ()
    return (
        f"{missing} of {n} photographs of {shot.folder} are not there: the plan counts on them as "
        "if they were.",
    )


def difference(machine: Machine, other: Machine) -> str:
    """Return in words by what another model is of another machine; nothing if it may be the same.

    Models before and after a calibration are of the same machine.
    """
    kinds = [
        [(leg.base_joint, leg.kind, leg.platform_joint) for leg in one.legs]
        for one in (machine, other)
    ]
    if other.leg_names != machine.leg_names or kinds[0] != kinds[1]:
        return f"other legs ({other.name})"
    both = list(zip(machine.legs, other.legs, strict=True))
    off = max(max(np.abs(a.A - b.A).max(), np.abs(a.B - b.B).max()) for a, b in both)
    if off > SAME_MACHINE * machine.size:
        return f"joints up to {1e3 * off:.0f} mm from those of the model"
    aligned = [
        abs(float(x @ y))
        for a, b in both
        for x, y in ((a.base_axis, b.base_axis), (a.platform_axis, b.platform_axis))
        if x is not None and y is not None
    ]
    turned = float(np.degrees(np.arccos(min([*aligned, 1.0]))))
    if turned > SAME_AXES:
        return f"axes of joints up to {turned:.0f} deg from those of the model"
    return ""


def _given(machine: Machine, shot: Dataset) -> tuple[Candidates, ...]:
    """Return views and poses of a dataset. Raises DatasetError if it is of another machine."""
    m, found = shot.measurements, difference(machine, shot.machine)
    if found:
        raise DatasetError(
            f"{shot.folder}: the dataset could not be planned with: found {found}, needed images "
            f"of {machine.name}; correct --given or MODEL."
        )
    missing = [view.name for view in m.views if view.T_base_camera is None]
    if missing or not machine.is_determined:
        what = f"no T_base_camera of view {missing[0]}" if missing else "readings without poses"
        raise DatasetError(
            f"{shot.folder}: the dataset could not be planned with: found {what}, needed where its "
            "images were taken; write T_base_camera of a result into dataset.yaml."
        )
    found_views = []
    for v, view in enumerate(m.views):
        rows = np.flatnonzero(m.view == v)
        if view.T_base_camera is None or not len(rows):
            continue
        place = Place(view.T_base_camera, view.name, fixed=True)
        configurations = list(follow_each(machine, m.q[rows][:, list(machine.motors)]))
        found_views.append(Candidates(place, poses_at(machine, configurations)))
    return tuple(found_views)


def _whole(name: str, found: int, least: int, most: int) -> int:
    """Return a number of an option between limits."""
    if not least <= found <= most:
        raise UsageError(
            f"The plan could not be made: found {name} {found}, needed {least} to {most}; correct "
            "it."
        )
    return found
