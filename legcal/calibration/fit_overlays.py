"""Overlays of a calibration: its photographs with the fitted outlines, in the result folder.

They are drawn like the overlays of a detection, with the machine and the cameras of the fit.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.calibration.detection import OVERLAYS, Detection
from legcal.calibration.detection_folder import draw_images, is_overlay
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.result import Calibration
from legcal.data.dataset import Dataset
from legcal.errors import UsageError
from legcal.files.folder import RESULT, in_the_way, path_problem
from legcal.files.reading import read_json
from legcal.geometry.motions import components
from legcal.machine.leg import with_radii
from legcal.machine.rods import ends_in_base, measured_readings
from legcal.perception.placement import placed_arms
from legcal.progress import Report
from legcal.workers import Run


def with_overlays(calibration: Calibration) -> Calibration:
    """Return the calibration with the files of its overlays, by row; nothing is drawn."""
    files = _as_detection(calibration.dataset, calibration.solution).overlay_files
    return replace(calibration, overlays=files)


def draw_overlays(calibration: Calibration, folder: Path, run: Run, progress: Report) -> None:
    """Draw the overlays of a calibration into a folder.

    Raises DatasetError if a photograph cannot be read, and OutOfResources if one cannot be drawn.
    """
    detection = _as_detection(calibration.dataset, calibration.solution)
    rows = np.array(list(calibration.overlays), dtype=np.intp)
    draw_images(replace(detection, rows=rows, corners=calibration.corners), folder, run, progress)


def check_overlays(dataset: Dataset, destination: Path | None) -> None:
    """Refuse overlays without photographs, or over files of another program, before any work."""
    start = f"{dataset.table_path}: the overlays could not be drawn: found"
    if destination is None:
        raise UsageError(f"{start} no output folder, needed one to write them into; give one.")
    rows = _rows_with_image(dataset)
    if not rows:
        raise UsageError(
            f"{start} no photograph, needed those of the outlines; leave the overlays out."
        )
    earlier = set(earlier_overlays(destination))
    if os.path.lexists(destination / OVERLAYS) and not earlier:
        raise UsageError(in_the_way(destination, RESULT, f"{OVERLAYS}, which legcal did not write"))


def earlier_overlays(destination: Path) -> list[Path]:
    """Return the overlays of an earlier result in a folder, relative to it."""
    if not RESULT.is_in(destination):
        return []
    listed = read_json(destination / RESULT.marker).get("overlays")
    names = [overlay.get("file") for overlay in listed or () if isinstance(overlay, Mapping)]
    return [
        Path(name)
        for name in names
        if isinstance(name, str)
        and path_problem(destination, name) is None
        and is_overlay(Path(name))
    ]


def _rows_with_image(dataset: Dataset) -> list[int]:
    paths = [dataset.image_path(row) for row in range(dataset.measurements.n_rows)]
    return [row for row, path in enumerate(paths) if path is not None and os.path.exists(path)]


def _as_detection(dataset: Dataset, solution: Solution) -> Detection:
    """Return the outlines, legs and cameras of a fit as a detection."""
    machine, measurements = dataset.machine, dataset.measurements
    poses = components(solution.T_Rb_Re)
    q = measured_readings(solution.legs, *poses, measurements.q_of_poses)
    A, B = ends_in_base(solution.legs, machine.T_base_Rb, *poses, q)
    cylinders = with_radii(
        [leg.cylinders for leg in machine.legs],
        lambda j, c: solution.radii.get((j, c.link), c.radius),
    )
    return Detection(
        dataset=dataset,
        outlines=solution.outlines,
        A_base=A[measurements.pose],
        B_base=B[measurements.pose],
        cylinders=cylinders,
        T_base_camera=solution.cameras_in_base(machine.T_base_Rb),
        rows=np.array(_rows_with_image(dataset), dtype=np.intp),
        unplaced={},
        image_notes=(),
        leg_notes=(),
        arms=placed_arms(
            solution.legs,
            q,
            measurements.pose,
            T_base=machine.T_base_Rb,
            radii=solution.radii,
        ),
    )
