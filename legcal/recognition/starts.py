"""Camera poses from two bars and two legs.

A bar fixes the plane of a leg's axis, and its width the distance. Open are the lean of the leg
towards the camera, which end is which, the turn about the leg and the place along it. The lean is
tried; a second bar that is to be a second leg gives the turn and the place, and must be as wide as
these demand: most combinations end there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array
from legcal.recognition.agreement import WIDTH_ERROR, Picture, Poses
from legcal.recognition.bars import Bars
from legcal.recognition.targets import Targets

N_FIRST, N_SECOND = 14, 40  # best bars that are tried as the first one, and as the second
LEANS = np.deg2rad([-55.0, -33.0, -11.0, 11.0, 33.0, 55.0])
LONGER = 1.2  # a bar may be so much longer than the piece that it shows
CONE = 0.12  # error of the logarithm of the ratio of the widths at both ends
WIDTH_REACH = 2.5  # standard deviations of the width of the second bar
SLACK = 0.2  # of the place along a piece, in its lengths
TURNED = 1.05  # how far from a solution bars and legs may be that allow none, as a cosine
CROSSING = 0.03  # sine between axes seen, below which the second bar does not tell the place


@dataclass(frozen=True, eq=False)
class _Firsts:
    """Bars taken for legs, each with a lean: all about a start but the turn and the place."""

    u: Array  # (n, 3) direction in the camera frame, from base to platform
    P: Array  # (n, 3) where the middle of the piece is put [m]
    slack: Array  # (n,) how far along the leg it may be instead [m]
    bar: Array  # (n,) int
    target: Array  # (n,) int


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
    U_c, U_b = _triads(firsts.u), _triads(direction)[firsts.target]
    rays, planes = _rays(bars), _planes(bars)
    # Turn about the first leg that lays the second one into the plane of the second bar.
    n = np.einsum("fxi,kx->fki", U_c, planes)[:, :, None, :]
    w = np.einsum("fxi,lx->fli", U_b, direction)[:, None, :, :]
    c0 = n[..., 0] * w[..., 0]
    c1 = n[..., 1] * w[..., 1] + n[..., 2] * w[..., 2]
    c2 = n[..., 2] * w[..., 1] - n[..., 1] * w[..., 2]
    size = np.hypot(c1, c2)
    good = np.abs(c0) <= TURNED * size
    good &= (np.arange(len(bars)) != firsts.bar[:, None])[:, :, None]
    good &= (targets.leg != targets.leg[firsts.target][:, None])[:, None, :]
    f, k, m = np.nonzero(good)
    cosine = np.clip(-c0[f, k, m] / np.maximum(size[f, k, m], 1e-12), -1.0, 1.0)
    base, step = np.arctan2(c2[f, k, m], c1[f, k, m]), np.arccos(cosine)
    turn = np.concatenate([base + step, base - step])
    f, k, m = (np.concatenate([x, x]) for x in (f, k, m))
    R = U_c[f] @ _about_x(turn) @ U_b[f].swapaxes(1, 2)
    u, P = firsts.u[f], firsts.P[f]
    apart = np.einsum("nij,nj->ni", R, middle[m] - middle[firsts.target[f]])
    across = np.einsum("ni,ni->n", planes[k], u)
    place = -np.einsum("ni,ni->n", planes[k], apart + P) / np.where(
        np.abs(across) < CROSSING, np.inf, across
    )
    good = np.abs(place) <= firsts.slack[f]
    # Where the second bar's middle is on the second leg, and how wide it should be there.
    X = apart + P + place[:, None] * u
    v = np.einsum("nij,nj->ni", R, direction[m])
    ray = rays[k]
    side = np.cross(np.cross(v, X), ray)
    along = -np.einsum("ni,ni->n", side, X) / _safe(np.einsum("ni,ni->n", side, v))
    depth = (X + along[:, None] * v)[:, 2]
    good &= (np.abs(along) <= (0.5 + 0.5 * SLACK) * length[m]) & (depth > 0.0)
    flat = np.linalg.norm(planes[k][:, :2], axis=1)
    expected = 2.0 * targets.radius[m] / (np.where(depth > 0.0, depth, 1.0) * flat)
    seen = bars.width.mean(axis=1)[k]
    # The depth of the first leg is no better known.
    sigma = np.sqrt(2.0) * np.hypot(WIDTH_ERROR, bars.pixel / seen)
    good &= np.abs(np.log(expected / seen)) <= WIDTH_REACH * sigma
    R, u, P, f = R[good], u[good], P[good], f[good]
    t = P + place[good, None] * u - np.einsum("nij,nj->ni", R, middle[firsts.target[f]])
    return Poses.rigid(R, t, n_legs)


def _firsts(bars: Bars, targets: Targets) -> _Firsts:
    """Take the best bars for every piece, with all leans that their edges allow."""
    rays, planes = _rays(bars), _planes(bars)
    u, P, slack, bar, target = [], [], [], [], []
    length = np.linalg.norm(targets.ends[:, 1] - targets.ends[:, 0], axis=1)
    for i in range(min(N_FIRST, len(bars))):
        along = np.append(bars.along[i], 0.0)
        ray = rays[i] / np.linalg.norm(rays[i])
        side = np.cross(ray, planes[i])  # in the plane of the axis, across the ray
        side *= np.sign(side @ along)
        width = float(bars.width[i].mean())
        flat = float(np.linalg.norm(planes[i, :2]))
        cone = float(np.log(bars.width[i, 1] / bars.width[i, 0]))
        sigma = CONE + 1.5 * bars.pixel / width
        for j in range(len(targets)):
            z = 2.0 * float(targets.radius[j]) / (width * flat)
            for lean in LEANS:
                v = np.cos(lean) * side + np.sin(lean) * ray
                # The ends of the bar on an axis along v, and how their widths differ.
                reach = float(bars.half_length[i]) * z / max(abs(float(v @ along)), 0.2)
                z0, z1 = z - reach * v[2], z + reach * v[2]
                if min(z0, z1) <= 0.0 or 2.0 * reach > LONGER * length[j]:
                    continue
                if abs(np.log(z0 / z1) - cone) > 3.0 * sigma:
                    continue
                for sign in (1.0, -1.0):
                    u.append(sign * v)
                    P.append(z * rays[i])
                    slack.append(max(0.5 * length[j] - reach, 0.0) + SLACK * length[j])
                    bar.append(i)
                    target.append(j)
    return _Firsts(
        np.array(u).reshape(-1, 3),
        np.array(P).reshape(-1, 3),
        np.array(slack),
        np.array(bar, dtype=np.intp),
        np.array(target, dtype=np.intp),
    )


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


def _about_x(angle: Array) -> Array:
    """Return rotations (n, 3, 3) about the x axis."""
    c, s = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack([one, zero, zero, zero, c, -s, zero, s, c], axis=-1).reshape(-1, 3, 3)


def _safe(x: Array) -> Array:
    return np.where(np.abs(x) < 1e-12, 1e-12, x)


def joined(parts: Sequence[Poses]) -> Poses:
    """Return all poses of some sets."""
    R, t, shift = ([getattr(p, name) for p in parts] for name in ("R", "t", "shift"))
    return Poses(np.concatenate(R), np.concatenate(t), np.concatenate(shift))
