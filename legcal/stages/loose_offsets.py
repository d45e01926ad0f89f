"""Offsets that no distance between leg ends fixes, and what is seen of their legs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import IntArray
from legcal.stages.leg_directions import LegDirections
from legcal.stages.nominal import NominalMechanism
from legcal.stages.solution import Solution


def check_any(found: Sequence[object], missing: str) -> None:
    """Refuse an empty criterion; *missing* says what there is none of."""
    if not found:
        raise NotIdentifiable(
            f"The offsets could not be identified: no {missing}; needed images at different poses "
            "that show several legs at once; add such images."
        )


def check_identifiable(
    mechanism: NominalMechanism,
    directions: LegDirections,
    pairs: IntArray,
    solution: Solution,
    largest_sigma: float = np.inf,
) -> None:
    """Refuse when an offset can change without any distance noticing."""
    with_offset = np.flatnonzero(np.isfinite(mechanism.parameters.offsets))
    loose = solution.unseen(len(with_offset))
    if np.isfinite(largest_sigma):
        sigma = np.sqrt(np.diag(solution.covariance())[: len(with_offset)])
        loose |= sigma > largest_sigma
    loose &= ~mechanism.on_platform[with_offset]
    if not loose.any():
        return
    reasons = [
        f"{mechanism.leg_names[int(j)]} {_why_loose(directions, pairs, int(j))}"
        for j in with_offset[loose]
    ]
    names = ", ".join(mechanism.leg_names[int(j)] for j in with_offset[loose])
    raise NotIdentifiable(
        f"The offsets could not be identified: no distance between leg ends fixes that of "
        f"{names} ({'; '.join(reasons)}); needed each leg in images of at least three different "
        "poses together with other legs that end elsewhere on the platform and turn against it; "
        "add images that show several legs at once."
    )


def _why_loose(directions: LegDirections, pairs: IntArray, leg: int) -> str:
    """Return what is seen of a leg whose offset nothing fixes."""
    mine = pairs[np.any(directions.leg[pairs] == leg, axis=1)]
    n_poses = len(np.unique(directions.group[mine[:, 0]]))
    if n_poses == 0:
        return "is in no image together with a leg that ends elsewhere on the platform"
    if n_poses < 3:
        return f"is together with others in {n_poses} pose{'s' if n_poses > 1 else ''}"
    return f"hardly turns against the legs that are seen with it in {n_poses} poses"
