"""``legcal.simulate``: a true machine, its session in memory, and the folder of both."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from legcal.brief import brief
from legcal.data.corners import write_corners
from legcal.data.dataset import CORNERS_NAME, OBSERVATIONS_NAME, PLAN_NAME
from legcal.data.dataset_file import dataset_texts
from legcal.data.measurements import Measurements
from legcal.data.outlines import join_outlines, write_observations
from legcal.data.reading_units import sigma_too_large, stated_sigma
from legcal.errors import UsageError
from legcal.files.folder import (
    OutputKind,
    check_destination,
    output_path,
    result_folder,
)
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.schema import MAX_DOCUMENT, Document, describe, read_bytes
from legcal.geometry.types import Array
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.model_writer import write_model
from legcal.planning.session import rough_view
from legcal.progress import Progress, shown_progress
from legcal.simulation.board import documents
from legcal.simulation.observe import (
    EVERY_PIXEL,
    corners_in_images,
    edges_of_bodies,
    outlines_of,
)
from legcal.simulation.session import (
    SimulatedSession,
    are_extreme,
    photographs,
    simulate_session,
    streams,
)
from legcal.simulation.settings import Level, SimulationSettings, joint_distance
from legcal.simulation.truth import write_true_model
from legcal.version import __version__
from legcal.vision.camera_file import camera_info
from legcal.workers import Workers, is_number


@brief
@dataclass(frozen=True, eq=False)
class SimulatedDataset:
    """A dataset that was written.

    Attributes
    ----------
    folder : Path
        The dataset.
    level : Level
        Its kind of observations.
    nominal, truth : Machine
        The model of the dataset, and the machine that was measured.
    truth_path : Path
        The YAML of the true model.
    measurements : Measurements
        The rows.
    seen : (n_rows, n_legs) array of bool
        Mask of the legs that each image shows.
    left_out : int
        Images without a leg, for which a dataset of outlines has no row.
    n_extreme : int
        Poses with every motor near an end of its travel.
    """

    folder: Path
    level: Level
    nominal: Machine
    truth: Machine
    truth_path: Path
    measurements: Measurements
    seen: Array
    left_out: int
    n_extreme: int
    to_measure: str  # the distance that would fix the scale, where nothing in the dataset does


def simulate(
    model: str | Path | Machine,
    output: str | Path,
    settings: SimulationSettings | None = None,
    *,
    workers: Workers = 1,
    progress: Progress = False,
) -> SimulatedDataset:
    """Write a dataset of a machine that differs from its nominal model by drawn errors.

    The same settings give the same files, to the last bit, on one computer. Draws for one purpose
    do not depend on the others: two levels with one seed show the same machine in the same poses.

    Parameters
    ----------
    model : str, Path or Machine
        The nominal model, as for :func:`legcal.load_mechanism`.
    output : path
        The folder of the dataset.
    settings : SimulationSettings, optional
        The machine's errors, poses, cameras and noise.
    workers : int, str or executor
        Workers that render photographs, as for :func:`legcal.calibrate`.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.

    Returns
    -------
    SimulatedDataset

    Raises
    ------
    UsageError
        If the output holds anything, or a camera is inside the machine.
    ModelError, DatasetError, OutOfClass
        If a file is malformed or not covered.
    DidNotConverge
        If the machine does not reach such poses.
    NotVisible
        If a view shows no leg. Nothing is written in any of these cases.
    """
    settings = settings or SimulationSettings()
    destination = output_path(output, SIMULATED)
    if is_number(workers) and workers < 1:
        raise UsageError(
            f"The dataset could not be simulated: found {workers} workers, needed 1 or more; "
            "correct it."
        )
    check_destination(destination, SIMULATED, replaces=False)
    nominal = model if isinstance(model, Machine) else load_mechanism(model)
    for leg in (nominal.legs[j] for j in nominal.motors):
        if too_large := sigma_too_large(settings.reading_errors(leg).sigma, leg):
            raise UsageError(
                "The readings could not be simulated: found a standard deviation of "
                f"{too_large[0]}, needed {too_large[1]}; give errors with the unit that is meant."
            )
    rngs = streams(settings.seed)
    with shown_progress(progress) as report, result_folder(destination, SIMULATED) as folder:
        yaml_path, _ = write_model(nominal, folder)
        truth = write_true_model(nominal, settings.errors, rngs["errors"], folder / TRUTH)
        session = simulate_session(truth, nominal, settings, rngs, report)
        m, legs = session.measurements, truth.leg_names
        board = documents(session.boards, poses=settings.board_pose)
        model_name = yaml_path.relative_to(folder).as_posix()
        measured = _measured(truth, settings.lengths, rngs["lengths"])
        write_session(
            folder, nominal, model_name, m, groups=session.groups, board=board, lengths=measured
        )
        exact = outlines_of(session.scene, replace(EVERY_PIXEL, sigma_px=0.0))
        write_observations(folder / TRUTH / "outlines.csv", exact, m, legs)
        has_tables = settings.level == Level.OUTLINES
        if has_tables:
            noise = replace(EVERY_PIXEL, sigma_px=settings.sigma_px)
            outlines = outlines_of(session.scene, noise, rngs["observations"])
            edges = edges_of_bodies(session.scene, truth.occluders, noise, rngs["observations"])
            outlines = join_outlines([outlines, edges])
            write_observations(folder / OBSERVATIONS_NAME, outlines, m, legs)
        if session.boards:
            of_boards = session.scene, session.posed_machines
            write_corners(folder / TRUTH / CORNERS_NAME, corners_in_images(*of_boards, 0.0), m)
            if has_tables:
                corners = corners_in_images(*of_boards, settings.sigma_px, rngs["corners"])
                write_corners(folder / CORNERS_NAME, corners, m)
        if not has_tables:
            names = session.measurements.image
            (folder / "images").mkdir()
            report("Photographs", 0, len(names))
            rendered = photographs(session, settings.appearance, rngs["photographs"], workers)
            with closing(rendered):
                for done, (row, png) in enumerate(rendered, 1):
                    (folder / names[row]).write_bytes(png)
                    report("Photographs", done, len(names))
        if settings.plan is not None:
            plan = read_bytes(Path(settings.plan) / PLAN_NAME, MAX_DOCUMENT)
            (folder / PLAN_NAME).write_bytes(plan)
        write_truth(folder / TRUTH_NAME, session, settings)
    shown = session.scene.images.shown
    readings = session.poses.readings[np.unique(session.scene.images.pose)]
    rod = truth.rod_for_scale(has_length=bool(measured or session.boards))
    return SimulatedDataset(
        folder=destination,
        level=Level(settings.level),
        nominal=nominal,
        truth=truth,
        truth_path=destination / TRUTH / "models" / truth.yaml_path.name,
        measurements=m,
        seen=np.concatenate([view.visible_legs(1, truth.n_legs) for view in shown]),
        left_out=session.left_out,
        n_extreme=int(np.sum(are_extreme(truth, readings))),
        to_measure="" if rod is None else rod[1],
    )


def _measured(
    truth: Machine, lengths: Mapping[str, float], rng: np.random.Generator
) -> dict[str, str]:
    """Return measured distances of joints with errors, in the form of ``dataset.yaml``."""
    lengths_in_words = {}
    for name, sigma in lengths.items():
        true = joint_distance(truth, name)
        if true is None:
            raise UsageError(
                f"The length {describe(name)} could not be measured: found no two joints of the "
                "base, of the platform or of one rod, needed them; name others."
            )
        lengths_in_words[name] = f"{1e3 * (true + sigma * rng.normal()):.6f}+-{1e3 * sigma:g}mm"
    return lengths_in_words


class ViewSummary(Document):
    """A view of the dataset."""

    images: int
    legs: dict[str, int]  # number of images that show each leg


class SimulationDocument(Document):
    """The document of ``legcal simulate --json``."""

    dataset: str
    level: str
    mechanism: str
    truth: str  # the true model
    images: int
    poses: int
    extreme_poses: int  # poses with every motor near an end of its travel
    left_out: int
    views: dict[str, ViewSummary]


def summary_document(made: SimulatedDataset) -> dict[str, Any]:
    """Return the document of ``legcal simulate --json``."""
    views: dict[str, ViewSummary] = {}
    for v, view in enumerate(made.measurements.views):
        rows = made.measurements.view == v
        seen = made.seen[rows].sum(axis=0).tolist()
        legs = dict(zip(made.nominal.leg_names, seen, strict=True))
        views[view.name] = ViewSummary(images=int(np.sum(rows)), legs=legs)
    return SimulationDocument(
        dataset=str(made.folder),
        level=made.level.value,
        mechanism=made.nominal.name,
        truth=str(made.truth_path),
        images=made.measurements.n_rows,
        poses=made.measurements.n_poses,
        extreme_poses=made.n_extreme,
        left_out=made.left_out,
        views=views,
    ).document()


# The folder


TRUTH = "truth"
TRUTH_NAME = f"{TRUTH}/truth.json"
SIMULATED = OutputKind("dataset", TRUTH_NAME, "legcal_truth")


def write_session(
    folder: Path,
    machine: Machine,  # the nominal model
    model: str,  # path of its YAML in the dataset
    m: Measurements,
    *,
    groups: Sequence[str] = (),  # view of the file of each view, where cameras are in the hand
    board: Any = None,  # the block of a board, or of several
    lengths: Mapping[str, str] | None = None,  # measured distances of joints
) -> None:
    """Write ``dataset.yaml``, ``measurements.csv`` and the camera files."""
    cameras: dict[int, str] = {}
    views: dict[str, Any] = {}
    for v, view in enumerate(m.views):
        if id(view.camera) not in cameras:
            name = f"camera_info{f'_{view.name}' * bool(cameras)}.yaml"
            (folder / name).write_text(camera_info(view.camera, view.name), encoding="utf-8")
            cameras[id(view.camera)] = name
        entry: dict[str, Any] = {"camera": cameras[id(view.camera)]}
        if groups:
            entry["hand_held"] = True
        if view.camera.gamma_is_given:
            entry["gamma"] = view.camera.gamma
        entry |= rough_view(view.T_base_camera, view.legs, machine)
        views[groups[v] if groups else view.name] = entry
    names, readings = list(groups) or list(m.view_names), m.q[:, list(machine.motors)]
    times = () if m.time is None else m.time.tolist()
    rows = (
        [
            names[v],
            m.image[row],
            m.pose_labels[m.pose[row]],
            *times[row : row + 1],
            *readings[row].tolist(),
        ]
        for row, v in enumerate(m.view.tolist())
    )
    columns = ["view", "image", "pose", *(["time"] if times else [])]
    blocks = {} if board is None else {"board": board}
    if lengths:
        blocks["parameters"] = {"lengths": dict(lengths)}
    sigma = stated_sigma(machine.legs, m.sigma_q)
    for name, text in dataset_texts(machine, model, views, rows, sigma, blocks, columns).items():
        (folder / name).write_text(text, encoding="utf-8")


def write_truth(
    path: Path,
    session: SimulatedSession,
    settings: SimulationSettings,
) -> None:
    """Write ``truth.json``: settings, radii, cameras, poses and board as they really were."""
    truth, poses = session.truth, session.poses
    sliders = [(j, str(leg.prismatic)) for j, leg in enumerate(truth.legs) if leg.has_value]
    document = {
        "legcal_truth": 1,
        "legcal": __version__,
        "model": f"models/{truth.yaml_path.name}",
        "settings": _plain(asdict(replace(settings, views=settings.n_views))),
        "radii": {leg.name: leg.radius_of_part for leg in truth.legs},
        "views": {
            view.name: {"T_base_camera": motion_to_xyz_quat(view.T_base_camera)}
            for view in session.scene.views
        },
        "poses": {
            label: {
                "T_base_platform": motion_to_xyz_quat(T),
                "joints": {name: float(readings[j]) for j, name in sliders},
            }
            for label, T, readings in zip(session.labels, poses.poses, poses.readings, strict=True)
        },
        **({"board": documents(session.boards, poses=True)} if session.boards else {}),
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """Convert settings to values of JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(x) for key, x in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Real) and not isinstance(value, bool):
        number = int(value) if isinstance(value, Integral) else float(value)
        return number if math.isfinite(number) else str(number)
    return value
