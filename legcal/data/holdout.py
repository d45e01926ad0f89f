"""Held-out images: a fit without them must predict their outlines.

Whole poses are held out, since images of one pose share its unknowns. They are drawn at random, in
an order that does not depend on the files, and so that every leg in every view loses no more than
its share.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.data.dataset import Dataset
from legcal.data.image_tables import canonical_order, measurements_at
from legcal.errors import NotIdentifiable, UsageError
from legcal.geometry.types import BoolArray, IntArray

_SEED = 20020721


def split_images(dataset: Dataset, fraction: float) -> tuple[IntArray, IntArray]:
    """Return the rows of the images to fit and of the held-out images, each ascending."""
    if not 0.0 < fraction < 1.0:
        raise UsageError(
            f"The images to keep aside could not be chosen: found the fraction {fraction:g}, "
            "needed a number between 0 and 1 (0.2 keeps a fifth aside); correct it."
        )
    measurements = dataset.measurements
    shown = _shown(dataset)
    wanted = max(1, round(fraction * measurements.n_rows))
    most = np.minimum(np.ceil(fraction * shown.sum(axis=0)), shown.sum(axis=0) - 1)
    held_out = np.zeros(measurements.n_rows, dtype=np.bool_)
    for pose in _shuffled_poses(dataset):
        tried = held_out | (measurements.pose == pose)
        fits = np.all(shown[tried].sum(axis=0) <= np.maximum(most, 0.0))
        if fits and tried.sum() <= wanted:
            held_out = tried
    if not held_out.any():
        raise NotIdentifiable(
            f"{dataset.folder}: no images could be kept aside: found "
            f"{measurements.n_rows} image{'s' * (measurements.n_rows != 1)} of "
            f"{measurements.n_poses} pose{'s' * (measurements.n_poses != 1)}, needed so many that "
            f"a whole pose is {100 * fraction:g} % of them and every leg stays in every view that "
            "shows it; take more images or leave out --holdout."
        )
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def dataset_at(dataset: Dataset, rows: IntArray) -> Dataset:
    """Return a dataset with some of its images only."""
    observations, axes, corners = dataset.observations, dataset.axes, dataset.corners
    return replace(
        dataset,
        measurements=measurements_at(dataset.measurements, rows),
        observations=None if observations is None else observations.at(rows),
        axes=None if axes is None else axes.at(rows),
        corners=None if corners is None else corners.at(rows),
        landmarks=None if dataset.landmarks is None else dataset.landmarks.at(rows),
    )


def _shuffled_poses(dataset: Dataset) -> IntArray:
    """Return all poses in a random order that does not depend on the order of the rows."""
    measurements = dataset.measurements
    rows = canonical_order(measurements, dataset.machine.leg_names).rows
    poses = np.array(list(dict.fromkeys(measurements.pose[rows].tolist())), dtype=np.intp)
    return np.random.default_rng(_SEED).permutation(poses)


def _shown(dataset: Dataset) -> BoolArray:
    """Return a mask of the legs by view that each row shows or may show, (n_rows, views * legs)."""
    measurements, names = dataset.measurements, dataset.machine.leg_names
    shown = np.zeros((measurements.n_rows, len(measurements.views), len(names)), dtype=np.bool_)
    has_observations = np.zeros(measurements.n_rows, dtype=np.bool_)
    for table, used in _tables(dataset):
        row, leg = table[used].T
        shown[row, measurements.view[row], leg] = True
        has_observations[row] = True
    for row in np.flatnonzero(~has_observations).tolist():
        view = int(measurements.view[row])
        shown[row, view] = [measurements.views[view].uses(name) for name in names]
    return shown.reshape(measurements.n_rows, -1)


def _tables(dataset: Dataset) -> list[tuple[IntArray, BoolArray]]:
    """Return for each table the image row and leg (n, 2) of its entries, and the mask of use."""
    tables = []
    if dataset.axes is not None:
        axes = dataset.axes
        tables.append((np.column_stack([axes.row, axes.leg]), np.ones(len(axes), dtype=np.bool_)))
    if dataset.observations is not None:
        outlines = dataset.observations
        tables.append((np.column_stack([outlines.row, outlines.leg]), outlines.used))
    return tables
