"""Platform errors before and after a calibration, at poses and over the workspace."""

from __future__ import annotations

from typing import Any

import numpy as np

from legcal.calibration.result import Calibration
from legcal.calibration.workspace_errors import PlatformMap, platform_map
from legcal.geometry.types import Array
from legcal.pages.document import Drawing, Row, Table, Text, number
from legcal.pages.svg import histogram, number_grid
from legcal.report.page.scene import platform_scene


def platform_blocks(calibration: Calibration) -> list[Any]:
    """Return figures, histograms and maps of the error of the platform."""
    platform = calibration.result.platform
    if platform is None or calibration.platform is None:
        reason = calibration.dataset.machine.undetermined
        return [Text([f"No error of the platform is predicted, because {reason}."])]
    change, sigma = calibration.platform.change, calibration.platform.sigma
    rows = [
        _figures("before: nominal vs. calibrated model", change.displacement, change.rotation),
        _figures("after: predicted error of the calibrated model, 1 sigma", sigma.displacement,
                 sigma.rotation),
    ]  # fmt: skip
    workspace = platform_map(calibration)
    if workspace is not None:
        n = len(workspace.position)
        rows += [
            _figures(f"before, {n} places of the workspace", workspace.change.displacement,
                     workspace.change.rotation),
            _figures(f"after, {n} places of the workspace", workspace.sigma.displacement,
                     workspace.sigma.rotation),
        ]  # fmt: skip
    columns = ("", ">mean [mm]", ">largest [mm]", ">mean [deg]", ">largest [deg]")
    scope = "The first two rows" if workspace is not None else "Both rows"
    note = (
        f"{scope} are at the {platform.poses} poses of the images. Both models get the "
        "same readings; errors of the readings themselves are not in sigma."
    )
    histograms = [
        Drawing(histogram(1e3 * displacement, f"{name} [mm] (number of poses)"))
        for name, displacement in (
            ("before: displacement", change.displacement),
            ("after: 1 sigma", sigma.displacement),
        )
    ]
    blocks: list[Any] = [Table(columns, rows, note=note), Row(histograms)]
    if workspace is not None:
        blocks += _maps(workspace)
    return blocks


def _figures(name: str, displacement: Array, rotation: Array) -> list[Any]:
    degrees = np.degrees(rotation)
    return [
        name,
        number(1e3 * displacement.mean(), 3),
        number(1e3 * displacement.max(), 3),
        number(degrees.mean(), 4),
        number(degrees.max(), 4),
    ]


def _maps(workspace: PlatformMap) -> list[Any]:
    """Return slices of constant z, if there is a grid, and all positions in space."""
    blocks: list[Any] = []
    before, after = 1e3 * workspace.change.displacement, 1e3 * workspace.sigma.displacement
    if workspace.index.size:
        for name, values in (("Before", before), ("After, 1 sigma", after)):
            digits = int(np.clip(np.ceil(1.5 - np.log10(max(values.max(), 1e-9))), 0, 5))
            slices = [
                Drawing(
                    number_grid(
                        (1e3 * workspace.x).tolist(),
                        (1e3 * workspace.y).tolist(),
                        np.where(level >= 0, values[level], np.nan),
                        f"{name} [mm], z = {1e3 * z:z.0f} mm",
                        float(values.max()),
                        digits,
                    )
                )
                for z, level in zip(workspace.z.tolist(), workspace.index, strict=True)
            ]
            blocks.append(Row(slices))
        blocks.append(
            Text(["Slices at the orientation of home; empty cells are out of reach."], dim=True)
        )
    blocks.append(platform_scene(workspace))
    return blocks
