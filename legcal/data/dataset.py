"""A dataset: the folder of section 4.1, read and validated before any work."""

from __future__ import annotations

import os
import platform
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from legcal.brief import brief
from legcal.data.corners import Corners, read_corners
from legcal.data.dataset_file import (
    ENCODER_SIGMAS,
    Override,
    ViewEntry,
    entry_problem,
    find_dataset_file,
    read_dataset_file,
    view_problems,
)
from legcal.data.landmarks import (
    LANDMARKS_NAME,
    Landmarks,
    place_by_landmarks,
    read_landmarks,
)
from legcal.data.measurements import (
    Measurements,
    View,
    few_views,
    measurement_table,
    measurements_in,
)
from legcal.data.outlines import Outlines, are_of_bodies, read_observations
from legcal.data.photograph_notes import notes_on_photographs
from legcal.data.reading_units import (
    SERVO_SIGMA,
    ReadingUnit,
    are_commands,
    legs_with_readings,
    reading_units,
    sigma_in,
    sigma_too_large,
    sigmas_of_legs,
)
from legcal.errors import DatasetError, Place, Problem
from legcal.files.folder import path_problem
from legcal.files.motions import motion_from_xyz_quat
from legcal.files.schema import closest, describe, few
from legcal.geometry.types import IntArray
from legcal.machine.files import shipped_folder, shipped_names
from legcal.machine.leg import Link
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.vision.board import FixedBoard, parse_boards
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera
from legcal.vision.image_file import Grey, ImageFacts, Move, decode_image, inspect_image

CORNERS_NAME = "corners.csv"
OBSERVATIONS_NAME = "observations.csv"
PLAN_NAME = "plan.json"  # plan in the folder of a planned session
POSES_NAME = "poses.csv"  # its poses
CACHE_NAME = ".legcal-cache.json"
MAX_KEPT = 128 * 2**20  # size of the cache of decoded images [bytes]
# Sizes of the machine from the base to a camera: one that stands farther is stated in millimetres,
# if it then stands far enough
FARTHEST, NEAREST = 50.0, 0.5
MIN_CORNERS = 4  # corners in an image that must place its camera


@brief
@dataclass(frozen=True, eq=False)
class Dataset:
    """The input of a calibration."""

    folder: Path  # the dataset folder
    yaml_path: Path  # ``dataset.yaml``
    table_path: Path  # the table of measurements
    camera_paths: tuple[Path, ...]  # the camera file of each view
    machine: Machine  # the nominal model
    measurements: Measurements  # the rows of the table, in its order
    observations: Outlines | None  # the outlines in ``observations.csv`` if there is one
    units: Mapping[str, ReadingUnit] = field(default_factory=dict)  # of its readings, by motor
    table_notes: tuple[str, ...] = ()  # oddities that are allowed in tables and the dataset file
    body_edges: Outlines | None = None  # the straight edges of bodies in ``observations.csv``
    overrides: tuple[Override, ...] = ()  # parameters by name, from the block ``parameters``
    boards: tuple[FixedBoard, ...] = ()  # the calibration boards, that on the base first
    corners: Corners | None = None  # the rows of ``corners.csv`` if there is one
    landmarks: Landmarks | None = None  # the rows of ``landmarks.csv`` if there is one
    # Metadata of the image files that were inspected, by name
    facts: Mapping[str, ImageFacts] = field(default_factory=dict)
    file_notes: tuple[str, ...] = ()  # oddities in these files
    # Images that a camera took which did not stand still, by name: they are read as if it had
    moves: Mapping[str, Move] = field(default_factory=dict)

    @property
    def notes(self) -> tuple[str, ...]:
        """All notes on oddities that are allowed."""
        return (*self.table_notes, *self.file_notes)

    def board_on(self, link: Link) -> FixedBoard | None:
        """Return the calibration board on a link, None if it has none."""
        return next((board for board in self.boards if board.link == link), None)

    def image_path(self, row: int) -> Path | None:
        """Return the image file of a row; None where only outlines are given."""
        image = self.measurements.image[row]
        return self.folder / image if image else None

    def image_reader(self, rows: Sequence[int]) -> ImageReader:
        """Return a reader of the images of these rows, in this order, for use in any process."""
        m = self.measurements
        return ImageReader(
            tuple(None if path is None else path.absolute() for path in map(self.image_path, rows)),
            tuple(m.views[m.view[row]].camera for row in rows),
            tuple(map(self.where, rows)),
            tuple(self.moves.get(m.image[row]) for row in rows),
        )

    def where(self, row: int) -> Place:
        """Return the place of a row in its table."""
        return Place(str(self.table_path), row + 1)


def rows_with_image(dataset: Dataset) -> IntArray:
    """Return the rows that have an image file."""
    paths = [dataset.image_path(row) for row in range(dataset.measurements.n_rows)]
    rows = [row for row, path in enumerate(paths) if path is not None and os.path.exists(path)]
    return np.array(rows, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class ImageReader:
    """Reads images by their number, also in another process, or on a machine that shares them."""

    paths: tuple[Path | None, ...]  # the files, absolute; None where a row has no image
    cameras: tuple[Camera, ...]  # the camera of each image
    places: tuple[Place, ...]  # where each image is named
    moves: tuple[Move | None, ...]  # of each image, to be undone

    def __call__(self, k: int) -> Grey:
        """Return image k as (height, width) grey levels 0 to 255, float32."""
        return self.levels(k).astype(np.float32)

    def levels(self, k: int) -> _Decoded:
        """Return image k as :meth:`__call__`; levels of 8 bits stay 8-bit."""
        path = self.paths[k]
        if path is None:
            remedy = f"name one or give its outlines in {OBSERVATIONS_NAME}"
            raise DatasetError(
                Problem(
                    "its image could not be read",
                    "an empty cell",
                    "an image",
                    remedy,
                    *self.places[k],
                )
            )
        levels, move = _decoded(path, self.cameras[k], self.places[k]), self.moves[k]
        return levels if move is None else move.undone(levels.astype(np.float32))


_Decoded = NDArray[np.uint8] | Grey
_kept = OrderedDict[tuple[str | int, ...], _Decoded]()  # by file; the last used at the end


def _decoded(path: Path, camera: Camera, place: Place) -> _Decoded:
    """Decode an image; in each process once while there is room, until the file changes."""
    try:
        file = os.stat(path)
    except OSError as error:
        raise DatasetError(
            Problem(
                "its image could not be read",
                f"'{error.strerror}' for {path} on {platform.node()}",
                "the file there",
                "put it back, or, where the workers of a cluster are other machines, the dataset "
                "into a folder that they share",
                *place,
            )
        ) from error
    key = (str(path), file.st_size, file.st_mtime_ns, camera.width, camera.height)
    if key in _kept:
        _kept.move_to_end(key)
        return _kept[key]
    levels = decode_image(path, camera, place)
    _kept[key] = levels
    while sum(decoded.nbytes for decoded in _kept.values()) > MAX_KEPT:
        _kept.popitem(last=False)
    return levels


def _encoder_sigmas(
    path: Path,
    machine: Machine,
    stated: float | Mapping[str, float | str] | None,
    units: Mapping[str, ReadingUnit],
) -> tuple[float, dict[str, float]]:
    """Return the standard deviation of readings in metres, and the deviations by joint [m or rad].

    Hobby servos need none: their readings are commands, assumed accurate to half a degree.
    """
    turning = [a.joint for a in machine.actuators if a.turns]
    of_motor = {str(leg.prismatic): leg for leg in legs_with_readings(machine.legs)}
    commanded = {
        name: SERVO_SIGMA for name, unit in units.items() if are_commands(of_motor[name], unit)
    }
    if stated is None:
        stated = {}
    if not isinstance(stated, Mapping):
        if turning:
            example = ", ".join(
                f"{name}: {'0.5deg' if name in commanded else 0.0001}"
                for name in machine.motor_names
            )
            raise DatasetError(
                f"{path}: encoder_sigma could not be used: found one number [m], but the motor "
                f"'{turning[0]}' turns, needed one for each motor in its unit; write "
                f"encoder_sigma: {{{example}}}, with your values."
            )
        for leg in of_motor.values():
            if too_large := sigma_too_large(stated, leg):
                raise DatasetError(
                    f"{path}: encoder_sigma could not be used: found {too_large[0]}, needed "
                    f"{too_large[1]}; give one standard deviation of a reading in metres."
                )
        return stated, {}
    motors, sigmas, problems = machine.motor_names, dict[str, float](), list[str]()
    for name, sigma in stated.items():
        try:
            if name not in motors:
                raise ValueError(
                    f"found no motor of that name, needed each of {', '.join(motors)}; "
                    f"{closest(name, motors)}"
                )
            sigmas[name] = sigma_in(sigma, units[name], of_motor[name])
        except ValueError as error:
            problems.append(f"{path}: encoder_sigma.{name} could not be used: {error}")
    if missing := [name for name in motors if name not in stated and name not in commanded]:
        problems.append(
            f"{path}: encoder_sigma is incomplete: found none for {few(missing)}, needed one "
            f"standard deviation of a reading{'' if machine.actuators else ' [m]'}, for each motor "
            "in the unit of its readings where one turns; add it."
        )
    if problems:
        raise DatasetError(problems)
    linear = [sigma for name, sigma in sigmas.items() if name not in turning]
    sigma_of_motor = commanded | sigmas
    return min(linear, default=ENCODER_SIGMAS[0]), {name: sigma_of_motor[name] for name in motors}


def load_dataset(
    folder: str | Path, *, check_images: bool = True, check_clicks: bool = True
) -> Dataset:
    """Read a dataset and check everything in it that can be checked without decoding images.

    Parameters
    ----------
    folder : str or Path
        The dataset folder, or its ``dataset.yaml``.
    check_images : bool
        Also check that every image that must be read exists, is complete and has the size of
        its camera file.
    check_clicks : bool
        Refuse clicks in ``landmarks.csv`` that do not place the camera of their view. Without, such
        a view starts as if it had none, and a note says why.

    Returns
    -------
    Dataset
        With rows, views and legs in the order of the files.

    Raises
    ------
    DatasetError
        With one sentence for each problem.
    ModelError, OutOfClass
        If the mechanism does not load.
    """
    yaml_path = find_dataset_file(Path(folder))
    folder = yaml_path.parent
    entry = read_dataset_file(yaml_path)
    boards = () if entry.board is None else parse_boards(entry.board, yaml_path)
    problems: list[str | Problem] = []
    problems += view_problems(yaml_path, entry.views, [board.link for board in boards])
    if wrong_path := path_problem(folder, entry.measurements):
        problems.append(
            f"{yaml_path}: measurements could not be used: found {wrong_path} "
            f"({entry.measurements}), needed a relative path inside it; move the table there."
        )
    camera_paths = tuple(folder / view.camera for view in entry.views.values())
    cameras = dict[Path, Camera]()
    for camera_path in dict.fromkeys(camera_paths):
        try:
            cameras[camera_path] = read_camera(camera_path)
        except DatasetError as error:
            problems += error.facts
    mechanism = folder / entry.mechanism
    if not os.path.isfile(mechanism) and entry.mechanism in shipped_names():
        mechanism = shipped_folder("models") / f"{entry.mechanism}.yaml"
    if not os.path.exists(mechanism):
        found = f"{describe(entry.mechanism)}, no file there"
        needed = "the model, relative to this file, or the name of a shipped one"
        remedy = f"copy it there with its URDF, or correct the path ({mechanism})"
        if not Path(entry.mechanism).suffix and "/" not in entry.mechanism:
            remedy += f"; of shipped models: {closest(entry.mechanism, shipped_names())}"
        raise DatasetError(
            [*problems, entry_problem(yaml_path, "mechanism", found, needed, remedy)]
        )
    machine = load_mechanism(mechanism)
    problems += [
        entry_problem(
            yaml_path,
            f"views.{name}.legs",
            f"the unknown leg {describe(leg)}",
            "legs of the mechanism",
            closest(leg, machine.leg_names),
        )
        for name, view in entry.views.items()
        for leg in view.legs or ()
        if leg not in machine.leg_names
    ]
    if problems:
        raise DatasetError(problems)
    in_mm = [
        name
        for name, view in entry.views.items()
        if (T := view.T_base_camera)
        and (far := float(np.linalg.norm(T.xyz)) / machine.size) > FARTHEST
        and 1e-3 * far > NEAREST
    ]
    views = tuple(
        _view(name, view, cameras[path], 1e-3 if name in in_mm else 1.0)
        for (name, view), path in zip(entry.views.items(), camera_paths, strict=True)
    )
    table_path = folder / entry.measurements
    units = reading_units(yaml_path, machine.legs, entry.readings)
    sigma_q, by_joint = _encoder_sigmas(yaml_path, machine, entry.encoder_sigma, units)
    table, unread = measurement_table(table_path, units)
    if unread:
        # Without readings of what moves joints at A, their positions are unknown.
        moving = [actuator.joint for actuator in machine.actuators if actuator.joint in unread]
        if moving:
            columns = f"column{'s' * (len(moving) > 1)} {few(moving)}"
            raise DatasetError(
                f"{table_path}, {columns}: the readings could not be left open: found empty cells "
                "in all rows of what moves joints at the base, needed its readings, since the "
                "images alone do not say where the rods begin; record them."
            )
        machine = load_mechanism(mechanism, without=unread)
    sigma = sigmas_of_legs(machine.legs, sigma_q, by_joint)
    rows, notes = measurements_in(table, folder, views, machine.legs, sigma, units)
    if unread:
        notes = (*notes, _without_readings(table_path, machine, unread))
    if in_mm:
        what = f"T_base_camera of {few_views(in_mm)} is too far for metres, and its xyz"
        notes = (*notes, f"{yaml_path}: {what} were taken as millimetres: write metres.")
    measurements, origin, taken = expand_hand_held(yaml_path, rows, entry.views)
    if taken:
        raise DatasetError(taken)
    landmarks = None
    of_clicks: list[str] = []
    if os.path.exists(folder / LANDMARKS_NAME):
        path = folder / LANDMARKS_NAME
        landmarks = read_landmarks(path, machine.leg_names, measurements)
        measurements, of_clicks = place_by_landmarks(
            path, machine, measurements, landmarks, may_be_wrong=not check_clicks
        )
    unused = [
        f"{yaml_path}: view {view.name} has no row in the table of measurements and is left out."
        for v, view in enumerate(rows.views)
        if not np.any(rows.view == v)
    ]
    observations, body_edges = read_observed(folder, machine, measurements)
    dataset = Dataset(
        folder=folder,
        yaml_path=yaml_path,
        table_path=table_path,
        camera_paths=tuple(camera_paths[v] for v in origin),
        machine=replace(
            machine,
            tolerance=entry.built or machine.tolerance,
            spline_teeth=entry.spline_teeth or machine.spline_teeth,
        ),
        measurements=measurements,
        observations=observations,
        units=units,
        body_edges=body_edges,
        table_notes=(*notes, *of_clicks, *unused),
        overrides=entry.parameters.overrides(yaml_path),
        boards=boards,
        corners=read_given_corners(folder / CORNERS_NAME, boards, measurements),
        landmarks=landmarks,
    )
    if hidden := _invisible(dataset):
        raise DatasetError(hidden)
    if not check_images:
        return dataset
    dataset, unusable = inspect_files(dataset)
    if unusable:
        raise DatasetError(_without_photographs(dataset) or [problem for _, problem in unusable])
    return dataset


def _without_readings(path: Path, machine: Machine, unread: Sequence[str]) -> str:
    """Return a note on motors without readings."""
    start = f"{path}: the readings of {few(unread)} are not known (empty cells): "
    if machine.is_determined:
        return start + "the others give the pose of the platform, and these legs are passive."
    return (
        f"{start}the pose of the platform is found in each image, and the offsets of these legs "
        "stay as the model has them."
    )


def _without_photographs(dataset: Dataset) -> str:
    """Return the problem of a dataset with no image file at all; "" if there are some."""
    images = dataset.measurements.image
    if len(images) < 2 or not all(images) or len(rows_with_image(dataset)):
        return ""
    return (
        f"{dataset.table_path}: the photographs could not be read: found none of the {len(images)} "
        f"that it names, the first of them {images[0]}, needed their files in "
        f"{dataset.folder}; take or copy them there under these names, or correct the column image."
    )


def _invisible(dataset: Dataset) -> list[str]:
    """Return the problems of legs without a visible cylinder, unless a table has outlines.

    The model must have a cylinder along some leg of every view, and along one of the rods on every
    motor that carries rods.
    """
    if dataset.observations is not None or dataset.board_on("platform") is not None:
        return []
    machine = dataset.machine
    add = "add <visual> cylinders along them, with their radii, to the URDF"
    shown = {leg.name for leg in machine.legs if leg.cylinders}
    views = [view.name for view in dataset.measurements.views if not any(map(view.uses, shown))]
    if views:
        return [
            f"{dataset.yaml_path}: {few_views(views)} could not be used: found no leg of which the "
            f"model {machine.yaml_path.name} has a visible cylinder, needed one at least; {add}."
        ]
    rods = {
        a.joint: [leg.name for leg in machine.legs if leg.prismatic == a.joint]
        for a in machine.actuators
    }
    return [
        f"{dataset.yaml_path}: the motor '{joint}' could not be calibrated: found no visible rod "
        f"on it (the model {machine.yaml_path.name} has no cylinder along {few(names)}), needed "
        f"one at least; {add}."
        for joint, names in rods.items()
        if not shown.intersection(names)
    ]


def _view(name: str, entry: ViewEntry, camera: Camera, unit: float) -> View:
    """Return a view of the measurements; the unit of T_base_camera is in metres."""
    T = entry.T_base_camera
    return View(
        name=name,
        camera=replace(camera, gamma=entry.gamma or 1.0, gamma_is_given=entry.gamma is not None),
        T_base_camera=motion_from_xyz_quat([unit * x for x in T.xyz], T.quat_xyzw) if T else None,
        legs=None if entry.legs is None else tuple(entry.legs),
    )


def read_observed(
    folder: Path, machine: Machine, measurements: Measurements
) -> tuple[Outlines | None, Outlines | None]:
    """Return the outlines beside the dataset and the edges of bodies; None where there are none."""
    path = folder / OBSERVATIONS_NAME
    if not os.path.exists(path):
        return None, None
    is_own = (folder / CACHE_NAME).exists()
    table = read_observations(path, machine.legs, measurements, skip_stale=is_own)
    of_bodies = are_of_bodies(table)
    return table.choose(~of_bodies), table.choose(of_bodies) if of_bodies.any() else None


def read_given_corners(
    path: Path, boards: tuple[FixedBoard, ...], measurements: Measurements
) -> Corners | None:
    """Return the corners beside a dataset, if there are any."""
    if not os.path.exists(path):
        return None
    if not boards:
        raise DatasetError(
            f"{path}: the corners could not be used: found no board in the dataset file, needed "
            "the one that they belong to; describe it in the block board, or remove the table."
        )
    return read_corners(path, boards, measurements)


def inspect_files(dataset: Dataset) -> tuple[Dataset, list[tuple[int, Problem]]]:
    """Return a dataset with the metadata of its images, and the problems by row.

    There is one problem for each row that neither an image nor tables make usable.
    """
    measurements, corners = dataset.measurements, dataset.corners
    facts, problems = dict[str, ImageFacts](), list[tuple[int, Problem]]()

    def refuse(row: int, what: str, found: str, needed: str, remedy: str, *columns: str) -> None:
        place = dataset.where(row)
        problems.append((row, Problem(what, found, needed, remedy, *place, columns=columns)))

    by_board = dataset.board_on("base") is not None
    held = [view.hand_held and by_board for view in measurements.views]
    no_place, of_held = "its camera could not be placed", "every image of a hand-held camera"
    shown = np.zeros(measurements.n_rows, dtype=np.intp)  # corners of the board on the base
    if corners is not None:
        on_base = dataset.board_on("base")
        counted = corners.used if on_base is None else corners.used & on_base.has(corners.corner)
        shown = np.bincount(corners.row[counted], minlength=measurements.n_rows)
    for row in np.flatnonzero(np.array(held, dtype=np.bool_)[measurements.view]).tolist():
        if corners is not None and shown[row] < MIN_CORNERS:
            found = f"{shown[row] or 'no'} corners of the board in {CORNERS_NAME}"
            needed = f"{MIN_CORNERS} in {of_held}"
            refuse(row, no_place, found, needed, "add them or remove the row")
        elif corners is None and not measurements.image[row]:
            found, remedy = (
                f"neither an image nor {CORNERS_NAME}",
                "name an image or give the corners",
            )
            refuse(row, no_place, found, f"the board in {of_held}", remedy, "image")
    no_use, remedy = "the row could not be used", "name an image or remove the row"
    outlines = dataset.observations
    in_tables = set() if outlines is None else set(outlines.row.tolist())
    tables = f"outlines of it in {OBSERVATIONS_NAME}"
    if dataset.board_on("platform") is not None and corners is not None:
        in_tables |= set(corners.row[corners.used].tolist())
        tables += f" or corners in {CORNERS_NAME}"
    for row in range(measurements.n_rows):
        path = dataset.image_path(row)
        if path is None and row not in in_tables:
            refuse(row, no_use, f"neither an image nor {tables}", "one of them", remedy, "image")
        elif path is not None and (os.path.exists(path) or row not in in_tables):
            camera, place = measurements.views[measurements.view[row]].camera, dataset.where(row)
            facts[measurements.image[row]], problem_of_image = inspect_image(path, camera, place)
            problems += [(row, problem_of_image)] if problem_of_image else []
    notes = notes_on_photographs(measurements, dataset.camera_paths, facts)
    return replace(dataset, facts=facts, file_notes=tuple(note.what for note in notes)), problems


def expand_hand_held(
    path: Path, measurements: Measurements, views: Mapping[str, ViewEntry]
) -> tuple[Measurements, tuple[int, ...], list[Problem]]:
    """Give every image of a hand-held view a separate view: NAME-1, NAME-2, ... by rows."""
    new: list[View] = []
    origin: list[int] = []
    problems: list[Problem] = []
    index = np.zeros_like(measurements.view)
    for v, (name, entry) in enumerate(views.items()):
        rows = np.flatnonzero(measurements.view == v)
        if not entry.hand_held:
            index[rows] = len(new)
            new.append(measurements.views[v])
            origin.append(v)
            continue
        for k, row in enumerate(rows.tolist(), start=1):
            index[row] = len(new)
            new.append(replace(measurements.views[v], name=f"{name}-{k}", hand_held=True))
            origin.append(v)
        taken = [f"{name}-{k + 1}" for k in range(len(rows)) if f"{name}-{k + 1}" in views]
        problems += [
            entry_problem(
                path,
                f"views.{view_name}",
                f"the name that an image of the hand-held view {name} gets",
                "another",
                "rename it",
            )
            for view_name in taken
        ]
    return replace(measurements, views=tuple(new), view=index), tuple(origin), problems
