"""The legs in their order around the base: neighbours are what one camera sees together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.identify.session import Session


def legs_around(session: Session) -> list[int]:
    """Return the legs in their order around the base."""
    points = session.A + (session.arm + session.t[:, None]).mean(axis=0)
    centred = points - points.mean(axis=0)
    _, _, basis = np.linalg.svd(session.A - session.A.mean(axis=0))
    angle = np.arctan2(centred @ basis[1], centred @ basis[0])
    return [int(j) for j in np.argsort(angle, kind="stable")]


def neighbours(ring: Sequence[int], size: int) -> list[tuple[int, ...]]:
    """Return all groups of so many neighbours, (size,) each, in the order of the legs."""
    n = len(ring)
    groups = (
        tuple(sorted(ring[(start + k) % n] for k in range(min(size, n)))) for start in range(n)
    )
    return list(dict.fromkeys(groups))


def steps_apart(ring: Sequence[int], leg: int, others: Sequence[int]) -> int:
    """Return how many places around the base a leg is from the nearest of others."""
    place = {j: k for k, j in enumerate(ring)}
    steps = (abs(place[leg] - place[other]) for other in others)
    return min((min(s, len(ring) - s) for s in steps), default=0)
