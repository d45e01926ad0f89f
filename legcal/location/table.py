"""What ``legcal locate`` shows: both frames with standard deviations, residuals, the verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.geometry.frames import roll_pitch_yaw
from legcal.location.location import Location

_TURNS = ("roll, x", "pitch, y", "yaw, z")
MOST_ROWS = 60  # of residuals; the file has them all


def location_table(location: Location, written: Sequence[str]) -> RenderableType:
    """Return what a person reads, in mm and degrees."""
    lines = [*(f"Note: {note}" for note in location.notes), _noise_line(location)]
    lines += _left_out(location)
    lines += [f"Written to {path}." for path in written]
    good = {"located": "bold green", "located in part": "bold yellow", "doubtful": "bold red"}
    return Group(
        _frames(location),
        Text(),
        _residuals(location),
        Text(),
        *(Text(line) for line in lines),
        Text(location.sentence, style=good[location.status]),
    )


def _frames(location: Location) -> Table:
    """Return a line for each component; sigma of an angle is that of a turn about the axis."""
    table = Table(box=None, pad_edge=False)
    for column in ("frame", "component"):
        table.add_column(column)
    for column in ("value", "sigma"):
        table.add_column(column, justify="right")
    table.add_column("unit")
    sigma = location.sigma.reshape(2, 6)
    for i, (name, T) in enumerate(
        (("T_world_base", location.T_world_base), ("T_platform_tool", location.T_platform_tool))
    ):
        for component, value, s in zip("xyz", T.translation, sigma[i, :3], strict=True):
            table.add_row(name, component, f"{1e3 * value:z.4f}", f"{1e3 * s:.4f}", "mm")
        if i == 1 and not location.has_tool_orientation:
            table.add_row(name, "rotation", "not measured", "", "")
            continue
        angles = roll_pitch_yaw(T.rotation.as_matrix())
        for component, value, s in zip(_TURNS, angles, sigma[i, 3:], strict=True):
            about = f"{np.degrees(s):.5f}"
            table.add_row(name, component, f"{np.degrees(value):z.5f}", about, "deg")
    return table


def _residuals(location: Location) -> Table:
    """Return a line for each row of the poses."""
    table = Table(box=None, pad_edge=False)
    table.add_column("row", justify="right")
    for column in ("position [mm]", "orientation [deg]"):
        table.add_column(column, justify="right")
    table.add_column("verdict")
    for row in location.rows[:MOST_ROWS]:
        turn = "" if row.rotation is None else f"{np.degrees(np.linalg.norm(row.rotation)):.4f}"
        table.add_row(
            str(row.row),
            f"{1e3 * np.linalg.norm(row.position):.4f}",
            turn,
            "used" if row.used else "left out",
        )
    if len(location.rows) > MOST_ROWS:
        table.add_row("...", "", "", f"{len(location.rows) - MOST_ROWS} more in the file")
    return table


def _left_out(location: Location) -> list[str]:
    """Return why rows were left out."""
    return [f"Row {row.row} was left out: {row.reason}." for row in location.rows if not row.used]


def _noise_line(location: Location) -> str:
    """Return how precise the measurement is, and where that comes from."""
    noise = location.noise
    stated = {True: "stated", False: "from the residuals"}
    words = f"position {1e3 * noise.position:.3g} mm ({stated[noise.position_stated]})"
    if noise.angle is not None:
        angle = f"{np.degrees(noise.angle):.3g} deg"
        words += f", orientation {angle} ({stated[noise.angle_stated]})"
    others = [
        "errors of the readings" * (noise.reading > 0.0),
        "the covariance of the model" * noise.model,
    ]
    known = [other for other in others if other]
    counted = f"; {' and '.join(known)} counted in" if known else ""
    p_value = "" if location.p_value is None else f", p {location.p_value:.2g}"
    return (
        f"Noise of a component: {words}{counted}. chi2 {location.chi2:.1f} at {location.dof} "
        f"degrees of freedom{p_value}."
    )
