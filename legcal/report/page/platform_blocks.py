"""Platform errors before and after a calibration, at poses and over the workspace."""

from __future__ import annotations

from typing import Any

import numpy as np

from legcal.calibration.result import Calibration
from legcal.calibration.workspace_errors import PlatformMap, platform_map
from legcal.geometry.types import Array
from legcal.pages.document import Drawing, Plot, Row, Table, Text, number
from legcal.pages.svg import histogram, number_grid
from legcal.report.page.residual_plots import FONT

_FLAT = 1e-3  # height of a planar workspace, relative to its extent
_IN_SPACE = {
    "aspectmode": "data",
    "camera": {"eye": {"x": 1.1, "y": -1.6, "z": 1.1}, "center": {"z": -0.2}},
}
_IN_A_PLANE = {
    "aspectmode": "manual",  # "data" would make a flat scene tiny
    "aspectratio": {"x": 1.0, "y": 1.0, "z": 0.01},
    "camera": {"eye": {"x": 0.0, "y": 0.0, "z": 1.6}, "up": {"x": 0.0, "y": 1.0, "z": 0.0}},
}


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
        Drawing(histogram(1e3 * change.displacement, "before: displacement [mm] (number of poses)"),
                wide=False),
        Drawing(histogram(1e3 * sigma.displacement, "after: 1 sigma [mm] (number of poses)"),
                wide=False),
    ]  # fmt: skip
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
                    ),
                    wide=False,
                )
                for z, level in zip(workspace.z.tolist(), workspace.index, strict=True)
            ]
            blocks.append(Row(slices))
        blocks.append(
            Text(["Slices at the orientation of home; empty cells are out of reach."], dim=True)
        )
    blocks.append(_in_space(workspace, before, after))
    return blocks


def _in_space(workspace: PlatformMap, before: Array, after: Array) -> Plot:
    is_flat = np.ptp(workspace.position[:, 2]) < _FLAT * np.ptp(workspace.position, axis=0).max()
    x, y, z = np.round(1e3 * workspace.position, 1).T.tolist()
    data = [
        {
            "type": "scatter3d",
            "mode": "markers",
            "name": name,
            "visible": k == 0,
            "x": x,
            "y": y,
            "z": z,
            "customdata": np.round(values, 5).tolist(),
            "hovertemplate": "(%{x}, %{y}, %{z}) mm: %{customdata:.4f} mm<extra></extra>",
            "marker": {
                "size": np.round(3.0 + 9.0 * values / max(float(values.max()), 1e-12), 1).tolist(),
                "color": np.round(values, 5).tolist(),
                "colorscale": [[0, "#dbe7f5"], [1, "#1a4a86"]],
                "colorbar": {"title": {"text": "mm"}, "thickness": 12, "len": 0.7},
                "line": {"width": 0.5, "color": "#667080"},
            },
        }
        for k, (name, values) in enumerate((("after", after), ("before", before)))
    ]
    buttons = [
        {"label": label, "method": "update", "args": [{"visible": [k == 0, k == 1]}]}
        for k, label in enumerate(("after, 1 sigma", "before"))
    ]
    axis = {"showbackground": False, "gridcolor": "#e8ebef",
            "tickfont": {"size": 10, "color": "#667080"}}  # fmt: skip
    look = {
        "font": FONT,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "showlegend": False,
        "updatemenus": [{"type": "buttons", "direction": "right", "x": 0, "xanchor": "left",
                         "y": 1.0, "yanchor": "top", "buttons": buttons, "showactive": True}],
        "scene": {f"{a}axis": {**axis, "title": {"text": f"{a} [mm]"}} for a in "xyz"}
        | (_IN_A_PLANE if is_flat else _IN_SPACE),
    }  # fmt: skip
    caption = "The same in space: larger and darker marks are larger errors."
    return Plot("platform-space", data, look, 420, caption)
