"""What ``legcal simulate`` tells about the dataset that it wrote."""

from __future__ import annotations

import shlex
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.simulation.settings import Level
from legcal.simulation.simulate import SimulatedDataset


def summary_document(made: SimulatedDataset) -> dict[str, Any]:
    """Return the document of ``legcal simulate --json``.

    Parameters
    ----------
    made : SimulatedDataset
        The dataset.
    """
    views = {}
    for v, view in enumerate(made.measurements.views):
        rows = made.measurements.view == v
        seen = made.seen[rows].sum(axis=0).tolist()
        legs = dict(zip(made.nominal.leg_names, seen, strict=True))
        views[view.name] = {"images": int(np.sum(rows)), "legs": legs}
    return {
        "dataset": str(made.folder),
        "level": made.level.value,
        "mechanism": made.nominal.name,
        "truth": str(made.truth_path),
        "images": made.measurements.n_rows,
        "poses": made.measurements.n_poses,
        "extreme_poses": made.n_extreme,
        "left_out": made.left_out,
        "views": views,
    }


def summary_table(made: SimulatedDataset) -> RenderableType:
    """Return what was simulated as people read it: how many images of a view show each leg."""
    document = summary_document(made)
    size = f"{_count(document['images'], 'image')} of {_count(document['poses'], 'pose')}"
    heading = Text.assemble((document["mechanism"], "bold"), f": {document['level']}, {size}")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("view", overflow="fold")
    table.add_column("images", justify="right")
    for name in made.nominal.leg_names:
        table.add_column(Text(name), justify="right")
    for name, view in document["views"].items():
        counts = [str(n) for n in view["legs"].values()]
        table.add_row(Text(name), str(view["images"]), *counts)
    folder = shlex.quote(str(made.folder))
    lines = [
        "Images of each view that show 40 % of a leg or more in one piece.",
        *([_left_out(made.left_out)] if made.left_out else []),
        f"{made.n_extreme} of {made.measurements.n_poses} poses have every motor near an end of "
        "its travel.",
        f"\nwritten: {made.folder}",
        f"the true model: {made.truth_path}",
        f"calibrate with: legcal calibrate {folder} -o OUT",
        f"judge with: legcal evaluate OUT/calibrated.yaml {shlex.quote(str(made.truth_path))}",
        *([f"measure noise with: legcal noise {folder}"] if _is_repeated(made) else []),
    ]
    return Group(heading, Text(), table, Text(), *(Text(s, overflow="fold") for s in lines))


def _is_repeated(made: SimulatedDataset) -> bool:
    """Say whether there are several photographs of a pose in a view."""
    m = made.measurements
    places = set(zip(m.view.tolist(), m.pose.tolist(), strict=True))
    return made.level is Level.PHOTOGRAPHS and len(places) < m.n_rows


def _left_out(n: int) -> str:
    """Return how many images are left out, in words."""
    return (
        "1 image shows no leg and is left out."
        if n == 1
        else f"{n} images show no leg and are left out."
    )


def _count(n: int, what: str) -> str:
    """Return a number of things."""
    return f"{n} {what}{'s' * (n != 1)}"
