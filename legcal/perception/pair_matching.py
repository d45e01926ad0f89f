"""Camera poses matched to the edge pairs of pictures, and Gauss-Newton steps of poses.

A leg that is where a pose has it shows an edge pair along its axis, as wide as its radius says. A
few hundred poses are scored at once by all pictures of a view, and improved by Gauss-Newton steps
in which joints may be off what the model says.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import Array, IntArray, cross, cross_matrices, rotation_matrices
from legcal.machine import Cylinder
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.vision import visible_segments

MIN_DEPTH = 0.02  # depth of the nearest point of a leg [m]
WIDTH_ERROR = 0.08  # of a pair and of what is predicted: relative, one standard deviation
WIDTH_PIXELS = 1.0  # and of a pair in its pixels
MAX_WIDTH_SIGMAS = 2.5  # standard deviations
WIDTH_BIAS_PIXELS = 0.4  # of pairs: shading ends inside an outline [px of a pair]
TOLERANCE_PIXELS = 1.5  # added to every tolerance [px of a pair]
LINE_ERROR, LINE_PIXELS = 2e-3, 0.7  # of an axis beside its pair: [m], [px]
ALONG_ERROR = 0.1  # of the middle of a pair that is as long as its segment, in its length
MIN_LINE_SHARE = 1.0 / 6.0  # at least this part of the tolerance
MIN_OVERLAP = 0.8  # share of a pair that should lie along the leg
CHUNK = 128  # poses scored together
TURN_SIGMA, DISPLACEMENT_SIGMA = 0.3, 0.1  # prior of a step: angle [rad], by the distance
MAX_TURN, MAX_DISPLACEMENT = 0.4, 0.2  # the same, at most


@dataclass(frozen=True, eq=False)
class LegSegments:
    """The visible segments of all legs at the reading of a picture."""

    leg: IntArray  # (n,) the leg of each segment
    ends: Array  # (n, 2, 3) of its axis in the base link, the first nearer to the base joint [m]
    place: Array  # (n, 2) where these ends are along the leg, 0 at A and 1 at B
    radius: Array  # (n,) [m]
    share: Array  # (n,) its part of the visible length of its leg

    def __len__(self) -> int:
        """Return the number of segments."""
        return len(self.leg)


def leg_segments(
    A_base: Array, B_base: Array, cylinders: Sequence[Sequence[Cylinder]], legs: IntArray
) -> LegSegments:
    """Return the segments of some legs (m,), joint centres (n_legs, 3) in the base link [m]."""
    leg, place, ends, radius, share = [], [], [], [], []
    for j in legs.tolist():
        AB = B_base[j] - A_base[j]
        length = float(np.linalg.norm(AB))
        segments = visible_segments(cylinders[j], length)
        total = sum(segment.end - segment.start for segment in segments)
        for segment in segments:
            leg.append(j)
            place.append((segment.start / length, segment.end / length))
            ends.append(A_base[j] + np.outer(place[-1], AB))
            radius.append(segment.radius)
            share.append((segment.end - segment.start) / total)
    return LegSegments(
        np.array(leg, dtype=np.intp),
        np.array(ends).reshape(-1, 2, 3),
        np.array(place).reshape(-1, 2),
        np.array(radius),
        np.array(share),
    )


@dataclass(frozen=True, eq=False)
class CameraPoses:
    """Candidate camera poses T_camera_base."""

    R: Array  # (n, 3, 3)
    t: Array  # (n, 3) [m]
    shift: Array  # (n, n_legs, 2, 3) of A and B against the model, in the base link [m]

    @classmethod
    def rigid(cls, R: Array, t: Array, n_legs: int) -> "CameraPoses":
        """Return poses at which all legs are where the model has them."""
        return cls(R, t, np.zeros((len(R), n_legs, 2, 3)))

    @classmethod
    def none(cls, n_legs: int) -> "CameraPoses":
        """Return no pose."""
        return cls.rigid(np.zeros((0, 3, 3)), np.zeros((0, 3)), n_legs)

    @classmethod
    def one(cls, T_base_camera: RigidTransform, shift: Array) -> "CameraPoses":
        """Return one pose, with shifts (n_legs, 2, 3)."""
        T = T_base_camera.inv()
        return cls(T.rotation.as_matrix()[None], T.translation[None], shift[None])

    @classmethod
    def joined(cls, parts: "Sequence[CameraPoses]") -> "CameraPoses":
        """Return all poses of some sets."""
        return cls(
            *(np.concatenate([getattr(p, name) for p in parts]) for name in ("R", "t", "shift"))
        )

    def T_base_camera(self, i: int = 0) -> RigidTransform:
        """Return a pose the other way round."""
        R = Rotation.from_matrix(self.R[i])
        return RigidTransform.from_components(self.t[i], R).inv()

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.R)

    def take(self, chosen: IntArray) -> "CameraPoses":
        """Return some of the poses."""
        return CameraPoses(self.R[chosen], self.t[chosen], self.shift[chosen])


@dataclass(frozen=True, eq=False)
class Picture:
    """What is known of a picture: its edge pairs, and the legs that it may show."""

    pairs: CandidatePairs
    targets: LegSegments  # segments of legs at its reading
    corners: Array  # (2, 2) least and greatest x and y of the sensor plane that it shows
    # Its camera frame, where poses are those of another one that is fixed to it: X_camera = R X + t
    R: Array = field(default_factory=lambda: np.eye(3))
    t: Array = field(default_factory=lambda: np.zeros(3))


class PairMatches(NamedTuple):
    """How well poses explain a picture, (n_poses, n_segments) each."""

    score: Array  # of each segment, 0 to 1: how well, times how much of its visible length
    pair: IntArray  # the edge pair with that score
    visible: Array  # share of each segment that is inside the picture

    @property
    def exclusive_score(self) -> Array:
        """The scores, where a pair counts only for the segment that it suits best."""
        same = self.pair[:, :, None] == self.pair[:, None, :]
        better = self.score[:, None, :] > self.score[:, :, None]
        return np.where(np.any(same & better, axis=2), 0.0, self.score)


def match_pairs(picture: Picture, poses: CameraPoses, tolerance: float) -> PairMatches:
    """Match poses to a picture; ``tolerance`` is how far axes may be from pairs [m]."""
    n, n_targets = len(poses), len(picture.targets)
    if n == 0 or n_targets == 0 or len(picture.pairs) == 0:
        visible = _in_picture(picture, poses)[3] if n and n_targets else np.zeros((n, n_targets))
        return PairMatches(np.zeros((n, n_targets)), np.zeros((n, n_targets), np.intp), visible)
    parts = [
        _match_chunk(picture, poses.take(np.arange(k, min(k + CHUNK, len(poses)))), tolerance)
        for k in range(0, len(poses), CHUNK)
    ]
    value, pair, visible = (np.concatenate(x) for x in zip(*parts, strict=True))
    return PairMatches(value, pair, visible)


def _in_picture(picture: Picture, poses: CameraPoses) -> tuple[Array, Array, Array, Array]:
    """Return ends X (n, T, 2, 3) [m], points (n, T, 2, 2), widths (n, T, 2), and what is shown."""
    targets = picture.targets
    ends = np.broadcast_to(targets.ends, (len(poses), *targets.ends.shape))
    if np.any(poses.shift):
        of_leg = poses.shift[:, targets.leg]  # (n, T, 2, 3)
        at = targets.place[:, :, None]
        ends = ends + (1.0 - at) * of_leg[:, :, :1] + at * of_leg[:, :, 1:]
    n_ends = 2 * len(targets)
    R, t = picture.R @ poses.R, poses.t @ picture.R.T + picture.t
    X = ends.reshape(-1, n_ends, 3) @ R.swapaxes(1, 2) + t[:, None, :]
    X = X.reshape(-1, len(targets), 2, 3)
    z = np.maximum(X[..., 2:], MIN_DEPTH)
    xy = X[..., :2] / z
    normal = cross(X[:, :, 0], X[:, :, 1])
    level = normal[..., 0] ** 2 + normal[..., 1] ** 2
    flat = np.sqrt(level / (level + normal[..., 2] ** 2 + 1e-24))
    width = 2.0 * targets.radius[:, None] / (z[..., 0] * np.maximum(flat, 0.1)[..., None])
    front = (X[..., 2] > MIN_DEPTH).all(axis=-1)
    return X, xy, width, np.where(front, _shown(xy, picture.corners), 0.0)


def _shown(xy: Array, corners: Array) -> Array:
    """Return the share of segments xy (..., 2, 2) that lies within a rectangle, (...)."""
    start, step = xy[..., 0, :], xy[..., 1, :] - xy[..., 0, :]
    safe = np.where(np.abs(step) > 1e-9, step, 1e-9)
    one, two = (corners[0] - start) / safe, (corners[1] - start) / safe
    enter = np.minimum(one, two).max(axis=-1)
    leave = np.maximum(one, two).min(axis=-1)
    return np.asarray(np.clip(np.minimum(leave, 1.0) - np.maximum(enter, 0.0), 0.0, 1.0))


def _match_chunk(
    picture: Picture, poses: CameraPoses, tolerance: float
) -> tuple[Array, IntArray, Array]:
    """Return score, pair and visible of :class:`PairMatches`."""
    pairs = picture.pairs
    X, xy, width, visible = _in_picture(picture, poses)
    reach = _tolerances(pairs, X, tolerance)[..., None].astype(np.float32)
    xy, width = xy.astype(np.float32), width.astype(np.float32)
    frame = np.concatenate([pairs.along, pairs.normal]).T.astype(np.float32)  # (2, 2 n_pairs)
    own = np.concatenate(
        [np.sum(pairs.middle * pairs.along, axis=1), np.sum(pairs.middle * pairs.normal, axis=1)]
    ).astype(np.float32)
    place = xy @ frame - own
    n = len(pairs)
    a0, a1 = place[:, :, 0, :n], place[:, :, 1, :n]
    o0, o1 = place[:, :, 0, n:], place[:, :, 1, n:]
    half = pairs.half_length.astype(np.float32)
    run = a1 - a0
    run = np.where(np.abs(run) < 1e-6, np.float32(1e-6), run)
    slope = (o1 - o0) / run
    gap = np.abs(o0 - slope * a0) + np.abs(slope) * half
    value = np.maximum(1.0 - (gap / reach) ** 2, 0.0)
    w0, w1 = width[:, :, 0, None], width[:, :, 1, None]
    expected = np.maximum(w0 - (w1 - w0) * a0 / run, np.float32(1e-6))
    seen = pair_widths(pairs).astype(np.float32)
    sigma = np.hypot(WIDTH_ERROR, WIDTH_PIXELS * pairs.pixel / seen).astype(np.float32)
    pull = np.log(expected / seen) / (np.float32(MAX_WIDTH_SIGMAS) * sigma)
    value *= np.maximum(1.0 - pull**2, 0.0)
    overlap = np.minimum(half, np.maximum(a0, a1)) - np.maximum(-half, np.minimum(a0, a1))
    overlap = np.maximum(overlap, 0.0)
    value *= np.minimum(overlap / (np.float32(2.0 * MIN_OVERLAP) * half), 1.0)
    length = np.abs(run) * np.maximum(visible, 0.05)[..., None].astype(np.float32)
    value *= np.minimum(overlap / length, 1.0)
    best = np.argmax(value, axis=2)
    found = np.take_along_axis(value, best[..., None], axis=2)[..., 0]
    return np.where(visible > 0.0, found, 0.0).astype(np.float64), best, visible


def _tolerances(pairs: CandidatePairs, X: Array, tolerance: float) -> Array:
    """Return a tolerance [m] on the sensor plane at segments X (n, T, 2, 3), (n, T)."""
    depth = np.maximum(X[..., 2].mean(axis=-1), MIN_DEPTH)
    return np.asarray(tolerance / depth + TOLERANCE_PIXELS * pairs.pixel)


def pair_widths(pairs: CandidatePairs) -> Array:
    """Return the widths of pairs (n,) in their middle, as wide as legs are that look like this."""
    return np.asarray(pairs.width.mean(axis=1) + WIDTH_BIAS_PIXELS * pairs.pixel)


def gauss_newton_step(
    pictures: Sequence[Picture],
    poses: CameraPoses,
    matches: Sequence[PairMatches],
    tolerance: float,
    joint_error: float = 0.0,
) -> CameraPoses:
    """Return poses after one Gauss-Newton step towards the pairs that they match.

    By pictures of one camera and matches with each, for a tolerance as in :func:`match_pairs`;
    ``joint_error`` is the standard deviation of the model's joints [m], 0 to leave them in place.
    """
    n, n_legs = poses.shift.shape[:2]
    centre = _centre(pictures, poses)
    H, b = _step_prior(centre), np.zeros((n, 6))
    H_leg, H_cross = np.zeros((n, n_legs, 6, 6)), np.zeros((n, n_legs, 6, 6))
    b_leg = np.zeros((n, n_legs, 6))
    for picture, found in zip(pictures, matches, strict=True):
        if len(picture.pairs) == 0 or len(picture.targets) == 0:
            continue
        J, J_leg, residual, weight = _equations(picture, poses, found, tolerance)
        weighted = (J * weight[..., None]).swapaxes(2, 3)  # (n, T, 6, 4)
        H += (weighted @ J).sum(axis=1)
        b -= (weighted @ residual[..., None])[..., 0].sum(axis=1)
        if joint_error > 0.0:
            weighted_leg = (J_leg * weight[..., None]).swapaxes(2, 3)
            of_leg, cross = weighted_leg @ J_leg, weighted @ J_leg
            gradient = (weighted_leg @ residual[..., None])[..., 0]
            for segment, leg in enumerate(picture.targets.leg.tolist()):
                H_leg[:, leg] += of_leg[:, segment]
                H_cross[:, leg] += cross[:, segment]
                b_leg[:, leg] -= gradient[:, segment]
    if joint_error == 0.0:
        xi = np.asarray(np.linalg.solve(H, b[..., None])[..., 0])
        return _moved(poses, xi, poses.shift, centre)
    H_leg += np.eye(6) / joint_error**2
    b_leg -= poses.shift.reshape(n, n_legs, 6) / joint_error**2
    back = np.linalg.solve(H_leg, np.concatenate([H_cross.swapaxes(2, 3), b_leg[..., None]], -1))
    H -= np.einsum("nlij,nljk->nik", H_cross, back[..., :6])
    b -= np.einsum("nlij,nlj->ni", H_cross, back[..., 6])
    xi = np.asarray(np.linalg.solve(H, b[..., None])[..., 0])
    change = back[..., 6] - np.einsum("nlij,nj->nli", back[..., :6], xi)
    return _moved(poses, xi, poses.shift + change.reshape(poses.shift.shape), centre)


def _centre(pictures: Sequence[Picture], poses: CameraPoses) -> Array:
    """Return the middle of the legs in the frame of each pose, (n, 3) [m]."""
    ends = [p.targets.ends.reshape(-1, 3) for p in pictures if len(p.targets)]
    middle = np.concatenate(ends).mean(axis=0) if ends else np.zeros(3)
    return np.asarray(poses.R @ middle + poses.t)


def _step_prior(centre: Array) -> Array:
    """Return the precision (n, 6, 6) of no step at all: what nothing fixes stays where it is."""
    J = np.concatenate(
        [-cross_matrices(centre), np.broadcast_to(np.eye(3), (len(centre), 3, 3))], axis=2
    )
    distance = DISPLACEMENT_SIGMA * np.maximum(np.linalg.norm(centre, axis=1), MIN_DEPTH)
    H = J.swapaxes(1, 2) @ J / (distance**2)[:, None, None]
    H[:, :3, :3] += np.eye(3) / TURN_SIGMA**2
    return np.asarray(H)


def _equations(
    picture: Picture, poses: CameraPoses, found: PairMatches, tolerance: float
) -> tuple[Array, Array, Array, Array]:
    """Return residuals of each segment: two of its line, one of its width, one of its place.

    Derivatives (n, T, 4, 6) by the motion of the camera, and by shifts of A and B of the leg;
    residuals and weights (n, T, 4).
    """
    pairs, place = picture.pairs, picture.targets.place
    X, xy, width, _ = _in_picture(picture, poses)
    along, across = pairs.along[found.pair], pairs.normal[found.pair]
    to_ends = xy - pairs.middle[found.pair][:, :, None, :]
    a = np.einsum("ntkx,ntx->ntk", to_ends, along)
    o = np.einsum("ntkx,ntx->ntk", to_ends, across)
    run = a[..., 1] - a[..., 0]
    run = np.where(np.abs(run) < 1e-6, 1e-6, run)
    half = pairs.half_length[found.pair]
    z = np.maximum(X[..., 2], MIN_DEPTH)
    depth = z.mean(axis=-1)
    # Derivatives of the offset of each end across the pair and along it, (n, T, 2, 3).
    g, g_along = _of_offset(xy, across, z), _of_offset(xy, along, z)
    shares = np.stack([(-half - a[..., 0]) / run, (half - a[..., 0]) / run], axis=-1)
    parts = np.stack([1.0 - shares, shares], axis=-1)  # (n, T, 2 places, 2 ends)
    residual = np.einsum("ntpe,nte->ntp", parts, o)
    share = -a[..., 0] / run
    expected = np.maximum(width[..., 0] + (width[..., 1] - width[..., 0]) * share, 1e-6)
    seen = pair_widths(pairs)[found.pair]
    P = (1.0 - share)[..., None] * X[:, :, 0] + share[..., None] * X[:, :, 1]
    of_depth = np.zeros_like(P)
    of_depth[..., 2] = -1.0 / np.maximum(P[..., 2], MIN_DEPTH)
    # Derivatives (n, T, 4, 2, 3) of the residuals by the two ends in the camera frame.
    D = np.empty((*P.shape[:2], 4, 2, 3))
    D[:, :, :2] = parts[..., None] * g[:, :, None]
    D[:, :, 2, 0] = (1.0 - share)[..., None] * of_depth
    D[:, :, 2, 1] = share[..., None] * of_depth
    D[:, :, 3] = 0.5 * g_along
    D = D @ picture.R  # by the ends in the frame of the poses
    X = (X - picture.t) @ picture.R
    turning = cross(X[:, :, None], D).sum(axis=3)
    J = np.concatenate([turning, D.sum(axis=3)], axis=-1)
    in_base = D @ poses.R[:, None, None]
    at = place[:, None, :, None]  # (T, 1, 2, 1)
    J_leg = np.concatenate(
        [((1.0 - at) * in_base).sum(axis=3), (at * in_base).sum(axis=3)], axis=-1
    )
    J_leg[:, :, 2:] = 0.0  # not accurate enough to move joints
    sigma_width = np.hypot(WIDTH_ERROR, WIDTH_PIXELS * pairs.pixel / seen)
    sigma = max(LINE_ERROR, MIN_LINE_SHARE * tolerance) / depth
    line = found.score / (sigma**2 + (LINE_PIXELS * pairs.pixel) ** 2)
    # A pair as long as the segment has its middle where the segment has it.
    length = np.abs(run)
    sigma_place = ALONG_ERROR * length + 0.5 * np.abs(length - 2.0 * half)
    return (
        J,
        J_leg,
        np.concatenate(
            [residual, np.stack([np.log(expected / seen), a.mean(axis=-1)], axis=-1)], axis=-1
        ),
        np.stack([line, line, found.score / sigma_width**2, found.score / sigma_place**2], axis=-1),
    )


def _of_offset(xy: Array, normal: Array, z: Array) -> Array:
    """Return derivatives (n, T, 2, 3) of offsets along normals (n, T, 2) of points xy at depths z.

    They are those by the points in the camera frame.
    """
    across = np.broadcast_to(normal[:, :, None, :], xy.shape)
    in_depth = -np.einsum("ntkx,ntx->ntk", xy, normal)[..., None]
    return np.asarray(np.concatenate([across, in_depth], axis=-1) / z[..., None])


def distances(picture: Picture, poses: CameraPoses, found: PairMatches) -> Array:
    """Return how far segments are from the pairs that agree with them, (n_poses, n_targets) [m].

    Sideways, at the ends of the pairs and at the depth of the segments.
    """
    _, _, residual, _ = _equations(picture, poses, found, 1.0)
    X, _, _, _ = _in_picture(picture, poses)
    return np.asarray(np.abs(residual[..., :2]).max(axis=-1) * X[..., 2].mean(axis=-1))


def _moved(poses: CameraPoses, xi: Array, shift: Array, centre: Array) -> CameraPoses:
    """Return poses moved by rotation vectors and translations in their frame, (n, 6), not far."""
    turned = np.linalg.norm(xi[:, :3], axis=1) / MAX_TURN
    moved = np.linalg.norm(np.cross(xi[:, :3], centre) + xi[:, 3:], axis=1)
    distance = np.maximum(np.linalg.norm(centre, axis=1), MIN_DEPTH)
    xi = xi / np.maximum(np.maximum(turned, moved / (MAX_DISPLACEMENT * distance)), 1.0)[:, None]
    turn = rotation_matrices(xi[:, :3])
    t = np.einsum("nij,nj->ni", turn, poses.t) + xi[:, 3:]
    return CameraPoses(turn @ poses.R, t, shift)


def depth_reversed(poses: CameraPoses, X: Array) -> CameraPoses:
    """Return the poses that show points X (m, 3) of a flat machine alike as seen from far.

    The machine is reflected in its own plane, which leaves a flat one as it is, and in the plane
    through its middle that faces the camera.
    """
    middle = X.mean(axis=0)
    normal = np.linalg.svd(X - middle, full_matrices=False)[2][2]
    at = poses.R @ middle + poses.t
    facing = at / np.linalg.norm(at, axis=1, keepdims=True)
    in_plane = np.eye(3) - 2.0 * np.outer(normal, normal)
    in_depth = np.eye(3) - 2.0 * facing[:, :, None] * facing[:, None, :]
    turned = in_depth @ poses.R @ in_plane
    return CameraPoses.rigid(turned, at - turned @ middle, poses.shift.shape[1])
