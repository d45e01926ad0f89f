"""Camera poses from two bars and two legs.

A bar fixes the plane of a leg's axis, and its width the distance. Open are the lean of the leg
towards the camera, which end is which, the turn about the leg and the place along it. The lean is
tried; a second bar that is to be a second leg gives the turn and the place, and must be as wide as
these demand: most combinations end there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.recognition.agreement import WIDTH_ERROR, Picture, Poses, seen_width
from legcal.recognition.bars import Bars
from legcal.recognition.targets import Targets

N_FIRST, N_SECOND = 20, 40  # best bars that are tried as the first one, and as the second
LEANS = np.deg2rad([-55.0, -33.0, -11.0, 11.0, 33.0, 55.0])
LONGER = 1.25, 3.0  # a bar is at most so much longer than the piece that it shows: factor, radii
CONE = 0.12  # error of the logarithm of the ratio of the widths at both ends
WIDTH_REACH = 2.5  # standard deviations of the width of the second bar
SLACK = 0.2  # of the place along a piece, in its lengths
TURNED = 1.05  # how far from a solution bars and legs may be that allow none, as a cosine
CROSSING = 0.03  # sine between axes seen, below which the second bar does not tell the place
MOST = 3000  # poses of a picture


@dataclass(frozen=True, eq=False)
class _Firsts:
    """Bars taken for legs, each with a lean: all about a start but the turn and the place."""

    u: Array  # (n, 3) direction in the camera frame, from base to platform
    P: Array  # (n, 3) where the middle of the piece is put [m]
    slack: Array  # (n,) how far along the leg it may be instead [m]
    bar: IntArray  # (n,)
    target: IntArray  # (n,)


def pose_starts(picture: Picture, n_legs: int) -> Poses:
    """Return camera poses that put two legs where two bars are.

    Parameters
    ----------
    picture : Picture
        Its best bars and all its targets are combined.
    n_legs : int
        Number of legs of the machine.
    """
    bars, targets = picture.bars.take(np.arange(min(N_SECOND, len(picture.bars)))), picture.targets
    nothing = Poses.rigid(np.zeros((0, 3, 3)), np.zeros((0, 3)), n_legs)
    if len(bars) < 2 or len(set(targets.leg.tolist())) < 2:
        return nothing
    firsts = _firsts(bars, targets)
    if len(firsts.u) == 0:
        return nothing
    middle = targets.ends.mean(axis=1)
    piece = targets.ends[:, 1] - targets.ends[:, 0]
    length = np.linalg.norm(piece, axis=1)
    direction = piece / length[:, None]
    # All in frames whose x axis is the first leg: of the camera, and of the base link.
    U_c, U_b = _triads(firsts.u), _triads(direction)[firsts.target]
    rays, planes = _rays(bars), _planes(bars)
    n_all, ray_all = planes @ U_c, rays @ U_c  # (n_firsts, n_bars, 3)
    P_all = np.einsum("fxi,fx->fi", U_c, firsts.P)
    w_all = direction @ U_b  # (n_firsts, n_targets, 3)
    d_all = (middle[None] - middle[firsts.target][:, None]) @ U_b
    f, k, m, cosine, sine = _turns(firsts, targets, n_all, w_all)
    n, P, d = n_all[f, k], P_all[f], _turned(d_all[f, m], cosine, sine)
    across = n[:, 0]
    place = -(_dot(n, d) + _dot(n, P)) / np.where(np.abs(across) < CROSSING, np.inf, across)
    good = np.flatnonzero(np.abs(place) <= firsts.slack[f])
    f, k, m = f[good], k[good], m[good]
    cosine, sine, place = cosine[good], sine[good], place[good]
    # Where the second bar's middle is on the second leg, and how wide it should be there.
    X = d[good] + P[good]
    X[:, 0] += place
    v, ray = _turned(w_all[f, m], cosine, sine), ray_all[f, k]
    vX, vr, Xr = _dot(v, X), _dot(v, ray), _dot(X, ray)
    along = -(_dot(X, X) * vr - vX * Xr) / _safe(vX * vr - Xr)
    depth = _dot(U_c[f, 2], X + along[:, None] * v)
    flat = np.linalg.norm(planes[k][:, :2], axis=1)
    expected = 2.0 * targets.radius[m] / (np.where(depth > 0.0, depth, 1.0) * flat)
    seen = seen_width(bars)[k]
    # The depth of the first leg is no better known.
    sigma = np.sqrt(2.0) * np.hypot(WIDTH_ERROR, bars.pixel / seen)
    off = np.abs(np.log(expected / seen)) / (WIDTH_REACH * sigma)
    good_along = np.abs(along) <= (0.5 + 0.5 * SLACK) * length[m]
    good = np.flatnonzero((off <= 1.0) & good_along & (depth > 0.0))
    merit = bars.merit[k] + bars.merit[firsts.bar[f]]
    good = good[np.argsort(-(merit * (1.0 - 0.5 * off**2))[good], kind="stable")[:MOST]]
    f, place = f[good], place[good]
    R = U_c[f] @ _about_x(cosine[good], sine[good]) @ U_b[f].swapaxes(1, 2)
    where = firsts.P[f] + place[:, None] * firsts.u[f]
    t = where - np.einsum("nij,nj->ni", R, middle[firsts.target[f]])
    return Poses.rigid(R, t, n_legs)


def _turns(
    firsts: _Firsts, targets: Targets, n: Array, w: Array
) -> tuple[IntArray, IntArray, IntArray, Array, Array]:
    """Return the turns about a first leg that lay a second one into the plane of a second bar.

    Indices of the first, the second bar and the second piece, and cosine and sine of the turn,
    from the normals n (n_firsts, n_bars, 3) of the planes and the directions w (n_firsts,
    n_targets, 3) of the pieces.
    """
    n, w = n[:, :, None, :].astype(np.float32), w[:, None, :, :].astype(np.float32)
    c0 = n[..., 0] * w[..., 0]
    c1 = n[..., 1] * w[..., 1] + n[..., 2] * w[..., 2]
    c2 = n[..., 2] * w[..., 1] - n[..., 1] * w[..., 2]
    good = c0**2 <= TURNED**2 * (c1**2 + c2**2)
    good &= (np.arange(n.shape[1]) != firsts.bar[:, None])[:, :, None]
    good &= (targets.leg != targets.leg[firsts.target][:, None])[:, None, :]
    f, k, m = np.nonzero(good)
    c0, c1, c2 = (c[good].astype(np.float64) for c in (c0, c1, c2))
    step = np.arccos(np.clip(-c0 / np.maximum(np.hypot(c1, c2), 1e-12), -1.0, 1.0))
    base = np.arctan2(c2, c1)
    turn = np.concatenate([base + step, base - step])
    f, k, m = (np.concatenate([x, x]) for x in (f, k, m))
    return f, k, m, np.cos(turn), np.sin(turn)


def _firsts(bars: Bars, targets: Targets) -> _Firsts:
    """Take the best bars for every piece, with all leans that their edges allow."""
    n = min(N_FIRST, len(bars))
    first = bars.take(np.arange(n))
    rays, planes = _rays(first), _planes(first)
    along = np.concatenate([first.along, np.zeros((n, 1))], axis=1)
    ray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    side = np.cross(ray, planes)  # in the plane of the axis, across the ray
    side *= np.sign(_dot(side, along))[:, None]
    width = seen_width(first)
    cone = np.log(first.width[:, 1] / first.width[:, 0])[:, None, None]
    sigma = (CONE + 1.5 * bars.pixel / width)[:, None, None]
    length = np.linalg.norm(targets.ends[:, 1] - targets.ends[:, 0], axis=1)
    flat = np.linalg.norm(planes[:, :2], axis=1)
    z = 2.0 * targets.radius / (width * flat)[:, None]  # (n, n_targets)
    v = np.cos(LEANS)[:, None] * side[:, None] + np.sin(LEANS)[:, None] * ray[:, None]
    # The ends of the bar on an axis along v, and how their widths differ.
    steep = np.maximum(np.abs(np.einsum("nlx,nx->nl", v, along)), 0.2)
    reach = (first.half_length[:, None] / steep)[:, None, :] * z[..., None]  # (n, n_targets, leans)
    z0, z1 = z[..., None] - reach * v[:, None, :, 2], z[..., None] + reach * v[:, None, :, 2]
    longest = LONGER[0] * length + LONGER[1] * targets.radius
    good = (np.minimum(z0, z1) > 0.0) & (2.0 * reach <= longest[:, None])
    ratio = np.log(np.where(good, z0, 1.0) / np.where(good, z1, 1.0))
    good &= np.abs(ratio - cone) <= 3.0 * sigma
    i, j, lean = np.nonzero(good)
    slack = np.maximum(0.5 * length[j] - reach[good], 0.0) + SLACK * length[j]
    u, P = v[i, lean], z[i, j][:, None] * rays[i]
    return _Firsts(np.concatenate([u, -u]), *(np.concatenate([x, x]) for x in (P, slack, i, j)))


def _rays(bars: Bars) -> Array:
    """Return the points (x, y, 1) of the middles, (n, 3)."""
    return np.concatenate([bars.middle, np.ones((len(bars), 1))], axis=1)


def _planes(bars: Bars) -> Array:
    """Return the unit normals (n, 3) of the planes of the axes and the camera centre."""
    along = np.concatenate([bars.along, np.zeros((len(bars), 1))], axis=1)
    planes = np.cross(along, _rays(bars))
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


def _safe(x: Array) -> Array:
    return np.where(np.abs(x) < 1e-12, 1e-12, x)


def joined(parts: Sequence[Poses]) -> Poses:
    """Return all poses of some sets."""
    R, t, shift = ([getattr(p, name) for p in parts] for name in ("R", "t", "shift"))
    return Poses(np.concatenate(R), np.concatenate(t), np.concatenate(shift))
