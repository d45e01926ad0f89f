"""Common mistakes of measured poses (units, mirrored axes, orders), tried one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.calibration.location.frames import PosePairs
from legcal.calibration.location.search import search
from legcal.geometry import Array

BETTER = 10.0  # times
CLEAR = 0.01  # of the spread of positions: what is left then asks for no other mistake
ROWS = 12  # that mistakes are tried on
SUBSETS = 8  # starts from a few of them
_LENGTHS = (
    (1e-3, "millimetres", "divide x, y and z by 1000"),
    (1e-2, "centimetres", "divide x, y and z by 100"),
    (0.0254, "inches", "multiply x, y and z by 0.0254"),
)
_MIRRORS = (
    ("x reversed", np.diag([-1.0, 1.0, 1.0])),
    ("y reversed", np.diag([1.0, -1.0, 1.0])),
    ("z reversed", np.diag([1.0, 1.0, -1.0])),
    ("x and y swapped", np.eye(3)[[1, 0, 2]]),
    ("y and z swapped", np.eye(3)[[0, 2, 1]]),
    ("x and z swapped", np.eye(3)[[2, 1, 0]]),
)


def likely_mistake(
    pairs: PosePairs,
    cost: float,  # of the best candidate for them
    fewest: int,  # rows that determine the frames
) -> tuple[str, str] | None:
    """Return what the poses look like and what to do, or None."""
    best, found = cost / _spread(pairs) / BETTER**2, None
    few = pairs.of(np.linspace(0, len(pairs) - 1, min(len(pairs), ROWS)).astype(np.intp))
    for changed, looks_like, remedy in _alternatives(few):
        other = float(search(changed, fewest, subsets=SUBSETS).cost[0]) / _spread(changed)
        if other < best:
            best, found = other / BETTER**2, (looks_like, remedy)
            if other < CLEAR**2:
                break
    return found


def _spread(pairs: PosePairs) -> float:
    """Return how far positions are apart, squared, in units of ``pairs.length``."""
    return float(pairs.p.var(axis=0).sum()) / pairs.length**2 + 1e-300


def _alternatives(pairs: PosePairs) -> Iterator[tuple[PosePairs, str, str]]:
    """Yield the poses with each mistake undone, what they look like with it, and what to do."""
    has_orientations = bool(pairs.oriented.any())
    reordered = _reordered(pairs.M)
    wrong_order = "quaternions in the order w, x, y, z", "write qx, qy, qz, qw under their names"
    for size, unit, remedy in _LENGTHS:
        metres = replace(pairs, p=size * pairs.p)
        yield metres, f"positions in {unit}", remedy
        if has_orientations:
            both = replace(metres, M=reordered)
            yield (
                both,
                f"positions in {unit} and {wrong_order[0]}",
                f"{remedy}, and {wrong_order[1]}",
            )
    mirror = _MIRRORS[2][1]
    name = "left-handed axes, a mirror image", "give poses in right-handed axes"
    yield replace(pairs, p=pairs.p @ mirror, M=mirror @ pairs.M @ mirror), *name
    if not has_orientations:
        return
    yield replace(pairs, M=reordered), *wrong_order
    back = np.swapaxes(pairs.M, 1, 2)
    inverse = "the orientation of the world in the tool", "invert the quaternions"
    yield replace(pairs, M=back), *inverse
    world = replace(pairs, M=back, p=-np.einsum("nij,nj->ni", back, pairs.p))
    yield world, "poses of the world in the tool", "give those of the tool in the world"
    for words, S in _MIRRORS:
        yield (
            replace(pairs, p=pairs.p @ S.T),
            f"positions along left-handed axes ({words})",
            "give positions and orientations along the same right-handed axes",
        )


def _reordered(M: Array) -> Array:
    """Return orientations whose quaternions were read as x, y, z, w and are w, x, y, z."""
    quaternions = Rotation.from_matrix(M).as_quat()
    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
