"""Simulated photographs against the truth beside them, by edge measurements of their own."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from simulated import settings
from thinned import thinned

from legcal.data.dataset import Dataset, load_dataset
from legcal.data.outlines import Outlines, read_observations
from legcal.geometry.types import Array
from legcal.simulation.dataset import simulate
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.request import Level
from legcal.vision.camera import Camera
from legcal.vision.camera_file import camera_info

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))
REACH, STEP = 4.0, 0.25  # of profiles across an outline [px]
FREE = 0.12  # of an outline, left out at both ends


def lens(folder: Path, width: int, height: int) -> Path:
    """Write the file of a camera that distorts like a cheap lens."""
    K = np.array([[1.25 * width, 0.0, 0.51 * width], [0.0, 1.26 * width, 0.48 * height], [0, 0, 1]])
    path = folder / "lens.yaml"
    path.write_text(camera_info(Camera(K, width, height, np.array([-0.2, 0.05, 0, 0, 0])), "lens"))
    return path


def photographs(name: str, folder: Path, size: tuple[int, int], looks: Appearance) -> Dataset:
    few = settings(
        level=Level.PHOTOGRAPHS, poses=1, views=1, camera=lens(folder, *size), appearance=looks
    )
    return load_dataset(simulate(name, folder / "set", few).folder)


def picture(dataset: Dataset) -> Array:
    path = dataset.image_path(0)
    assert path is not None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image.astype(np.float64)


def true_outlines(dataset: Dataset) -> Outlines:
    path = dataset.folder / "truth" / "outlines.csv"
    return read_observations(path, dataset.machine.legs, dataset.measurements)


def profiles(image: Array, camera: Camera, ends: Array, other: Array) -> Array:
    """Return grey levels across an outline (n, m), from inside to outside.

    Inside is where the other outline of the same part is. Bends of the lens are followed.
    """
    t = np.arange(FREE, 1.0 - FREE, 1.0 / np.linalg.norm(ends[1] - ends[0]))
    start, end = camera.undistort(ends)
    curve = camera.distort(start + t[:, None] * (end - start))
    along = np.gradient(curve, axis=0)
    out = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    out *= np.sign(out[len(out) // 2] @ (ends.mean(axis=0) - other.mean(axis=0)))
    across = np.arange(-REACH, REACH + 0.5 * STEP, STEP)
    points = (curve[:, None] + across[:, None] * out[:, None]).astype(np.float32)
    found = cv2.remap(image.astype(np.float32), points[..., 0], points[..., 1], cv2.INTER_LINEAR)
    return np.asarray(found, dtype=np.float64)


def outward_errors(levels: Array) -> Array:
    """Return how far outside of an outline the edge is [px]: areas of profiles between two levels.

    Profiles that another edge crosses have no constant level at one end, and are left out.
    """
    flat = round(2.0 / STEP)
    inside, outside = levels[:, :flat], levels[:, -flat:]
    step = outside.mean(axis=1) - inside.mean(axis=1)
    clean = np.maximum(np.ptp(inside, axis=1), np.ptp(outside, axis=1)) < 0.01 * np.abs(step)
    levels, step, first = levels[clean], step[clean], inside[clean].mean(axis=1)
    covered = 1.0 - (levels - first[:, None]) / step[:, None]
    return np.asarray((covered.sum(axis=1) - 0.5) * STEP - REACH)


@pytest.mark.parametrize("name", ["hexapod", "3-rps", "tricept"])
def test_clean_photographs_show_the_true_outlines_on_both_sides(name: str, tmp_path: Path) -> None:
    dataset = photographs(name, tmp_path, (640, 480), Appearance.clean())
    truth, (view,) = true_outlines(dataset), dataset.measurements.views
    image = picture(dataset)
    medians: dict[int, list[float]] = {1: [], 2: []}
    for i in range(len(truth.row)):
        same = (truth.leg == truth.leg[i]) & (np.array(truth.part) == truth.part[i])
        (pair,) = np.flatnonzero(same & (truth.edge != truth.edge[i]))
        levels = profiles(image, view.camera, truth.ends[i], truth.ends[pair])
        errors = outward_errors(levels)
        if len(errors) > 40:
            medians[int(truth.edge[i])].append(float(np.median(errors)))
    for side in medians.values():
        assert len(side) >= 3
        assert np.abs(side).max() < 0.02
        assert abs(np.mean(side)) < 0.01


@pytest.mark.parametrize("name", thinned(SHIPPED, ["hexapod", "3-rpr", "3-upu", "tricept"]))
def test_photographs_of_every_class_show_the_legs_that_they_are_said_to(
    name: str, tmp_path: Path
) -> None:
    looks = Appearance(clutter=4, samples=13)
    dataset = photographs(name, tmp_path, (320, 240), looks)
    truth, (view,) = true_outlines(dataset), dataset.measurements.views
    image = picture(dataset)
    assert image.shape == (240, 320)
    names = dataset.machine.leg_names
    said = {names.index(leg) for leg in view.legs or names}
    assert said <= set(truth.leg.tolist())
    for leg in said:
        surest = 0.0
        for i in np.flatnonzero(truth.leg == leg):
            same = (truth.leg == leg) & (np.array(truth.part) == truth.part[i])
            (pair,) = np.flatnonzero(same & (truth.edge != truth.edge[i]))
            levels = profiles(image, view.camera, truth.ends[i], truth.ends[pair])
            middle = levels.shape[1] // 2
            step = levels[:, middle + round(1.5 / STEP)] - levels[:, middle - round(1.5 / STEP)]
            surest = max(surest, abs(float(np.median(step))))
        assert surest > 4.0  # grey levels: those of one pixel have a noise of two
