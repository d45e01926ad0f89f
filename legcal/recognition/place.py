"""The camera pose on which all pictures of a view agree, and what comes close to it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.recognition.agreement import Agreement, Picture, Poses, agreement, distances, improved
from legcal.recognition.bars import Bars
from legcal.recognition.exchange import exchanged
from legcal.recognition.placed import Placed
from legcal.recognition.starts import joined, pose_starts

TOLERANCES = (0.05, 0.035, 0.025, 0.018, 0.012, 0.008, 0.006)  # of an axis [m]
LAST = (0.01, 0.007, 0.005, 0.004, 0.003)  # with the joints known better
JOINT_ERROR = 6e-3  # standard deviation of the joint centres of the nominal model [m]
START_PICTURES = 1, 1, 2, 4  # whose bars suggest poses, as long as there is a doubt
SOME_PICTURES = 8  # that judge which poses are worth a comparison with all
KEPT = (400, 40, 12, 6)  # poses: those of a picture, its refined ones, of some pictures, of all
N_POLISHED, POLISHING = 2, 4  # poses around which better ones are sought, by so many pictures
N_REVERSED = 4  # poses of which those with near and far exchanged are tried as well
POLISH = (0.018, 0.012, 0.008)  # tolerances
POLISH_TURN, POLISH_FURTHER = np.deg2rad(3.0), 0.05  # angle, part of the distance
SAME_TURN, SAME_PLACE = np.deg2rad(8.0), 0.08  # of one pose: angle, part of the distance
SAME_MATCHES = 0.5  # share of common matches from which on two poses say the same
OTHER_TURN, OTHER_PLACE = np.deg2rad(20.0), 0.25  # unless they are so far from each other
SAME_BAR = np.deg2rad(4.0), 0.6  # of two bars on one leg: angle, distance in widths
MATCHED = 0.15  # agreement of a piece with its bar that counts as a match
JUDGED = 3e-3  # tolerance with which poses are judged in the end [m]
SHIFT_COST = 0.06  # in legs, of shifts as likely as one standard deviation of all (in chi^2 / 2)
NEAR_STARTS = np.deg2rad(2.5)  # turns of a rough pose that are tried as well
FEW_MATCHES, FEW_ERROR = 3, 3e-3  # below so many the place of a leg is this uncertain [m]


def place_camera(
    pictures: Sequence[Picture], n_legs: int, starts: Sequence[int] = START_PICTURES
) -> Placed:
    """Return the camera poses on which most legs of all pictures of a view agree.

    Parameters
    ----------
    pictures : sequence of Picture
        Of one camera pose, at different readings.
    n_legs : int
        Number of legs of the machine.
    starts : sequence of int
        How many pictures more suggest poses, as long as there is a doubt.
    """
    by_merit = np.argsort([-_merit(p) for p in pictures], kind="stable").tolist()
    best_first = [pictures[k] for k in by_merit]
    nothing = Poses.rigid(np.zeros((0, 3, 3)), np.zeros((0, 3)), n_legs)
    best = _judged(pictures, nothing)
    done = 0
    for n in starts:
        if done >= len(pictures):
            break
        suggested = [_starts(picture, n_legs) for picture in best_first[done : done + n]]
        done += n
        poses = joined([best.poses, *suggested])
        if len(poses) == 0:
            continue
        poses = refined(best_first[:done], poses, TOLERANCES[2:4], JOINT_ERROR)
        some = best_first[: max(SOME_PICTURES, done)]
        score = supports(some, poses, TOLERANCES[3])[0].sum(axis=1)
        poses = poses.take(_distinct(poses, score, KEPT[2]))
        poses = joined([poses, _reversed(some, poses.take(np.arange(min(N_REVERSED, len(poses)))))])
        poses = refined(some, poses, TOLERANCES[3:], JOINT_ERROR)
        score = supports(some, poses, TOLERANCES[-1])[0].sum(axis=1)
        poses = poses.take(_best(score, KEPT[3]))
        poses = joined([poses, _polished(some[:POLISHING], poses)])
        best = _judged(pictures, refined(pictures, poses, LAST, JOINT_ERROR))
        if best.is_clear:
            break
    return best


def _polished(pictures: Sequence[Picture], poses: Poses) -> Poses:
    """Return for each of the best poses the best one around it that steps lead to.

    A leg on a wrong bar keeps a pose, and the joints moved for it, from where all legs agree.
    """
    n_legs = poses.shift.shape[1]
    found = []
    for i in range(min(N_POLISHED, len(poses))):
        around = _around(pictures, poses.R[i], poses.t[i], n_legs)
        around = refined(pictures, around, POLISH, JOINT_ERROR)
        score = supports(pictures, around, POLISH[-1])[0].sum(axis=1)
        found.append(around.take(_best(score, 1)))
    return joined([*found, poses.take(np.zeros(0, dtype=np.intp))])


def _reversed(pictures: Sequence[Picture], poses: Poses) -> Poses:
    """Return the poses that show a flat machine alike from far: near and far exchanged."""
    ends = np.concatenate([picture.targets.ends.reshape(-1, 3) for picture in pictures])
    if len(ends) == 0:
        return poses
    return Poses.rigid(*exchanged(poses.R, poses.t, ends), poses.shift.shape[1])


def _around(pictures: Sequence[Picture], R: Array, t: Array, n_legs: int) -> Poses:
    """Return poses around one: the machine turned a little, further, nearer, or as it is."""
    ends = np.concatenate([picture.targets.ends.reshape(-1, 3) for picture in pictures])
    middle = ends.mean(axis=0) if len(ends) else np.zeros(3)
    turns = POLISH_TURN * np.concatenate([np.zeros((3, 3)), np.eye(3), -np.eye(3)])
    further = 1.0 + POLISH_FURTHER * np.array([0.0, 1.0, -1.0, *np.zeros(6)])
    new = Rotation.from_rotvec(turns).as_matrix() @ R
    return Poses.rigid(new, further[:, None] * (R @ middle + t) - new @ middle, n_legs)


def place_near(pictures: Sequence[Picture], T_base_camera: RigidTransform, n_legs: int) -> Placed:
    """Return the camera pose near a rough one on which the pictures of a view agree.

    Parameters
    ----------
    pictures : sequence of Picture
        Of one camera pose, at different readings.
    T_base_camera : RigidTransform
        The rough pose.
    n_legs : int
        Number of legs of the machine.
    """
    T = T_base_camera.inv()
    turns = NEAR_STARTS * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    R = Rotation.from_rotvec(turns).as_matrix() @ T.rotation.as_matrix()
    poses = Poses.rigid(R, np.tile(T.translation, (len(R), 1)), n_legs)
    poses = refined(pictures, poses, TOLERANCES[:3])
    poses = refined(pictures, poses, (*TOLERANCES[2:], *LAST), JOINT_ERROR)
    found = _judged(pictures, poses)
    return replace(found, hinted=True)


def with_first(placed: Placed, i: int, pose: Poses, pictures: Sequence[Picture]) -> Placed:
    """Return poses with the i-th one first, where outlines put it."""
    order = np.array([i, *(k for k in range(len(placed.poses)) if k != i)], dtype=np.intp)
    return replace(
        placed,
        poses=joined([pose, placed.poses.take(order[1:])]),
        support=placed.support[order],
        expected=placed.expected[order],
        score=placed.score[order],
        leg_error=_leg_error(pictures, pose),
    )


def _judged(pictures: Sequence[Picture], poses: Poses) -> Placed:
    """Return poses with their support, best first, without those that say the same."""
    n_legs = poses.shift.shape[1]
    if len(poses) == 0:
        empty = np.zeros((0, len(pictures)))
        return Placed(poses, empty, empty, np.zeros(0), np.full(n_legs, np.inf))
    found = [agreement(picture, poses, JUDGED) for picture in pictures]
    values = [one.one_bar_each for one in found]
    shares = [picture.targets.share for picture in pictures]
    support = np.stack([v @ s for v, s in zip(values, shares, strict=True)], axis=1)
    expected = np.stack([f.visible @ s for f, s in zip(found, shares, strict=True)], axis=1)
    cost = 0.5 * np.sum(poses.shift**2, axis=(1, 2, 3)) / JOINT_ERROR**2
    score = support.sum(axis=1) - SHIFT_COST * cost
    order = _different(pictures, poses, found, [v >= MATCHED for v in values], score)
    best = poses.take(order[:1])
    error = _leg_error(pictures, best)
    return Placed(poses.take(order), support[order], expected[order], score[order], error)


def _different(
    pictures: Sequence[Picture],
    poses: Poses,
    found: Sequence[Agreement],
    matched: Sequence[BoolArray],
    score: Array,
) -> IntArray:
    """Return the poses, best first, that put other legs on other bars than better ones do.

    So do poses that are far from them: legs in a plane that is seen from its edge are on the same
    bars from below.
    """
    common = np.zeros((len(score), len(score)))
    for picture, agreed, match in zip(pictures, found, matched, strict=True):
        if len(picture.bars) == 0:
            continue
        same = _one_leg(picture.bars)
        for j in range(len(picture.targets)):
            bar, has = agreed.bar[:, j], match[:, j]
            common += same[np.ix_(bar, bar)] & has[:, None] & has[None, :]
    least = np.maximum(np.diag(common), 1.0)
    kept: list[int] = []
    for i in np.argsort(-score, kind="stable").tolist():
        alike = common[i, kept] / least[i] >= SAME_MATCHES
        if not np.any(alike & _near(poses, kept, i, OTHER_TURN, OTHER_PLACE)):
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def _one_leg(bars: Bars) -> BoolArray:
    """Return which bars (n, n) may be of one leg: they continue each other or overlap."""
    apart = np.abs(np.einsum("ijx,ix->ij", bars.middle[None] - bars.middle[:, None], bars.normal))
    near = np.maximum(apart, apart.T) <= SAME_BAR[1] * bars.width.mean(axis=1)[:, None]
    return np.asarray(near & (np.abs(bars.along @ bars.along.T) >= np.cos(SAME_BAR[0])))


def _leg_error(pictures: Sequence[Picture], pose: Poses) -> Array:
    """Return the root mean square distance (n_legs,) of legs from their bars [m]."""
    n_legs = pose.shift.shape[1]
    square, count = np.zeros(n_legs), np.zeros(n_legs)
    for picture in pictures:
        if len(picture.bars) == 0 or len(picture.targets) == 0:
            continue
        found = agreement(picture, pose, JUDGED)
        matched = found.one_bar_each[0] >= MATCHED
        distance = distances(picture, pose, found)[0]
        np.add.at(square, picture.targets.leg[matched], distance[matched] ** 2)
        np.add.at(count, picture.targets.leg[matched], 1.0)
    error = np.sqrt(square / np.maximum(count, 1.0))
    error = np.where(count < FEW_MATCHES, np.maximum(error, FEW_ERROR), error)
    return np.where(count > 0, error, np.inf)


def _starts(picture: Picture, n_legs: int) -> Poses:
    """Return the poses that suit a picture best, among those that two of its bars suggest."""
    poses = pose_starts(picture, n_legs)
    if len(poses) == 0:
        return poses
    # From the frame of the picture to that of the poses.
    back = picture.R.T
    poses = Poses.rigid(back @ poses.R, (poses.t - picture.t) @ picture.R, n_legs)
    poses = poses.take(_best(supports([picture], poses, TOLERANCES[0])[0].sum(axis=1), KEPT[0]))
    poses = refined([picture], poses, TOLERANCES[:3])
    score = supports([picture], poses, TOLERANCES[2])[0].sum(axis=1)
    return poses.take(_distinct(poses, score, KEPT[1]))


def _merit(picture: Picture) -> float:
    return float(picture.bars.merit[:8].sum()) if len(picture.bars) else 0.0


def refined(
    pictures: Sequence[Picture],
    poses: Poses,
    tolerances: Sequence[float],
    joint_error: float = 0.0,
) -> Poses:
    """Return poses after a step towards the bars for each of some tolerances."""
    for tolerance in tolerances:
        found = [agreement(picture, poses, tolerance) for picture in pictures]
        poses = improved(pictures, poses, found, tolerance, joint_error)
    return poses


def supports(pictures: Sequence[Picture], poses: Poses, tolerance: float) -> tuple[Array, Array]:
    """Return the support and the expected number of legs, both (n_poses, n_pictures)."""
    support, expected = [], []
    for picture in pictures:
        found = agreement(picture, poses, tolerance)
        support.append(found.one_bar_each @ picture.targets.share)
        expected.append(found.visible @ picture.targets.share)
    return np.stack(support, axis=1), np.stack(expected, axis=1)


def _best(score: Array, n: int) -> IntArray:
    return np.argsort(-score, kind="stable")[:n]


def _distinct(poses: Poses, score: Array, n: int) -> IntArray:
    """Return the best poses that differ from better ones."""
    kept: list[int] = []
    for i in np.argsort(-score, kind="stable").tolist():
        if len(kept) == n:
            break
        if not np.any(_near(poses, kept, i, SAME_TURN, SAME_PLACE)):
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def _near(poses: Poses, some: list[int], i: int, angle: float, part: float) -> BoolArray:
    """Return which of some poses are within an angle and a part of the distance of pose i."""
    trace = np.einsum("kij,ij->k", poses.R[some], poses.R[i])
    turn = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
    # Where the camera stands in the base link.
    at = -np.einsum("kij,ki->kj", poses.R[some], poses.t[some])
    apart = np.linalg.norm(at + poses.R[i].T @ poses.t[i], axis=1)
    return np.asarray((turn < angle) & (apart < part * np.linalg.norm(poses.t[i])))
