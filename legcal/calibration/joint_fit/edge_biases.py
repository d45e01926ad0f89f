"""Common-mode edge biases: which errors outlines may share, and how large, by the residuals.

Shading moves an edge of a leg alike in all images of a camera, a little differently where the leg
stands elsewhere in the image; blur moves many edges. Such errors do not average out over images.
So groups of outlines have unknown biases, random with variances that restricted maximum
likelihood finds in the residuals. Where these are white there are none.

Biases that move both edges of a leg inwards show in the residuals, and depth and radius take
them up. Those that move a leg sideways hardly show, since the fit follows, and they are what moves
joints. What shows must therefore say how large both are. If edges erred independently, both
variances would be equal; light from one side makes one edge of a leg brighter and the other
darker, and sideways biases count twice (:data:`SIDEWAYS`).

Where the gamma of a camera is not told, its outlines move together, each by its own amount, with
the logarithm of that gamma over the one with which they were measured
(``gammas.py``). How far that may be off is known beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.calibration.joint_fit.observations import ObservedOutlines
from legcal.estimation import Effects, estimate_variances
from legcal.geometry import Array, IntArray

KINDS = (
    "bias of many edges",
    "tilt of many edges",
    "bias of a leg in a view",
    "tilt of a leg in a view",
    "change of that bias over the image",
    "change of that tilt over the image",
)
GAMMA, GAMMA_SUFFIX = len(KINDS), ".gamma"  # one more kind, and the end of the names of its shifts
N_KINDS = len(KINDS) + 1
GAMMA_SIGMA = 0.5  # of the logarithm: photographs are linear, or near 2.2
SIDEWAYS = np.sqrt(2.0)  # standard deviation of sideways biases, those inwards being one
_LEAST_GAIN = 25.0  # of white residuals, one set in 20,000 gains that much
_MODES = (("bias", (1.0, 1.0)), ("tilt", (-1.0, 1.0)))  # shifts of both ends


@dataclass(frozen=True, eq=False)
class EdgeBiases:
    """Biases that outlines share, random with known variances.

    Their names: ``all.bias``; ``c1.tilt`` of a view; ``leg1.rod.bias`` of a part;
    ``c1.leg1.rod.inward.bias`` of both edges of a part in a view, ``c1.leg1.rod.sideways.bias``
    and, for how it changes along x of the image, ``c1.leg1.rod.sideways.bias_x``; ``c1.gamma``
    of a camera whose gamma is not told.
    """

    names: tuple[str, ...]  # b of them
    kind: IntArray  # (b,) among ``KINDS``, then ``GAMMA``
    sigma: Array  # (N_KINDS,) standard deviation of each kind [px], and of ln gamma
    index: IntArray  # (n, c) which of them each outline has a part in
    shift: Array  # (n, c, 2) how one unit of each moves both ends along the line's normal [px]

    @property
    def sigmas(self) -> Array:
        """Standard deviation of each bias [px, or none], (b,)."""
        return np.asarray(self.sigma[self.kind])

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each, ``px`` or none, b of them."""
        return tuple("" if kind == GAMMA else "px" for kind in self.kind.tolist())

    @property
    def sizes(self) -> dict[str, float]:
        """Standard deviation of each of ``KINDS`` [px], by its name; empty without such biases."""
        sigma = self.sigma[: len(KINDS)].tolist()
        return dict(zip(KINDS, sigma, strict=True)) if np.any(self.kind != GAMMA) else {}

    def __len__(self) -> int:
        return len(self.names)

    def of_sizes(self, sigma: Array) -> EdgeBiases:
        """Return biases with these standard deviations, without those where it is zero."""
        kept = sigma[self.kind] > 0.0
        number = np.cumsum(kept) - 1
        columns = kept[self.index].all(axis=0)  # all biases of a column are of one kind
        return EdgeBiases(
            tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept),
            self.kind[kept],
            sigma,
            number[self.index[:, columns]],
            self.shift[:, columns],
        )


def possible_biases(
    outlines: ObservedOutlines,
    leg_names: Sequence[str],
    fitted: ObservedOutlines | None = None,
) -> EdgeBiases:
    """Return all biases that outlines may share, with a standard deviation of one unit.

    Biases of many edges are inward; those of one part in a view are inward and sideways and
    change along x and y of the image, by one unit over the spread of places in all groups: those of
    the outlines *fitted* to, if not these themselves.
    """
    o = outlines
    parts = [f"{leg_names[leg]}.{part}" for leg, part in o.parts]
    known = o if fitted is None else fitted
    view = known.series[o.view]
    found, group = np.unique(np.column_stack([view, o.radius]), axis=0, return_inverse=True)
    group = group.ravel()
    inward, sideways = o.epsilon, np.full(len(o), SIDEWAYS)
    x, y = _places_in_groups(o, known).T
    together = [f"{o.views[v]}.{parts[p]}.inward" for v, p in found.tolist()]
    aside = [f"{o.views[v]}.{parts[p]}.sideways" for v, p in found.tolist()]
    levels = [
        (("all",), np.zeros(len(o), dtype=np.intp), inward, "", 0),
        (o.views, view, inward, "", 0),
        (parts, o.radius, inward, "", 0),
        (together, group, inward, "", 2),
        (aside, group, sideways, "", 2),
        (together, group, inward * x, "_x", 4),
        (aside, group, sideways * x, "_x", 4),
        (together, group, inward * y, "_y", 4),
        (aside, group, sideways * y, "_y", 4),
    ]
    names: list[str] = []
    kind, index, shift = [], [], []
    for owners, member, weight, suffix, first_kind in levels:
        for mode, (name, ends) in enumerate(_MODES):
            index.append(member + len(names))
            shift.append(weight[:, None] * np.array(ends))
            names += [f"{owner}.{name}{suffix}" for owner in owners]
            kind += [first_kind + mode] * len(owners)
    cameras = sorted({o.cameras[v] for v in o.view[o.by_gamma != 0.0].tolist()})
    if cameras:
        of_view = np.array([cameras.index(c) if c in cameras else 0 for c in o.cameras])
        index.append(of_view[o.view] + len(names))
        # Outlines that were measured with too small a gamma lie off by what a greater one moves.
        shift.append(np.repeat((-o.epsilon * o.by_gamma)[:, None], 2, axis=1))
        names += [f"{camera}{GAMMA_SUFFIX}" for camera in cameras]
        kind += [GAMMA] * len(cameras)
    return EdgeBiases(
        tuple(names),
        np.array(kind),
        np.ones(N_KINDS),
        np.stack(index, axis=1),
        np.stack(shift, axis=1),
    )


def estimated_biases(
    possible: EdgeBiases, z: Array, K: Array, least: Array | float = 0.0
) -> EdgeBiases:
    """Return the biases that the residuals show: none at all where they are white.

    *z* (b,) and *K* (b, b) are scores of all of them and their covariance (:class:`Effects`);
    *least* (N_KINDS,) are standard deviations known from elsewhere, where the residuals show less
    [px]. That of a gamma is known, whatever the residuals show.
    """
    sigma = np.zeros(N_KINDS)
    variances, _ = estimate_variances(Effects(z, K, possible.kind), _LEAST_GAIN)
    sigma[: len(variances)] = np.sqrt(variances)
    return possible.of_sizes(with_gamma(np.maximum(sigma, least)))


def with_gamma(sigma: Array) -> Array:
    """Return standard deviations (N_KINDS,) with that of the logarithm of a gamma."""
    return np.append(sigma[:GAMMA], GAMMA_SIGMA)


def _places_in_groups(outlines: ObservedOutlines, others: ObservedOutlines) -> Array:
    """Return places (n, 2) from the middle of others of the group, over the spread of all these.

    Where a group has no others, places count as their middle.
    """
    n_parts = len(outlines.parts)
    group, of_others = (others.series[o.view] * n_parts + o.radius for o in (outlines, others))
    places = others.pixels.mean(axis=1)
    counts = np.bincount(of_others, minlength=len(others.views) * n_parts)
    sums = [np.bincount(of_others, weights=x, minlength=len(counts)) for x in places.T]
    middle = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]
    squares = np.sum((places - middle[of_others]) ** 2)
    spread = float(np.sqrt(squares / (2 * len(places)))) if len(places) else 0.0
    away = outlines.pixels.mean(axis=1) - middle[group]
    known = (counts[group] > 0) & (spread > 0.0)
    return np.where(known[:, None], away, 0.0) / (spread or 1.0)
