"""What the model says of the legs of one picture, without a camera: pieces of cylinders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.detection.pieces import visible_pieces
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import Cylinder


@dataclass(frozen=True, eq=False)
class Targets:
    """The visible pieces of all legs at the reading of a picture.

    Attributes
    ----------
    leg : (n,) array of int
        The leg of each piece.
    ends : (n, 2, 3) array
        Both ends of its axis in the base link, the first nearer to the base joint [m].
    place : (n, 2) array
        Where these ends are along the leg, 0 at A and 1 at B.
    radius : (n,) array
        Its radius [m].
    share : (n,) array
        Its part of the visible length of its leg.
    """

    leg: IntArray
    ends: Array
    place: Array
    radius: Array
    share: Array

    def __len__(self) -> int:
        """Return the number of pieces."""
        return len(self.leg)


def targets_of(
    A_base: Array, B_base: Array, cylinders: Sequence[Sequence[Cylinder]], legs: IntArray
) -> Targets:
    """Return the pieces of some legs.

    Parameters
    ----------
    A_base, B_base : (n_legs, 3) array
        Joint centres at the reading of the picture, in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs.
    legs : (m,) array of int
        The legs to look for.
    """
    leg, place, ends, radius, share = [], [], [], [], []
    for j in legs.tolist():
        AB = B_base[j] - A_base[j]
        length = float(np.linalg.norm(AB))
        pieces = visible_pieces(cylinders[j], length)
        total = sum(piece.end - piece.start for piece in pieces)
        for piece in pieces:
            leg.append(j)
            place.append((piece.start / length, piece.end / length))
            ends.append(A_base[j] + np.outer(place[-1], AB))
            radius.append(piece.radius)
            share.append((piece.end - piece.start) / total)
    return Targets(
        np.array(leg, dtype=np.intp),
        np.array(ends).reshape(-1, 2, 3),
        np.array(place).reshape(-1, 2),
        np.array(radius),
        np.array(share),
    )
