"""Which pieces of a leg's cylinders a camera can see.

Where coaxial cylinders overlap the thicker one is seen; equally thick ones (a telescope drawn
as two cylinders of one radius) look like one. The ends of a leg are covered by balls, forks and
sockets that no model gives the size of, so the outlines are looked for away from the joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from legcal.mechanism.leg import Cylinder, main_cylinders

EQUAL_RADII = 0.01  # relative difference below which two cylinders look like one
END_COVER = 2.0  # length that may be hidden at a joint and beside a thicker cylinder, in radii


@dataclass(frozen=True)
class Piece:
    """A visible stretch of one cylinder of a leg.

    Attributes
    ----------
    link : str
        The URDF link that names the part.
    radius : float
        Radius [m].
    start, end : float
        Distances from A along the leg between which its outline is looked for [m].
    """

    link: str
    radius: float
    start: float
    end: float


def visible_pieces(cylinders: Sequence[Cylinder], length: float) -> tuple[Piece, ...]:
    """Return the visible piece of every part of a leg, from base to platform.

    Parameters
    ----------
    cylinders : sequence of Cylinder
        What the model knows of the leg.
    length : float
        Leg length AB [m].

    Returns
    -------
    tuple of Piece
        One for each part with something left to see: its longest stretch that no thicker
        cylinder covers, shortened at the joints and beside thicker cylinders. Cylinders of
        equal radius that touch or overlap are one part, named by the longest of them. Of
        several cylinders of one link the longest is the part; the others only hide.
    """
    main = main_cylinders(cylinders)
    parts = _merge_equal(cylinders, length)
    pieces = []
    for link, radius, start, end in parts:
        cover = END_COVER * radius
        stretches = [(max(start, cover), min(end, length - cover))]
        for _, thicker, first, last in parts:
            if thicker > radius:
                gap = END_COVER * thicker
                stretches = [
                    stretch
                    for low, high in stretches
                    for stretch in ((low, min(high, first - gap)), (max(low, last + gap), high))
                ]
        low, high = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
        if high > low and _look_alike(radius, main[link].radius):
            pieces.append(Piece(link, radius, low, high))
    return tuple(sorted(pieces, key=lambda piece: (piece.start, piece.link)))


def _merge_equal(
    cylinders: Sequence[Cylinder], length: float
) -> list[tuple[str, float, float, float]]:
    """Return spans (link, radius, start, end) of cylinders, those of equal radius joined."""
    spans = [((c.end - c.start, c.link), c.radius, *c.span(length)) for c in cylinders]
    merged: list[tuple[tuple[float, str], float, float, float]] = []
    for name, radius, start, end in sorted(spans, key=lambda span: (span[2], span[3], span[0])):
        for i, (other_name, other, low, high) in enumerate(merged):
            if _look_alike(radius, other) and start <= high + radius:
                longest = max(name, other_name)  # of equal lengths the later name, in any pose
                merged[i] = (longest, max(radius, other), low, max(high, end))
                break
        else:
            merged.append((name, radius, start, end))
    return [(link, radius, start, end) for (_, link), radius, start, end in merged]


def _look_alike(one: float, two: float) -> bool:
    """Say whether two radii are too near to show a step."""
    return abs(one - two) <= EQUAL_RADII * max(one, two)
