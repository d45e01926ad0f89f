"""What is recorded of a simulated machine: readings, hints, and the tables of its level."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from legcal.dataset.folder import OBSERVATIONS_NAME
from legcal.dataset.given_axes import AXES_NAME
from legcal.dataset.given_corners import CORNERS_NAME
from legcal.observations.axes_file import write_axis_table
from legcal.observations.corners_file import write_corners
from legcal.observations.measurements import Measurements, View
from legcal.observations.table import write_observations
from legcal.simulation.corner_tables import corners_of_images
from legcal.simulation.dataset_files import image_names, measurements_of
from legcal.simulation.folder import TRUTH
from legcal.simulation.hints import rough_pose
from legcal.simulation.imaged_machine import ImagedMachine
from legcal.simulation.parameter_errors import Distribution
from legcal.simulation.settings import Level, SimulationSettings
from legcal.simulation.tables import axes_of_images, outlines_of_images

_OFTEN = 0.5  # of the photographs of a view that show a leg which its hint names


def recorded(
    imaged: ImagedMachine, settings: SimulationSettings, chance: Mapping[str, np.random.Generator]
) -> Measurements:
    """Return the rows of the dataset: readings with their errors, and what is told of cameras.

    Parameters
    ----------
    imaged : ImagedMachine
        The machine and its images.
    settings : SimulationSettings
        What to simulate.
    chance : mapping of str to numpy.random.Generator
        Sources of ``readings`` and ``hints``.
    """
    legs, images = imaged.truth.leg_names, imaged.images
    # Tables say themselves what is seen; in photographs nobody looks for a leg that often hides.
    least = _OFTEN if settings.level is Level.PHOTOGRAPHS else 0.0
    views = []
    for v, view in enumerate(imaged.views):
        T = rough_pose(view.T_base_camera, chance["hints"])
        shown = tuple(legs[j] for j in images.seen_in_view(v, least))
        hint = shown if 0 < len(shown) < len(legs) else None
        hints = (T, hint) if settings.hints and not imaged.groups else (None, None)
        views.append(View(view.name, view.camera, *hints))
    q, size = imaged.poses.readings, settings.readings.size
    if settings.readings.distribution is Distribution.UNIFORM:
        q = q + chance["readings"].uniform(-size, size, q.shape)
    else:
        q = q + size * chance["readings"].normal(size=q.shape)
    names = [""] * len(images)
    if settings.level is Level.PHOTOGRAPHS:
        names = image_names(images, imaged.views, imaged.labels)
    return measurements_of(images, views, imaged.labels, names, q, settings.encoder_sigma)


def write_tables(
    folder: Path,
    imaged: ImagedMachine,
    m: Measurements,
    settings: SimulationSettings,
    chance: Mapping[str, np.random.Generator],
) -> None:
    """Write the tables that the level asks for, and exact outlines and corners beside the truth.

    Parameters
    ----------
    folder : Path
        The dataset.
    imaged, settings
        As in :func:`recorded`.
    m : Measurements
        The rows.
    chance : mapping of str to numpy.random.Generator
        Sources of ``observations`` and ``corners``.
    """
    images, machines, views = imaged.images, imaged.machines, imaged.views
    legs = imaged.truth.leg_names
    if imaged.board is not None:
        placed, sigma_px = imaged.board, settings.sigma_px
        exact_corners = corners_of_images(images, machines, views, placed, 0.0, None)
        write_corners(folder / TRUTH / CORNERS_NAME, exact_corners, m)
        if settings.level is not Level.PHOTOGRAPHS:
            corners = corners_of_images(
                images, machines, views, placed, sigma_px, chance["corners"]
            )
            write_corners(folder / CORNERS_NAME, corners, m)
    exact = outlines_of_images(images, machines, views, 0.0, None)
    write_observations(folder / TRUTH / "outlines.csv", exact, m, legs)
    if settings.level is Level.OUTLINES:
        noisy = outlines_of_images(
            images, machines, views, settings.sigma_px, chance["observations"]
        )
        write_observations(folder / OBSERVATIONS_NAME, noisy, m, legs)
    elif settings.level is Level.AXES:
        axes = axes_of_images(images, machines, views, settings.table, chance["observations"])
        write_axis_table(folder / AXES_NAME, axes.row, axes.leg, axes.values, axes.sigmas, m, legs)
