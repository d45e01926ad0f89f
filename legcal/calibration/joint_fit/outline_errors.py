"""Errors of outlines: of single ones, common-mode edge biases, and gammas of cameras.

**Single outlines** have the covariance ``scale^2 C + bias^2 [[1, 1], [1, 1]] + tilt^2 [[1, -1],
[-1, 1]]``: C is what detection claims, the bias is an error common to both ends of an outline
(shading, blur), the tilt one of opposite signs there (:class:`NoiseModel`).

**Common-mode edge biases.** Shading moves an edge of a leg alike in all images of a camera, a
little differently where the leg stands elsewhere in the image; blur moves many edges. Such errors
do not average out over images. So groups of outlines have unknown biases, random with variances
that restricted maximum likelihood finds in the residuals. Where these are white there are none.
Biases that move both edges of a leg inwards show in the residuals, and depth and radius take
them up. Those that move a leg sideways hardly show, since the fit follows, and they are what moves
joints. What shows must therefore say how large both are. If edges erred independently, both
variances would be equal; light from one side makes one edge of a leg brighter and the other
darker, and sideways biases count twice (:data:`SIDEWAYS`).

**Places.** An edge that comes back to the same place of a view has the same light and the same
background there, and errs alike again, which residuals hardly show where the fit follows. Poses at
the ends of travel come back to few places of each leg, the fewer the less legs there are. These
errors are not estimated with the others: what they do to the fit is added to its covariance.

**Gammas.** Where the gamma of a camera is not given, its outlines move together, each by its own
amount, with the logarithm of that gamma over the one with which they were measured. A fit recovers
only a share of a wrong gamma: how far each outline moves is known roughly, and common-mode biases
take some. Which gamma is right is found with others (:mod:`.gammas`); what the fit finds beside it
accounts for light at the limb that looks like another one, and the stated uncertainty for both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from legcal.calibration.joint_fit.factors import ObservedOutlines
from legcal.data.measurements import few_views
from legcal.estimation.variances import Effects, estimate_variances, expected_variances
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array, BoolArray, IntArray

_SUM = np.array([1.0, 1.0])
_DIFFERENCE = np.array([-1.0, 1.0])
_MEDIAN_OF_1 = 0.454936423119573  # of the square of a unit Gaussian
MEDIAN_OF_2 = 2.0 * np.log(2.0)  # of the squared norm of two unit Gaussians
_MIN_SCALE = 0.1
_MIN_NOISE_GAIN = (
    12.0  # twice the log-likelihood: of white offsets, one set in 4,000 gains that much
)
_MAX_ITERATIONS = 100
_VARIANCE_TOLERANCE = 1e-9
_RANK = 1e-10  # of the largest singular value: kinds of noise that the offsets do not separate

KINDS = (
    "bias of many edges",
    "tilt of many edges",
    "bias of a leg in a view",
    "tilt of a leg in a view",
    "change of that bias over the image",
    "change of that tilt over the image",
)
PLACES = ("bias of an edge at a place", "tilt of an edge at a place")  # not estimated
GAMMA, GAMMA_SUFFIX = len(KINDS), ".gamma"  # one more kind, and the end of the names of its shifts
N_KINDS = len(KINDS) + 1
GAMMA_SIGMA = 0.5  # of the logarithm: photographs are linear, or near 2.2
SIDEWAYS = np.sqrt(2.0)  # standard deviation of sideways biases, those inwards being one
_MAX_PLACES = 100  # where most outlines stand
_MIN_BIAS_GAIN = 6.0  # one set of white residuals in ten to twenty gains that much
_MODES = (("bias", (1.0, 1.0)), ("tilt", (-1.0, 1.0)))  # shifts of both ends

RECOVERED_SHARE = 0.5  # of the error of a gamma (logarithm) that a fit recovers, about
# Systematic errors at the limb that look like another gamma, in rendered photographs of machines
# with a known one: standard deviation of its logarithm.
LIMB_SIGMA = 0.17
_VAGUE_SIGMA = 0.25  # the same from where on a gamma is called hardly known


@dataclass(frozen=True)
class NoiseModel:
    """Errors of single outlines.

    Attributes
    ----------
    scale : float
        Factor on the claimed standard deviations.
    bias_px : float
        Standard deviation of the error that is common to both ends of an outline [px].
    tilt_px : float
        Standard deviation of the error that is opposite at both ends [px].
    """

    scale: float = 1.0
    bias_px: float = 0.0
    tilt_px: float = 0.0

    @property
    def variances(self) -> Array:
        """The squares of these, (3,)."""
        return np.array([self.scale, self.bias_px, self.tilt_px]) ** 2

    def covariance(self, claimed: Array) -> Array:
        """Return the covariances (n, 2, 2) [px^2] of outlines with claimed ones."""
        added = self.bias_px**2 * np.outer(_SUM, _SUM)
        added = added + self.tilt_px**2 * np.outer(_DIFFERENCE, _DIFFERENCE)
        return np.asarray(self.scale**2 * claimed + added)

    def whitening(self, claimed: Array, weight: Array | BoolArray | None = None) -> Array:
        """Return lower triangular T (n, 2, 2) with T C T^T = 1 [1/px], times the root of weights.

        Weights (n,) are those of squares; an outline without weight is not used.
        """
        T = whitener(self.covariance(claimed))
        return np.asarray(T if weight is None else T * np.sqrt(weight)[:, None, None])

    def squared_norms(self, offsets: Array, claimed: Array) -> Array:
        """Return the squared whitened norms (n,) of offsets (n, 2) [px]."""
        whitened = np.einsum("nij,nj->ni", self.whitening(claimed), offsets)
        return np.asarray(np.sum(whitened**2, axis=-1))


def noise_of_the_median(offsets: Array, claimed: Array) -> NoiseModel:
    """Return the noise at which the median outline is as far off as it should be.

    Wrong outlines, as long as they are fewer than half, hardly matter. The difference of the
    offsets at both ends does not feel the bias and their sum does not feel the tilt: the smaller of
    what these two say is the scale, and the excess of the other is bias or tilt.

    Parameters
    ----------
    offsets : (n, 2) array
        Offsets at both ends [px].
    claimed : (n, 2, 2) array
        Claimed covariances [px^2].

    Returns
    -------
    NoiseModel
    """
    s, d = (offsets @ _SUM) / np.sqrt(2.0), (offsets @ _DIFFERENCE) / np.sqrt(2.0)
    ss, sd, dd, turned = s * s, s * d, d * d, _turned(claimed)

    def scale_of(squares: Array, variances: Array) -> float:
        return float(np.sqrt(np.median(squares / variances) / _MEDIAN_OF_1))

    def excess(noise: NoiseModel) -> float:
        (a, b, c), _ = _inverted(_covariance(noise.variances, turned))
        return float(np.median(a * ss + 2.0 * b * sd + c * dd) - MEDIAN_OF_2)

    return _balanced(scale_of(ss, turned[0]), scale_of(dd, turned[2]), excess, offsets)


def estimate_noise(
    offsets: Array, explained: Array, claimed: Array, weight: Array | None = None
) -> NoiseModel:
    """Return the noise of outlines by restricted maximum likelihood.

    Bias and tilt of single outlines are there only if the offsets show them.

    Parameters
    ----------
    offsets : (n, 2) array
        Offsets of the accepted outlines at both ends [px].
    explained : (n, 2, 2) array
        Covariance of the predicted offsets [px^2]: the share of the errors that the fit absorbs.
    claimed : (n, 2, 2) array
        Claimed covariances [px^2].
    weight : (n,) array, optional
        How much outlines count that disagree with the fit; the squares of their offsets, and what
        is explained of these, are given with this weight.

    Returns
    -------
    NoiseModel
    """
    weight = np.ones(len(offsets)) if weight is None else weight
    moments = _turned(offsets[:, :, None] * offsets[:, None] + explained)
    claimed = _turned(claimed)
    best = _fitted(moments, claimed, weight, bias=False, tilt=False)
    for _ in range(2):
        has = best.bias_px > 0.0, best.tilt_px > 0.0
        wider = [
            best
            if kinds == has
            else _fitted(moments, claimed, weight, bias=kinds[0], tilt=kinds[1])
            for kinds in ((True, has[1]), (has[0], True))
        ]
        gains = [_likelihood(noise, moments, claimed, weight) for noise in wider]
        gain = 2.0 * (max(gains) - _likelihood(best, moments, claimed, weight))
        if gain <= _MIN_NOISE_GAIN:
            break
        best = wider[int(np.argmax(gains))]
    return best


def _turned(C: Array) -> Array:
    """Return matrices (n, 2, 2) of both ends by their sum and difference over sqrt 2.

    Symmetric ones are their three numbers, (3, n): bias and tilt add to the first and the last.
    """
    mean, mixed = 0.5 * (C[:, 0, 0] + C[:, 1, 1]), 0.5 * (C[:, 0, 1] + C[:, 1, 0])
    return np.stack([mean + mixed, 0.5 * (C[:, 1, 1] - C[:, 0, 0]), mean - mixed])


def _fitted(moments: Array, claimed: Array, weight: Array, *, bias: bool, tilt: bool) -> NoiseModel:
    """Return the noise of these kinds with the largest likelihood, by Fisher's scoring.

    *moments*, with their weights (n,), and *claimed* are (3, n) of :func:`_turned`.
    """
    kinds = [True, bias, tilt]
    shapes = [s for s, is_one in zip((claimed, *_ADDED), kinds, strict=True) if is_one]
    variances, least = np.zeros(3), np.array([_MIN_SCALE**2, 0.0, 0.0])
    share = _product(_inverted(claimed)[0], moments) / float(weight.sum())
    variances[0] = max(0.5 * share, _MIN_SCALE**2)
    k, n = len(shapes), claimed.shape[1]
    counted = [shape * weight for shape in shapes]
    wanted = [_pairs(a, b) for i, a in enumerate(shapes) for b in (moments, *counted[: i + 1])]
    coefficients = np.stack(np.broadcast_arrays(*wanted)).reshape(len(wanted), 6 * n)
    for _ in range(_MAX_ITERATIONS if bias or tilt else 0):
        a, b, c = _inverted(_covariance(variances, claimed))[0]
        squares = np.stack([a * a, a * b, b * b, a * c + b * b, b * c, c * c])
        sums = iter((coefficients @ squares.reshape(6 * n)).tolist())
        right, information = np.zeros(k), np.zeros((k, k))
        for i in range(k):
            right[i] = next(sums)
            for j in range(i + 1):
                information[i, j] = information[j, i] = next(sums)
        found = np.linalg.lstsq(information, right, rcond=_RANK)[0]
        before, variances = variances, variances.copy()
        variances[kinds] = np.maximum(found, least[kinds])
        if np.abs(variances - before).max() <= _VARIANCE_TOLERANCE * variances.max():
            break
    return NoiseModel(*np.sqrt(variances).tolist())


# By sum and difference: what one unit of bias and of tilt adds.
_ADDED = (np.array([[2.0], [0.0], [0.0]]), np.array([[0.0], [0.0], [2.0]]))


def _covariance(variances: Array, claimed: Array) -> Array:
    """Return covariances (3, n) of variances: of the scale, bias and tilt."""
    covariance = variances[0] * claimed
    covariance[0] += 2.0 * variances[1]
    covariance[2] += 2.0 * variances[2]
    return np.asarray(covariance)


def _pairs(X: Array, Y: Array) -> Array:
    """Return what trace(S X S Y) has of the products of the numbers (a, b, c) of S, (6, n).

    Those are a a, a b, b b, a c + b b, b c, and c c; all matrices are (3, n).
    """
    (x, xy, y), (u, uv, v) = X, Y
    first, last = 2.0 * (x * uv + xy * u), 2.0 * (xy * v + y * uv)
    return np.array([x * u, first, x * v + y * u, 2.0 * xy * uv, last, y * v])


def _inverted(C: Array) -> tuple[Array, Array]:
    """Return the inverses of matrices (3, n), and their determinants (n,)."""
    a, b, c = C
    determinant = a * c - b * b
    return np.stack([c, -b, a]) / determinant, determinant


def _product(X: Array, Y: Array) -> float:
    """Return the sum of the traces of the products of matrices (3, n)."""
    return float(np.vdot(X, Y) + np.vdot(X[1], Y[1]))


def _likelihood(noise: NoiseModel, moments: Array, claimed: Array, weight: Array) -> float:
    """Return the logarithm of the likelihood of weighted second moments (3, n) [px^2]."""
    inverse, determinant = _inverted(_covariance(noise.variances, claimed))
    return -0.5 * (float(weight @ np.log(determinant)) + _product(inverse, moments))


def _balanced(
    of_sums: float, of_differences: float, excess: Callable[[NoiseModel], float], offsets: Array
) -> NoiseModel:
    """Return the scale of the better mode, and the excess of the other as bias or tilt."""
    if of_differences <= of_sums:
        scale = max(of_differences, _MIN_SCALE)
        return NoiseModel(scale, _root(lambda px: excess(NoiseModel(scale, px)), offsets))
    scale = max(of_sums, _MIN_SCALE)
    return NoiseModel(scale, 0.0, _root(lambda px: excess(NoiseModel(scale, 0.0, px)), offsets))


def _root(excess: Callable[[float], float], offsets: Array) -> float:
    """Return where a falling function of an added error crosses zero, 0 if it starts below."""
    if excess(0.0) <= 0.0:
        return 0.0
    low, high = 0.0, 2.0 * float(np.abs(offsets).max())
    above, below = excess(low), excess(high)
    while below > 0.0:
        low, above, high = high, below, 2.0 * high
        below = excess(high)
    # Regula falsi (Illinois): the value at an end that stays twice counts half. Steps are at least
    # as long as the tolerance, and both ends close around the root. SciPy's takes 0.1 s to load.
    tolerance = 1e-12 + 1e-14 * high
    was_above = None
    while high - low > 2.0 * tolerance:
        between = low + (high - low) * above / (above - below)
        between = min(max(between, low + tolerance), high - tolerance)
        value = excess(between)
        is_above = value > 0.0
        stays = 0.5 if is_above is was_above else 1.0
        if is_above:
            low, above, below = between, value, stays * below
        else:
            high, below, above = between, value, stays * above
        was_above = is_above
    return 0.5 * (low + high)


@dataclass(frozen=True, eq=False)
class EdgeBiases:
    """Biases that outlines share, random with known variances.

    Their names: ``all.bias``; ``c1.tilt`` of a view; ``leg1.rod.bias`` of a part;
    ``c1.leg1.rod.inward.bias`` of both edges of a part in a view, ``c1.leg1.rod.sideways.bias``
    and, for how it changes along x of the image, ``c1.leg1.rod.sideways.bias_x``; ``c1.gamma``
    of a camera whose gamma is not given.
    """

    names: tuple[str, ...]  # b of them
    kind: IntArray  # (b,) among ``KINDS``, then ``GAMMA``
    sigma: Array  # (N_KINDS,) standard deviation of each kind [px], and of ln gamma
    index: IntArray  # (n, c) which of them each outline has a part in
    shift: Array  # (n, c, 2) how one unit of each moves both ends along the line's normal [px]
    shown: Array | None = None  # (n_kinds,) variances that residuals show by themselves
    likeliest_sigma: Array | None = None  # (N_KINDS,) where those above are expected ones
    parts: dict[bytes, EdgeBiases] = field(default_factory=dict, repr=False)  # chosen before

    @property
    def sigmas(self) -> Array:
        """Standard deviation of each bias [px, or none], (b,)."""
        return np.asarray(self.sigma[self.kind])

    @property
    def are_shown(self) -> bool:
        """Whether the residuals show any."""
        return self.shown is not None and bool(self.shown.any())

    @property
    def likeliest(self) -> EdgeBiases:
        """Those with the standard deviations that are most likely."""
        return self if self.likeliest_sigma is None else self.of_sizes(self.likeliest_sigma)

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
        found = self.parts.get(kept.tobytes())
        if found is None:
            number = np.cumsum(kept) - 1
            columns = kept[self.index].all(axis=0)  # all biases of a column are of one kind
            found = self.parts[kept.tobytes()] = EdgeBiases(
                tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept),
                self.kind[kept],
                sigma,
                number[self.index[:, columns]],
                self.shift[:, columns],
            )
        return replace(found, sigma=sigma)


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
    key, group = np.unique(view * len(parts) + o.radius, return_inverse=True)
    found = list(zip(*(part.tolist() for part in np.divmod(key, max(len(parts), 1))), strict=True))
    inward, sideways = o.epsilon, np.full(len(o), SIDEWAYS)
    x, y = _places_in_groups(o, known).T
    together = [f"{o.views[v]}.{parts[p]}.inward" for v, p in found]
    across = [f"{o.views[v]}.{parts[p]}.sideways" for v, p in found]
    levels = [
        (("all",), np.zeros(len(o), dtype=np.intp), inward, "", 0),
        (o.views, view, inward, "", 0),
        (parts, o.radius, inward, "", 0),
        (together, group, inward, "", 2),
        (across, group, sideways, "", 2),
        (together, group, inward * x, "_x", 4),
        (across, group, sideways * x, "_x", 4),
        (together, group, inward * y, "_y", 4),
        (across, group, sideways * y, "_y", 4),
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
    possible: EdgeBiases,
    z: Array,
    K: Array,
    least: Array | float = 0.0,
    near: EdgeBiases | None = None,
) -> EdgeBiases:
    """Return the biases that the residuals show: none at all where they are white.

    *z* (b,) and *K* (b, b) are scores of all of them and their covariance (:class:`Effects`);
    *least* (N_KINDS,) are standard deviations known from elsewhere, where the residuals show less
    [px]. That of a gamma is known, whatever the residuals show. Those of an earlier fit are *near*.
    """
    sigma = np.zeros(N_KINDS)
    start = None if near is None else near.shown
    variances, _ = estimate_variances(Effects(z, K, possible.kind), _MIN_BIAS_GAIN, start)
    sigma[: len(variances)] = np.sqrt(variances)
    return replace(possible.of_sizes(with_gamma(np.maximum(sigma, least))), shown=variances)


def expected_biases(
    possible: EdgeBiases, z: Array, K: Array, biases: EdgeBiases, least: Array
) -> EdgeBiases:
    """Return estimated biases with the standard deviations that are expected, given the residuals.

    As for :func:`estimated_biases`, which says how large they are most likely: few groups of
    outlines leave that uncertain, and what residuals hardly show may be there.
    """
    kinds = range(len(KINDS))
    found = expected_variances(Effects(z, K, possible.kind), biases.sigma**2, kinds)
    expected = possible.of_sizes(np.maximum(np.sqrt(found), least))
    return replace(expected, shown=biases.shown, likeliest_sigma=biases.sigma)


def shifts_at_places(outlines: ObservedOutlines, used: BoolArray) -> Array:
    """Return how errors at places shift both ends of outlines, (n, 2, 2 n_places) [px].

    By one unit of bias at each place, then of tilt. At a place a used outline of an edge in a view
    has others within a width of the part: the first place is that with most, the next one that with
    most of those that are left.
    """
    o, width = outlines, outlines.width_px
    edge = 2 * (o.series[o.view] * len(o.parts) + o.radius) + (o.epsilon < 0.0)
    middle, found = o.pixels.mean(axis=1), list[IntArray]()
    for key in np.unique(edge[used]).tolist() if np.isfinite(width) else []:
        own = np.flatnonzero(used & (edge == key))
        near = np.linalg.norm(middle[own, None] - middle[own], axis=-1) <= width
        counts, left = np.count_nonzero(near, axis=1), np.ones(len(own), dtype=np.bool_)
        while counts.max() > 1:
            here = near[int(np.argmax(counts))] & left
            found.append(own[here])
            left &= ~here
            counts = (counts - np.count_nonzero(near[:, here], axis=1)) * left
    found = sorted(found, key=len, reverse=True)[:_MAX_PLACES]
    shifts = np.zeros((len(o), len(_MODES[0][1]), len(PLACES), len(found)))
    for k, members in enumerate(found):
        shifts[members, :, :, k] = shifts_of_edges(len(members))
    return shifts.reshape(*shifts.shape[:2], -1)


def shifts_of_edges(n: int) -> Array:
    """Return how a unit of bias and of tilt shift both ends of n outlines, (n, 2, 2) [px]."""
    return np.tile(np.transpose([ends for _, ends in _MODES]), (n, 1, 1))


def sigmas_at_places(z: Array, K: Array) -> Array:
    """Return the standard deviations (2,) of bias and tilt at places, as they are expected [px].

    Not those that are most likely, which are often zero where there are some: poses and cameras
    follow much of such errors, and residuals say little of them. *z* (c,) and *K* (c, c) are scores
    of those of :func:`shifts_at_places`, and their covariance.
    """
    effects = Effects(z, K, np.repeat(np.arange(len(PLACES)), len(z) // len(PLACES)))
    likeliest, _ = estimate_variances(effects, 0.0)
    return np.asarray(np.sqrt(expected_variances(effects, likeliest, range(len(PLACES)))))


def notes_on_blur(biases: EdgeBiases, claimed: Array) -> tuple[str, ...]:
    """Return a note where edges lie inwards or outwards together by more than each is uncertain.

    With the biases of a fit and the claimed covariances (n, 2, 2) of the outlines that it used
    [px^2]: that is what a blur does which images leave open.
    """
    if biases.shown is None or not len(claimed):
        return ()
    together = float(np.sqrt(biases.shown[KINDS.index("bias of many edges")]))
    each = float(np.median(np.sqrt(claimed.sum(axis=(1, 2))))) / 2.0
    if together <= each:
        return ()
    return (
        f"Outlines of many legs lie inwards or outwards together by {together:.2f} px (1 sigma), "
        f"more than single ones are uncertain ({each:.2f} px), as where sharpening or noise "
        "reduction by the camera leaves the blur of edges undecided, or light at the limb does; "
        "the stated uncertainty holds it; switch the processing off, or light the legs evenly.",
    )


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


@dataclass(frozen=True)
class EstimatedGamma:
    """The gamma of a camera."""

    views: tuple[str, ...]  # of the camera
    gamma: float
    fitted_sigma: float  # standard deviation of its logarithm, by the fit
    measured_with: float  # the gamma with which the outlines were measured

    @property
    def sigma(self) -> float:
        """Standard deviation of its logarithm: fits recover a share of it."""
        unseen = (1.0 / RECOVERED_SHARE - 1.0) * np.log(self.gamma / self.measured_with)
        return float(
            np.sqrt((self.fitted_sigma / RECOVERED_SHARE) ** 2 + unseen**2 + LIMB_SIGMA**2)
        )

    def __str__(self) -> str:
        hardly = ", and its outlines hardly determine it" * (self.sigma > _VAGUE_SIGMA)
        return (
            f"The gamma of the camera of {few_views(self.views)} is not given{hardly}: found "
            f"{self.gamma:.2f} +- {self.gamma * self.sigma:.2f} by outlines measured with "
            f"{self.measured_with:.2f}, "
            "which the uncertainty of the result takes into account; write gamma of the views in "
            "dataset.yaml if you know it."
        )
