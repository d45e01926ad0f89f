"""How far apart two methods put the same outlines: the part of their bias that repeats hide."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.observations.sets import outline_keys
from legcal.repeatability.repeats import Repeats
from legcal.vision.cylinder import EPSILON


@dataclass(frozen=True, eq=False)
class Difference:
    """Where one outline of a leg lies by a second method, against a first.

    Attributes
    ----------
    leg : str
        The leg.
    outward : (2,) array
        Mean over repeats, at both ends: how far the second line lies outside the first [px].
    """

    leg: str
    outward: Array


def outline_differences(
    first: Outlines,
    second: Outlines,
    measurements: Measurements,
    repeats: Sequence[Repeats],
    leg_names: Sequence[str],
) -> list[Difference]:
    """Return the mean differences of all outlines that both methods found.

    Parameters
    ----------
    first, second : Outlines
        Outlines of the same images by both methods.
    measurements : Measurements
        The rows.
    repeats : sequence of Repeats
        The images over which differences are averaged.
    leg_names : sequence of str
        The legs, in the order of the measurements.
    """
    group_of = {row: k for k, group in enumerate(repeats) for row in group.rows.tolist()}
    place = {key: i for i, key in enumerate(outline_keys(second)) if second.used[i]}
    found: dict[tuple[int, int, str, int], list[Array]] = {}
    for i, (row, leg, part, edge) in enumerate(outline_keys(first)):
        j = place.get((row, leg, part, edge))
        if j is None or not first.used[i]:
            continue
        camera = measurements.views[int(measurements.view[row])].camera
        # Positive inside the second line, which then lies outside the first.
        h = np.broadcast_to(second.h[j], (2, 3))
        offset = EPSILON[edge - 1] * camera.line_offset(h, camera.undistort(first.ends[i]))
        found.setdefault((group_of[row], leg, part, edge), []).append(offset)
    return [
        Difference(leg_names[leg], np.asarray(np.mean(offsets, axis=0)))
        for (_, leg, _, _), offsets in sorted(found.items(), key=lambda item: item[0])
    ]
