"""A dataset made from a folder of photographs and a table as its owner keeps it.

Columns are identified by their headings, the unit by the heading or by the travel of the machine,
and photographs by :mod:`legcal.data.photograph_matching`. Everything is checked before anything is
written; the result is a :class:`NewDataset` that can be shown first. Photographs in the dataset's
folder stay where they are; others are linked, or copied where the file system has no links.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from legcal.data.dataset import Dataset, load_dataset
from legcal.data.dataset_file import MEASUREMENTS, dataset_texts, listed
from legcal.data.measurements import few_views
from legcal.data.photograph_matching import (
    ONE_VIEW,
    Photograph,
    find_photographs,
    likely_pattern,
    match,
    with_likely_views,
)
from legcal.data.reading_units import are_commands, sigmas_of, usual_sigma
from legcal.data.readings_sheet import ReadingsSheet, SheetReadings
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.files.folder import OutputKind, check_destination, check_path, new_files, result_folder
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import (
    MAX_IMAGE,
    NAME_NEEDED,
    Document,
    Number,
    describe,
    few,
    is_name,
    read_bytes,
)
from legcal.machine.files import DATASET_YAML, shipped_folder, shipped_names
from legcal.machine.leg import Leg
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.vision.board import Board, board_beside_machine, board_document
from legcal.vision.camera import Camera
from legcal.vision.camera_file import read_camera, rough_camera_info
from legcal.vision.image_file import (
    FOCAL_SIGMA,
    BadImage,
    camera_of_photographs,
    image_size,
    inspect_image,
    read_facts,
)

DATASET_FOLDER = OutputKind("dataset", "", "")  # may contain other files
_WIDENED = 1.2  # uncertainty of a focal length, over the usual one, that is explained
_EXAMPLE = "examples/hexapod"
_EXAMPLE_KIND = OutputKind("example", "", "")
# Without results of a calibration beside them
_EXAMPLE_FILES = (
    "dataset.yaml", "measurements.csv", "camera_info.yaml", "images", "models", "urdf"
)  # fmt: skip
MIN_SIGMA = 2.5e-6  # [mean leg lengths] minimum default noise of readings
_CAMERA_NAMES = ("camera_info.yaml", "camera_info.yml", "camera.yaml")


class ViewToWrite(Document):
    """A camera position."""

    camera: str  # its camera file


class MatchedImage(Document):
    """A photograph with the readings of its row."""

    row: int  # of the table, from 1
    view: str
    photograph: str
    image: str  # in the dataset
    readings: dict[str, Number]  # by joint [m, or rad of what turns]


class NewDatasetDocument(Document):
    """The document of ``legcal init --json``."""

    dataset: str
    mechanism: str
    columns: dict[str, str]  # of the table, by joint
    unit: str
    unit_from: str
    lengths: bool  # whether the table has lengths of legs, not readings
    matched: str
    encoder_sigma: Number | dict[str, Number]  # [m], or by motor [m, rad] if any motor turns
    views: dict[str, ViewToWrite]
    images: list[MatchedImage]
    notes: list[str]
    written: list[str]


@dataclass(frozen=True, eq=False)
class NewDataset:
    """A dataset that is not written yet."""

    machine: Machine  # the nominal model
    model: str  # its name in ``dataset.yaml``
    destination: Path  # the folder of the dataset
    sheet: ReadingsSheet
    readings: SheetReadings  # of the motors whose readings are known
    pairs: Sequence[tuple[int, Photograph]]  # rows of the sheet and their photographs, by views
    matched: str  # how, in words
    cameras: Mapping[str, Path]  # the camera file of each view
    # One standard deviation of a reading [m], by joint [m or rad] where a motor turns
    encoder_sigma: float | dict[str, float]
    notes: tuple[str, ...]  # oddities, and choices that were made
    # Contents of camera files to write, from the metadata of photographs
    made_cameras: Mapping[Path, str] = field(default_factory=dict)
    board: Board | None = None  # on the base
    hand_held: bool = False

    def readings_of(self, k: int) -> dict[str, float]:
        """Return the readings of a row of the table by joint [m or rad]."""
        return dict(zip(self.readings.joints, self.readings.q[k].tolist(), strict=True))

    def document(self, written: Sequence[Path]) -> dict[str, Any]:
        """Return the document of ``legcal init --json``, with the files that were written."""
        return NewDatasetDocument(
            dataset=str(self.destination),
            mechanism=self.model,
            columns=dict(self.sheet.taken),
            unit=self.readings.unit,
            unit_from=self.readings.unit_from,
            lengths=self.readings.are_lengths,
            matched=self.matched,
            encoder_sigma=self.encoder_sigma,
            views={view: ViewToWrite(camera=str(path)) for view, path in self.cameras.items()},
            images=[
                MatchedImage(
                    row=k + 1,
                    view=photograph.view,
                    photograph=photograph.name,
                    image=self.place(photograph),
                    readings=self.readings_of(k),
                )
                for k, photograph in self.pairs
            ],
            notes=list(self.notes),
            written=[str(path) for path in written],
        ).document()

    def place(self, photograph: Photograph) -> str:
        """Return the path of a photograph relative to the dataset's folder."""
        real, destination = photograph.path.resolve(), self.destination.resolve()
        if real.is_relative_to(destination):
            return real.relative_to(destination).as_posix()
        return (PurePosixPath("images") / photograph.name).as_posix()


@dataclass(frozen=True, kw_only=True)
class SheetOptions:
    """Options of the user besides photographs and table.

    Attributes
    ----------
    cameras : str or sequence of str
        Camera files: one for all views, or ``VIEW=FILE`` for each; by default those beside the
        photographs.
    unit : str, optional
        Unit of the readings: m, cm, mm, um; for motors that turn rad, mrad, deg or us (pulses of
        hobby servos that the model describes). By default the unit of the headings, else chosen by
        the travel.
    lengths : bool
        Whether the table holds whole lengths of legs in place of readings.
    encoder_sigma : float, str or mapping, optional
        One standard deviation of a reading [m], as text with its unit, or by joint [m or rad]; by
        default the last digit of the table, and half a degree for pulses of servos.
    board : str, Path or Board, optional
        The calibration board on the base, as for :func:`legcal.calibrate_camera`.
    hand_held : bool
        Whether the camera was in the hand: each photograph has a camera pose of its own.
    """

    cameras: str | Sequence[str] = ()
    unit: str | None = None
    lengths: bool = False
    encoder_sigma: float | str | Mapping[str, float] | None = None
    board: str | Path | Board | None = None
    hand_held: bool = False


def init(
    folder: str | Path,
    readings: str | Path,
    model: str | Path,
    output: str | Path,
    *,
    options: SheetOptions = SheetOptions(),
    force: bool = False,
) -> Dataset:
    """Make a dataset from a folder of photographs and a table of readings, and load it.

    Parameters
    ----------
    folder : path
        The photographs: in it, or in one folder for each view. It is not changed.
    readings : path
        A CSV with a column for each actuated leg, and a heading.
    model : path or str
        The nominal model, as for :func:`legcal.load_mechanism`.
    output : path
        The folder of the dataset.
    options : SheetOptions
        Cameras, unit and noise.
    force : bool
        Whether files that exist already are replaced.

    Raises
    ------
    DatasetError, ModelError, UsageError
        With one sentence for each problem.
    OutOfResources
        If the folder cannot be written.
    """
    write_new_dataset(plan_new_dataset(folder, readings, model, output, options), force=force)
    return load_dataset(output)


def plan_new_dataset(
    folder: str | Path,
    readings: str | Path,
    model: str | Path,
    destination: str | Path,
    options: SheetOptions = SheetOptions(),
) -> NewDataset:
    """Return a dataset of photographs and readings, checked and not written; see :func:`init`."""
    folder, path, destination = Path(folder), Path(readings), Path(destination)
    machine = load_mechanism(model)
    check_path(destination, DATASET_FOLDER)
    if destination.resolve().is_relative_to(folder.resolve()):
        raise UsageError(
            f"{destination}: the dataset could not be written: found a place in the folder of the "
            "photographs, which is not changed, needed one beside it; give another folder with -o."
        )
    photographs = find_photographs(folder)
    by_names, pattern = with_likely_views(photographs)
    sheet = ReadingsSheet(path, machine, "photograph", may_be_unknown=True)
    table = sheet.table
    named = {view.casefold() for view in table.text("view") if view}
    if named <= {photograph.folder.casefold() for photograph in by_names}:
        photographs = by_names
    else:
        pattern = None  # the table names other views
    sheet_readings = sheet.readings(options.unit, lengths=options.lengths)
    pairs, matched, matching_notes = match(table, photographs)
    matches = [photograph for _, photograph in pairs]
    cameras, made = _cameras(folder, destination, matches, listed(options.cameras))
    stated = options.encoder_sigma
    if isinstance(stated, Mapping):
        stated = {joint: x for joint, x in stated.items() if joint not in sheet.unknown}
    least = float(f"{MIN_SIGMA * machine.size:.3g}")
    sigma, sigma_notes = _sigmas(stated, sheet.motors, sheet_readings, least)
    unknown = [
        f"The readings of {few(sheet.unknown)} are not known (empty cells): these legs count as "
        "passive. Where the others do not determine the pose, click joints with legcal detect "
        "DATASET -o OUT --edit: at the base in a picture of each view, at the platform in all."
    ]
    is_shipped = str(model) in shipped_names() and not os.path.isfile(model)
    relative_path = os.path.relpath(machine.yaml_path.resolve(), destination.resolve())
    stated_options = {"--encoder-sigma": options.encoder_sigma, "--unit": options.unit}
    unused = [name for name, value in stated_options.items() if value]
    unused_note = f"{' and '.join(unused)} had no effect: the table has no reading."
    return NewDataset(
        machine=machine,
        model=str(model) if is_shipped else Path(relative_path).as_posix(),
        destination=destination,
        sheet=sheet,
        readings=sheet_readings,
        pairs=pairs,
        matched=matched,
        cameras=cameras,
        encoder_sigma=sigma,
        notes=(
            *sheet.notes,
            *(unknown if sheet.unknown else []),
            *([] if sheet.motors or not unused else [unused_note]),
            *sheet_readings.notes,
            *matching_notes,
            *sigma_notes,
            *_made_notes(cameras, made),
            *([] if named or options.hand_held else _view_notes(pattern, matches)),
        ),
        made_cameras={path: text for path, (_, text) in made.items()},
        board=None if options.board is None else board_beside_machine(options.board),
        hand_held=options.hand_held,
    )


def _made_notes(
    cameras: Mapping[str, Path], made: Mapping[Path, tuple[Camera, str]]
) -> Iterator[str]:
    """Yield notes on cameras with nothing but a focal length from photographs."""
    for path, (camera, _) in made.items():
        assert camera.covariance is not None
        sigma = float(camera.covariance[0, 0] ** 0.5 / camera.K[0, 0])
        why = ""
        if sigma > _WIDENED * FOCAL_SIGMA:
            why = " (a digital zoom, another format than 4:3 or 3:2 or a long lens leave it open)"
        views = [view for view, camera_path in cameras.items() if camera_path == path]
        yield (
            f"The camera of {few_views(views)} is only known by the focal length in the EXIF data "
            f"of its photographs, {camera.K[0, 0]:.0f} px, taken as good to "
            f"{100 * sigma:.2g} %{why}: calibrate estimates it with the machine; calibrate the "
            "camera with legcal camera for a result that does not depend on it."
        )


def _view_notes(pattern: str | None, photographs: Sequence[Photograph]) -> Iterator[str]:
    """Yield a note on the views where no column names them, and on alternatives."""
    views = list(dict.fromkeys(photograph.view for photograph in photographs))
    if pattern is not None:
        yield (
            f"Views {few(views)} are taken from the names of the "
            f"photographs, '{pattern}': if that is not where the camera stood, add a column view, "
            "or put the photographs of each place in a folder."
        )
    elif views == [ONE_VIEW]:
        likely = likely_pattern(photographs)
        looks = f" as the names of the files look ('{likely}')," if likely else ""
        yield (
            f"All photographs are one view, {ONE_VIEW}: if the camera stood in several places,"
            f"{looks} put those of each place in a folder, or add a column view; if it was in the "
            "hand, give --hand-held and the --board on the base."
        )


def write_new_dataset(new: NewDataset, *, force: bool = False) -> list[Path]:
    """Write a dataset, complete or not at all; return its files, photographs excepted."""
    cameras = list(dict.fromkeys(new.cameras.values()))
    names = {camera: f"camera_info{f'_{k + 1}' * bool(k)}.yaml" for k, camera in enumerate(cameras)}
    names |= {camera: camera.name for camera in new.made_cameras}
    dataset_files = [DATASET_YAML, MEASUREMENTS, *names.values()]
    linked = {
        new.place(photograph): photograph.path.resolve()
        for _, photograph in new.pairs
        if not photograph.path.resolve().is_relative_to(new.destination.resolve())
    }
    contents = {
        names[camera]: new.made_cameras[camera].encode()
        if camera in new.made_cameras
        else camera.read_bytes()
        for camera in cameras
    }
    joints, table = new.machine.motor_names, new.sheet.table
    columns = ["view", "image", *(["pose"] if "pose" in table else [])]
    poses = [[pose] if "pose" in table else [] for pose in table.text("pose")]
    rows = [
        [photograph.view, new.place(photograph), *poses[k], *map(new.readings_of(k).get, joints)]
        for k, photograph in new.pairs
    ]
    held = {"hand_held": True} if new.hand_held else {}
    views = {view: {"camera": names[camera], **held} for view, camera in new.cameras.items()}
    board = {} if new.board is None else {"board": board_document(new.board)}
    texts = dataset_texts(new.machine, new.model, views, rows, new.encoder_sigma, board, columns)
    contents |= {name: text.encode() for name, text in texts.items()}
    names_to_write = [*dataset_files, *linked]
    with new_files(new.destination, "dataset", names_to_write, force=force) as folder:
        for name, content in contents.items():
            (folder / name).write_bytes(content)
        for name, path in linked.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(path, folder / name)
            except OSError:  # no links there
                shutil.copy2(path, folder / name)
    return [new.destination / name for name in dataset_files]


def _sigmas(
    stated: float | str | Mapping[str, float] | None,
    motors: Sequence[Leg],
    readings: SheetReadings,
    least: float,  # minimum default [m]
) -> tuple[float | dict[str, float], list[str]]:
    """Return the standard deviation of readings [m], by joint [m or rad] where a motor turns."""
    if not motors:
        return least, []
    units = dict(zip((str(leg.prismatic) for leg in motors), readings.units, strict=True))
    sigmas = {
        name: max(digit, usual_sigma(leg, least, units[name]))
        for name, leg, digit in zip(units, motors, readings.digits.tolist(), strict=True)
    }
    sigmas |= {} if stated is None else sigmas_of(stated, motors, units)
    slides = not any(leg.reads_angle for leg in motors)
    smallest = min(sigmas.values())
    notes = []
    if stated is None:
        shown = f"{1e6 * smallest:.3g} um" if smallest < 1e-3 else f"{1e3 * smallest:.3g} mm"
        if not slides:
            units_of = [SHOWN_IN[leg.reading_unit] for leg in motors]
            texts = [
                f"{scale * sigma:.2g} {unit}"
                for (scale, unit), sigma in zip(units_of, sigmas.values(), strict=True)
            ]
            each = [f"{name} {text}" for name, text in zip(sigmas, texts, strict=True)]
            shown = texts[0] if len(set(texts)) == 1 else few(each)
        why = "the last digit of the table, at least that of a good encoder"
        if any(map(are_commands, motors, readings.units)):
            why = "half a degree of what a hobby servo makes of its command"
        notes.append(
            f"encoder_sigma is {shown}, {why}: give --encoder-sigma if readings are known better "
            "or worse."
        )
    return smallest if slides and not isinstance(stated, Mapping) else sigmas, notes


def _cameras(
    folder: Path,
    destination: Path,
    photographs: Sequence[Photograph],
    options: Sequence[str],
) -> tuple[dict[str, Path], dict[Path, tuple[Camera, str]]]:
    """Return the camera file of each view, and the cameras to make with contents of their files.

    It is an option, else a file beside the photographs or above them, else a camera made from the
    focal length in the metadata of the photographs. Photographs of another size are refused.
    """
    views = list(dict.fromkeys(photograph.view for photograph in photographs))
    bad = sorted(view for view in views if not is_name(view))
    if bad:
        raise DatasetError(
            f"{folder}: the view {describe(bad[0])} could not be used: found a name that tables "
            f"cannot show, needed {NAME_NEEDED}; rename it."
        )
    stated, problems = dict[str, str](), list[str]()  # camera files by view, "" for all
    for name, file in map(split_camera, options):
        if name and name not in views:
            problems.append(
                f"--camera {name}={file} could not be used: found no view of that name, needed one "
                f"of {few(views)}; correct it."
            )
        elif stated.setdefault(name, file) != file:
            whose = f"{name}=" * bool(name)
            problems.append(
                f"The camera files could not be used: found --camera {whose}{stated[name]} and "
                f"--camera {whose}{file}, needed one for all views, or VIEW=FILE for each; leave "
                "the other out."
            )
    path_of_view, made = dict[str, Path](), dict[Path, tuple[Camera, str]]()
    for view in views:
        images = [photograph.path for photograph in photographs if photograph.view == view]
        near = (images[0].parent, folder, folder.parent)
        files = [path / name for path in near for name in _CAMERA_NAMES]
        text = stated.get(view, stated.get("", ""))
        if text or any(path.is_file() for path in files):
            path_of_view[view] = Path(text or next(path for path in files if path.is_file()))
        elif camera := _camera_by_exif(images):
            content = rough_camera_info(camera, "exif")
            path = next((path for path, (_, other) in made.items() if other == content), None)
            if path is None:
                path = destination / f"camera_exif{f'_{len(made) + 1}' * bool(made)}.yaml"
                made[path] = camera, content
            path_of_view[view] = path
    missing = [view for view in views if view not in path_of_view]
    if missing:
        problems.append(
            f"{folder}: the camera of view{'s' * (len(missing) > 1)} {few(missing)} could not be "
            f"found: found no --camera, no {_CAMERA_NAMES[0]} beside the photographs and not one "
            "focal length in their EXIF data, needed "
            "the file of its calibration; make it with: legcal camera BOARDS --board "
            "chessboard:9x6:25mm -o camera_info.yaml, and give --camera camera_info.yaml."
        )
    if problems:
        raise DatasetError(problems)
    read = {
        path: made[path][0] if path in made else read_camera(path)
        for path in dict.fromkeys(path_of_view.values())
    }
    unusable = [
        problem
        for photograph in photographs
        if (problem := inspect_image(photograph.path, read[path_of_view[photograph.view]])[1])
    ]
    if unusable:
        raise DatasetError(unusable)
    return path_of_view, made


def split_camera(option: str) -> tuple[str, str]:
    """Return the view of ``VIEW=FILE``, "" for a file of all views, and the file."""
    view, _, file = option.partition("=")
    return (view, file) if file and not os.path.isfile(option) else ("", option)


def _camera_by_exif(paths: Sequence[Path]) -> Camera | None:
    """Return the camera from the metadata of photographs; None if these are insufficient."""
    contents = [read_bytes(path, MAX_IMAGE) for path in paths]
    try:
        size = image_size(contents[0])
    except BadImage:
        return None
    return camera_of_photographs(
        [read_facts(content) for content in contents], size.width, size.height
    )


def copy_example(destination: Path) -> None:
    """Copy the example (a simulated hexapod, 45 photographs), complete or not at all."""
    check_destination(destination, _EXAMPLE_KIND, replaces=False)
    source = shipped_folder(_EXAMPLE)
    if not (source / DATASET_YAML).is_file():
        raise OutOfResources(
            f"{source}: the example could not be read: found no {DATASET_YAML}, needed the files "
            "that come with legcal; install it again."
        )
    with result_folder(destination, _EXAMPLE_KIND) as folder:
        for name in _EXAMPLE_FILES:
            if (source / name).is_dir():
                shutil.copytree(source / name, folder / name)
            else:
                shutil.copyfile(source / name, folder / name)
