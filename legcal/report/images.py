"""What people read of what images show: a calibrated camera, and the outlines of the legs."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from legcal.calibration import CameraCalibration
from legcal.perception import PAGE
from legcal.report.render import heading, report, table
from legcal.vision import intrinsic_unit


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
        [*warnings, f"Written to {output}."],
    )


def detection_table(document: dict[str, Any], output: Path) -> RenderableType:
    """Return the document of ``detect``, and where it was written."""
    views, rejected = document["views"], Counter[str]()
    for view in views.values():
        rejected.update(view["rejected"])
    shown = (("contrast", 0, ""), ("length", 0, " px"), ("residual", 2, " px"))
    rows = [
        (
            name,
            str(view["images"]),
            f"{view['legs_found']}/{view['legs_visible']}",
            f"{view['used']}/{view['outlines']}",
            *(
                "-" if view[key] is None else f"{view[key]:.{digits}f}{unit}"
                for key, digits, unit in shown
            ),
        )
        for name, view in views.items()
    ]
    numbers = ("images", "legs found", "outlines used", *(key for key, _, _ in shown))
    told = ", ".join(f"{n} {why}" for why, n in rejected.most_common())
    return report(
        heading(
            document["mechanism"],
            f": {document['used']} of {document['outlines']} outlines used in "
            f"{document['images']} images",
        ),
        table("view", *(f">{name}" for name in numbers), rows=rows),
        f"Not used: {told}." if told else None,
        [
            *(Text(view["problem"], style="red") for view in views.values() if view["problem"]),
            *(Text(f"note: {note}", style="dim") for note in document["notes"]),
            f"Look at {output / PAGE}.",
        ],
    )
