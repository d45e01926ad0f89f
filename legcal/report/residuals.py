"""Residuals of outlines: as charts, and in crops of photographs with both outlines."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup
from scipy.special import ndtri

from legcal.calibration.result import Calibration
from legcal.data.measurements import row_names
from legcal.errors import LegcalError, printable
from legcal.geometry.motions import components
from legcal.geometry.types import Array, Image, IntArray
from legcal.machine.rods import arms_at, ends_at_poses, measured_readings
from legcal.pages.document import Charts, Crop, Drawing
from legcal.pages.svg import Points, scatter
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

N_WORST, N_MEDIAN = 30, 10
MAX_BYTES = 1_300_000  # largest total size of the pictures, so that pages stay below 9 MB
MAX_POINTS = 3000  # largest number of outlines of a chart that browsers draw quickly
_OFFSET = "outline less fit [px]"
_MARGIN = 18  # margin around an outline [px]
_ASPECT = 0.8  # smallest ratio of the shorter to the longer side
_SIDE = 360  # largest longer side of a picture [px]
_QUALITY = 78  # JPEG quality [percent]
_N_POINTS = 12  # points along a line
_SMALLER = 0.7  # scale factor of each attempt to keep to MAX_BYTES


@dataclass(frozen=True)
class Crops:
    """The crops on a page."""

    worst: list[Crop]
    median: list[Crop]
    links: dict[int, str]  # targets of links to outlines, by row of the table
    missing: tuple[str, ...]  # images that could not be read any more


@dataclass(frozen=True)
class _Piece:
    """A crop of an image before encoding."""

    outline: int
    grey: Image
    corner: tuple[int, int]


def outline_crops(calibration: Calibration, overlays: Mapping[int, str]) -> Crops:
    """Return the outlines with the largest and with median residuals in sigmas.

    *overlays* are pictures of whole images in the folder of the page, by row of the measurements.
    """
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    dataset = calibration.dataset
    size = np.linalg.norm(residuals.whitened, axis=1)
    order = np.argsort(-size, kind="stable")
    worst = residuals.index[order[:N_WORST]].tolist()
    middle = max(N_WORST, (len(order) - N_MEDIAN) // 2)
    median = residuals.index[order[middle : middle + N_MEDIAN]].tolist()
    reader = dataset.image_reader(range(dataset.measurements.n_rows))
    pieces: dict[int, _Piece] = {}
    missing: list[str] = []
    wanted: dict[int, list[int]] = {}
    for i in (*worst, *median):
        wanted.setdefault(int(outlines.row[i]), []).append(i)
    for row, of_row in wanted.items():
        if dataset.image_path(row) is None:
            continue
        try:
            image = reader(row)
        except LegcalError:
            missing.append(dataset.measurements.image[row])
            continue
        for i in of_row:
            pieces[i] = _cut(i, image, outlines.ends[i])
    scale, quality = 1.0, _QUALITY
    pictures = {i: _picture(piece, scale, quality) for i, piece in pieces.items()}
    while sum(map(len, pictures.values())) > MAX_BYTES:
        scale *= _SMALLER
        pictures = {i: _picture(piece, scale, quality) for i, piece in pieces.items()}
    number = dict(zip(residuals.index.tolist(), range(len(residuals)), strict=True))
    made = {
        i: _crop(calibration, piece, pictures[i], number[i], overlays)
        for i, piece in pieces.items()
    }
    links = {i: overlays[row] for i, row in enumerate(outlines.row.tolist()) if row in overlays} | {
        i: f"#{crop.name}" for i, crop in made.items()
    }
    return Crops(
        [made[i] for i in worst if i in made],
        [made[i] for i in median if i in made],
        links,
        tuple(missing),
    )


def _cut(outline: int, image: Image, ends: Array) -> _Piece:
    """Return the crop of an image around an outline."""
    middle, half = ends.mean(axis=0), 0.5 * np.ptp(ends, axis=0) + _MARGIN
    half = np.maximum(half, _ASPECT * half.max())
    low, high = np.floor(middle - half).astype(int), np.ceil(middle + half).astype(int) + 1
    height, width = image.shape
    left, top = np.clip(low, 0, [width - 1, height - 1]).tolist()
    right, bottom = np.clip(high, [left + 1, top + 1], [width, height]).tolist()
    return _Piece(outline, image[top:bottom, left:right].copy(), (left, top))


def _picture(piece: _Piece, scale: float, quality: int) -> str:
    """Encode a crop as a data URL."""
    grey = np.clip(np.rint(piece.grey), 0, 255).astype(np.uint8)
    factor = scale * min(1.0, _SIDE / max(grey.shape))
    if factor < 1.0:
        grey = np.asarray(
            cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
    _, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _crop(
    calibration: Calibration, piece: _Piece, picture: str, k: int, overlays: Mapping[int, str]
) -> Crop:
    """Return a crop with its lines and caption."""
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    dataset, solution = calibration.dataset, calibration.solution
    i, measurements = piece.outline, dataset.measurements
    row, j = int(outlines.row[i]), int(outlines.leg[i])
    v, pose = int(measurements.view[row]), int(measurements.pose[row])
    leg, part = solution.legs[j], outlines.part[i]
    R, t = components([solution.T_Rb_Re[pose]])
    q = measured_readings(solution.legs, R, t, measurements.q_of_poses[pose : pose + 1])
    if leg.is_arm(part):
        ends = arms_at(solution.legs, q)[j][0]
    else:
        ends = np.stack([of_legs[0, j] for of_legs in ends_at_poses(solution.legs, R, t, q)])
    A, B = solution.T_camera_Rb[v].apply(ends)
    u = (B - A) / np.linalg.norm(B - A)
    fit = outlines_of_axis(u, A, solution.radii[j, part])[int(outlines.edge[i]) - 1]
    given = measurements.views[v].camera
    origin = np.array(piece.corner) - 0.5  # pixel (0, 0) is the centre of the first one
    lines = [
        (
            "measured" if outlines.used[i] else "rejected",
            _points(_curve(given, outlines.h[i], outlines.ends[i]) - origin),
        ),
        ("predicted", _points(_curve(solution.cameras[v], fit, outlines.ends[i]) - origin)),
    ]
    offset, sigmas = residuals.offset[k], float(np.linalg.norm(residuals.whitened[k]))
    name = dataset.machine.leg_names[j]
    rejected = "" if outlines.used[i] else f"; rejected: {outlines.reason[i]}"
    height, width = piece.grey.shape
    return Crop(
        name=f"outline-{i}",
        picture=Markup(picture),
        width=width,
        height=height,
        lines=lines,
        caption=f"{name}, edge {outlines.edge[i]}: {offset[0]:+.3f} and {offset[1]:+.3f} px",
        detail=f"{sigmas:.1f} sigma, {row_names(measurements)[row]}{rejected}",
        link=overlays.get(row, ""),
    )


def _curve(camera: Camera, h: Array, ends: Array) -> Array:
    """Return points of the image of a line (3,) of the sensor plane between two ends [px]."""
    xy = camera.undistort(ends)
    normal = h[:2] / (h[:2] @ h[:2])
    feet = xy - (xy @ h[:2] + h[2])[:, None] * normal
    share = np.linspace(0.0, 1.0, _N_POINTS)[:, None]
    return camera.distort(feet[0] + share * (feet[1] - feet[0]))


def _points(pixels: Array) -> str:
    return " ".join(f"{x:.2f},{y:.2f}" for x, y in pixels.tolist())


def chosen_points(size: Array) -> IntArray:
    """Return the indices of drawn points: the largest, and a regular sample of the others."""
    n = len(size)
    if n <= MAX_POINTS:
        return np.arange(n)
    order = np.argsort(-size, kind="stable")
    worst, others = order[: MAX_POINTS // 2], order[MAX_POINTS // 2 :]
    spread = others[np.linspace(0, len(others) - 1, MAX_POINTS // 2).astype(np.intp)]
    return np.sort(np.concatenate([worst, spread]))


def residual_charts(calibration: Calibration, links: dict[int, str]) -> Charts:
    """Return the charts; *links* are the targets of clicks on outlines, by row of the table."""
    residuals, outlines = calibration.residuals, calibration.solution.outlines
    measurements, legs = calibration.dataset.measurements, calibration.dataset.machine.leg_names
    keep = chosen_points(np.abs(residuals.offset).max(axis=1))
    index = residuals.index[keep]
    offset, whitened = residuals.offset[keep], residuals.whitened[keep]
    row, leg = outlines.row[index], outlines.leg[index]
    views, images = [v.name for v in measurements.views], row_names(measurements)
    both_ends = np.repeat(np.arange(len(index)), 2)
    number, leg_of_end = index[both_ends], leg[both_ends]
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(both_ends))
    charts = []
    for title, x, label, words in (
        ("By view", measurements.view[row][both_ends] + jitter, "view", views),
        ("By leg", leg_of_end + jitter, "leg", legs),
        ("By image", row[both_ends] + 1.0, "image, in the order of the table", ()),
        ("Along the image", outlines.ends[index].reshape(-1, 2)[:, 0],
         "place along the image, u [px]", ()),
        ("Against contrast", outlines.contrast[index][both_ends], "contrast [grey levels]", ()),
    ):  # fmt: skip
        if not (has_x := np.isfinite(x)).any():
            continue
        groups = [
            Points(x[chosen], offset.ravel()[chosen], number[chosen], j)
            for j in np.unique(leg_of_end[has_x]).tolist()
            if (chosen := has_x & (leg_of_end == j)).any()
        ]
        svg = scatter(f"Residuals: {title}", groups, label, _OFFSET, words=words)
        charts.append(Drawing(svg.markup(), title=title))
    quantiles = Points(_normal(residuals.whitened)[keep].ravel(), whitened.ravel(), number)
    svg = scatter("Residuals: QQ plot", [quantiles], "normal quantile", "residual / sigma",
                  diagonal=True)  # fmt: skip
    charts.append(Drawing(svg.markup(), title="QQ plot"))
    labels = {
        i: f"{printable(legs[j])} {printable(outlines.part[i])}, edge {edge}: "
        f"{a:+.3f} and {b:+.3f} px\n{printable(images[r])}"
        for i, j, edge, (a, b), r in zip(
            index.tolist(), leg.tolist(), outlines.edge[index].tolist(), offset.tolist(),
            row.tolist(), strict=True,
        )
    }  # fmt: skip
    return Charts(charts, labels, {i: links[i] for i in labels if i in links})


def _normal(whitened: Array) -> Array:
    """Return the quantiles of a normal distribution at the ranks of residuals."""
    flat = whitened.ravel()
    rank = np.empty(len(flat))
    rank[np.argsort(flat, kind="stable")] = np.arange(len(flat))
    return np.asarray(ndtri((rank + 0.5) / len(flat)).reshape(whitened.shape))
