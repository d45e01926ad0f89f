"""The table of ``legcal inspect``: a mechanism as found, on 80 columns."""

import math
from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text


def inspect_table(description: dict[str, Any]) -> RenderableType:
    """Return a mechanism's description as people read it, lengths in millimetres.

    Parameters
    ----------
    description : dict
        The document of :func:`legcal.mechanism.inspect.describe`.
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
