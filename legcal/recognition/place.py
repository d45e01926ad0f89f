"""The camera pose on which all pictures of a view agree, and what comes close to it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array, IntArray
from legcal.recognition.agreement import Agreement, Picture, Poses, agreement, improved
from legcal.recognition.starts import joined, pose_starts

TOLERANCES = (0.05, 0.035, 0.025, 0.018, 0.012, 0.009)  # of an axis, on the sensor plane
JOINT_ERROR = 0.01  # standard deviation of the joint centres of the nominal model [m]
START_PICTURES, MOST_START_PICTURES = 2, 8  # whose bars suggest poses: at once, at most
CLEAR_SUPPORT, CLEAR_LEAD = 0.4, 1.6  # of a pose: share of the expected legs, against the next one
KEPT = (500, 40, 10)  # of the starts of a picture, of its refined ones, of all
SAME_TURN, SAME_PLACE = np.deg2rad(8.0), 0.08  # of one pose: angle, part of the distance


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses of a camera, best first.

    Attributes
    ----------
    poses : Poses
        T_camera_base.
    support : (n, n_pictures) array
        How many legs agree in each picture, weighted by how well and how much of them.
    expected : (n, n_pictures) array
        How many legs each picture would show.
    """

    poses: Poses
    support: Array
    expected: Array

    @classmethod
    def nothing(cls, n_pictures: int, n_legs: int) -> "Placed":
        """Return no pose."""
        empty = np.zeros((0, n_pictures))
        return cls(Poses.rigid(np.zeros((0, 3, 3)), np.zeros((0, 3)), n_legs), empty, empty)

    @property
    def is_clear(self) -> bool:
        """Whether the first pose is convincing, and far ahead of the next one."""
        if len(self.poses) == 0:
            return False
        total = self.support.sum(axis=1)
        runner_up = total[1] if len(total) > 1 else 0.0
        enough = total[0] >= CLEAR_SUPPORT * self.expected[0].sum()
        return bool(enough and total[0] >= CLEAR_LEAD * runner_up)

    def pose(self, i: int = 0) -> RigidTransform:
        """Return T_base_camera of a pose."""
        R = Rotation.from_matrix(self.poses.R[i])
        return RigidTransform.from_components(self.poses.t[i], R).inv()


def place_camera(pictures: Sequence[Picture], n_legs: int) -> Placed:
    """Return the camera poses on which most legs of all pictures of a view agree.

    Parameters
    ----------
    pictures : sequence of Picture
        Of one camera pose, at different readings.
    n_legs : int
        Number of legs of the machine.
    """
    order = np.argsort([-_merit(p) for p in pictures], kind="stable").tolist()
    best = Placed.nothing(len(pictures), n_legs)
    for first in range(0, min(len(order), MOST_START_PICTURES), START_PICTURES):
        starts = [_starts(pictures[k], n_legs) for k in order[first : first + START_PICTURES]]
        poses = joined([best.poses, *starts])
        if len(poses) == 0:
            continue
        few = [pictures[k] for k in order[: first + START_PICTURES]]
        poses = _refined(few, poses, TOLERANCES[2:4], JOINT_ERROR)
        score = _support(pictures, poses, TOLERANCES[3])[0].sum(axis=1)
        poses = poses.take(_distinct(poses, score, KEPT[2]))
        poses = _refined(pictures, poses, (*TOLERANCES[3:], *TOLERANCES[-2:]), JOINT_ERROR)
        support, expected = _support(pictures, poses, TOLERANCES[-1])
        ranked = _distinct(poses, support.sum(axis=1), len(poses))
        best = Placed(poses.take(ranked), support[ranked], expected[ranked])
        if best.is_clear:
            break
    return best


def _starts(picture: Picture, n_legs: int) -> Poses:
    """Return the poses that suit a picture best, among those that two of its bars suggest."""
    poses = pose_starts(picture, n_legs)
    if len(poses) == 0:
        return poses
    poses = poses.take(_best(_support([picture], poses, TOLERANCES[0])[0].sum(axis=1), KEPT[0]))
    poses = _refined([picture], poses, TOLERANCES[:3])
    score = _support([picture], poses, TOLERANCES[2])[0].sum(axis=1)
    return poses.take(_distinct(poses, score, KEPT[1]))


def _merit(picture: Picture) -> float:
    return float(picture.bars.merit[:8].sum()) if len(picture.bars) else 0.0


def _refined(
    pictures: Sequence[Picture],
    poses: Poses,
    tolerances: Sequence[float],
    joint_error: float = 0.0,
) -> Poses:
    for tolerance in tolerances:
        found = [agreement(picture, poses, tolerance) for picture in pictures]
        poses = improved(pictures, poses, found, tolerance, joint_error)
    return poses


def _support(
    pictures: Sequence[Picture], poses: Poses, tolerance: float
) -> tuple[Array, Array]:
    """Return the support and the expected number of legs, both (n_poses, n_pictures)."""
    support, expected = [], []
    for picture in pictures:
        found = agreement(picture, poses, tolerance)
        support.append(_one_bar_each(found) @ picture.targets.share)
        expected.append(found.visible @ picture.targets.share)
    return np.stack(support, axis=1), np.stack(expected, axis=1)


def _one_bar_each(found: Agreement) -> Array:
    """Return the agreement of pieces, where a bar counts for the piece that it suits best."""
    same = found.bar[:, :, None] == found.bar[:, None, :]
    better = found.value[:, None, :] > found.value[:, :, None]
    return np.where(np.any(same & better, axis=2), 0.0, found.value)


def _best(score: Array, n: int) -> IntArray:
    return np.argsort(-score, kind="stable")[:n]


def _distinct(poses: Poses, score: Array, n: int) -> IntArray:
    """Return the best poses that differ from better ones."""
    kept: list[int] = []
    distance = np.linalg.norm(poses.t, axis=1)
    for i in np.argsort(-score, kind="stable").tolist():
        if len(kept) == n:
            break
        if kept:
            trace = np.einsum("kij,ij->k", poses.R[kept], poses.R[i])
            turn = np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0))
            apart = np.linalg.norm(poses.t[kept] - poses.t[i], axis=1)
            if np.any((turn < SAME_TURN) & (apart < SAME_PLACE * distance[i])):
                continue
        kept.append(i)
    return np.array(kept, dtype=np.intp)
