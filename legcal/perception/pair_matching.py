"""Camera poses matched to the edge pairs of pictures, and Gauss-Newton steps of poses.

A leg that is where a pose has it shows an edge pair along its axis, as wide as its radius says. A
few hundred poses are scored at once by all pictures of a view, and improved by Gauss-Newton steps
in which joints may be off what the model says.

:class:`EdgeMaps` say where pictures show edges of each direction, to compare many camera poses with
at once. A rod shows edges along itself wherever light changes across it: limbs, stripes of
reflection, the side in shadow. Thousands of camera poses are scored by the edges along the limbs
that they predict, in several pictures together. Pairs of clean edges suggest such poses, but one
rod in two may have none that is clean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.lines import cross
from legcal.geometry.motions import cross_matrices, rotation_matrices
from legcal.geometry.tables import Table
from legcal.geometry.types import Array, Image, IntArray
from legcal.machine.leg import Cylinder
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.profiles import Samples
from legcal.perception.tuning import JOINT_ERROR, WIDTH_ERROR
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey
from legcal.vision.visibility import visible_segments

# Lengths are parts of the mean leg length of the machine.
MIN_DEPTH = 0.05  # depth of the nearest point of a leg
WIDTH_PIXELS = 1.0  # and of a pair in its pixels
MAX_WIDTH_SIGMAS = 2.5  # standard deviations
WIDTH_BIAS_PIXELS = 0.4  # of pairs: shading ends inside an outline [px of a pair]
TOLERANCE_PIXELS = 1.5  # added to every tolerance [px of a pair]
LINE_ERROR, LINE_PIXELS = 0.005, 0.7  # of an axis beside its pair: length, [px]
ALONG_ERROR = 0.1  # of the middle of a pair that is as long as its segment, in its length
MIN_LINE_SHARE = 1.0 / 6.0  # at least this part of the tolerance
MIN_OVERLAP = 0.8  # share of a pair that should lie along the leg
CHUNK = 128  # poses of a picture, or of several, that are worked on together
FAR = 1e3  # on the sensor plane, where no leg is
TURN_SIGMA, DISPLACEMENT_SIGMA = 0.3, 0.1  # prior of a step: angle [rad], by the distance
MAX_TURN, MAX_DISPLACEMENT = 0.4, 0.2  # the same, at most


@dataclass(frozen=True, eq=False)
class LegSegments(Table):
    """The visible segments of all legs at the reading of a picture."""

    leg: IntArray  # (n,) the leg of each segment
    ends: Array  # (n, 2, 3) of its axis in the base link, the first nearer to the base joint [m]
    place: Array  # (n, 2) where these ends are along the leg, 0 at A and 1 at B
    radius: Array  # (n,) [m]
    share: Array  # (n,) its part of the visible length of its leg


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
class CameraPoses(Table):
    """Candidate camera poses T_camera_base."""

    R: Array  # (n, 3, 3)
    t: Array  # (n, 3) [m]
    shift: Array  # (n, n_legs, 2, 3) of A and B against the model, in the base link [m]

    @classmethod
    def rigid(cls, R: Array, t: Array, n_legs: int) -> CameraPoses:
        """Return poses at which all legs are where the model has them."""
        return cls(R, t, np.zeros((len(R), n_legs, 2, 3)))

    @classmethod
    def none(cls, n_legs: int) -> CameraPoses:
        """Return no pose."""
        return cls.rigid(np.zeros((0, 3, 3)), np.zeros((0, 3)), n_legs)

    @classmethod
    def of(cls, T_base_camera: Sequence[RigidTransform], n_legs: int) -> CameraPoses:
        """Return poses the other way round, at which legs are where the model has them."""
        T = [one.inv() for one in T_base_camera]
        R = np.array([one.rotation.as_matrix() for one in T]).reshape(-1, 3, 3)
        return cls.rigid(R, np.array([one.translation for one in T]).reshape(-1, 3), n_legs)

    @classmethod
    def one(cls, T_base_camera: RigidTransform, shift: Array) -> CameraPoses:
        """Return one pose, with shifts (n_legs, 2, 3)."""
        return replace(cls.of([T_base_camera], len(shift)), shift=shift[None])

    def T_base_camera(self, i: int = 0) -> RigidTransform:
        """Return a pose the other way round."""
        R = Rotation.from_matrix(self.R[i])
        return RigidTransform.from_components(self.t[i], R).inv()


@dataclass(frozen=True, eq=False)
class Picture:
    """An image: its edge pairs, and the legs that it may show."""

    pairs: CandidatePairs
    targets: LegSegments  # segments of legs at its reading
    corners: Array  # (2, 2) least and greatest x and y of the sensor plane that it shows
    size: float  # mean leg length of the machine, which tolerances are parts of [m]
    joint_error: float = JOINT_ERROR  # of the joints of the model, of the size
    # Its camera frame, where poses are those of another one that is fixed to it: X_camera = R X + t
    R: Array = field(default_factory=lambda: np.eye(3))
    t: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class Pictures(Table):
    """Pictures of one camera in arrays, where all have as many segments and pairs as the most.

    Segments that fill up count for nothing, pairs that do are far from everything.
    """

    ends: Array  # (n_pictures, n_segments, 2, 3), place, leg, radius and share as in LegSegments
    place: Array
    leg: IntArray
    radius: Array
    share: Array  # 0 of those that fill up
    pairs: Array  # (n_pictures, n_pairs, 9): middle, along, normal, half length, width as
    # of a leg that looks like this, width
    pixel: Array  # (n_pictures,) how well edges are known
    R: Array  # (n_pictures, 3, 3) their camera frames, as in Picture
    t: Array  # (n_pictures, 3)
    corners: Array  # (n_pictures, 2, 2)
    size: float  # mean leg length of the machine, which tolerances are parts of [m]
    joint_error: float  # of the joints of the model, of the size

    @classmethod
    def of(cls, pictures: Sequence[Picture]) -> Pictures:
        """Return pictures in arrays."""
        targets, pairs = [p.targets for p in pictures], [p.pairs for p in pictures]
        n_segments = max((len(one) for one in targets), default=0)
        n_pairs = max((len(one) for one in pairs), default=0)
        of_pairs = [
            np.concatenate(
                [
                    p.middle,
                    p.along,
                    p.normal,
                    np.stack([p.half_length, pair_widths(p), p.width.mean(axis=1)], axis=1),
                ],
                axis=1,
            )
            for p in pairs
        ]
        nowhere = np.array([FAR, FAR, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
        return cls(
            _filled([one.ends for one in targets], n_segments, np.zeros((2, 3))),
            _filled([one.place for one in targets], n_segments, np.zeros(2)),
            _filled([one.leg for one in targets], n_segments, np.zeros((), dtype=np.intp)),
            _filled([one.radius for one in targets], n_segments, np.zeros(())),
            _filled([one.share for one in targets], n_segments, np.zeros(())),
            _filled(of_pairs, n_pairs, nowhere),
            np.array([p.pixel for p in pairs]),
            np.array([p.R for p in pictures]).reshape(-1, 3, 3),
            np.array([p.t for p in pictures]).reshape(-1, 3),
            np.array([p.corners for p in pictures]).reshape(-1, 2, 2),
            pictures[0].size if pictures else 1.0,
            pictures[0].joint_error if pictures else JOINT_ERROR,
        )

    @property
    def min_depth(self) -> float:
        """Depth of the nearest point of a leg [m]."""
        return MIN_DEPTH * self.size

    @property
    def all_ends(self) -> Array:
        """The ends of all segments, (n, 3) [m]."""
        return self.ends[self.share > 0.0].reshape(-1, 3)

    def blocks(self, n_poses: int) -> Iterator[Pictures]:
        """Return the pictures a few at a time, fewer for more poses, so that arrays stay small."""
        n = max(1, CHUNK // max(n_poses, 1))
        if len(self) <= n:
            yield self
            return
        for first in range(0, len(self), n):
            yield self.choose(slice(first, first + n))


def _filled(parts: Sequence[NDArray[Any]], n: int, value: NDArray[Any]) -> NDArray[Any]:
    """Return arrays (m, ...) one behind the other, filled up to n rows of a value."""
    filled = np.empty((len(parts), n, *value.shape), dtype=value.dtype)
    for one, part in zip(filled, parts, strict=True):
        one[: len(part)] = part
        one[len(part) :] = value
    return filled


@dataclass(frozen=True, eq=False)
class PairMatches(Table):
    """Scores of poses in images, (n_pictures, n_poses, n_segments) each."""

    score: Array  # of each segment, 0 to 1: how well, times how much of its visible length
    pair: IntArray  # the edge pair of its picture with that score
    visible: Array  # share of each segment that is inside the picture

    @property
    def exclusive_score(self) -> Array:
        """The scores, where a pair counts only for the segment that it suits best."""
        same = self.pair[..., :, None] == self.pair[..., None, :]
        better = self.score[..., None, :] > self.score[..., :, None]
        return np.where(np.any(same & better, axis=-1), 0.0, self.score)


def match_pairs(pictures: Pictures, poses: CameraPoses, tolerance: float) -> PairMatches:
    """Match poses to pictures; ``tolerance`` is how far axes may be from pairs, of the size."""
    n = len(poses)
    if len(pictures) == 0 or n == 0:
        nothing = np.zeros((len(pictures), n, pictures.ends.shape[1]))
        return PairMatches(nothing, nothing.astype(np.intp), nothing)
    if n <= CHUNK:
        return PairMatches.joined(
            [_match_block(some, poses, tolerance) for some in pictures.blocks(n)]
        )
    few = (poses.choose(slice(k, k + CHUNK)) for k in range(0, n, CHUNK))
    parts = [match_pairs(pictures, some, tolerance) for some in few]
    every = ((part.score, part.pair, part.visible) for part in parts)
    return PairMatches(*(np.concatenate(of_field, axis=1) for of_field in zip(*every, strict=True)))


def projected(pictures: Pictures, poses: CameraPoses) -> tuple[Array, Array, Array]:
    """Return ends X (K, n, T, 2, 3) [m], points (K, n, T, 2, 2) and widths (K, n, T, 2).

    Of K pictures, n poses and T segments.
    """
    ends = pictures.ends[:, None]
    if np.any(poses.shift):
        of_leg = poses.shift.swapaxes(0, 1)[pictures.leg].swapaxes(1, 2)  # (K, n, T, 2, 3)
        at = pictures.place[:, None, :, :, None]
        ends = ends + (1.0 - at) * of_leg[..., :1, :] + at * of_leg[..., 1:, :]
    K, n, T = len(pictures), len(poses), ends.shape[2]
    R = pictures.R[:, None] @ poses.R
    t = poses.t @ pictures.R.swapaxes(1, 2) + pictures.t[:, None]
    X = ends.reshape(K, ends.shape[1], 2 * T, 3) @ R.swapaxes(2, 3) + t[:, :, None]
    X = X.reshape(K, n, T, 2, 3)
    z = np.maximum(X[..., 2], pictures.min_depth)
    xy = X[..., :2] / z[..., None]
    normal = cross(X[..., 0, :], X[..., 1, :])
    level = normal[..., 0] ** 2 + normal[..., 1] ** 2
    flat = np.sqrt(level / (level + normal[..., 2] ** 2 + 1e-24))
    width = (2.0 * pictures.radius[:, None] / np.maximum(flat, 0.1))[..., None] / z
    return X, xy, width


def _shown(xy: Array, corners: Array) -> Array:
    """Return the share of segments xy (..., 2, 2) within rectangles (..., 2, 2), (...)."""
    start, step = xy[..., 0, :], xy[..., 1, :] - xy[..., 0, :]
    safe = np.where(np.abs(step) > 1e-9, step, 1e-9)
    one, two = (corners[..., 0, :] - start) / safe, (corners[..., 1, :] - start) / safe
    near, far = np.minimum(one, two), np.maximum(one, two)
    enter = np.maximum(np.maximum(near[..., 0], near[..., 1]), 0.0)
    leave = np.minimum(np.minimum(far[..., 0], far[..., 1]), 1.0)
    return np.asarray(np.maximum(leave - enter, 0.0))


def _match_block(pictures: Pictures, poses: CameraPoses, tolerance: float) -> PairMatches:
    """Match a few poses to a few pictures."""
    X, xy, width = projected(pictures, poses)
    front = (X[..., 0, 2] > pictures.min_depth) & (X[..., 1, 2] > pictures.min_depth)
    front &= pictures.share[:, None] > 0.0
    visible = np.where(front, _shown(xy, pictures.corners[:, None, None]), 0.0)
    K, n, T = visible.shape
    n_pairs = pictures.pairs.shape[1]
    if T == 0 or n_pairs == 0:
        return PairMatches(np.zeros((K, n, T)), np.zeros((K, n, T), dtype=np.intp), visible)
    depth = np.maximum(0.5 * (X[..., 0, 2] + X[..., 1, 2]), pictures.min_depth)
    reach = tolerance * pictures.size / depth + TOLERANCE_PIXELS * pictures.pixel[:, None, None]
    reach = reach[..., None].astype(np.float32)
    xy, width = xy.astype(np.float32), width.astype(np.float32)
    middle, along, normal = (pictures.pairs[..., k : k + 2] for k in (0, 2, 4))
    axes = np.concatenate([along, normal], axis=1)  # (K, 2 n_pairs, 2)
    own = np.sum(axes * np.concatenate([middle, middle], axis=1), axis=2).astype(np.float32)
    frame = axes.astype(np.float32).swapaxes(1, 2)
    place = (xy.reshape(K, -1, 2) @ frame - own[:, None]).reshape(K, n, T, 2, 2 * n_pairs)
    a0, a1 = place[..., 0, :n_pairs], place[..., 1, :n_pairs]
    o0, o1 = place[..., 0, n_pairs:], place[..., 1, n_pairs:]
    half, seen = (pictures.pairs[:, None, None, :, k].astype(np.float32) for k in (6, 7))
    run = a1 - a0
    run = np.where(np.abs(run) < 1e-6, np.float32(1e-6), run)
    slope = (o1 - o0) / run
    gap = np.abs(o0 - slope * a0) + np.abs(slope) * half
    value = np.maximum(1.0 - (gap / reach) ** 2, 0.0)
    w0, w1 = width[..., 0, None], width[..., 1, None]
    expected = np.maximum(w0 - (w1 - w0) * a0 / run, np.float32(1e-6))
    sigma = _width_sigmas(pictures).astype(np.float32)[:, None, None]
    pull = np.log(expected / seen) / (np.float32(MAX_WIDTH_SIGMAS) * sigma)
    value *= np.maximum(1.0 - pull**2, 0.0)
    overlap = np.minimum(half, np.maximum(a0, a1)) - np.maximum(-half, np.minimum(a0, a1))
    overlap = np.maximum(overlap, 0.0)
    value *= np.minimum(overlap / (np.float32(2.0 * MIN_OVERLAP) * half), 1.0)
    length = np.abs(run) * np.maximum(visible, 0.05)[..., None].astype(np.float32)
    value *= np.minimum(overlap / length, 1.0)
    best = np.argmax(value, axis=-1)
    chosen = np.take_along_axis(value, best[..., None], axis=-1)[..., 0]
    return PairMatches(np.where(visible > 0.0, chosen, 0.0).astype(np.float64), best, visible)


def pair_widths(pairs: CandidatePairs) -> Array:
    """Return the widths of pairs (n,) in their middle, as wide as legs are that look like this."""
    return np.asarray(pairs.width.mean(axis=1) + WIDTH_BIAS_PIXELS * pairs.pixel)


def _width_sigmas(pictures: Pictures) -> Array:
    """Return standard deviations of the logarithms of pairs' widths, (n_pictures, n_pairs)."""
    pixel = WIDTH_PIXELS * pictures.pixel[:, None]
    return np.asarray(np.hypot(WIDTH_ERROR, pixel / pictures.pairs[..., 7]))


def gauss_newton_step(
    pictures: Pictures,
    poses: CameraPoses,
    matches: PairMatches,
    tolerance: float,
    joint_error: float = 0.0,
) -> CameraPoses:
    """Return poses after one Gauss-Newton step towards the pairs that they match.

    By pictures of one camera and matches with them, for a tolerance as in :func:`match_pairs`;
    ``joint_error`` is the standard deviation of the model's joints, of the size; 0 to leave them
    in place.
    """
    joint_error *= pictures.size
    n, n_legs = poses.shift.shape[:2]
    centre = _centre(pictures, poses)
    H, b = _step_prior(centre, pictures.min_depth), np.zeros((n, 6))
    of_legs = np.zeros((n, n_legs, 6, 13))  # products with shifts, with motions, with residuals
    done = 0
    for some in pictures.blocks(n):
        found = matches.choose(slice(done, done := done + len(some)))
        if found.score.size == 0 or some.pairs.shape[1] == 0:
            continue
        J, J_leg, residual, weight = segment_equations(some, poses, found, tolerance)
        rows = np.concatenate([J, residual[..., None]], axis=-1)  # (K, n, T, 4, 7)
        K, _, T = weight.shape[:3]
        flat = (K, n, 4 * T, 7)
        weighted = (J * weight[..., None]).reshape(*flat[:3], 6)
        products = (weighted.swapaxes(2, 3) @ rows.reshape(flat)).sum(axis=0)
        H += products[..., :6]
        b -= products[..., 6]
        if joint_error > 0.0:
            of_lines = np.concatenate([J_leg, rows[..., :2, :]], axis=-1)
            weighted = (J_leg * weight[..., :2, None]).swapaxes(3, 4)
            products = (weighted @ of_lines).swapaxes(0, 1).reshape(n, K * T, 6 * 13)
            own = (some.leg.ravel() == np.arange(n_legs)[:, None]).astype(np.float64)
            of_legs += (own @ products).reshape(n, n_legs, 6, 13)
    if joint_error == 0.0:
        xi = np.asarray(np.linalg.solve(H, b[..., None])[..., 0])
        return _moved(poses, xi, poses.shift, centre, pictures.min_depth)
    H_leg = of_legs[..., :6] + np.eye(6) / joint_error**2
    right = of_legs[..., 6:]
    right[..., 6] = -right[..., 6] - poses.shift.reshape(n, n_legs, 6) / joint_error**2
    back = np.linalg.solve(H_leg, right)
    coupled = right[..., :6].reshape(n, 6 * n_legs, 6).swapaxes(1, 2)
    taken = coupled @ back.reshape(n, 6 * n_legs, 7)
    xi = np.asarray(np.linalg.solve(H - taken[..., :6], (b - taken[..., 6])[..., None]))
    change = back[..., 6] - (back[..., :6] @ xi[:, None])[..., 0]
    shift = poses.shift + change.reshape(poses.shift.shape)
    return _moved(poses, xi[..., 0], shift, centre, pictures.min_depth)


def _centre(pictures: Pictures, poses: CameraPoses) -> Array:
    """Return the middle of the legs in the frame of each pose, (n, 3) [m]."""
    ends = pictures.all_ends
    middle = ends.mean(axis=0) if len(ends) else np.zeros(3)
    return np.asarray(poses.R @ middle + poses.t)


def _step_prior(centre: Array, min_depth: float) -> Array:
    """Return the precision (n, 6, 6) of no step at all: what nothing fixes stays where it is."""
    J = np.concatenate(
        [-cross_matrices(centre), np.broadcast_to(np.eye(3), (len(centre), 3, 3))], axis=2
    )
    distance = DISPLACEMENT_SIGMA * np.maximum(np.linalg.norm(centre, axis=1), min_depth)
    H = J.swapaxes(1, 2) @ J / (distance**2)[:, None, None]
    H[:, :3, :3] += np.eye(3) / TURN_SIGMA**2
    return np.asarray(H)


def segment_equations(
    pictures: Pictures, poses: CameraPoses, matches: PairMatches, tolerance: float
) -> tuple[Array, Array, Array, Array]:
    """Return residuals of each segment: two of its line, one of its width, one of its place.

    Derivatives (K, n, T, 4, 6) by the motion of the camera, and (K, n, T, 2, 6) of the first two,
    which alone are accurate enough to move joints, by shifts of A and B of the leg; residuals and
    weights (K, n, T, 4).
    """
    X, xy, width = projected(pictures, poses)
    K, n_pairs = pictures.pairs.shape[:2]
    table = np.concatenate([pictures.pairs, _width_sigmas(pictures)[..., None]], axis=2)
    at = matches.pair + (n_pairs * np.arange(K))[:, None, None]
    of_pair = table.reshape(K * n_pairs, -1).take(at, axis=0)
    middle, axes = of_pair[..., :2], of_pair[..., 2:6].reshape(*at.shape, 2, 2)
    half, seen, sigma_width = of_pair[..., 6], of_pair[..., 7], of_pair[..., 9]
    z = np.maximum(X[..., 2], pictures.min_depth)
    depth = 0.5 * (z[..., 0] + z[..., 1])
    # Places of both ends along the pair and across it, and their derivatives by the ends.
    places = (xy - middle[..., None, :]) @ axes.swapaxes(-1, -2)
    a, o = places[..., 0], places[..., 1]
    slopes = np.empty((*at.shape, 2, 2, 3))  # (along and across, ends, x y z)
    slopes[..., :2] = axes[..., None, :]
    slopes[..., 2] = -(axes @ xy.swapaxes(-1, -2))
    slopes /= z[..., None, :, None]
    run = a[..., 1] - a[..., 0]
    run = np.where(np.abs(run) < 1e-6, 1e-6, run)
    parts = np.empty((*at.shape, 2, 2))  # (places, ends)
    parts[..., 1] = (np.stack([-half, half], axis=-1) - a[..., :1]) / run[..., None]
    parts[..., 0] = 1.0 - parts[..., 1]
    share = -a[..., 0] / run
    shares = np.stack([1.0 - share, share], axis=-1)
    expected = np.maximum(width[..., 0] + (width[..., 1] - width[..., 0]) * share, 1e-6)
    deep = np.maximum(np.sum(shares * X[..., 2], axis=-1), pictures.min_depth)
    # Derivatives (K, n, T, 4, 2, 3) of the residuals by the two ends in the camera frame.
    D = np.zeros((*at.shape, 4, 2, 3))
    D[..., :2, :, :] = parts[..., None] * slopes[..., None, 1, :, :]
    D[..., 2, :, 2] = -shares / deep[..., None]
    D[..., 3, :, :] = 0.5 * slopes[..., 0, :, :]
    flat = (*at.shape[:2], -1, 3)
    # By the ends in the frame of the poses, and in the base link.
    D = (D.reshape(flat) @ pictures.R[:, None]).reshape(D.shape)
    X = ((X - pictures.t[:, None, None, None]).reshape(flat) @ pictures.R[:, None]).reshape(X.shape)
    lines = D[..., :2, :, :]
    in_base = (lines.reshape(flat) @ poses.R).reshape(lines.shape)
    J = np.empty((*at.shape, 4, 6))  # sums over the two ends
    J[..., :3] = sum(cross(X[..., None, k, :], D[..., k, :]) for k in (0, 1))
    J[..., 3:] = D[..., 0, :] + D[..., 1, :]
    one, two = np.moveaxis(pictures.place[:, None, :, None, :, None], -2, 0)
    first, second = in_base[..., 0, :], in_base[..., 1, :]
    both = first + second
    J_leg = np.empty((*at.shape, 2, 6))
    J_leg[..., 3:] = one * first + two * second
    J_leg[..., :3] = both - J_leg[..., 3:]
    residual = np.empty((*at.shape, 4))
    residual[..., :2] = (parts @ o[..., None])[..., 0]
    residual[..., 2] = np.log(expected / seen)
    residual[..., 3] = 0.5 * (a[..., 0] + a[..., 1])
    sigma = max(LINE_ERROR, MIN_LINE_SHARE * tolerance) * pictures.size / depth
    # A pair as long as the segment has its middle where the segment has it.
    length = np.abs(run)
    sigma_place = ALONG_ERROR * length + 0.5 * np.abs(length - 2.0 * half)
    variance = np.empty_like(residual)
    pixel = LINE_PIXELS * pictures.pixel[:, None, None]
    variance[..., 0] = variance[..., 1] = sigma**2 + pixel**2
    variance[..., 2], variance[..., 3] = sigma_width**2, sigma_place**2
    return J, J_leg, residual, matches.score[..., None] / variance


def distances(pictures: Pictures, poses: CameraPoses, matches: PairMatches) -> Array:
    """Return the distances of segments from the pairs that agree with them, (K, n, T) [m].

    Sideways, at the ends of the pairs and at the depth of the segments.
    """
    _, _, residual, _ = segment_equations(pictures, poses, matches, 1.0)
    X, _, _ = projected(pictures, poses)
    return np.asarray(np.abs(residual[..., :2]).max(axis=-1) * X[..., 2].mean(axis=-1))


def _moved(
    poses: CameraPoses, xi: Array, shift: Array, centre: Array, min_depth: float
) -> CameraPoses:
    """Return poses moved by rotation vectors and translations in their frame, (n, 6), not far."""
    turned = np.linalg.norm(xi[:, :3], axis=1) / MAX_TURN
    moved = np.linalg.norm(cross(xi[:, :3], centre) + xi[:, 3:], axis=1)
    distance = np.maximum(np.linalg.norm(centre, axis=1), min_depth)
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


N_DIRECTIONS = 12  # of edges, in half a turn
SMOOTH = 1.0  # of a picture before slopes are taken [cells]
NEARBY, STRONG = 31, 3.0  # an edge counts in full that is so many times the mean slope of so much
EVEN = 0.25  # of the mean slope of a picture, which is added to that
RIDGE = 0.8  # of the largest slope beside it, which an edge has
SAMPLES = 8  # points of a limb that are looked up
MOST_SAMPLES = 4_000_000  # that are looked up at once


@dataclass(frozen=True, eq=False)
class EdgeMaps(Table):
    """Edges in pictures, on their sensor planes."""

    maps: Samples  # (n_pictures, N_DIRECTIONS, height, width), 0 to 1
    corner: Array  # (n_pictures, 2) x and y of the middle of the first cell
    cell: Array  # (n_pictures,) size of a cell

    @classmethod
    def of(
        cls,
        pictures: Sequence[Grey],
        moving: Sequence[Image | None],
        cameras: Sequence[Camera],
        factors: Sequence[int],
    ) -> EdgeMaps:
        """Return the edge maps of images reduced by factors, without static background if given."""
        grids = [_grid(*one) for one in zip(pictures, cameras, factors, strict=True)]
        flat = [
            (_on_plane(picture, grid), None if part is None else _on_plane(part, grid))
            for picture, part, (grid, _, _) in zip(pictures, moving, grids, strict=True)
        ]
        of_pictures = [_edges(picture, part) for picture, part in flat]
        shape = np.max([one.shape for one in of_pictures], axis=0)
        maps = np.zeros((len(pictures), *shape), dtype=np.float32)
        for into, of_picture in zip(maps, of_pictures, strict=True):
            into[:, : of_picture.shape[1], : of_picture.shape[2]] = of_picture
        corner = np.array([corner for _, corner, _ in grids])
        return cls(maps, corner, np.array([cell for _, _, cell in grids]))

    def mirrored(self, middle: Array) -> EdgeMaps:
        """Return maps with left and right exchanged about middles x (n_pictures,)."""
        turned = np.roll(self.maps[:, ::-1, :, ::-1], 1, axis=1)
        last = self.corner[:, 0] + self.cell * (self.maps.shape[3] - 1)
        corner = np.stack([2.0 * middle - last, self.corner[:, 1]], axis=1)
        return EdgeMaps(np.ascontiguousarray(turned), corner, self.cell)

    def halved(self) -> EdgeMaps:
        """Return maps of half the size, with the strongest edge of four cells."""
        n, directions, height, width = self.maps.shape
        even = self.maps[:, :, : height // 2 * 2, : width // 2 * 2]
        fours = even.reshape(n, directions, height // 2, 2, width // 2, 2)
        corner = self.corner + 0.5 * self.cell[:, None]
        return EdgeMaps(fours.max(axis=(3, 5)), corner, 2.0 * self.cell)

    def blurred(self, cells: float) -> EdgeMaps:
        """Return maps in which edges count that are some cells away."""
        peak = np.float32(1.0 / (np.sqrt(2.0 * np.pi) * cells))  # of a line
        flat = self.maps.reshape(-1, *self.maps.shape[2:])
        soft = [np.minimum(cv2.GaussianBlur(one, (0, 0), cells) / peak, 1.0) for one in flat]
        return replace(self, maps=np.reshape(np.array(soft, dtype=np.float32), self.maps.shape))

    def scores(self, pictures: Pictures, poses: CameraPoses) -> Array:
        """Return the number of legs that poses explain in all images together, (n_poses,)."""
        samples = 2 * SAMPLES * pictures.ends.shape[1] * len(pictures)
        n = max(1, MOST_SAMPLES // max(samples, 1))
        chunks = [poses.choose(slice(k, k + n)) for k in range(0, len(poses), n)]
        return np.concatenate([np.zeros(0), *(self._scores(pictures, some) for some in chunks)])

    def _scores(self, pictures: Pictures, poses: CameraPoses) -> Array:
        """Return the scores of poses that are few enough."""
        X, xy, width = projected(pictures, poses)
        front = np.all(X[..., 2] > pictures.min_depth, axis=-1)
        of_picture = (slice(None), *(np.newaxis,) * 4)
        at = (xy - self.corner[:, None, None, None]) / self.cell[of_picture]
        along = at[..., 1, :] - at[..., 0, :]  # (K, n, T, 2)
        along /= np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-6)
        normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        half = (0.5 * width / self.cell[of_picture[:4]])[..., None] * normal[..., None, :]
        limbs = np.stack([at - half, at + half], axis=-3)  # (K, n, T, 2 limbs, 2 ends, 2)
        place = ((np.arange(SAMPLES) + 0.5) / SAMPLES)[:, None]
        points = limbs[..., :1, :] + place * (limbs[..., 1:, :] - limbs[..., :1, :])
        turn = np.arctan2(along[..., 1], along[..., 0]) * (N_DIRECTIONS / np.pi)
        direction = np.rint(turn).astype(np.intp) % N_DIRECTIONS
        n_pictures, _, rows, columns = self.maps.shape
        column, row = np.floor(points[..., 0] + 0.5), np.floor(points[..., 1] + 0.5)
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        inside &= front[..., None, None]
        row, column = (np.where(inside, x, 0).astype(np.intp) for x in (row, column))
        number = np.arange(n_pictures)[:, None, None] * N_DIRECTIONS + direction
        cells = (number * (rows * columns))[..., None, None] + row * columns + column
        value = np.where(inside, self.maps.reshape(-1)[cells], 0.0).mean(axis=(-1, -2))
        return np.asarray(np.einsum("knt,kt->n", value, pictures.share))


def _grid(picture: Grey, camera: Camera, factor: int) -> tuple[Samples | None, Array, float]:
    """Return the pixels (h, w, 2) of a reduced picture for even cells, their corner and size.

    None where the lens bends nothing.
    """
    K = camera.K
    height, width = picture.shape
    cell = factor / float(np.sqrt(K[0, 0] * K[1, 1]))
    corner = camera.undistort(np.full((1, 2), 0.5 * (factor - 1)))[0]
    if not camera.has_distortion and K[0, 0] == K[1, 1]:
        return None, corner, cell
    far = camera.undistort(np.array([[factor * width - 1.0, factor * height - 1.0]]))[0]
    n = np.clip(np.ceil((far - corner) / cell), 1, 2 * max(picture.shape)).astype(int)
    x, y = (corner[k] + cell * np.arange(n[k]) for k in (0, 1))
    xy = np.stack(np.meshgrid(x, y), axis=-1)
    pixels = camera.distort(xy.reshape(-1, 2)).reshape(xy.shape)
    return ((pixels + 0.5) / factor - 0.5).astype(np.float32), corner, cell


def _on_plane(picture: Image, grid: Samples | None) -> Samples:
    """Return a picture on even cells of the sensor plane."""
    even = picture.astype(np.float32)
    if grid is None:
        return even
    return np.asarray(cv2.remap(even, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR))


def _edges(picture: Samples, moving: Samples | None) -> Samples:
    """Return the strength of edges by direction, (N_DIRECTIONS, height, width)."""
    smooth = cv2.GaussianBlur(np.sqrt(np.maximum(picture, 0.0)), (0, 0), SMOOTH)
    dx, dy = (np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1 - k, k)) for k in (0, 1))
    slope = cv2.magnitude(dx, dy)
    around = cv2.blur(slope, (NEARBY, NEARBY)) + EVEN * float(slope.mean()) + 1e-6
    edge = np.minimum(slope / (np.float32(STRONG) * around), np.float32(1.0))
    edge[slope < RIDGE * cv2.dilate(slope, np.ones((3, 3), np.uint8))] = 0.0
    if moving is not None:
        edge[moving < 0.5] = 0.0
    turn = (np.arctan2(dy, dx) + 0.5 * np.pi) * (N_DIRECTIONS / np.pi)
    low = np.floor(turn)
    share, low = (turn - low).astype(np.float32), low.astype(np.intp) % N_DIRECTIONS
    rows, columns = np.indices(picture.shape)
    maps = np.zeros((N_DIRECTIONS, *picture.shape), dtype=np.float32)
    maps[low, rows, columns] = edge * (1.0 - share)
    maps[(low + 1) % N_DIRECTIONS, rows, columns] += edge * share
    return maps
