"""Text reports of a calibrated camera and of a simulated dataset."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.text import Text

from legcal.calibration.camera_calibration.document import CameraCalibration
from legcal.calibration.camera_calibration.projection import CameraComparison
from legcal.report.render import Report, heading, report, table
from legcal.vision.camera import intrinsic_unit

_OFTEN = 0.5  # smallest share of images with a leg without a remark


def camera_table(calibration: CameraCalibration, output: Path) -> Report:
    """Return a calibrated camera and its file."""
    used = [image for image in calibration.images if image.rms_px is not None]
    camera = calibration.camera
    title = heading(
        camera.model,
        f", {camera.width} x {camera.height} px: {len(used)} of {len(calibration.images)} images, "
        f"{sum(image.used for image in used)} corners, {calibration.rms_px:.3f} px off (rms), "
        f"{100.0 * calibration.coverage:.0f} % of the image covered",
    )
    images = [
        (
            image.name,
            f"{image.used}/{image.corners}",
            "left out" if image.rms_px is None else f"{image.rms_px:.3f} px",
            "" if image.tilt is None else f"{np.degrees(image.tilt):.0f} deg",
        )
        for image in calibration.images
    ]
    numbers = []
    for name, value, sigma in zip(
        calibration.names, calibration.values, calibration.sigma, strict=True
    ):
        unit = " px" if intrinsic_unit(name) else ""
        numbers.append((name, f"{value:.{3 if unit else 5}f}{unit}", f"{sigma:.2g}{unit}"))
    warnings = [Text(f"warning: {warning}", style="yellow") for warning in calibration.warnings]
    return report(
        title,
        table("image", ">corners", ">residual", ">tilt", rows=images),
        table("", ">value", ">sigma", rows=numbers),
        _model_and_sheet(calibration),
        [*warnings, f"Written to {output}."],
    )


_PARTS = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)


def comparison_table(comparison: CameraComparison) -> Report:
    """Return the difference of two cameras in the nine parts of the image."""
    px, pixels = comparison.px, comparison.pixels
    worst = int(np.argmax(px))
    cell = np.minimum((3.0 * pixels / (pixels.max(axis=0) + 1.0)).astype(np.intp), 2)
    rows = []
    for y, names in enumerate(_PARTS):
        for x, name in enumerate(names):
            inside = (cell[:, 0] == x) & (cell[:, 1] == y)
            if not inside.any():
                continue
            lengths = [px] if comparison.sigma_px is None else [px, comparison.sigma_px]
            rms = [f"{np.sqrt(np.mean(length[inside] ** 2)):.3f} px" for length in lengths]
            rows.append((name, *rms, *[""] * (2 - len(rms))))
    u, v = pixels[worst]
    compared = f"{100.0 * comparison.reached:.3g} % of the image compared"
    if comparison.reached < 1.0:
        compared += ", as the lens model of the first camera does not reach the rest"
    return report(
        heading("difference", f": {np.sqrt(np.mean(px**2)):.3f} px (rms) over the image"),
        table("part of the image", ">difference", ">sigma", rows=rows),
        [
            f"At most {px[worst]:.3f} px, at ({u:.0f}, {v:.0f}); {1e3 * comparison.off.max():.2g} "
            f"mm at 1 m. A turn of {np.degrees(comparison.turn):.3f} deg is taken out, as the pose "
            "of a camera takes it up.",
            f"{compared}.",
        ],
    )


def _model_and_sheet(calibration: CameraCalibration) -> str:
    """Return the lens model with its reason, and the shape of the board, in sentences."""
    cross_validation = (
        ""
        if calibration.validated_px is None
        else f", {calibration.validated_px:.3f} px off in new images"
    )
    k = int(np.argmax(np.abs(calibration.sheet[:3])))
    bend, sigma = 1e3 * abs(calibration.sheet[k]), 1e3 * calibration.sheet_sigma[k]
    wider, wider_sigma = 100.0 * calibration.sheet[3], 100.0 * calibration.sheet_sigma[3]
    sigma_px = calibration.projection_sigma
    middle = np.sqrt(np.mean(sigma_px[3:10, 4:13] ** 2))
    worst = sigma_px[np.isfinite(sigma_px)].max()
    return (
        f"Lens model {calibration.lens}{cross_validation}. Pixels are known to {middle:.2g} px (1 "
        f"sigma) in the middle of the image, {worst:.2g} px at worst. The board is bent by "
        f"{bend:.2g} +- {sigma:.2g} mm, and printed {wider:+.2g} +- {wider_sigma:.2g} % wider than "
        "high."
    )


def simulation_table(document: dict[str, Any], *, to_measure: str = "") -> Report:
    """Return the document of ``simulate``: the number of images of each view with each leg.

    *to_measure* is the distance that would fix the scale, if nothing in the dataset does.
    """
    n_images, n_poses, left_out = (document[key] for key in ("images", "poses", "left_out"))
    views = document["views"]
    legs = list(dict.fromkeys(name for view in views.values() for name in view["legs"]))
    rows = [
        (name, str(view["images"]), *(str(n) for n in view["legs"].values()))
        for name, view in views.items()
    ]
    folder = shlex.quote(document["dataset"])
    length = f"--length {to_measure}=MEASURED±SIGMAmm"
    return report(
        heading(
            document["mechanism"],
            f": {document['level']}, {n_images} image{'s' * (n_images != 1)} of {n_poses} "
            f"pose{'s' * (n_poses != 1)}",
        ),
        table("view", ">images", *(f">{leg}" for leg in legs), rows=rows),
        [
            "Images of each view that show 40 % of a leg or more in one piece.",
            _left_out(left_out) if left_out else "",
            _hidden(views.values(), n_images),
            f"{document['extreme_poses']} of {n_poses} poses have every motor near an end of its "
            "travel.",
            Text(
                "Readings of motors that turn carry no length, and nothing else in this dataset "
                "does: simulate with --board charuco, or measure a rod and calibrate with its "
                "length, as below.",
                style="yellow",
            )
            if to_measure
            else "",
        ],
        [
            Text(line, overflow="fold")
            for line in (
                f"written: {document['dataset']}",
                f"the true model: {document['truth']}",
                f"calibrate with: legcal calibrate {folder} -o OUT"
                + (f" {length}" if to_measure else ""),
                f"judge with: legcal evaluate OUT/calibrated.yaml {shlex.quote(document['truth'])}",
            )
        ],
    )


def _hidden(views: Iterable[dict[str, Any]], n_images: int) -> str:
    """Return the legs that few images show, in words; "" without any."""
    images = Counter[str]()
    for view in views:
        images.update(view["legs"])
    rarely_shown = {name: n for name, n in images.items() if n < _OFTEN * n_images}
    if not rarely_shown:
        return ""
    legs = ", ".join(f"{name} in {n}" for name, n in rarely_shown.items())
    return (
        f"Few of the {n_images} images show these legs: {legs}. Other parts or a board hide them, "
        "or they are outside; use other or more --views, or a smaller board."
    )


def _left_out(n: int) -> str:
    """Return the number of images left out, in words."""
    return (
        "1 image shows no leg and is left out."
        if n == 1
        else f"{n} images show no leg and are left out."
    )
