"""The tables of ``legcal noise``: Table 1, the errors by direction, and the outlines."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.calibration import (
    ANGLES,
    CALLED,
    OUTLINE,
    QUANTITIES,
    CameraCalibration,
    Evaluation,
    LegNoise,
    Location,
    MethodNoise,
    Noise,
    Spread,
)
from legcal.geometry import roll_pitch_yaw
from legcal.vision import intrinsic_unit

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


def accuracy_table(evaluation: Evaluation) -> RenderableType:
    """Return the platform errors and the parameters of an evaluation, in mm and degrees."""
    title = "Parameters [mm; axes and twists in deg]"
    if "rad" not in evaluation.units:
        title = "Parameters [mm]"
    table = Table(title=Text(title), title_justify="left", box=None, pad_edge=False)
    table.add_column("parameter")
    for column in ("model", "reference", "difference"):
        table.add_column(column, justify="right")
    scale = np.where([unit == "rad" for unit in evaluation.units], np.degrees(1.0), 1e3)
    for name, value, reference in zip(
        evaluation.names,
        scale * evaluation.values,
        scale * evaluation.references,
        strict=True,
    ):
        table.add_row(name, f"{value:.4f}", f"{reference:.4f}", f"{value - reference:+.4f}")
    return Group(Text(_headline(evaluation)), Text(), table)


def _headline(evaluation: Evaluation) -> str:
    dX, dE = 1e3 * evaluation.displacement, np.degrees(evaluation.rotation)
    if len(dX) == 0:
        return "Parameters only: readings do not give one pose where mobility and motors differ."
    return (
        f"Platform error over {len(dX)} poses: displacement {dX.mean():.4f} mm "
        f"(max {dX.max():.4f}), orientation {dE.mean():.4f} deg (max {dE.max():.4f})"
    )


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


def inspect_table(description: dict[str, Any]) -> RenderableType:
    """Return a mechanism's description as people read it, lengths in millimetres.

    Parameters
    ----------
    description : dict
        The document of :func:`legcal.machine.document.describe`.
    """
    motors, mobility = description["motors"], description["mobility"]
    verdict = "the motors determine the pose" if motors == mobility else "NOT determined by motors"
    if motors > mobility:
        verdict = "more than it needs"
    if mobility == 0:
        verdict = "it cannot move"
    heading = Text.assemble(
        (description["name"], "bold"),
        f": {'spatial' if description['spatial'] else 'planar'}, {len(description['legs'])} legs, "
        f"mobility {mobility}, {motors} motors ({verdict})",
    )
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("leg", overflow="fold")
    table.add_column("type", overflow="fold", min_width=_type_width(description["legs"]))
    table.add_column(r"A in base \[mm]", justify="right", no_wrap=True)
    table.add_column(r"B in platform \[mm]", justify="right", no_wrap=True)
    table.add_column(r"length \[mm]", justify="right", no_wrap=True)
    table.add_column(r"R \[mm]", justify="right")
    A, B = (_points([leg[end] for leg in description["legs"]]) for end in ("A", "B"))
    for leg, A_text, B_text in zip(description["legs"], A, B, strict=True):
        radii = dict.fromkeys(f"{1e3 * c['radius']:.4g}" for c in leg["cylinders"])
        kind = "" if leg["actuated"] else f" {leg['kind']}"
        table.add_row(
            leg["name"], f"{leg['type']}{kind}", A_text, B_text, _length(leg),
            ", ".join(radii) or "none",
        )  # fmt: skip
    axes: list[RenderableType] = []
    if _has_axes(description["legs"]):
        axes = [Text(), _axes_table(description["legs"])]
    notes = [Text(f"note: {note}") for note in description["diagnostics"]]
    legend = Text(
        f"R_b and R_e stand on the joints of {description['n_d']} legs; q is the reading.",
        style="dim",
    )
    return Group(heading, Text(), table, *axes, Text(), legend, *notes)


def _has_axes(legs: Sequence[dict[str, Any]]) -> bool:
    """Say whether the axis of any joint is a parameter."""
    return any(leg["base_axis"] or leg["platform_axis"] for leg in legs)


def _axes_table(legs: Sequence[dict[str, Any]]) -> Table:
    """Return the axes of the joints, and the twist of legs that cannot turn about themselves."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("leg", overflow="fold")
    table.add_column("axis at base", justify="right", no_wrap=True)
    table.add_column("axis at platform", justify="right", no_wrap=True)
    table.add_column(r"twist \[deg]", justify="right", no_wrap=True)
    for leg in legs:
        if not _has_axes([leg]):
            continue
        twist = "" if leg["twist"] is None else f"{math.degrees(leg['twist']) + 0.0:.3f}"
        table.add_row(
            leg["name"], _direction(leg["base_axis"]), _direction(leg["platform_axis"]), twist
        )
    return table


def _direction(axis: Sequence[float] | None) -> str:
    """Return a unit vector, or nothing where there is no axis."""
    if axis is None:
        return ""
    return " ".join(f"{round(x, 4) + 0.0:7.4f}" for x in axis)


def _type_width(legs: Sequence[dict[str, Any]]) -> int:
    """Return what the kinds of legs need, each on a line of its own."""
    return max(4, *(0 if leg["actuated"] else len(leg["kind"]) for leg in legs))


def _points(points: Sequence[Sequence[float]]) -> list[str]:
    """Return points in millimetres, decimals aligned."""
    words = [[f"{round(1e3 * x, 1) + 0.0:.1f}" for x in point] for point in points]
    width = max(len(word) for row in words for word in row)
    return [" ".join(word.rjust(width) for word in row) for row in words]


def _length(leg: dict[str, Any]) -> str:
    """Return the length law of a leg in millimetres."""
    if leg["kind"] == "constant":
        return f"{1e3 * leg['q0']:.3f}"
    return f"{1e3 * leg['q0']:.3f} {'+' if leg['sign'] > 0 else '-'} q"


_CLAIMING = "detector"  # the method whose claims stand beside its axes
_LEAST_NAME = 6  # characters of a leg's name that are never wrapped
_TABLE_1 = {"psi": r"psi \[deg]", "theta": r"theta \[deg]", "x": r"x \[mm]", "z": r"z \[mm]"}
_BY_DIRECTION = {
    "angle": r"angle \[deg]",
    "across": r"across \[mm]",
    "tilt": r"tilt \[deg]",
    "depth": r"depth \[mm]",
}
_CONVENTIONS = (
    "u = Rz(theta) Rx(psi) e_y in the camera: psi is the tilt out of the image, theta the angle in "
    "it from the y axis; M_LS = (x, 0, z). In the image: angle, and place across the leg in the "
    "middle of what is seen; towards the camera: tilt and depth there."
)
_PAPER = "The paper's Table 1 for its own machine: 0.05, 0.06 (as printed in rad), 0.05 mm, 0.1 mm."


def noise_table(noise: Noise) -> RenderableType:
    """Return the measurement noise as people read it, in mm, degrees and px."""
    counts = sorted({len(group.rows) for group in noise.repeats})
    repeats = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    heading = Text.assemble(
        (noise.dataset.mechanism.name, "bold"),
        f": {sum(len(group.rows) for group in noise.repeats)} images, {repeats} of each of "
        f"{len(noise.repeats)} orientations (a pose in a view)",
    )
    return Group(
        heading,
        Text(),
        _axis_table(noise, "Standard deviations of leg axes (Table 1)", _TABLE_1),
        Text(),
        _axis_table(noise, "The same in the image, and towards the camera", _BY_DIRECTION),
        Text(),
        _outline_table(noise),
        Text(),
        *_bounding(noise),
        *_difference(noise),
        *(Text(sentence, style="dim") for sentence in (_CONVENTIONS, _PAPER)),
        *(Text(f"note: {note}") for note in noise.notes),
    )


def _bounding(noise: Noise) -> list[Text]:
    """Return lines on which orientations set the upper bounds."""
    lines = []
    for method in noise.methods:
        places: dict[str, list[str]] = {}
        for quantity in (*QUANTITIES, OUTLINE):
            o = method.bounding(quantity)
            if o is not None:
                leg = noise.dataset.mechanism.leg_names[o.leg]
                place = f"{leg} in {noise.view_names[o.view]}/{noise.pose_labels[o.pose]}"
                places.setdefault(place, []).append(quantity)
        if places:
            found = "; ".join(f"{place} ({', '.join(of)})" for place, of in places.items())
            lines.append(Text(f"Upper bounds by {CALLED[method.name]}: {found}."))
    return [*lines, Text()] if lines else []


def _difference(noise: Noise) -> list[Text]:
    """Return a sentence on how far both methods put the same outlines apart."""
    found = noise.difference()
    if found is None:
        return []
    mean, rms = found
    side = "outside" if mean >= 0.0 else "inside"
    return [
        Text(
            f"Averaged over repeats, Canny's outlines lie {abs(mean):.3f} px {side} the detector's "
            f"({rms:.3f} px rms): bias of at least one of them, of which the spread tells nothing."
        ),
        Text(),
    ]


def _table_noise_table(noise: Noise, title: str, columns: Sequence[str]) -> Table:
    """Return a table by leg and method."""
    longest = max(len(leg.name) for leg in noise.methods[0].legs)
    table = Table(
        title=Text(title), title_justify="left", box=None, pad_edge=False, padding=(0, 2, 0, 0)
    )
    table.add_column("leg", overflow="fold", min_width=min(longest, _LEAST_NAME))
    table.add_column("method", no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _rows(noise: Noise) -> list[tuple[str, MethodNoise, LegNoise]]:
    """Return the rows: every leg by every method."""
    return [
        (leg.name if k == 0 else "", method, method.legs[j])
        for j, leg in enumerate(noise.methods[0].legs)
        for k, method in enumerate(noise.methods)
    ]


def _axis_table(noise: Noise, title: str, columns: dict[str, str]) -> Table:
    """Return pooled standard deviations of some quantities, and their upper bounds."""
    table = _table_noise_table(noise, title, [*columns.values(), "images"])
    for name, method, leg in _rows(noise):
        cells = [_value(leg.spread(q), q, lambda s: s.sd, "no M_LS" * (leg.without_M_LS > 0))
                 for q in columns]  # fmt: skip
        table.add_row(name, CALLED[method.name], *cells, f"{leg.axes}/{leg.images}")
        if method.name == _CLAIMING:
            cells = [_value(leg.spread(q), q, lambda s: s.claimed) for q in columns]
            table.add_row("", " claims", *cells, "", style="dim")
    of_all: dict[str, Callable[[Spread], float]] = {
        "median": lambda s: s.median,
        "upper bound": lambda s: s.largest,
    }
    for what, of in of_all.items():
        for k, method in enumerate(noise.methods):
            cells = [_value(method.spread(q), q, of) for q in columns]
            table.add_row(what if k == 0 else "", CALLED[method.name], *cells, "")
    return table


def _outline_table(noise: Noise) -> Table:
    """Return the spread of outlines beside what is claimed of them."""
    columns = ("spread", "claimed", "ratio", "(95 %)", "median", "largest", "missed")
    table = _table_noise_table(noise, "Outlines, offsets at both ends [px]", columns)
    for name, method, leg in _rows(noise):
        shown = sum(o.outlines for o in leg.orientations)
        missed = shown - sum(o.outlines_found for o in leg.orientations)
        cells = _outline_cells(leg.spread(OUTLINE))
        table.add_row(name, CALLED[method.name], *cells, f"{missed}/{shown}")
    for k, method in enumerate(noise.methods):
        cells = _outline_cells(method.spread(OUTLINE))
        table.add_row("all" if k == 0 else "", CALLED[method.name], *cells, "")
    return table


def _outline_cells(spread: Spread | None) -> list[str]:
    """Return spread, claim, ratio with its range, the median and the largest."""
    if spread is None:
        return ["-"] * 6
    low, high = spread.ratio_range
    return [
        f"{spread.sd:.4f}",
        f"{spread.claimed:.4f}",
        f"{spread.ratio:.2f}",
        f"{low:.2f} to {high:.2f}",
        f"{spread.median:.4f}",
        f"{spread.largest:.4f}",
    ]


def _value(
    spread: Spread | None, quantity: str, of: Callable[[Spread], float], none: str = "-"
) -> str:
    """Return a standard deviation in degrees or millimetres with three digits."""
    if spread is None:
        return none or "-"
    value = math.degrees(of(spread)) if quantity in ANGLES else 1e3 * of(spread)
    return f"{float(f'{value:.3g}'):.12g}"
