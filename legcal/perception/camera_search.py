"""The camera pose of a view, searched for anywhere or near a rough one, by its edge pairs.

Two pairs taken for two legs suggest a pose: a pair gives the axis of a leg, except for its lean
towards the camera, and by its width its distance; the turn about that axis follows from a second
pair, which lays a second leg into its plane. Thousands of such poses, most of them wrong, are
judged by one picture, the better ones refined and scored by more, the best by all. A pose is
accepted where enough legs match and no other pose comes near it. A pose is found for mirrored
images of many machines as well, with fewer legs on their pairs: so one at which many legs are
missing is compared with the best one of the images with left and right exchanged.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.tables import first_apart
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import (
    MAX_WIDTH_SIGMAS,
    CameraPoses,
    EdgeMaps,
    LegSegments,
    PairMatches,
    Picture,
    Pictures,
    depth_reversed,
    distances,
    gauss_newton_step,
    match_pairs,
    pair_widths,
)
from legcal.perception.tuning import FITTING, JOINT_ERROR, LEAD, SEARCHING, SUPPORT, WIDTH_ERROR

# Share of the expected legs that accepts a pose is SUPPORT; that of a pose that leads alone, of a
# clear one, of a clear one near a rough pose, and which mirrored images do not reach:
LONE_SUPPORT, CLEAR_SUPPORT = 0.6 * SUPPORT, 1.75 * SUPPORT
HINTED_SUPPORT, NOT_MIRRORED_SUPPORT = 3.0 * SUPPORT, 2.25 * SUPPORT
# Legs that agree in all images together, at least: two always fit some pose
MIN_LEGS, MIN_LEGS_HINTED = 2.8, 1.6
# Lead over the next pose, in legs of all images together and as a part of the score: that is
# enough, that is clear, that a pose with few legs needs, and that mirrored images need.
ENOUGH_LEAD, CLEAR_LEAD = (LEAD, 0.16), (2.0 * LEAD, 0.35)
LONE_LEAD, MIRRORED_LEAD = (1.5 * LEAD, 0.3), (0.5 * LEAD, 0.06)
SHIFT_COST = 0.06  # in legs, of shifts of joints as likely as one standard deviation (chi^2 / 2)
START_PICTURES = 1, 1, 2, 4  # whose pairs suggest poses, until one is clear
SOME_PICTURES = 8  # that judge which poses are worth a comparison with all
N_KEPT = (400, 40, 12, 6)  # poses: those of a picture, its refined ones, of some pictures, of all
N_REVERSED = 4  # poses of which those with near and far exchanged are tried as well
N_POLISHED, N_POLISHING = 2, 4  # poses around which better ones are sought, by so many pictures
POLISH = SEARCHING[3:6]  # tolerances
POLISH_TURN, POLISH_FURTHER = np.deg2rad(3.0), 0.05  # angle, part of the distance
NEAR_TURN = np.deg2rad(2.5)  # turns of a rough pose that are tried as well
SAME_POSE = np.deg2rad(8.0), 0.08  # within an angle and a part of the distance
SAME_MATCHES = 0.5  # share of common matches from which on two poses say the same,
OTHER_POSE = np.deg2rad(20.0), 0.25  # unless they are so far from each other
SAME_LEG_TURN, SAME_LEG_WIDTHS = np.deg2rad(4.0), 0.6  # of two pairs: angle, distance [widths]
MIN_MATCH_SCORE = 0.15  # score of a segment with its pair that counts as a match
MIN_MATCHES, ERROR_OF_FEW = 3, 0.5 * JOINT_ERROR  # below so many, a leg is at least so uncertain

LEFT_RIGHT = np.array([-1.0, 1.0])
UP_DOWN = np.array([1.0, -1.0])
UPSIDE_DOWN = np.array([-1.0, -1.0])


class EdgeStep(NamedTuple):
    """Settings by which poses are moved to edges."""

    blur: float  # how far edges count [cells of half the size, or of the maps]
    turn: float  # by which poses are turned, one standard deviation [deg]
    part: float  # and moved, as a part of the distance
    n_kept: int
    is_fine: bool = False
    all_pictures: bool = False


N_SUGGESTING, N_MOVED, N_TRIED = 4, 60, 24  # pictures; poses that are moved, and so often
EDGE_STEPS = (
    EdgeStep(4.0, 6.0, 0.08, 40),
    EdgeStep(4.0, 3.0, 0.05, 30),
    EdgeStep(3.0, 2.0, 0.03, 20),
    EdgeStep(2.0, 1.5, 0.02, 12),
    EdgeStep(2.0, 1.0, 0.012, 8),
    EdgeStep(1.5, 0.6, 0.008, 6, all_pictures=True),
    EdgeStep(2.0, 0.4, 0.005, 6, is_fine=True, all_pictures=True),
    EdgeStep(1.5, 0.2, 0.003, 4, is_fine=True, all_pictures=True),
)


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """Poses of a camera, best first, each far from the better ones or with legs on other pairs."""

    poses: CameraPoses  # T_camera_base
    support: Array  # (n, n_pictures) legs that agree, by how well and how much of them
    expected: Array  # (n, n_pictures) legs that each picture would show
    score: Array  # (n,) support of all pictures, less what the shifts of the joints cost: legs
    # (n_legs,) of legs from their pairs at the first pose, of the mean leg length; infinite without
    leg_error: Array
    hinted: bool = False  # whether it was searched for near a rough pose only
    by_outlines: bool | None = None  # whether outlines measured at the poses support the first
    # one; None where pairs were clear
    along_edges: float = 0.0  # legs with edges along them at the first pose, where it is by edges
    is_given: bool = False  # whether clicks on joints have the first pose

    @property
    def needed(self) -> float:
        """Mean number of legs per image that must match for a pose to be accepted."""
        n = self.support.shape[1]
        alone = not self.hinted and self._leads(LONE_LEAD)
        share = LONE_SUPPORT if alone else SUPPORT
        least = MIN_LEGS_HINTED if self.hinted else MIN_LEGS
        return float(max(share * self.expected[0].mean(), least / n))

    @property
    def is_enough(self) -> bool:
        """Whether enough legs agree with the first pose."""
        return len(self.poses) > 0 and float(self.support[0].mean()) >= self.needed

    @property
    def lead(self) -> float:
        """Score of the first pose less the score of the second, in legs."""
        if len(self.poses) < 2:
            return float("inf")
        return float(self.score[0] - self.score[1])

    @property
    def leads_clearly(self) -> bool:
        """Whether the first pose is clearly better than the second one by pairs."""
        return self._leads(CLEAR_LEAD)

    @property
    def leads(self) -> bool:
        """Whether the first pose is better than the second one by pairs."""
        return self._leads(ENOUGH_LEAD)

    @property
    def is_convincing(self) -> bool:
        """Whether the first pose is accepted."""
        if self.is_given:
            return True
        if self.by_outlines is not None:
            return self.by_outlines
        return self.is_enough and (self.hinted or self.leads)

    @property
    def is_clear(self) -> bool:
        """Whether the first pose is so clear that no further search is needed."""
        if not self.is_enough or self.by_outlines is False:
            return False
        if self.hinted:
            return self.share >= HINTED_SUPPORT
        return self.share >= CLEAR_SUPPORT and self.leads_clearly

    @property
    def share(self) -> float:
        """Share of the expected legs that agree with the first pose; 0 where none is expected."""
        expected = float(self.expected[0].sum()) if len(self.poses) else 0.0
        return float(self.support[0].sum()) / expected if expected else 0.0

    def _leads(self, enough: tuple[float, float]) -> bool:
        """Return whether the first pose leads by a number of legs and a part of its score."""
        legs, part = enough
        return self.lead >= max(legs, part * float(self.score[0]))

    def pose(self, i: int = 0) -> RigidTransform:
        """Return T_base_camera of a pose."""
        return self.poses.T_base_camera(i)


def place_camera(
    pictures: Sequence[Picture],
    n_legs: int,
    starts: Sequence[int] = START_PICTURES,
    known: Sequence[RigidTransform] = (),
) -> PoseCandidates:
    """Return the camera poses on which most legs of all pictures of a view agree.

    Pictures are of one camera pose at different readings; ``starts`` says how many more of them
    suggest poses, until one is clear. ``known`` are T_base_camera that are tried first; where most
    legs agree with one of them, nothing else is.
    """
    best_first = sorted(pictures, key=lambda picture: -picture.pairs.best_merit)
    every = Pictures.of(pictures)
    near = CameraPoses.of(known, n_legs)
    best = _candidates(every, _approached(every, near, SUPPORT) if known else near)
    done = 0
    for n in starts if best.share < HINTED_SUPPORT else ():
        if done >= len(pictures) or (done and best.is_clear):
            break
        suggested = [_starts(picture, n_legs) for picture in best_first[done : done + n]]
        done += n
        poses = CameraPoses.joined([best.poses, *suggested])
        if len(poses) == 0:
            continue
        first = Pictures.of(best_first[:done])
        poses = refined(first, poses, SEARCHING[2:4], every.joint_error)
        some = Pictures.of(best_first[: max(SOME_PICTURES, done)])
        score = scores(some, poses, SEARCHING[3])
        poses = poses.choose(_distinct(poses, score, N_KEPT[2]))
        # From far a flat machine looks alike with near and far exchanged.
        ahead, ends = poses.choose(np.arange(min(N_REVERSED, len(poses)))), some.all_ends
        poses = CameraPoses.joined([poses, depth_reversed(ahead, ends) if len(ends) else ahead])
        poses = refined(some, poses, SEARCHING[3:], every.joint_error)
        score = scores(some, poses, SEARCHING[-1])
        poses = poses.choose(_best(score, N_KEPT[3]))
        poses = CameraPoses.joined([poses, _polished(some.choose(slice(N_POLISHING)), poses)])
        best = _candidates(every, refined(every, poses, FITTING, every.joint_error))
    return best


def _approached(pictures: Pictures, poses: CameraPoses, least: float = 0.0) -> CameraPoses:
    """Return rough poses after all steps that lead to the pairs.

    Poses that a smaller share of the legs than *least* supports even roughly stay where they are.
    """
    poses = refined(pictures, poses, SEARCHING[:3])
    if least > 0.0:
        matches = match_pairs(pictures, poses, SEARCHING[2])
        shown, seen = (_by_legs(pictures, x).sum(axis=0) for x in (matches.score, matches.visible))
        if not np.any(shown >= least * seen):
            return poses
    return refined(pictures, poses, (*SEARCHING[2:], *FITTING), pictures.joint_error)


def _polished(pictures: Pictures, poses: CameraPoses) -> CameraPoses:
    """Return for each of the best poses the best one around it that steps lead to.

    A leg on a wrong pair keeps a pose, and the joints moved for it, from where all legs agree.
    """
    n_legs = poses.shift.shape[1]
    polished = []
    for i in range(min(N_POLISHED, len(poses))):
        around = _around(pictures, poses.R[i], poses.t[i], n_legs)
        around = refined(pictures, around, POLISH, pictures.joint_error)
        score = scores(pictures, around, POLISH[-1])
        polished.append(around.choose(_best(score, 1)))
    return CameraPoses.joined([*polished, poses.choose(np.zeros(0, dtype=np.intp))])


def _around(pictures: Pictures, R: Array, t: Array, n_legs: int) -> CameraPoses:
    """Return poses around one: the machine turned a little, further, nearer, or as it is."""
    ends = pictures.all_ends
    middle = ends.mean(axis=0) if len(ends) else np.zeros(3)
    turns = POLISH_TURN * np.concatenate([np.zeros((3, 3)), np.eye(3), -np.eye(3)])
    further = 1.0 + POLISH_FURTHER * np.array([0.0, 1.0, -1.0, *np.zeros(6)])
    at = further[:, None] * (R @ middle + t)
    return _turned_about(middle, at, Rotation.from_rotvec(turns).as_matrix() @ R, n_legs)


def _turned_about(middle: Array, at: Array, R: Array, n_legs: int) -> CameraPoses:
    """Return poses with rotations R (n, 3, 3) that have the middle of the machine at (n, 3) [m]."""
    return CameraPoses.rigid(R, at - R @ middle, n_legs)


def place_by_edges(
    pictures: Sequence[Picture], maps: EdgeMaps, n_legs: int, known: CameraPoses
) -> PoseCandidates:
    """Return the camera poses along whose limbs most edges of pictures lie.

    Pairs of edges and known poses suggest them; they are moved at random, less and less, to where
    edges are. ``maps`` are of the same pictures. Pairs do not say which pose is best: see
    :attr:`PoseCandidates.by_outlines`.
    """
    every = Pictures.of(pictures)
    suggested = [_suggested(picture, n_legs) for picture in pictures[:N_SUGGESTING]]
    poses = CameraPoses.joined([known, *suggested])
    if len(poses) == 0:
        return _candidates(every, poses)
    coarse, rng = maps.halved(), np.random.default_rng(len(poses))
    few = slice(N_SUGGESTING)
    score = coarse.choose(few).blurred(EDGE_STEPS[0].blur).scores(every.choose(few), poses)
    poses = poses.choose(_best(score, N_MOVED))
    for step in EDGE_STEPS:
        some = slice(None) if step.all_pictures else few
        of_step = (maps if step.is_fine else coarse).choose(some).blurred(step.blur)
        poses, score = _moved_to_edges(of_step, every.choose(some), poses, step, rng)
        poses = poses.choose(_distinct(poses, score, step.n_kept))
    matches = match_pairs(every, poses, FITTING[-1])
    support, expected = (_by_legs(every, x).T for x in (matches.exclusive_score, matches.visible))
    error = _leg_error(every, poses.choose(slice(0, 1)))
    first = float(score.max()) / len(pictures)
    return PoseCandidates(poses, support, expected, support.sum(axis=1), error, along_edges=first)


def _moved_to_edges(
    maps: EdgeMaps, pictures: Pictures, poses: CameraPoses, step: EdgeStep, rng: np.random.Generator
) -> tuple[CameraPoses, Array]:
    """Return for each pose the best one of some around it, and the scores."""
    n, middle = len(poses), pictures.all_ends.mean(axis=0)
    R, t = np.repeat(poses.R, N_TRIED, axis=0), np.repeat(poses.t, N_TRIED, axis=0)
    at = R @ middle + t
    distance = np.linalg.norm(at, axis=1, keepdims=True)
    turns = Rotation.from_rotvec(np.deg2rad(step.turn) * rng.normal(size=(len(R), 3)))
    at = at + step.part * distance * rng.normal(size=at.shape) * np.array([0.5, 0.5, 1.0])
    around = _turned_about(middle, at, turns.as_matrix() @ R, poses.shift.shape[1])
    tried = CameraPoses.joined([poses, around])
    score = maps.scores(pictures, tried)
    parent = np.concatenate([np.arange(n), np.repeat(np.arange(n), N_TRIED)])
    order = np.lexsort([-score, parent])
    best = order[np.flatnonzero(np.diff(parent[order], prepend=-1))]
    return tried.choose(best), score[best]


def place_near(
    pictures: Sequence[Picture], T_base_camera: RigidTransform, n_legs: int
) -> PoseCandidates:
    """Return the camera pose near a rough one on which the pictures of a view agree."""
    rough = CameraPoses.of([T_base_camera], n_legs)
    turns = NEAR_TURN * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    R = Rotation.from_rotvec(turns).as_matrix() @ rough.R
    poses = CameraPoses.rigid(R, np.repeat(rough.t, len(R), axis=0), n_legs)
    every = Pictures.of(pictures)
    return replace(_candidates(every, _approached(every, poses)), hinted=True)


def place_at(
    pictures: Sequence[Picture], T_base_camera: RigidTransform, n_legs: int
) -> PoseCandidates:
    """Return a camera pose that clicks give, as it is: pictures hardly show the legs."""
    candidates = _candidates(Pictures.of(pictures), CameraPoses.of([T_base_camera], n_legs))
    return replace(candidates, hinted=True, is_given=True)


def with_first(
    placed: PoseCandidates, i: int, pose: CameraPoses, pictures: Sequence[Picture]
) -> PoseCandidates:
    """Return poses with the i-th one first, where outlines put it."""
    order = np.array([i, *(k for k in range(len(placed.poses)) if k != i)], dtype=np.intp)
    return replace(
        placed,
        poses=CameraPoses.joined([pose, placed.poses.choose(order[1:])]),
        support=placed.support[order],
        expected=placed.expected[order],
        score=placed.score[order],
        leg_error=_leg_error(Pictures.of(pictures), pose),
    )


def _candidates(pictures: Pictures, poses: CameraPoses) -> PoseCandidates:
    """Return poses with their support, best first, without equivalent ones."""
    n_legs = poses.shift.shape[1]
    if len(poses) == 0:
        empty = np.zeros((0, len(pictures)))
        return PoseCandidates(poses, empty, empty, np.zeros(0), np.full(n_legs, np.inf))
    matches = match_pairs(pictures, poses, FITTING[-1])
    value = matches.exclusive_score
    support, expected = (_by_legs(pictures, x).T for x in (value, matches.visible))
    joint_error = pictures.joint_error * pictures.size
    cost = 0.5 * np.sum(poses.shift**2, axis=(1, 2, 3)) / joint_error**2
    score = support.sum(axis=1) - SHIFT_COST * cost
    order = _different(pictures, poses, matches, value >= MIN_MATCH_SCORE, score)
    best = poses.choose(order[:1])
    error = _leg_error(pictures, best)
    return PoseCandidates(poses.choose(order), support[order], expected[order], score[order], error)


def _by_legs(pictures: Pictures, value: Array) -> Array:
    """Return values of segments (n_pictures, n_poses, n_segments) added up to legs, (.., ..)."""
    return np.asarray((value @ pictures.share[..., None])[..., 0])


def _different(
    pictures: Pictures, poses: CameraPoses, matches: PairMatches, matched: BoolArray, score: Array
) -> IntArray:
    """Return the poses, best first, that put other legs on other pairs than better ones do.

    So do poses that are far from them: legs in a plane that is seen from its edge are on the same
    pairs from below.
    """
    common = np.zeros((len(score), len(score)))
    if pictures.pairs.shape[1]:
        for pairs, pair, match in zip(pictures.pairs, matches.pair, matched, strict=True):
            same = _one_leg(pairs)[pair[:, None], pair[None]]
            common += np.sum(same & match[:, None] & match[None], axis=2)
    alike = common / np.maximum(np.diag(common), 1.0)[:, None] >= SAME_MATCHES
    order = _best(score, len(score))
    near = _near(poses.choose(order), *OTHER_POSE) & alike[order][:, order]
    return order[first_apart(near)]


def _one_leg(pairs: Array) -> BoolArray:
    """Return the mask of pairs (n, n) that may be of one leg: they continue or overlap.

    Pairs (n, 9) are as in :class:`legcal.perception.pair_matching.Pictures`.
    """
    middle, along, normal, width = pairs[:, :2], pairs[:, 2:4], pairs[:, 4:6], pairs[:, 8]
    apart = np.abs(np.sum(middle * normal, axis=1)[:, None] - normal @ middle.T)
    near = np.maximum(apart, apart.T) <= SAME_LEG_WIDTHS * width[:, None]
    return np.asarray(near & (np.abs(along @ along.T) >= np.cos(SAME_LEG_TURN)))


def _leg_error(pictures: Pictures, pose: CameraPoses) -> Array:
    """Return the root mean square distance (n_legs,) of legs from their pairs, of the size."""
    n_legs = pose.shift.shape[1]
    square, count = np.zeros(n_legs), np.zeros(n_legs)
    matches = match_pairs(pictures, pose, FITTING[-1])
    matched = matches.exclusive_score[:, 0] >= MIN_MATCH_SCORE
    if matched.any():
        distance = distances(pictures, pose, matches)[:, 0] / pictures.size
        np.add.at(square, pictures.leg[matched], distance[matched] ** 2)
        np.add.at(count, pictures.leg[matched], 1.0)
    error = np.sqrt(square / np.maximum(count, 1.0))
    error = np.where(count < MIN_MATCHES, np.maximum(error, ERROR_OF_FEW), error)
    return np.where(count > 0, error, np.inf)


def _starts(picture: Picture, n_legs: int) -> CameraPoses:
    """Return the poses that fit an image best, among the poses suggested by two of its pairs."""
    poses = _suggested(picture, n_legs)
    if len(poses) == 0:
        return poses
    alone = Pictures.of([picture])
    poses = poses.choose(_best(scores(alone, poses, SEARCHING[0]), N_KEPT[0]))
    poses = refined(alone, poses, SEARCHING[:3])
    score = scores(alone, poses, SEARCHING[2])
    return poses.choose(_distinct(poses, score, N_KEPT[1]))


def _suggested(picture: Picture, n_legs: int) -> CameraPoses:
    """Return the poses that two pairs of a picture suggest."""
    poses, back = pose_hypotheses(picture, n_legs), picture.R.T
    # From the frame of the picture to that of the poses.
    return CameraPoses.rigid(back @ poses.R, (poses.t - picture.t) @ picture.R, n_legs)


def refined(
    pictures: Pictures,
    poses: CameraPoses,
    tolerances: Sequence[float],
    joint_error: float = 0.0,
) -> CameraPoses:
    """Return poses after a step towards the pairs for each of some tolerances."""
    for tolerance in tolerances:
        matches = match_pairs(pictures, poses, tolerance)
        poses = gauss_newton_step(pictures, poses, matches, tolerance, joint_error)
    return poses


def scores(pictures: Pictures, poses: CameraPoses, tolerance: float) -> Array:
    """Return the number of legs that agree with each pose in all images together, (n_poses,)."""
    score = match_pairs(pictures, poses, tolerance).exclusive_score
    return np.asarray(_by_legs(pictures, score).sum(axis=0))


def _best(score: Array, n: int) -> IntArray:
    return np.argsort(-score, kind="stable")[:n]


def _distinct(poses: CameraPoses, score: Array, n: int) -> IntArray:
    """Return the best poses that differ from better ones."""
    order = _best(score, len(score))
    return order[first_apart(_near(poses.choose(order), *SAME_POSE), n)]


def _near(poses: CameraPoses, angle: float, part: float) -> BoolArray:
    """Return which poses (n, n) are within an angle and a part of the distance of others."""
    flat = poses.R.reshape(len(poses), 9)
    trace = flat @ flat.T
    turn = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    at = -np.einsum("kij,ki->kj", poses.R, poses.t)  # where the camera stands in the base link
    apart = np.linalg.norm(at[:, None] - at, axis=2)
    reach = part * np.linalg.norm(poses.t, axis=1)
    return np.asarray((turn < angle) & (apart < reach[:, None]))


def flipped(pairs: CandidatePairs, corners: Array, flip: Array) -> CandidatePairs:
    """Return the pairs of the image with its pixels in the opposite order along some axes.

    ``corners`` (2, 2) are of the sensor plane; ``flip`` (2,) is -1 along axes that are turned.
    """
    middle = corners.mean(axis=0)
    return replace(pairs, middle=middle + flip * (pairs.middle - middle), along=flip * pairs.along)


def shrunk(pairs: CandidatePairs, corners: Array, factor: float) -> CandidatePairs:
    """Return the pairs of the image before it was made larger by a factor about its middle."""
    middle = corners.mean(axis=0)
    return replace(
        pairs,
        middle=middle + (pairs.middle - middle) / factor,
        half_length=pairs.half_length / factor,
        width=pairs.width / factor,
    )


def mirrored(pictures: Sequence[Picture]) -> list[Picture]:
    """Return the pictures with left and right exchanged."""
    return [replace(p, pairs=flipped(p.pairs, p.corners, LEFT_RIGHT)) for p in pictures]


def is_mirrored(original: PoseCandidates, other: PoseCandidates) -> bool:
    """Return whether mirrored images explain a view better than the original ones.

    Those of a machine with a plane of symmetry, as all planar ones, explain it about as well.
    """
    if not original.is_convincing:
        return other.is_clear
    if not other.is_convincing:  # it may have no pose at all
        return False
    lead = float(other.score[0] - original.score[0])
    legs, part = MIRRORED_LEAD
    return lead >= max(legs, part * float(other.score[0]))


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
        picture.pairs.choose(np.arange(min(N_SECOND, len(picture.pairs)))),
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
    first = pairs.choose(np.arange(n))
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
