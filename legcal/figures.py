"""Matplotlib figures for users, and foreign names in them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from legcal.errors import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@contextmanager
def new_figure(
    n_panels: int, columns: int, panel: tuple[float, float]
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure with panels in rows, each of a width and height in inches.

    It is laid out at the end. Pyplot has closed it: a notebook shows it once, no window opens, and
    it does not stay in memory.
    """
    from matplotlib import pyplot

    columns = max(min(n_panels, columns), 1)
    rows = max(-(-n_panels // columns), 1)
    with pyplot.ioff():
        size = (panel[0] * columns, panel[1] * rows)
        figure, axes = pyplot.subplots(rows, columns, figsize=size, squeeze=False)
        pyplot.close(figure)
    for unused in axes.flat[n_panels:]:
        unused.set_visible(False)
    yield figure, list(axes.flat)
    figure.tight_layout()


def plain(text: str) -> str:
    """Escape a name for a figure, so that a dollar sign does not begin a formula."""
    return printable(text).replace("$", r"\$")
