"""The tables of ``legcal noise``: Table 1, the errors by direction, and the outlines."""

import math
from collections.abc import Callable, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.repeatability.quantities import ANGLES, QUANTITIES
from legcal.repeatability.result import CALLED, OUTLINE, LegNoise, MethodNoise, Noise
from legcal.repeatability.spread import Spread

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


def _table(noise: Noise, title: str, columns: Sequence[str]) -> Table:
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
    table = _table(noise, title, [*columns.values(), "images"])
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
    table = _table(noise, "Outlines, offsets at both ends [px]", columns)
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
