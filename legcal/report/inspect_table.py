"""The table of ``legcal inspect``: a mechanism as found, on 80 columns."""

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
    heading = Text.assemble(
        (description["name"], "bold"),
        f": {'spatial' if description['spatial'] else 'planar'}, {len(description['legs'])} legs, "
        f"mobility {mobility}, {motors} motors ({verdict})",
    )
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("leg", overflow="fold")
    table.add_column("type")
    table.add_column(r"A in base \[mm]", justify="right", no_wrap=True)
    table.add_column(r"B in platform \[mm]", justify="right", no_wrap=True)
    table.add_column(r"q0 \[mm]", justify="right", no_wrap=True)
    table.add_column(r"R \[mm]", justify="right")
    for leg in description["legs"]:
        radii = dict.fromkeys(f"{1e3 * c['radius']:.4g}" for c in leg["cylinders"])
        kind = "" if leg["actuated"] else f" {leg['kind']}"
        sign = "" if leg["sign"] > 0 else "-q"
        table.add_row(
            leg["name"],
            Text(f"{leg['type']}{kind}"),
            _point(leg["A"]),
            _point(leg["B"]),
            f"{sign}{1e3 * leg['q0']:{'+' if sign else ''}.3f}",
            ", ".join(radii) or "none",
        )
    notes = [Text(f"note: {note}") for note in description["diagnostics"]]
    legend = Text(
        f"R_b and R_e stand on the joints of {description['n_d']} legs. Leg length L = q + q0"
        + (" (-q where shown)." if any(leg["sign"] < 0 for leg in description["legs"]) else "."),
        style="dim",
    )
    return Group(heading, Text(), table, Text(), legend, *notes)


def _point(xyz: Sequence[float]) -> str:
    """Return a point in millimetres, signs and decimals aligned."""
    return " ".join(f"{1e3 * x + 0.0:7.1f}" for x in xyz)
