"""Which pieces of a leg's cylinders a camera can see.

Where coaxial cylinders overlap the thicker one is seen; equally thick ones (a telescope drawn
as two cylinders of one radius) look like one. The ends of a leg are covered by balls, forks and
sockets that no model gives the size of, so the outlines are looked for away from the joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from legcal.mechanism.leg import Cylinder

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
        equal radius that touch or overlap are one part, named by the longest of them.
    """
    parts = _merge_equal([(c.link, c.radius, *c.span(length)) for c in cylinders])
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
        if high > low:
            pieces.append(Piece(link, radius, low, high))
    return tuple(sorted(pieces, key=lambda piece: (piece.start, piece.link)))


def _merge_equal(
    spans: list[tuple[str, float, float, float]],
) -> list[tuple[str, float, float, float]]:
    """Join spans (link, radius, start, end) of equal radius that touch."""
    merged: list[tuple[str, float, float, float]] = []
    longest: list[float] = []
    for link, radius, start, end in sorted(spans, key=lambda span: (span[2], span[3], span[0])):
        for i, (name, other, low, high) in enumerate(merged):
            equal = abs(radius - other) <= EQUAL_RADII * max(radius, other)
            if equal and start <= high + radius:
                name = link if end - start > longest[i] else name
                longest[i] = max(longest[i], end - start)
                merged[i] = (name, max(radius, other), low, max(high, end))
                break
        else:
            merged.append((link, radius, start, end))
            longest.append(end - start)
    return merged
