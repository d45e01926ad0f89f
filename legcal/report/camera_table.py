"""What ``legcal camera`` prints: images, intrinsics with their sigmas, warnings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.camera_calibration.result import CameraCalibration
from legcal.vision.intrinsics import intrinsic_unit


def camera_table(found: CameraCalibration, output: Path) -> RenderableType:
    """Return a calibrated camera as people read it.

    Parameters
    ----------
    found : CameraCalibration
        The camera.
    output : Path
        Where it was written.
    """
    used = [image for image in found.images if image.rms_px is not None]
    camera = found.camera
    heading = Text.assemble(
        (camera.model, "bold"),
        f", {camera.width} x {camera.height} px: {len(used)} of {len(found.images)} images, "
        f"{sum(image.used for image in used)} corners, {found.rms_px:.3f} px off (rms), "
        f"{100.0 * found.coverage:.0f} % of the image covered",
    )
    return Group(
        heading,
        Text(),
        _images(found),
        Text(),
        _numbers(found),
        Text(),
        *(Text(f"warning: {warning}", style="yellow") for warning in found.warnings),
        Text(f"Written to {output}."),
    )


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(columns[0], overflow="fold")
    for column in columns[1:]:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _images(found: CameraCalibration) -> Table:
    """Return one row an image."""
    table = _table("image", "corners", "residual", "tilt")
    for image in found.images:
        if image.rms_px is None or image.tilt is None:
            table.add_row(Text(image.name), f"{image.used}/{image.corners}", "left out", "")
            continue
        table.add_row(
            Text(image.name),
            f"{image.used}/{image.corners}",
            f"{image.rms_px:.3f} px",
            f"{np.degrees(image.tilt):.0f} deg",
        )
    return table


def _numbers(found: CameraCalibration) -> Table:
    """Return one row a number of the camera."""
    table = _table("", "value", "sigma")
    for name, value, sigma in zip(found.names, found.values, found.sigma, strict=True):
        unit = " px" if intrinsic_unit(name) else ""
        digits = 3 if unit else 5
        table.add_row(name, f"{value:.{digits}f}{unit}", f"{sigma:.2g}{unit}")
    return table
