"""Views of a camera that is held in the hand: every image is a camera position of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.dataset.entry import ViewEntry
from legcal.observations.measurements import Measurements, View


def hand_held_problems(path: Path, views: Mapping[str, ViewEntry], *, has_board: bool) -> list[str]:
    """Return what keeps views from being hand-held.

    Parameters
    ----------
    path : Path
        ``dataset.yaml``.
    views : mapping of str to ViewEntry
        Its views.
    has_board : bool
        Whether it describes a calibration board.
    """
    held = {name: view for name, view in views.items() if view.hand_held}
    problems = [
        f"{path}: views.{name}.hand_held could not be used: found no board, needed a calibration "
        "board on the base in every image of a camera that is held in the hand; describe it in "
        "the block board."
        for name in held
        if not has_board
    ]
    problems += [
        f"{path}: views.{name}.T_base_camera could not be used: found one pose of a camera that is "
        "held in the hand, needed none, the board tells the pose of every image; remove it."
        for name, view in held.items()
        if view.T_base_camera is not None
    ]
    return problems


def expand_hand_held(
    path: Path, measurements: Measurements, views: Mapping[str, ViewEntry]
) -> tuple[Measurements, tuple[int, ...], list[str]]:
    """Give every image of a hand-held view a view of its own: NAME-1, NAME-2, ... by rows.

    Parameters
    ----------
    path : Path
        ``dataset.yaml``, for messages.
    measurements : Measurements
        The rows, with the views of the file.
    views : mapping of str to ViewEntry
        Those views.

    Returns
    -------
    measurements : Measurements
        With the new views in the places of the old ones.
    origin : tuple of int
        The view of the file that each new view comes from.
    problems : list of str
        Names that the file has given to other views.
    """
    new: list[View] = []
    origin: list[int] = []
    problems: list[str] = []
    index = np.zeros_like(measurements.view)
    for v, (name, entry) in enumerate(views.items()):
        rows = np.flatnonzero(measurements.view == v)
        if not entry.hand_held:
            index[rows] = len(new)
            new.append(measurements.views[v])
            origin.append(v)
            continue
        for k, row in enumerate(rows.tolist(), start=1):
            index[row] = len(new)
            new.append(replace(measurements.views[v], name=f"{name}-{k}", hand_held=True))
            origin.append(v)
        taken = [f"{name}-{k + 1}" for k in range(len(rows)) if f"{name}-{k + 1}" in views]
        problems += [
            f"{path}: views.{other} could not be used: found the name that an image of the "
            f"hand-held view {name} gets, needed another; rename it."
            for other in taken
        ]
    return replace(measurements, views=tuple(new), view=index), tuple(origin), problems
