"""Errors of outlines: noise of single outlines, common-mode edge biases, gammas of cameras.

**Single outlines** have the covariance ``scale^2 C + bias^2 [[1, 1], [1, 1]] + tilt^2 [[1, -1],
[-1, 1]]``: C is claimed by the detection, the bias is an error common to both ends of an outline
(shading, blur), the tilt one of opposite signs at its ends (:class:`NoiseModel`).

**Common-mode edge biases.** Shading shifts an edge of a leg alike in all images of a camera, with a
slow change over the image; blur shifts many edges. Such errors do not average out over images.
Groups of outlines therefore have random biases, with variances estimated from the residuals by
restricted maximum likelihood; for white residuals there are none. Inward biases, of both edges of
a leg, show in the residuals and are absorbed by depth and radius. Sideways biases hardly show,
since the fit absorbs them, and they displace joints; their size has to follow from the inward
ones. With independent edges both variances would be equal; light from one side makes one edge of a
leg brighter and the other darker, so that sideways variances count twice (:data:`SIDEWAYS`).

**Places.** An edge that returns to the same place in a view has the same light and background, and
the same error, which residuals hardly show where the fit absorbs it. Poses at the ends of travel
return to few places of each leg, fewer for machines with fewer legs. These errors are not
estimated as biases: their effect on the fit is added to its covariance.

**Gammas.** Where the gamma of a camera is not given, its outlines shift with the logarithm of that
gamma over the gamma used in measurement, each by a known derivative. A fit recovers only part of a
wrong gamma: the derivatives are approximate, and common-mode biases absorb some. The gamma is
therefore estimated by trials (:mod:`legcal.calibration.estimate`); the bias ``gamma`` of the fit
accounts for light at the limb that looks like another gamma, and the stated uncertainty includes
both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.factors import ObservedOutlines
from legcal.calibration.tuning import (
    GAMMA_SIGMA,
    LIMB_GAMMA_SIGMA,
    LIMB_SHARES,
    MIN_BIAS_GAIN,
    POLISHED_BIAS_PX,
)
from legcal.data.measurements import few_views
from legcal.estimation.variances import Effects, estimate_variances, expected_variances
from legcal.geometry.covariances import whitener
from legcal.geometry.types import Array, BoolArray, IntArray

_SUM = np.array([1.0, 1.0])
_DIFFERENCE = np.array([-1.0, 1.0])
MEDIAN_OF_1 = 0.454936423119573  # median square of a unit Gaussian
MEDIAN_OF_2 = 2.0 * np.log(2.0)  # median squared norm of two unit Gaussians
_MIN_SCALE = 0.1
_MIN_NOISE_GAIN = (
    12.0  # twice the log-likelihood: of white offsets, one set in 4,000 gains that much
)
_MAX_ITERATIONS = 100
_VARIANCE_TOLERANCE = 1e-9
_HALVINGS = 40  # of an interval around the size of an error
_RANK = 1e-10  # relative singular value of kinds of noise that offsets cannot separate

KINDS = (
    "bias of many edges",
    "tilt of many edges",
    "bias of a leg in a view",
    "tilt of a leg in a view",
    "change of that bias over the image",
    "change of that tilt over the image",
)
_IN_VIEWS = slice(2, 4)  # of these: bias and tilt of a leg in a view
PLACES = ("bias of an edge at a place", "tilt of an edge at a place")  # not estimated
GAMMA, GAMMA_SUFFIX = len(KINDS), ".gamma"  # one more kind, and the suffix of its names
N_KINDS = len(KINDS) + 1
SIDEWAYS = np.sqrt(2.0)  # ratio of the standard deviations of sideways and inward biases
_MAX_PLACES = 100  # with the most outlines
_MODES = (("bias", (1.0, 1.0)), ("tilt", (-1.0, 1.0)))  # shifts of both ends

RECOVERED_SHARE = 0.5  # of an error of ln gamma, recovered by a fit
_VAGUE_SIGMA = 0.25  # of ln gamma, above which it is reported as hardly determined


@dataclass(frozen=True)
class NoiseModel:
    """Errors of single outlines."""

    scale: float = 1.0  # factor on the claimed standard deviations
    bias_px: float = 0.0  # standard deviation of the error common to both ends of an outline [px]
    tilt_px: float = 0.0  # that of the error that is opposite at both ends [px]

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


def robust_noise(offsets: Array, claimed: Array) -> NoiseModel:
    """Estimate the noise from the median outline, robust against less than half outliers.

    *offsets* (n, 2) are those at both ends [px], *claimed* (n, 2, 2) their covariances [px^2].

    The difference of the offsets at both ends is independent of the bias, and their sum of the
    tilt: the smaller of their two scales is the scale, and the excess of the other is bias or tilt.
    """
    s, d = (offsets @ _SUM) / np.sqrt(2.0), (offsets @ _DIFFERENCE) / np.sqrt(2.0)
    ss, sd, dd, turned = s * s, s * d, d * d, _turned(claimed)

    def scale_of(squares: Array, variances: Array) -> float:
        return float(np.sqrt(np.median(squares / variances) / MEDIAN_OF_1))

    def excess(noise: NoiseModel) -> float:
        (a, b, c), _ = _inverted(_covariance(noise.variances, turned))
        return float(np.median(a * ss + 2.0 * b * sd + c * dd) - MEDIAN_OF_2)

    of_sums, of_differences = scale_of(ss, turned[0]), scale_of(dd, turned[2])
    scale = max(min(of_sums, of_differences), _MIN_SCALE)
    if of_differences <= of_sums:
        return NoiseModel(scale, _root(lambda px: excess(NoiseModel(scale, px)), offsets))
    return NoiseModel(scale, 0.0, _root(lambda px: excess(NoiseModel(scale, 0.0, px)), offsets))


def estimate_noise(
    offsets: Array,  # (n, 2): of the accepted outlines at both ends [px]
    # (n, 2, 2): covariance of the predicted offsets [px^2]: errors absorbed by the fit
    explained: Array,
    claimed: Array,  # (n, 2, 2): claimed covariances [px^2]
    # (n,): of the squares of outlines; *offsets* and *explained* are weighted already
    weight: Array | None = None,
    included: NoiseModel = NoiseModel(),  # its bias and tilt are included, significant or not
) -> NoiseModel:
    """Estimate the noise of outlines by restricted maximum likelihood.

    Bias and tilt of single outlines are included only if they are significant.
    """
    weight = np.ones(len(offsets)) if weight is None else weight
    moments = _turned(offsets[:, :, None] * offsets[:, None] + explained)
    claimed = _turned(claimed)
    bias, tilt = included.bias_px > 0.0, included.tilt_px > 0.0
    best = _fitted(moments, claimed, weight, bias=bias, tilt=tilt)
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
    """Rotate matrices (n, 2, 2) of both ends to sum and difference over sqrt 2, as (3, n).

    Rows are the three elements of symmetric matrices: bias adds to the first, tilt to the last.
    """
    mean, mixed = 0.5 * (C[:, 0, 0] + C[:, 1, 1]), 0.5 * (C[:, 0, 1] + C[:, 1, 0])
    return np.stack([mean + mixed, 0.5 * (C[:, 1, 1] - C[:, 0, 0]), mean - mixed])


def _fitted(moments: Array, claimed: Array, weight: Array, *, bias: bool, tilt: bool) -> NoiseModel:
    """Maximise the likelihood of the noise of these kinds by Fisher scoring.

    *moments*, with their weights (n,), and *claimed* are (3, n) of :func:`_turned`.
    """
    kinds = [True, bias, tilt]
    shapes = [s for s, is_one in zip((claimed, *_ADDED), kinds, strict=True) if is_one]
    variances, least = np.zeros(3), np.array([_MIN_SCALE**2, 0.0, 0.0])
    mean_square = _product(_inverted(claimed)[0], moments) / float(weight.sum())
    variances[0] = max(0.5 * mean_square, _MIN_SCALE**2)
    k, n = len(shapes), claimed.shape[1]
    counted = [shape * weight for shape in shapes]
    products = [_pairs(a, b) for i, a in enumerate(shapes) for b in (moments, *counted[: i + 1])]
    coefficients = np.stack(np.broadcast_arrays(*products)).reshape(len(products), 6 * n)
    for _ in range(_MAX_ITERATIONS if bias or tilt else 0):
        a, b, c = _inverted(_covariance(variances, claimed))[0]
        squares = np.stack([a * a, a * b, b * b, a * c + b * b, b * c, c * c])
        sums = iter((coefficients @ squares.reshape(6 * n)).tolist())
        right, information = np.zeros(k), np.zeros((k, k))
        for i in range(k):
            right[i] = next(sums)
            for j in range(i + 1):
                information[i, j] = information[j, i] = next(sums)
        solution = np.linalg.lstsq(information, right, rcond=_RANK)[0]
        before, variances = variances, variances.copy()
        variances[kinds] = np.maximum(solution, least[kinds])
        if np.abs(variances - before).max() <= _VARIANCE_TOLERANCE * variances.max():
            break
    return NoiseModel(*np.sqrt(variances).tolist())


# One unit of bias and of tilt, in sum and difference.
_ADDED = (np.array([[2.0], [0.0], [0.0]]), np.array([[0.0], [0.0], [2.0]]))


def _covariance(variances: Array, claimed: Array) -> Array:
    """Covariances (3, n) for variances of scale, bias and tilt."""
    covariance = variances[0] * claimed
    covariance[0] += 2.0 * variances[1]
    covariance[2] += 2.0 * variances[2]
    return np.asarray(covariance)


def _pairs(X: Array, Y: Array) -> Array:
    """Coefficients (6, n) of trace(S X S Y) for products of the elements (a, b, c) of S.

    The products are a a, a b, b b, a c + b b, b c, and c c; all matrices are (3, n).
    """
    (x, xy, y), (u, uv, v) = X, Y
    first, last = 2.0 * (x * uv + xy * u), 2.0 * (xy * v + y * uv)
    return np.array([x * u, first, x * v + y * u, 2.0 * xy * uv, last, y * v])


def _inverted(C: Array) -> tuple[Array, Array]:
    """Invert matrices (3, n); also return their determinants (n,)."""
    a, b, c = C
    determinant = a * c - b * b
    return np.stack([c, -b, a]) / determinant, determinant


def _product(X: Array, Y: Array) -> float:
    """Sum of traces of products of matrices (3, n)."""
    return float(np.vdot(X, Y) + np.vdot(X[1], Y[1]))


def _likelihood(noise: NoiseModel, moments: Array, claimed: Array, weight: Array) -> float:
    """Log-likelihood of weighted second moments (3, n) [px^2]."""
    inverse, determinant = _inverted(_covariance(noise.variances, claimed))
    return -0.5 * (float(weight @ np.log(determinant)) + _product(inverse, moments))


def _root(excess: Callable[[float], float], offsets: Array) -> float:
    """Root of a decreasing function of an added error; 0 if it is negative at zero."""
    if excess(0.0) <= 0.0:
        return 0.0
    low, high = 0.0, 2.0 * float(np.abs(offsets).max())
    while excess(high) > 0.0:
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True, eq=False)
class EdgeBiases:
    """Common-mode biases of groups of outlines, random with known variances.

    Their names: ``all.bias``; ``c1.tilt`` of a view; ``leg1.rod.bias`` of a part;
    ``c1.leg1.rod.inward.bias`` of both edges of a part in a view, ``c1.leg1.rod.sideways.bias``
    and, for how it changes along x of the image, ``c1.leg1.rod.sideways.bias_x``; ``c1.gamma``
    of a camera whose gamma is not given.
    """

    names: tuple[str, ...]  # b of them
    kind: IntArray  # (b,) among ``KINDS``, then ``GAMMA``
    sigma: Array  # (N_KINDS,) standard deviation of each kind [px], and of ln gamma
    index: IntArray  # (n, c) the biases that act on each outline
    shift: Array  # (n, c, 2) shift of both ends along the line's normal by one unit [px]
    shown: Array | None = None  # (n_kinds,) variances estimated from residuals
    likeliest_sigma: Array | None = None  # (N_KINDS,) if ``sigma`` is a posterior mean

    @property
    def sigmas(self) -> Array:
        """Standard deviation of each bias [px, or none], (b,)."""
        return np.asarray(self.sigma[self.kind])

    @property
    def are_shown(self) -> bool:
        """Whether the residuals show common-mode biases."""
        return self.shown is not None and bool(self.shown.any())

    @property
    def likeliest(self) -> EdgeBiases:
        """The biases with the most likely standard deviations."""
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

    @property
    def shifts(self) -> Array:
        """Shifts of both ends of outlines by one standard deviation of each bias, (n, 2, b)."""
        shifts = np.zeros((len(self.index), 2, len(self)))
        for index, shift in zip(self.index.T, np.swapaxes(self.shift, 0, 1), strict=True):
            shifts[np.arange(len(index)), :, index] += shift
        return shifts * self.sigmas

    def __len__(self) -> int:
        return len(self.names)

    def of_sizes(self, sigma: Array) -> EdgeBiases:
        """Set the standard deviations; drop biases where they are zero."""
        kept = sigma[self.kind] > 0.0
        renumbered = np.cumsum(kept) - 1
        columns = kept[self.index].all(axis=0)  # all biases of a column are of one kind
        return EdgeBiases(
            tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept),
            self.kind[kept],
            sigma,
            renumbered[self.index[:, columns]],
            self.shift[:, columns],
        )


def possible_biases(
    outlines: ObservedOutlines,
    leg_names: Sequence[str],
    fitted: ObservedOutlines | None = None,
) -> EdgeBiases:
    """Return all candidate biases of outlines, with unit standard deviations.

    Biases of many edges are inward. Those of one part in a view are inward and sideways, and have
    a linear change along x and y of the image, by one unit over the spread of outlines in a group,
    in the outlines *fitted* to (by default, *outlines*).
    """
    o = outlines
    parts = [f"{leg_names[leg]}.{part}" for leg, part in o.parts]
    reference = o if fitted is None else fitted
    view = reference.series[o.view]
    key, group = np.unique(view * len(parts) + o.radius, return_inverse=True)
    leg_in_view = list(
        zip(*(part.tolist() for part in np.divmod(key, max(len(parts), 1))), strict=True)
    )
    inward, sideways = o.epsilon, np.full(len(o), SIDEWAYS)
    x, y = _places_in_groups(o, reference).T
    inward_names = [f"{o.views[v]}.{parts[p]}.inward" for v, p in leg_in_view]
    sideways_names = [f"{o.views[v]}.{parts[p]}.sideways" for v, p in leg_in_view]
    levels = [
        (("all",), np.zeros(len(o), dtype=np.intp), inward, "", 0),
        (o.views, view, inward, "", 0),
        (parts, o.radius, inward, "", 0),
        (inward_names, group, inward, "", 2),
        (sideways_names, group, sideways, "", 2),
        (inward_names, group, inward * x, "_x", 4),
        (sideways_names, group, sideways * x, "_x", 4),
        (inward_names, group, inward * y, "_y", 4),
        (sideways_names, group, sideways * y, "_y", 4),
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
        camera_of_view = np.array([cameras.index(c) if c in cameras else 0 for c in o.cameras])
        index.append(camera_of_view[o.view] + len(names))
        # A too small gamma displaces outlines by the opposite of their shift with gamma.
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
    """Estimate the standard deviations of biases; no biases for white residuals.

    *z* (b,) and *K* (b, b) are the scores of all biases and their covariance (:class:`Effects`);
    *least* (N_KINDS,) are lower bounds known from elsewhere [px]. The prior of a gamma is fixed.
    *near* are the biases of an earlier fit.
    """
    sigma = np.zeros(N_KINDS)
    start = None if near is None else near.shown
    variances, _ = estimate_variances(Effects(z, K, possible.kind), MIN_BIAS_GAIN, start)
    sigma[: len(variances)] = np.sqrt(variances)
    return replace(possible.of_sizes(with_gamma(np.maximum(sigma, least))), shown=variances)


def expected_biases(
    possible: EdgeBiases, z: Array, K: Array, biases: EdgeBiases, least: Array
) -> EdgeBiases:
    """Replace the likeliest standard deviations of biases by posterior means.

    Few groups of outlines leave the likeliest values of :func:`estimated_biases` uncertain, and
    they are zero for biases that may well exist.
    """
    kinds = range(len(KINDS))
    variances = expected_variances(Effects(z, K, possible.kind), biases.sigma**2, kinds)
    expected = possible.of_sizes(np.maximum(np.sqrt(variances), least))
    return replace(expected, shown=biases.shown, likeliest_sigma=biases.sigma)


def shifts_at_places(outlines: ObservedOutlines, used: BoolArray) -> Array:
    """Shifts of both ends of outlines by errors at places, (n, 2, 2 n_places) [px].

    By one unit of bias at each place, then of tilt. A place is a cluster of used outlines of an
    edge in a view within a width of the part, chosen greedily by size.
    """
    o, width = outlines, outlines.width_px
    edge = 2 * (o.series[o.view] * len(o.parts) + o.radius) + (o.epsilon < 0.0)
    middle, clusters = o.pixels.mean(axis=1), list[IntArray]()
    for key in np.unique(edge[used]).tolist() if np.isfinite(width) else []:
        members_of_edge = np.flatnonzero(used & (edge == key))
        near = (
            np.linalg.norm(middle[members_of_edge, None] - middle[members_of_edge], axis=-1)
            <= width
        )
        counts, unassigned = (
            np.count_nonzero(near, axis=1),
            np.ones(len(members_of_edge), dtype=np.bool_),
        )
        while counts.max() > 1:
            cluster = near[int(np.argmax(counts))] & unassigned
            clusters.append(members_of_edge[cluster])
            unassigned &= ~cluster
            counts = (counts - np.count_nonzero(near[:, cluster], axis=1)) * unassigned
    clusters = sorted(clusters, key=len, reverse=True)[:_MAX_PLACES]
    shifts = np.zeros((len(o), len(_MODES[0][1]), len(PLACES), len(clusters)))
    for k, members in enumerate(clusters):
        shifts[members, :, :, k] = shifts_of_edges(len(members))
    return shifts.reshape(*shifts.shape[:2], len(PLACES) * len(clusters))


def least_in_views(noise: NoiseModel, claimed: Array) -> Array:
    """Return least standard deviations (N_KINDS,) of biases of edges in photographs [px].

    Of those of a leg in a view, in parts of the noise of single outlines, whose covariances (n, 2,
    2) are *claimed* [px^2]: residuals show little of them where a fit to few images absorbs them.
    """
    least = np.zeros(N_KINDS)
    if len(claimed):
        C = noise.covariance(claimed)
        variances = np.stack([_SUM @ C @ _SUM, _DIFFERENCE @ C @ _DIFFERENCE])
        single = 0.5 * np.sqrt(np.median(variances, axis=1))
        least[_IN_VIEWS] = LIMB_SHARES * single
    return least


def least_at_places(outlines: ObservedOutlines, shifts: Array) -> Array:
    """Return least standard deviations of errors at places [px], as :func:`shifts_at_places`.

    The fit absorbs most of such an error, whatever its size, so that residuals do not show it; what
    polished surfaces reflect is known to make some.
    """
    polished = np.array([part in outlines.polished for part in outlines.parts], dtype=np.bool_)
    at_place = shifts.any(axis=1).reshape(len(shifts), len(PLACES), -1)
    least = np.zeros(at_place.shape[1:])
    least[0] = POLISHED_BIAS_PX * at_place[polished[outlines.radius], 0].any(axis=0)
    return least.ravel()


def shifts_of_edges(n: int) -> Array:
    """Shifts of both ends of n outlines by one unit of bias and of tilt, (n, 2, 2) [px]."""
    return np.tile(np.transpose([ends for _, ends in _MODES]), (n, 1, 1))


def sigmas_at_places(z: Array, K: Array) -> Array:
    """Return posterior means (2,) of the standard deviations of bias and tilt at places [px].

    The likeliest values are often zero although errors exist, since poses and cameras absorb most
    of them. *z* (c,) and *K* (c, c) are scores of :func:`shifts_at_places` and their covariance.
    """
    effects = Effects(z, K, np.repeat(np.arange(len(PLACES)), len(z) // len(PLACES)))
    likeliest, _ = estimate_variances(effects, 0.0)
    return np.asarray(np.sqrt(expected_variances(effects, likeliest, range(len(PLACES)))))


def notes_on_blur(biases: EdgeBiases, claimed: Array) -> tuple[str, ...]:
    """Return a note if the common inward bias of edges exceeds the noise of single outlines.

    This is the effect of an undetermined blur. *claimed* are the covariances (n, 2, 2) of the used
    outlines [px^2].
    """
    if biases.shown is None or not len(claimed):
        return ()
    common = float(np.sqrt(biases.shown[KINDS.index("bias of many edges")]))
    single = float(np.median(np.sqrt(claimed.sum(axis=(1, 2))))) / 2.0
    if common <= single:
        return ()
    return (
        f"Outlines of many legs have a common inward or outward bias of {common:.2f} px (1 sigma), "
        f"more than the noise of single outlines ({single:.2f} px); sharpening or noise reduction "
        "by the camera, or light at the limb, are common causes; the stated uncertainty includes "
        "the bias; switch the processing off, or light the legs evenly.",
    )


def with_gamma(sigma: Array) -> Array:
    """Append the standard deviation of ln gamma; return (N_KINDS,)."""
    return np.append(sigma[:GAMMA], GAMMA_SIGMA)


def _places_in_groups(outlines: ObservedOutlines, others: ObservedOutlines) -> Array:
    """Positions (n, 2) of outlines relative to the centre of their group, over the spread.

    Centres and spread are of *others*; zero for a group without others.
    """
    n_parts = len(outlines.parts)
    group, of_others = (others.series[o.view] * n_parts + o.radius for o in (outlines, others))
    places = others.pixels.mean(axis=1)
    counts = np.bincount(of_others, minlength=len(others.views) * n_parts)
    sums = [np.bincount(of_others, weights=x, minlength=len(counts)) for x in places.T]
    middle = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]
    squares = np.sum((places - middle[of_others]) ** 2)
    spread = float(np.sqrt(squares / (2 * len(places)))) if len(places) else 0.0
    offset = outlines.pixels.mean(axis=1) - middle[group]
    has_others = (counts[group] > 0) & (spread > 0.0)
    return np.where(has_others[:, None], offset, 0.0) / (spread or 1.0)


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
            np.sqrt((self.fitted_sigma / RECOVERED_SHARE) ** 2 + unseen**2 + LIMB_GAMMA_SIGMA**2)
        )

    def __str__(self) -> str:
        hardly = ", and its outlines hardly determine it" * (self.sigma > _VAGUE_SIGMA)
        return (
            f"The gamma of the camera of {few_views(self.views)} is not given{hardly}: estimated "
            f"{self.gamma:.2f} +- {self.gamma * self.sigma:.2f} from outlines measured with "
            f"{self.measured_with:.2f}; the uncertainty of the result includes this; write gamma "
            "of the views in dataset.yaml if you know it."
        )
