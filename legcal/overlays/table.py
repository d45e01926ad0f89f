"""What ``legcal detect`` prints: the figures of every view, and what was rejected why."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from legcal.overlays.folder import PAGE

_COLUMNS = ("images", "legs found", "outlines used", "contrast", "length", "residual")


def detection_table(document: dict[str, Any], output: Path) -> RenderableType:
    """Return the figures of a detection as people read them.

    Parameters
    ----------
    document : dict
        Of :func:`legcal.overlays.folder.detection_document`.
    output : Path
        Where it was written.
    """
    views = document["views"]
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("view", overflow="fold")
    for column in _COLUMNS:
        table.add_column(column, justify="right")
    for name, view in views.items():
        table.add_row(
            Text(name),
            str(view["images"]),
            f"{view['legs_found']}/{view['legs_visible']}",
            f"{view['used']}/{view['outlines']}",
            *(
                "-" if view[key] is None else f"{view[key]:.{digits}f}{unit}"
                for key, digits, unit in (
                    ("contrast", 0, ""),
                    ("length", 0, " px"),
                    ("residual", 2, " px"),
                )
            ),
        )
    rejected: Counter[str] = Counter()
    for view in views.values():
        rejected.update(view["rejected"])
    heading = Text.assemble(
        (document["mechanism"], "bold"),
        f": {document['used']} of {document['outlines']} outlines used in "
        f"{document['images']} images",
    )
    lines: list[RenderableType] = [heading, Text(), table, Text()]
    if rejected:
        told = ", ".join(f"{n} {why}" for why, n in rejected.most_common())
        lines += [Text(f"Not used: {told}."), Text()]
    lines += [Text(view["problem"], style="red") for view in views.values() if view["problem"]]
    lines += [Text(f"note: {note}", style="dim") for note in document["notes"]]
    return Group(*lines, Text(f"Look at {output / PAGE}."))
