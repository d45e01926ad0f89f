"""Camera poses that two edge pairs suggest, each taken for a leg.

A pair that is assigned to a leg gives its axis, except for its lean towards the camera, and by its
width its distance. The turn about that axis follows from a second pair: it lays a second leg into
the plane of that pair. A picture gives many poses in this way, most of them wrong.
"""

from typing import NamedTuple

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import (
    MAX_WIDTH_SIGMAS,
    CameraPoses,
    LegSegments,
    Picture,
    pair_widths,
)
from legcal.perception.tuning import WIDTH_ERROR

N_FIRST, N_SECOND = 20, 40  # best pairs that are tried as the first one, and as the second
LEANS = np.deg2rad([-55.0, -33.0, -11.0, 11.0, 33.0, 55.0])
MAX_LENGTH_RATIO = 1.25, 3.0  # of a pair to the segment that it shows: factor, radii
CONE = 0.12  # error of the logarithm of the ratio of the widths at both ends
PLACE_TOLERANCE = 0.2  # of the place along a segment, in its lengths
HALF = 0.5 + 0.5 * PLACE_TOLERANCE  # of a segment, with half of that
MAX_COSINE = 1.05  # how far from a solution pairs and legs may be that allow none, as a cosine
MIN_CROSSING = 0.03  # sine between axes seen, below which the second pair does not fix the place
MAX_POSES = 3000  # poses of a picture


class _FirstAssignments(NamedTuple):
    """Pairs assigned to legs, each with a lean; the turn about the leg and the place are open."""

    u: Array  # (n, 3) direction in the camera frame, from base to platform
    P: Array  # (n, 3) where the middle of the segment is put [m]
    tolerance: Array  # (n,) how far along the leg it may be instead [m]
    pair: IntArray  # (n,)
    target: IntArray  # (n,)


def pose_hypotheses(picture: Picture, n_legs: int) -> CameraPoses:
    """Return camera poses that put two legs where two pairs of a picture are."""
    pairs, targets = (
        picture.pairs.take(np.arange(min(N_SECOND, len(picture.pairs)))),
        picture.targets,
    )
    nothing = CameraPoses.none(n_legs)
    if len(pairs) < 2 or len(set(targets.leg.tolist())) < 2:
        return nothing
    firsts = _firsts(pairs, targets)
    if len(firsts.u) == 0:
        return nothing
    middle = targets.ends.mean(axis=1)
    segment = targets.ends[:, 1] - targets.ends[:, 0]
    length = np.linalg.norm(segment, axis=1)
    direction = segment / length[:, None]
    # All in frames whose x axis is the first leg: of the camera, and of the base link.
    U_c, U_b = _triads(firsts.u), _triads(direction)[firsts.target]
    rays, planes = _rays(pairs), _planes(pairs)
    n_all, ray_all = planes @ U_c, rays @ U_c  # (n_firsts, n_pairs, 3)
    P_all = np.einsum("fxi,fx->fi", U_c, firsts.P)
    w_all = direction @ U_b  # (n_firsts, n_targets, 3)
    d_all = (middle[None] - middle[firsts.target][:, None]) @ U_b
    flat = np.linalg.norm(planes[:, :2], axis=1)
    seen = pair_widths(pairs)
    # The depth of the first leg is no better known.
    sigma = MAX_WIDTH_SIGMAS * np.sqrt(2.0) * np.hypot(WIDTH_ERROR, pairs.pixel / seen)
    # Depths (n_pairs, n_targets) where segments are as wide as pairs, and what second ones reach.
    deep = 2.0 * targets.radius / (flat * seen)[:, None]
    reach = np.linalg.norm(d_all, axis=2) + firsts.tolerance[:, None] + HALF * length
    near, far = deep * np.exp(-sigma)[:, None], deep * np.exp(sigma)[:, None]
    is_near = near <= (firsts.P[:, 2:] + reach)[:, None]
    is_near &= far >= (firsts.P[:, 2:] - reach)[:, None]
    f, k, m, cosine, sine = _turns(firsts, targets, n_all, w_all, is_near)
    n, P, d = n_all[f, k], P_all[f], _turned(d_all[f, m], cosine, sine)
    across = n[:, 0]
    place = -(_dot(n, d) + _dot(n, P)) / np.where(np.abs(across) < MIN_CROSSING, np.inf, across)
    good = np.flatnonzero(np.abs(place) <= firsts.tolerance[f])
    f, k, m = f[good], k[good], m[good]
    cosine, sine, place = cosine[good], sine[good], place[good]
    # Where the second pair's middle is on the second leg, and how wide it should be there.
    X = d[good] + P[good]
    X[:, 0] += place
    v, ray = _turned(w_all[f, m], cosine, sine), ray_all[f, k]
    vX, vr, Xr = _dot(v, X), _dot(v, ray), _dot(X, ray)
    across = vX * vr - Xr
    along = -(_dot(X, X) * vr - vX * Xr) / np.where(np.abs(across) < 1e-12, 1e-12, across)
    depth = _dot(U_c[f, 2], X + along[:, None] * v)
    off = np.abs(np.log(deep[k, m] / np.where(depth > 0.0, depth, 1.0))) / sigma[k]
    good_along = np.abs(along) <= HALF * length[m]
    good = np.flatnonzero((off <= 1.0) & good_along & (depth > 0.0))
    merit = pairs.merit[k] + pairs.merit[firsts.pair[f]]
    good = good[np.argsort(-(merit * (1.0 - 0.5 * off**2))[good], kind="stable")[:MAX_POSES]]
    f, place = f[good], place[good]
    R = U_c[f] @ _about_x(cosine[good], sine[good]) @ U_b[f].swapaxes(1, 2)
    where = firsts.P[f] + place[:, None] * firsts.u[f]
    t = where - np.einsum("nij,nj->ni", R, middle[firsts.target[f]])
    return CameraPoses.rigid(R, t, n_legs)


def _turns(
    firsts: _FirstAssignments, targets: LegSegments, n: Array, w: Array, is_near: BoolArray
) -> tuple[IntArray, IntArray, IntArray, Array, Array]:
    """Return the turns about a first leg that lay a second one into the plane of a second pair.

    Indices of the first, the second pair and the second segment, and cosine and sine of the turn,
    from the normals n (n_firsts, n_pairs, 3) of the planes and the directions w (n_firsts,
    n_targets, 3) of the segments; ``is_near`` (n_firsts, n_pairs, n_targets) says which come into
    question.
    """
    good = is_near & (np.arange(n.shape[1]) != firsts.pair[:, None])[:, :, None]
    good &= (targets.leg != targets.leg[firsts.target][:, None])[:, None, :]
    f, k, m = np.nonzero(good)
    one, other = n[f, k].astype(np.float32), w[f, m].astype(np.float32)
    c0 = one[:, 0] * other[:, 0]
    c1 = one[:, 1] * other[:, 1] + one[:, 2] * other[:, 2]
    c2 = one[:, 2] * other[:, 1] - one[:, 1] * other[:, 2]
    turns = np.flatnonzero(c0**2 <= MAX_COSINE**2 * (c1**2 + c2**2))
    f, k, m = f[turns], k[turns], m[turns]
    c0, c1, c2 = (c[turns].astype(np.float64) for c in (c0, c1, c2))
    size = np.maximum(np.hypot(c1, c2), 1e-12)
    along, c1, c2 = np.clip(-c0 / size, -1.0, 1.0), c1 / size, c2 / size
    across = np.sqrt(1.0 - along**2)
    cosine = np.concatenate([c1 * along - c2 * across, c1 * along + c2 * across])
    sine = np.concatenate([c2 * along + c1 * across, c2 * along - c1 * across])
    f, k, m = (np.concatenate([x, x]) for x in (f, k, m))
    return f, k, m, cosine, sine


def _firsts(pairs: CandidatePairs, targets: LegSegments) -> _FirstAssignments:
    """Take the best pairs for every segment, with all leans that their edges allow."""
    n = min(N_FIRST, len(pairs))
    first = pairs.take(np.arange(n))
    rays, planes = _rays(first), _planes(first)
    along = np.concatenate([first.along, np.zeros((n, 1))], axis=1)
    ray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    side = np.cross(ray, planes)  # in the plane of the axis, across the ray
    side *= np.sign(_dot(side, along))[:, None]
    width = pair_widths(first)
    cone = np.log(first.width[:, 1] / first.width[:, 0])[:, None, None]
    sigma = (CONE + 1.5 * pairs.pixel / width)[:, None, None]
    length = np.linalg.norm(targets.ends[:, 1] - targets.ends[:, 0], axis=1)
    flat = np.linalg.norm(planes[:, :2], axis=1)
    z = 2.0 * targets.radius / (width * flat)[:, None]  # (n, n_targets)
    v = np.cos(LEANS)[:, None] * side[:, None] + np.sin(LEANS)[:, None] * ray[:, None]
    # The ends of the pair on an axis along v, and how their widths differ.
    steep = np.maximum(np.abs(np.einsum("nlx,nx->nl", v, along)), 0.2)
    reach = (first.half_length[:, None] / steep)[:, None, :] * z[..., None]  # (n, n_targets, leans)
    z0, z1 = z[..., None] - reach * v[:, None, :, 2], z[..., None] + reach * v[:, None, :, 2]
    longest = MAX_LENGTH_RATIO[0] * length + MAX_LENGTH_RATIO[1] * targets.radius
    good = (np.minimum(z0, z1) > 0.0) & (2.0 * reach <= longest[:, None])
    ratio = np.log(np.where(good, z0, 1.0) / np.where(good, z1, 1.0))
    good &= np.abs(ratio - cone) <= 3.0 * sigma
    i, j, lean = np.nonzero(good)
    tolerance = np.maximum(0.5 * length[j] - reach[good], 0.0) + PLACE_TOLERANCE * length[j]
    u, P = v[i, lean], z[i, j][:, None] * rays[i]
    return _FirstAssignments(
        np.concatenate([u, -u]), *(np.concatenate([x, x]) for x in (P, tolerance, i, j))
    )


def _rays(pairs: CandidatePairs) -> Array:
    """Return the points (x, y, 1) of the middles, (n, 3)."""
    return np.concatenate([pairs.middle, np.ones((len(pairs), 1))], axis=1)


def _planes(pairs: CandidatePairs) -> Array:
    """Return the unit normals (n, 3) of the planes of the axes and the camera centre."""
    along = np.concatenate([pairs.along, np.zeros((len(pairs), 1))], axis=1)
    planes = np.cross(along, _rays(pairs))
    return np.asarray(planes / np.linalg.norm(planes, axis=1, keepdims=True))


def _triads(u: Array) -> Array:
    """Return right-handed orthonormal matrices (n, 3, 3) whose first columns are u."""
    other = np.eye(3)[np.argmin(np.abs(u), axis=1)]
    v = np.cross(u, other)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.stack([u, v, np.cross(u, v)], axis=2)


def _about_x(cosine: Array, sine: Array) -> Array:
    """Return rotations (n, 3, 3) about the x axis."""
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    rows = [one, zero, zero, zero, cosine, -sine, zero, sine, cosine]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


def _turned(x: Array, cosine: Array, sine: Array) -> Array:
    """Return vectors (n, 3) turned about the x axis."""
    y, z = x[:, 1], x[:, 2]
    return np.stack([x[:, 0], cosine * y - sine * z, sine * y + cosine * z], axis=-1)


def _dot(x: Array, y: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", x, y))
