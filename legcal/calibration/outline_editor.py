"""What the page of a detection needs so that people correct outlines over the photographs.

The page holds the table as it was written, cameras without what it does not need of them, and where
outlines were expected that were not found: such a one is placed there and dragged onto its edge.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from legcal.data.dataset import OBSERVATIONS_NAME, Dataset
from legcal.data.measurements import row_names
from legcal.data.outlines import Outlines, format_observations
from legcal.data.reasons import WORDS_BY_CODE
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.pages.document import OutlineEditor
from legcal.vision.camera import Camera
from legcal.vision.visibility import PredictedLeg

# Of an end that a person places over an enlarged photograph: edges are blurred over a pixel or two,
# and where in that width their middle is the eye says to about half a pixel.
SIGMA_BY_HAND = 0.5  # [px]
MAX_BYTES = 8_300_000  # of the table and what is said of its images, in a page
_OF_IMAGE = 250  # bytes in the page for each image


def outline_editor(
    dataset: Dataset,
    outlines: Outlines,
    predicted: Callable[[int], Sequence[PredictedLeg]],
    photographs: Mapping[int, str],
) -> OutlineEditor | None:
    """Return the editor of outlines; None where the table is more than a page should hold.

    *predicted* says where the legs of a row of the measurements should be seen; *photographs* are
    the files of the images, relative to the page, by row.
    """
    measurements, machine = dataset.measurements, dataset.machine
    names = row_names(measurements)
    images = []
    for row, file in photographs.items():
        view = measurements.views[int(measurements.view[row])]
        images.append(
            {
                "view": view.name,
                "image": names[row],
                "label": f"{view.name}, {names[row]}",
                "photograph": file,
                "width": view.camera.width,
                "height": view.camera.height,
                "camera": int(measurements.view[row]),
                "expected": _expected(dataset, outlines, row, predicted),
            }
        )
    cameras = [
        {
            "K": view.camera.K.tolist(),
            "distortion": view.camera.distortion.tolist(),
            "model": view.camera.model,
        }
        for view in measurements.views
    ]
    table = format_observations(outlines, measurements, machine.leg_names)
    found = OutlineEditor(OBSERVATIONS_NAME, table, images, cameras, SIGMA_BY_HAND, WORDS_BY_CODE)
    size = len(found.packed) + _OF_IMAGE * len(images)
    return found if size <= MAX_BYTES else None


def _expected(
    dataset: Dataset,
    outlines: Outlines,
    row: int,
    predicted: Callable[[int], Sequence[PredictedLeg]],
) -> dict[str, list[list[float]]]:
    """Return both ends [px] of the outlines of an image that were expected and not found."""
    measurements, names = dataset.measurements, dataset.machine.leg_names
    here = np.flatnonzero(outlines.row == row)
    found = np.isfinite(outlines.h[here]).all(axis=1) & np.isfinite(outlines.ends[here]).all((1, 2))
    lost = here[~found].tolist()
    if not lost:
        return {}
    camera = measurements.views[int(measurements.view[row])].camera
    legs = {(leg.leg, part.link): leg for leg in predicted(row) for part in leg.segments}
    expected = {}
    for i in lost:
        j, part, edge = int(outlines.leg[i]), outlines.part[i], int(outlines.edge[i])
        leg = legs.get((j, part))
        ends = None if leg is None else _ends(camera, leg, part, edge)
        if ends is not None:
            expected[f"{names[j]}\n{part}\n{edge}"] = np.round(ends, 2).tolist()
    return expected


def _ends(camera: Camera, leg: PredictedLeg, part: str, edge: int) -> Array | None:
    """Return the ends (2, 2) of a predicted outline [px], the first nearer to the base."""
    for i, segment in enumerate(leg.segments):
        band = leg.bands[i]
        if segment.link == part and band is not None:
            h, t = leg.outlines[i][edge - 1], np.array([0.0, band.length])
            xy = band.points(t, band.offsets(h, t))
            rays = np.column_stack([xy, np.ones(2)])
            return camera.distort(xy if cross(rays[1], rays[0]) @ h > 0.0 else xy[::-1])
    return None
