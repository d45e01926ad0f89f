"""Text reports of a machine, its camera, what is identifiable, and where base and tool are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from math import degrees
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text
from scipy.spatial.transform import Rotation

from legcal.files.quantity import SHOWN_IN
from legcal.geometry.motions import roll_pitch_yaw
from legcal.machine.model import Machine
from legcal.machine.parameters import leg_labels, legs_in_words, list_in_words
from legcal.pages.document import Table
from legcal.report.render import Part, Report, heading, report, table

if TYPE_CHECKING:
    from legcal.calibration.camera_calibration.document import CameraCalibration
    from legcal.calibration.camera_calibration.projection import CameraComparison
    from legcal.calibration.identify.report import (
        ConditionBlock,
        Identifiability,
        Ranks,
        WeakDirection,
    )
    from legcal.calibration.location.document import Location
    from legcal.calibration.location.tool_poses import ToolPoses

_TURNS = ("roll, x", "pitch, y", "yaw, z")
_WIDTH = 80  # characters of a terminal
_PARTS = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)
_FIRST = 3  # tool poses shown before they are used
_MAX_ROWS = 60  # rows of residuals shown; the file has all


def scale_option(machine: Machine, *, board: bool) -> str:
    """Return the option of ``legcal calibrate`` that fixes the scale; "" if none is needed."""
    rod = machine.rod_for_scale(has_length=board)
    return "" if rod is None else f" {machine.length_option}"


def inspect_table(description: dict[str, Any]) -> Report:
    """Return the document of ``inspect`` as text, lengths in millimetres."""
    motors, mobility, legs = description["motors"], description["mobility"], description["legs"]
    verdict = "the motors determine the pose"
    if description["motor_rank"] < mobility:
        verdict = "NOT determined by motors"
    elif motors > mobility:
        verdict = "more than it needs"
    if mobility == 0:
        verdict = "it cannot move"
    title = heading(
        description["name"],
        f": {'spatial' if description['spatial'] else 'planar'}, {len(legs)} legs, "
        f"mobility {mobility}, {motors} motors ({verdict})",
    )
    radii_mm = [[1e3 * cylinder["radius"] for cylinder in leg["cylinders"]] for leg in legs]
    A, B = (_points([leg[end] for leg in legs]) for end in ("A", "B"))
    rows = [
        (
            leg["name"],
            leg["type"] if leg["actuated"] else f"{leg['type']} {leg['kind']}",
            A_text,
            B_text,
            _length(leg),
            ", ".join(dict.fromkeys(f"{round(radius, 2):g}" for radius in radii)) or "none",
        )
        for leg, A_text, B_text, radii in zip(legs, A, B, radii_mm, strict=True)
    ]
    kinds = max(4, *(0 if leg["actuated"] else len(leg["kind"]) for leg in legs))
    columns = ("leg", "type", ">A in base [mm]", ">B in platform [mm]", ">length [mm]", ">R [mm]")
    names = [column.removeprefix(">") for column in columns]
    widths = [max(map(len, cells)) for cells in zip(names, *rows, strict=True)]
    widths[1] = kinds
    joints: list[tuple[str, ...]] = [*rows]
    details = None
    if sum(widths) + 2 * len(columns[1:]) > _WIDTH:  # long names would be broken
        joints = [row[:4] for row in rows]
        details = table(*columns[:1], *columns[4:], rows=[(row[0], *row[4:]) for row in rows])
    laws = [
        (
            leg["name"],
            _span(leg["travel"]),
            _span([_length_at(leg, q) for q in leg["travel"] or ()]),
            "" if leg["travel"] is None else f"{1e3 * leg['q_home']:z.2f}",
            f"{1e3 * _length_at(leg, leg['q_home']):.2f}",
        )
        for leg in legs
        if "actuator" not in leg
    ]
    columns_of_laws = ("leg", ">travel [mm]", ">length [mm]", ">reading at home", ">length at home")
    axes = [
        (
            leg["name"],
            _direction(leg["base_axis"]),
            _direction(leg["platform_axis"]),
            "" if leg["twist"] is None else f"{degrees(leg['twist']) + 0.0:.3f}",
        )
        for leg in legs
        if leg["base_axis"] or leg["platform_axis"]
    ]
    columns_of_axes = ("leg", ">axis at base", ">axis at platform", ">twist [deg]")
    frame = ", ".join(description["base_frame"])
    legend = f"R_b and R_e stand on the joints of {frame}; q is the reading."
    if "actuators" in description:
        legend = f"R_b and R_e stand on the joints of {frame}, A where their motors read 0."
    return report(
        title,
        table(*columns[: len(joints[0])], rows=joints, least={1: kinds}),
        details,
        table(*columns_of_laws, rows=laws) if laws else None,
        _motors(description) if "actuators" in description else None,
        table(*columns_of_axes, rows=axes) if axes else None,
        [
            _home(description["home"]),
            *_workspace(description),
            *_bodies(legs),
            Text(legend, style="dim"),
            *(f"note: {note}" for note in description["diagnostics"]),
        ],
    )


def _motors(description: dict[str, Any]) -> Table:
    """Return the motors that move joints of rods, with axis and travel."""
    rows = []
    for joint, motor in description["actuators"].items():
        rods = [leg for leg in description["legs"] if leg.get("actuator") == joint]
        turns = motor["kind"] == "revolute"
        scale, unit = SHOWN_IN["rad" if turns else "m"]
        low, high = (scale * limit for limit in rods[0]["travel"])
        rows.append(
            (
                joint,
                ", ".join(leg["name"] for leg in rods),
                f"axis {_direction(motor['axis'])}"
                if turns
                else f"along {_direction(motor['direction'])}",
                f"{low:z.2f} to {high:z.2f} {unit}",
                f"{scale * rods[0]['q_home']:z.2f} {unit}",
            )
        )
        if turns:
            rows.append(("", "", f"at {_points([motor['point']])[0]} mm", "", ""))
        if "arm" in motor:
            rows.append(("", "", f"a round arm, R {1e3 * motor['arm']['radius']:g} mm", "", ""))
        if "us_per_deg" in motor:
            pulses = f"{motor['centre_us']:g} us at 0, {motor['us_per_deg']:g} us/deg"
            rows.append(("", "", pulses, "", ""))
        if "gain" in motor:
            rows.append(("", "", f"gain {motor['gain']:.6g}", "", ""))
    columns = ("motor", "legs", "moves", ">travel", ">at home")
    return table(*columns, rows=rows)


def _direction(axis: Sequence[float] | None) -> str:
    """Return a unit vector as text; "" without an axis."""
    return "" if axis is None else " ".join(f"{round(x, 4) + 0.0:7.4f}" for x in axis)


def _points(points: Sequence[Sequence[float]]) -> list[str]:
    """Return points in millimetres, decimals of each coordinate aligned."""
    words = [[f"{1e3 * x:z.2f}" for x in point] for point in points]
    width = [max(len(row[k]) for row in words) for k in range(3)]
    return [" ".join(map(str.rjust, row, width)) for row in words]


def _bodies(legs: Sequence[dict[str, Any]]) -> list[str]:
    """Return a line on bodies that are measured by their edges, for each length."""
    legs_of: dict[str, list[str]] = {}
    for leg in legs:
        for body in leg.get("bodies", ()):
            legs_of.setdefault(f"{1e3 * body['length']:.0f} mm", []).append(leg["name"])
    return [
        f"Edges are measured on bodies of {length}: {', '.join(names)}."
        for length, names in legs_of.items()
    ]


def _length_at(leg: dict[str, Any], q: float) -> float:
    """Return the length of a leg at a reading [m]."""
    return float(leg["q0"] if leg["kind"] == "constant" else leg["sign"] * q + leg["q0"])


def _span(values: Sequence[float] | None) -> str:
    """Return the range of lengths in millimetres; "" without any."""
    return f"{1e3 * min(values):z.2f} to {1e3 * max(values):z.2f}" if values else ""


def _home(home: dict[str, Sequence[float]]) -> str:
    xyz = ", ".join(f"{1e3 * x:z.2f}" for x in home["xyz"])
    turn = Rotation.from_quat(home["quat_xyzw"])
    angles = ", ".join(f"{degrees(x):z.3f}" for x in roll_pitch_yaw(turn.as_matrix()))
    return f"Home: platform at ({xyz}) mm in the base, roll pitch yaw ({angles}) deg."


def _workspace(description: dict[str, Any]) -> list[str]:
    """Return the limits of the platform, beside those of the motors, in one sentence."""
    limits = []
    if "reach" in description:
        limits.append(f"within {1e3 * description['reach']:.2f} mm of the z axis of the base")
    if "floor" in description:
        limits.append(f"at or above z = {1e3 * description['floor']:z.2f} mm in the base")
    return [f"The platform stays {' and '.join(limits)}."] if limits else []


def _length(leg: dict[str, Any]) -> str:
    """Return the length law of a leg in millimetres."""
    q0 = f"{1e3 * leg['q0']:.2f}"
    return q0 if leg["kind"] == "constant" else f"{q0} {'+' if leg['sign'] > 0 else '-'} q"


def understood(columns: Mapping[str, str], noun: str, unit: str) -> list[str]:
    """Return lines on how the headings of a table and the unit of its readings were read."""
    renamed = [f"{text} is {name}" for text, name in columns.items() if text != name]
    return [
        f"Columns: {', '.join(renamed)}." if renamed else "",
        f"Unit of the {noun}: {unit}." if unit else "",
    ]


def poses_table(poses: ToolPoses) -> Report:
    """Return the interpretation of a table of tool poses: columns, unit, the first poses."""
    rows = [
        (str(number), *(f"{1e3 * x:z.3f}" for x in position), "yes" if oriented else "no")
        for number, position, oriented in zip(
            poses.numbers[:_FIRST], poses.position, poses.oriented, strict=False
        )
    ]
    return report(
        heading(poses.source, f": {len(poses)} tool poses"),
        understood(poses.columns, "readings", poses.unit),
        table(">row", ">x [mm]", ">y [mm]", ">z [mm]", "orientation", rows=rows),
    )


def location_table(location: Location, written: Sequence[str]) -> Report:
    """Return base and tool with their residuals, in mm and degrees."""
    frames, sigma = [], location.sigma.reshape(2, 6)
    for i, (name, T) in enumerate(
        (("T_world_base", location.T_world_base), ("T_platform_tool", location.T_platform_tool))
    ):
        for component, value, s in zip("xyz", T.translation, sigma[i, :3], strict=True):
            frames.append((name, component, f"{1e3 * value:z.4f}", f"{1e3 * s:.4f}", "mm"))
        if i == 1 and not location.has_tool_orientation:
            frames.append((name, "rotation", "not measured", "", ""))
            continue
        # The sigma of an angle is that of a rotation about the axis.
        angles = roll_pitch_yaw(T.rotation.as_matrix())
        for component, value, s in zip(_TURNS, angles, sigma[i, 3:], strict=True):
            value, s = np.degrees(value), np.degrees(s)
            frames.append((name, component, f"{value:z.5f}", f"{s:.5f}", "deg"))
    residuals = [
        (
            str(row.row),
            f"{1e3 * np.linalg.norm(row.position):.4f}",
            "" if row.rotation is None else f"{np.degrees(np.linalg.norm(row.rotation)):.4f}",
            "used" if row.used else "left out",
        )
        for row in location.rows[:_MAX_ROWS]
    ]
    if len(location.rows) > _MAX_ROWS:
        residuals.append(("...", "", "", f"{len(location.rows) - _MAX_ROWS} more in the file"))
    good = {"located": "bold green", "located in part": "bold yellow", "doubtful": "bold red"}
    return report(
        table("frame", "component", ">value", ">sigma", "unit", rows=frames),
        table(">row", ">position [mm]", ">orientation [deg]", "verdict", rows=residuals),
        [
            *(f"Note: {note}" for note in location.notes),
            _noise_line(location),
            *(
                f"Row {row.row} was left out: {row.left_out}."
                for row in location.rows
                if not row.used
            ),
            *(f"Written to {path}." for path in written),
            Text(location.sentence, style=good[location.status]),
        ],
    )


def _noise_line(location: Location) -> str:
    noise = location.noise
    stated = {True: "stated", False: "from the residuals"}
    words = f"position {1e3 * noise.position:.3g} mm ({stated[noise.position_stated]})"
    if noise.angle is not None:
        angle = f"{np.degrees(noise.angle):.3g} deg"
        words += f", orientation {angle} ({stated[noise.angle_stated]})"
    counted = "; the covariance of the model counted in" * noise.model
    p_value = "" if location.p_value is None else f", p {location.p_value:.2g}"
    return (
        f"Noise of a component: {words}{counted}. chi2 {location.chi2:.1f} at {location.dof} "
        f"degrees of freedom{p_value}."
    )


def camera_table(calibration: CameraCalibration, output: Path) -> Report:
    """Return a calibrated camera and its file."""
    from legcal.vision.camera import intrinsic_unit

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
            image.image,
            f"{image.used}/{image.corners}",
            "left out" if image.rms_px is None else f"{image.rms_px:.3f} px",
            "" if image.tilt_rad is None else f"{np.degrees(image.tilt_rad):.0f} deg",
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
    noise = f"Noise of corners: {calibration.noise_px:.3f} px, "
    if calibration.noise_length_px:
        noise += (
            f"correlated over {calibration.noise_length_px:.0f} px, so that "
            f"{100.0 * calibration.effective_corners:.0f} % of the corners are independent; the "
            f"standard deviations count {calibration.error_ratio:.1f} times the claimed errors."
        )
    else:
        noise += "without a correlation of neighbours."
    return report(
        title,
        table("image", ">corners", ">residual", ">tilt", rows=images),
        table("", ">value", ">sigma", rows=numbers),
        _model_and_sheet(calibration),
        noise + _repeats(calibration),
        [*warnings, f"Written to {output}."],
    )


def _repeats(calibration: CameraCalibration) -> str:
    """Return in words the noise of corners where the board stands still, and what is beyond it."""
    repeats = calibration.repeats
    if repeats is None:
        return ""
    length = "without such a correlation"
    if repeats.length_px:
        length = f"correlated over {repeats.length_px:.0f} px"
    shared_px = np.sqrt(max(calibration.noise_px**2 - repeats.noise_px**2, 0.0))
    return (
        f" In {repeats.pairs} pair{'s' * (repeats.pairs != 1)} of images in which the board stands "
        f"still it is {repeats.noise_px:.3f} px, {length}: {shared_px:.3f} px comes back with each "
        "image of a pose, from print, lens or processing."
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


# legcal identify


CONDITIONS = {
    "eq12": "base joints and axes (12)",
    "eq15": "offsets and lengths (15)",
    "eq17": "platform joints (17)",
    "every_leg_seen": "every leg seen",
    "two_directions": "two directions of every leg",
    "three_legs_at_once": "three legs at once (18, 19)",
}
_LEGEND = "length known: leg with an encoder (length = reading + offset), or of constant length"
_SCALE = (
    "readings are angles, and radii alone say how large the machine is, so that calibrate refuses "
    "it until a length or radii are stated (--length, --set), or a board is seen"
)
_MAX_WEAK = 6  # directions shown
_MAX_MM, _MAX_DEG = 1000.0, 180.0  # [mm], [deg]; beyond, a number says no more


def identify_table(found: Identifiability) -> Report:
    """Return an identifiability report as text, 80 columns wide."""
    remedies = [
        (r.remedy, f"{r.full_rank}/{found.full.of}", "enough" if r.enough else "helps")
        for r in found.remedies
    ]
    return report(
        _heading(found),
        [conditions_table(found.conditions, found.legs), Text(_LEGEND, style="dim")],
        _weak(found.full) if found.full.weak else None,
        table("remedy", ">rank", "", rows=remedies) if remedies else None,
        _verdict(found),
    )


def _heading(found: Identifiability) -> list[str]:
    """Return the machine, views and boards of the report."""
    space = "spatial" if found.spatial else "planar"
    r = f", {found.r} with a revolute joint at the base" if found.r else ""
    lines = [f"{space}, {found.n} legs ({found.n_ac} with known length{r})"]
    labels = leg_labels(found.legs)
    first = 0
    for (view, images), group in groupby(zip(found.views, found.images, strict=True)):
        last = first + len(list(group))
        between = " and " if last == first + 2 else " to "
        views_in_heading = (
            f"view {last}" if last == first + 1 else f"views {first + 1}{between}{last}"
        )
        per_view = "" if last == first + 1 else " each"
        legs = f"legs {', '.join(labels[name] for name in view)}" if view else "no leg"
        lines.append(f"{views_in_heading}: {legs} in {images} image{'s' * (images != 1)}{per_view}")
        first = last
    if found.board:
        lines.append("a calibration board on the base in every view")
    if found.platform_board:
        lines.append("a calibration board on the platform in every view")
    return lines


def conditions_table(conditions: Sequence[ConditionBlock], leg_names: Sequence[str]) -> Table:
    """Return the paper's conditions."""
    rows = []
    for c in conditions:
        failing = [leg_names.index(name) for name in c.failing or ()]
        legs = f": {legs_in_words(failing, leg_names)}" if failing else ""
        numbers = ("", "") if c.equations is None else (str(c.equations), str(c.unknowns))
        remark = ", not needed with the board" if c.needed is False else ""
        remark += ", by analogy" if c.by_analogy else ""
        rows.append((CONDITIONS[c.name], *numbers, f"{'ok' if c.ok else 'fails'}{legs}{remark}"))
    return table("condition of the paper", ">equations", ">unknowns", "", rows=rows)


def _weak(ranks: Ranks) -> Table:
    """Return the undetermined directions."""
    rows = [(weak.direction, *_hidden(weak)) for weak in ranks.weak[:_MAX_WEAK]]
    if len(ranks.weak) > _MAX_WEAK:
        rows.append((f"and {len(ranks.weak) - _MAX_WEAK} more (see --json)", "", ""))
    return table("undetermined combination", ">hides [mm]", ">[deg]", rows=rows)


def _hidden(weak: WeakDirection) -> tuple[str, str]:
    """Return the unobserved platform error of a direction with 1 mm in its largest component."""
    if weak.dX_m is None or weak.dE_rad is None:
        return "?", "?"
    if weak.harmless:
        return "harmless", ""
    dX_mm, dE_deg = 1e3 * weak.dX_m, degrees(weak.dE_rad)
    return (
        f"{dX_mm:.2f}" if dX_mm < _MAX_MM else f"> {_MAX_MM:.0f}",
        f"{dE_deg:.3f}" if dE_deg < _MAX_DEG else f"> {_MAX_DEG:.0f}",
    )


def _two_digits(value: float) -> str:
    """Return a number with two significant digits, without exponent if it is large."""
    return f"{float(f'{value:.2g}'):.12g}"


def _verdict(found: Identifiability) -> list[Part]:
    harmless = sum(weak.harmless for weak in found.full.weak)
    determined = f"the joint fit determines {found.full.rank} of {found.full.of} parameters"
    lines: list[Part] = []
    if found.identifiable:
        undetermined = (
            f"; {harmless} undetermined directions do not move the platform" if harmless else ""
        )
        lines.append(f"Identifiable: {determined}{undetermined}.")
        if found.scale_is_open:
            lines.append(f"But for the scale: {_SCALE}.")
    else:
        lines.append(Text(f"NOT identifiable: {determined}.", style="bold"))
    if found.platform_sigma is not None:
        sigma = found.platform_sigma
        expected = (
            f"Predicted error of the platform (1 sigma): {_two_digits(1e3 * sigma.dX_m)} mm, "
            f"{_two_digits(degrees(sigma.dE_rad))} deg."
        )
        lines.append(Text(expected, style="dim"))
    if any(weak.dX_m is not None and not weak.harmless for weak in found.full.weak):
        hidden = "hides: unobserved platform error if the largest component is 1 mm."
        lines.append(Text(hidden, style="dim"))
    failed = [CONDITIONS[c.name] for c in found.conditions if c.fails]
    if failed:
        lines.append(f"The paper's conditions fail: {list_in_words(failed)}.")
    return [*lines, *(f"note: {note}" for note in found.notes)]
