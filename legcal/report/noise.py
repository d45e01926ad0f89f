"""What people read of the measurement noise: Table 1, the errors by direction, and the outlines."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from legcal.calibration.measurement_noise.document import (
    CALLED,
    DatasetNoise,
    LegNoise,
    MethodNoise,
)
from legcal.calibration.measurement_noise.repeatability import (
    ANGLES,
    OUTLINE,
    QUANTITIES,
    PooledSpread,
)
from legcal.report.render import heading, report, table

_CLAIMING = "detector"  # the method whose claims stand beside its axes
_MIN_NAME = 6  # characters of a leg's name that are never wrapped
_TABLE_1 = {"psi": "psi [deg]", "theta": "theta [deg]", "x": "x [mm]", "z": "z [mm]"}
_BY_DIRECTION = {
    "angle": "angle [deg]",
    "across": "across [mm]",
    "tilt": "tilt [deg]",
    "depth": "depth [mm]",
}
_CONVENTIONS = (
    "u = Rz(theta) Rx(psi) e_y in the camera: psi is the tilt out of the image, theta the angle in "
    "it from the y axis; M_LS = (x, 0, z). In the image: angle, and place across the leg in the "
    "middle of what is seen; towards the camera: tilt and depth there."
)
_PAPER = "The paper's Table 1 for its own machine: 0.05, 0.06 (as printed in rad), 0.05 mm, 0.1 mm."


def noise_table(noise: DatasetNoise) -> RenderableType:
    """Return the measurement noise as people read it, in mm, degrees and px."""
    counts = sorted({len(group.rows) for group in noise.repeats})
    repeats = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    title = heading(
        noise.dataset.machine.name,
        f": {sum(len(group.rows) for group in noise.repeats)} images, {repeats} of each of "
        f"{len(noise.repeats)} orientations (a pose in a view)",
    )
    return report(
        title,
        _axis_table(noise, "Standard deviations of leg axes (Table 1)", _TABLE_1),
        _axis_table(noise, "The same in the image, and towards the camera", _BY_DIRECTION),
        _outline_table(noise),
        _bounding(noise),
        _difference(noise),
        [
            *(Text(sentence, style="dim") for sentence in (_CONVENTIONS, _PAPER)),
            *(f"note: {note}" for note in noise.notes),
        ],
    )


def _bounding(noise: DatasetNoise) -> list[str]:
    """Return lines on which orientations set the upper bounds."""
    lines = []
    for method in noise.methods:
        places: dict[str, list[str]] = {}
        for quantity in (*QUANTITIES, OUTLINE):
            o = method.bounding(quantity)
            if o is not None:
                at = noise.place(o)
                places.setdefault(f"{at.leg} in {at.view}/{at.pose}", []).append(quantity)
        if places:
            found = "; ".join(f"{place} ({', '.join(of)})" for place, of in places.items())
            lines.append(f"Upper bounds by {CALLED[method.name]}: {found}.")
    return lines


def _difference(noise: DatasetNoise) -> str | None:
    """Return a sentence on how far both methods put the same outlines apart."""
    found = noise.difference()
    if found is None:
        return None
    mean, rms = found
    side = "outside" if mean >= 0.0 else "inside"
    return (
        f"Averaged over repeats, Canny's outlines lie {abs(mean):.3f} px {side} the detector's "
        f"({rms:.3f} px rms): bias of at least one of them, which the spread does not show."
    )


def _rows(noise: DatasetNoise) -> list[tuple[str, MethodNoise, LegNoise]]:
    """Return the rows: every leg by every method."""
    return [
        (leg.name if k == 0 else "", method, method.legs[j])
        for j, leg in enumerate(noise.methods[0].legs)
        for k, method in enumerate(noise.methods)
    ]


def _by_leg_and_method(
    noise: DatasetNoise, title: str, columns: list[str], rows: list[list[str | Text]]
) -> Table:
    longest = max(len(leg.name) for leg in noise.methods[0].legs)
    names = ("leg", "method", *(f">{column}" for column in columns))
    return table(*names, rows=rows, title=title, least={0: min(longest, _MIN_NAME), 1: 8})


def _axis_table(noise: DatasetNoise, title: str, columns: dict[str, str]) -> Table:
    """Return pooled standard deviations of some quantities, and their upper bounds."""
    rows: list[list[str | Text]] = []
    for name, method, leg in _rows(noise):
        none = "no M_LS" if leg.without_M_LS else "-"
        cells = [_value(leg.spread(q), q, lambda s: s.sd, none) for q in columns]
        rows.append([name, CALLED[method.name], *cells, f"{leg.axes}/{leg.images}"])
        if method.name == _CLAIMING:
            cells = [_value(leg.spread(q), q, lambda s: s.claimed) for q in columns]
            rows.append([Text(cell, style="dim") for cell in ("", " claims", *cells, "")])
    of_all: dict[str, Callable[[PooledSpread], float]] = {
        "median": lambda s: s.median,
        "upper bound": lambda s: s.largest,
    }
    for what, of in of_all.items():
        for k, method in enumerate(noise.methods):
            cells = [_value(method.spread(q), q, of) for q in columns]
            rows.append([what if k == 0 else "", CALLED[method.name], *cells, ""])
    return _by_leg_and_method(noise, title, [*columns.values(), "images"], rows)


def _outline_table(noise: DatasetNoise) -> Table:
    """Return the spread of outlines beside what is claimed of them."""
    rows: list[list[str | Text]] = []
    for name, method, leg in _rows(noise):
        shown = sum(o.outlines for o in leg.orientations)
        missed = shown - sum(o.outlines_found for o in leg.orientations)
        cells = _outline_cells(leg.spread(OUTLINE))
        rows.append([name, CALLED[method.name], *cells, f"{missed}/{shown}"])
    for k, method in enumerate(noise.methods):
        cells = _outline_cells(method.spread(OUTLINE))
        rows.append(["all" if k == 0 else "", CALLED[method.name], *cells, ""])
    columns = ["spread", "claimed", "ratio", "(95 %)", "median", "largest", "missed"]
    return _by_leg_and_method(noise, "Outlines, offsets at both ends [px]", columns, rows)


def _outline_cells(spread: PooledSpread | None) -> list[str]:
    """Return spread, claim, ratio with its range, the median and the largest."""
    if spread is None:
        return ["-"] * 6
    return [
        f"{spread.sd:.4f}",
        f"{spread.claimed:.4f}",
        f"{spread.ratio:.2f}",
        f"{spread.ratio_low:.2f} to {spread.ratio_high:.2f}",
        f"{spread.median:.4f}",
        f"{spread.largest:.4f}",
    ]


def _value(
    spread: PooledSpread | None, quantity: str, of: Callable[[PooledSpread], float], none: str = "-"
) -> str:
    """Return a standard deviation in degrees or millimetres with three digits."""
    if spread is None:
        return none
    value = degrees(of(spread)) if quantity in ANGLES else 1e3 * of(spread)
    return f"{float(f'{value:.3g}'):.12g}"
