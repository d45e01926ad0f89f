"""A picture of a calibration: corners, mean residuals and the projection error over the field."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.calibration.camera_calibration.document import CameraCalibration
from legcal.calibration.camera_calibration.projection import GRID, grid
from legcal.files.folder import OutputFile

_LONGER = 1280  # side of the picture [px]
_CELLS = 16  # cells along the longer side
_ARROW = 0.45  # length of the longest arrow, relative to a cell
_LEAST_ARROW = 3  # smallest number of corners of a cell with an arrow
_LETTER = 0.55  # scale of letters
_LABELLED = 4  # every fourth place of the grid has its standard deviation written
_DARK, _WHITE, _EMPTY = (32, 32, 32), (255, 255, 255), (60, 60, 140)
_SEEN, _RESIDUAL, _CENTRE = (90, 120, 60), (0, 225, 255), (255, 170, 40)  # blue, green, red
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MARK = b"Software\x00legcal camera"

Canvas = NDArray[np.uint8]


PICTURE_FILE = OutputFile(
    "the picture", "picture", "", "a new file or a picture that this command wrote", mark=_MARK
)


def write_picture(calibration: CameraCalibration, path: Path) -> None:
    """Write the picture as PNG; an earlier one of this command is replaced, any other file is not.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
    png = np.asarray(cv2.imencode(".png", picture(calibration))[1]).tobytes()
    header = len(_SIGNATURE) + 25  # the chunk IHDR
    chunk = b"tEXt" + _MARK
    marked = (len(_MARK)).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    PICTURE_FILE.write(path, png[:header] + marked + png[header:])


def picture(calibration: CameraCalibration) -> Canvas:
    """Return the picture (BGR): cells coloured by number of corners, arrows of mean residuals."""
    camera = calibration.camera
    factor = _LONGER / max(camera.width, camera.height)
    side = _LONGER / _CELLS
    width, height = (round(factor * n) for n in (camera.width, camera.height))
    canvas = np.full((height, width, 3), _DARK, dtype=np.uint8)
    points = (calibration.corners[:, :2] + 0.5) * factor
    cell = np.floor(points / side).astype(np.intp)
    shape = int(np.ceil(height / side)), int(np.ceil(width / side))
    index = np.clip(cell[:, 1], 0, shape[0] - 1) * shape[1] + np.clip(cell[:, 0], 0, shape[1] - 1)
    count = np.bincount(index, minlength=shape[0] * shape[1])
    mean = (
        np.stack([np.bincount(index, r, len(count)) for r in calibration.corners[:, 2:].T], axis=-1)
        / np.maximum(count, 1)[:, None]
    )
    enough = count >= _LEAST_ARROW
    longest = float(np.linalg.norm(mean[enough], axis=1).max()) if enough.any() else 0.0
    scale = _ARROW * side / max(longest, 1e-9)
    full = max(float(np.quantile(count[count > 0], 0.9)), 1.0) if count.any() else 1.0
    for k in range(len(count)):
        y, x = divmod(k, shape[1])
        low = round(x * side) + 1, round(y * side) + 1
        high = min(round((x + 1) * side), width) - 1, min(round((y + 1) * side), height) - 1
        share = 0.25 + 0.75 * min(count[k] / full, 1.0)
        colour = _EMPTY if not count[k] else tuple(int(share * c) for c in _SEEN)
        cv2.rectangle(canvas, low, high, colour, -1)
    for point in points:
        cv2.circle(canvas, tuple(np.rint(point).astype(int).tolist()), 1, (150, 180, 130), -1)
    for drawn in np.flatnonzero(enough).tolist():
        y, x = divmod(drawn, shape[1])
        middle = (np.array([x, y]) + 0.5) * side
        start, end = (
            tuple(np.rint(p).astype(int).tolist())
            for p in (middle - scale * mean[drawn], middle + scale * mean[drawn])
        )
        cv2.arrowedLine(canvas, start, end, _RESIDUAL, 2, cv2.LINE_AA, tipLength=0.3)
    places = grid(camera).reshape(*GRID[::-1], 2)[::_LABELLED, ::_LABELLED].reshape(-1, 2)
    sigmas = calibration.projection_sigma[::_LABELLED, ::_LABELLED].ravel()
    for place, sigma in zip(places, sigmas.tolist(), strict=True):
        label = f"{sigma:.2g}"
        (w, h), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, _LETTER, 1)
        at = np.rint(place * factor - [0.5 * w, -0.5 * h]).astype(int)
        left, bottom = np.clip(at, [12, 12 + h], [width - w - 12, height - 12]).tolist()
        origin = left, bottom
        cv2.putText(
            canvas, label, origin, cv2.FONT_HERSHEY_SIMPLEX, _LETTER, _WHITE, 1, cv2.LINE_AA
        )
    centre = tuple(np.rint((camera.K[:2, 2] + 0.5) * factor).astype(int).tolist())
    cv2.drawMarker(canvas, centre, _CENTRE, cv2.MARKER_CROSS, 24, 2, cv2.LINE_AA)
    validated_px = calibration.validated_px
    lines = (
        f"{camera.model}, {len(points)} corners, {calibration.rms_px:.3f} px off (rms)"
        + ("" if validated_px is None else f", {validated_px:.3f} px in images left out"),
        f"arrows: mean residual of a cell, the longest {longest:.3f} px; green: corners, brighter "
        "where more; red: none; cross: principal point; numbers: projection, 1 sigma [px]",
    )
    legend = np.full((62, width, 3), _DARK, dtype=np.uint8)
    for row, line in enumerate(lines):
        (w, _), _ = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, _LETTER, 1)
        letter_scale = _LETTER * min(1.0, (width - 20) / w)
        origin = (10, 24 + 26 * row)
        cv2.putText(
            legend, line, origin, cv2.FONT_HERSHEY_SIMPLEX, letter_scale, _WHITE, 1, cv2.LINE_AA
        )
    return np.vstack([canvas, legend])
