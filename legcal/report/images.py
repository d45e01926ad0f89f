"""What people read of images: a calibrated camera, a simulated dataset."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from legcal.calibration.camera_calibration.document import CameraCalibration
from legcal.report.render import heading, report, table
from legcal.vision.camera import intrinsic_unit

_OFTEN = 0.5  # of the images, in which a leg should be seen


def camera_table(found: CameraCalibration, output: Path) -> RenderableType:
    """Return a calibrated camera, and where it was written."""
    used = [image for image in found.images if image.rms_px is not None]
    camera = found.camera
    title = heading(
        camera.model,
        f", {camera.width} x {camera.height} px: {len(used)} of {len(found.images)} images, "
        f"{sum(image.used for image in used)} corners, {found.rms_px:.3f} px off (rms), "
        f"{100.0 * found.coverage:.0f} % of the image covered",
    )
    images = [
        (
            image.name,
            f"{image.used}/{image.corners}",
            "left out" if image.rms_px is None else f"{image.rms_px:.3f} px",
            "" if image.tilt is None else f"{np.degrees(image.tilt):.0f} deg",
        )
        for image in found.images
    ]
    numbers = []
    for name, value, sigma in zip(found.names, found.values, found.sigma, strict=True):
        unit = " px" if intrinsic_unit(name) else ""
        numbers.append((name, f"{value:.{3 if unit else 5}f}{unit}", f"{sigma:.2g}{unit}"))
    warnings = [Text(f"warning: {warning}", style="yellow") for warning in found.warnings]
    return report(
        title,
        table("image", ">corners", ">residual", ">tilt", rows=images),
        table("", ">value", ">sigma", rows=numbers),
        _model_and_sheet(found),
        [*warnings, f"Written to {output}."],
    )


def _model_and_sheet(found: CameraCalibration) -> str:
    """Return why the lens model was taken, and what the board is like, in sentences."""
    unseen = (
        "" if found.validated_px is None else f", {found.validated_px:.3f} px off in new images"
    )
    k = int(np.argmax(np.abs(found.sheet[:3])))
    bend, sigma = 1e3 * abs(found.sheet[k]), 1e3 * found.sheet_sigma[k]
    wider, open_to = 100.0 * found.sheet[3], 100.0 * found.sheet_sigma[3]
    return (
        f"Lens model {found.lens}{unseen}. The board is bent by {bend:.2g} +- {sigma:.2g} mm, and "
        f"printed {wider:+.2g} +- {open_to:.2g} % wider than high."
    )


def simulation_table(document: dict[str, Any], *, to_measure: str = "") -> RenderableType:
    """Return the document of ``simulate``: how many images of each view show each leg.

    *to_measure* is the distance that would fix the scale, where nothing in the dataset does.
    """
    n_images, n_poses, left_out = (document[key] for key in ("images", "poses", "left_out"))
    views = document["views"]
    legs = list(dict.fromkeys(name for view in views.values() for name in view["legs"]))
    rows = [
        (name, str(view["images"]), *(str(n) for n in view["legs"].values()))
        for name, view in views.items()
    ]
    folder = shlex.quote(document["dataset"])
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
                "does: simulate with --board charuco, or calibrate with --length "
                f"{to_measure}=MEASURED±SIGMAmm.",
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
                f"calibrate with: legcal calibrate {folder} -o OUT",
                f"judge with: legcal evaluate OUT/calibrated.yaml {shlex.quote(document['truth'])}",
            )
        ],
    )


def _hidden(views: Iterable[dict[str, Any]], of: int) -> str:
    """Return which legs few images show, in words; nothing if there are none."""
    images = Counter[str]()
    for view in views:
        images.update(view["legs"])
    few = {name: n for name, n in images.items() if n < _OFTEN * of}
    if not few:
        return ""
    legs = ", ".join(f"{name} in {n}" for name, n in few.items())
    return (
        f"Few of the {of} images show these legs: {legs}. Other parts or a board stand before "
        "them, or they are outside; take other or more --views, or a smaller board."
    )


def _left_out(n: int) -> str:
    """Return how many images are left out, in words."""
    return (
        "1 image shows no leg and is left out."
        if n == 1
        else f"{n} images show no leg and are left out."
    )
