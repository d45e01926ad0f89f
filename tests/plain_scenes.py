"""Scenes in which nothing is hidden, for sessions in memory."""

from collections.abc import Mapping, Sequence

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.simulation.observe import Scene
from legcal.simulation.visibility import Images, LegView, Stretch, Viewpoint


def plain_scene(
    A: Array,  # (n_poses, n_legs, 3)
    B: Array,
    views: Sequence[Viewpoint],
    view: IntArray,  # (n_rows,) view and pose of each image
    pose: IntArray,
    radii: Mapping[tuple[int, str], float],  # of each (leg, part) [m]
    seen: Sequence[Sequence[int]] | None = None,  # legs of each row; None for all
    span: tuple[float, float] = (0.15, 0.85),  # of the length of a leg that is seen
    arms: Mapping[tuple[int, str], Array] | None = None,  # which parts are arms: their ends
) -> Scene:
    """Return a scene in which nothing is hidden: images show legs over one part of their length."""
    length, arms = np.linalg.norm(B - A, axis=-1), arms or {}
    shown = []
    for row, k in enumerate(pose.tolist()):
        stretches: list[list[Stretch]] = [[] for _ in length[k]]
        of_arms: list[Stretch | None] = [None for _ in length[k]]
        for (j, part), radius in radii.items():
            if seen is not None and j not in seen[row]:
                continue
            whole = length[k, j]
            if (j, part) in arms:
                whole = np.linalg.norm(np.diff(arms[j, part][k], axis=0))
            start, end = (float(part_of * whole) for part_of in span)
            stretch = Stretch(j, part, radius, start, end)
            if (j, part) in arms:
                of_arms[j] = stretch
            else:
                stretches[j].append(stretch)
        shown.append(
            tuple(
                LegView((span[1] - span[0]) * bool(s), 0.0, tuple(s), arm)
                for s, arm in zip(stretches, of_arms, strict=True)
            )
        )
    images = Images(view, pose, np.zeros(len(view), dtype=np.intp), tuple(shown))
    return Scene(A, B, tuple(views), images, {j: ends for (j, _), ends in arms.items()})
