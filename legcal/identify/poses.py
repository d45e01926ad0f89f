"""Random poses inside the travel, found in closed form for all of them at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.equations import demanded
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.sensitivity import freedoms

_STEPS = 5  # from home to a pose, so that no pose jumps to another assembly mode
_ITERATIONS = 3  # of Newton's method a step
_LAST_ITERATIONS = 12
_CLOSED = 1e-9  # of the mean leg length
_NEARLY_CLOSED = 1e-5  # where more is demanded than freedoms are left, and joints give way
_DEPENDENT = 1e-4  # singular values of equations below this are those of the others
_SINGULAR = 0.05  # smallest singular value, of its value at home
_RANK = 1e-9  # of the largest singular value
_FREE = 0.05  # mean leg lengths: how far poses move where no motor holds them
_ATTEMPTS = 12
_SHRINKING = 0.6  # each attempt with that part of the travel of the one before, but
_LOOSE = 0.01  # of a hold by motors and joints, without unit
_LEAST_SHARE = 0.078  # of the travel at least


def random_poses(
    legs: Sequence[LegGeometry],
    frame_legs: Sequence[int],
    home: RigidTransform,
    travel: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return random poses with all sliders inside their travel.

    Parameters
    ----------
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    frame_legs : sequence of int
        The legs that define R_b and R_e.
    home : RigidTransform
        T_Rb_Re near a closed pose of the wanted assembly mode.
    travel : (n_legs, 2) array
        Shortest and longest length of each leg [m]; equal for legs of constant length.
    count : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the poses.

    Returns
    -------
    (count, 3, 3) and (count, 3) array
        Rotations and positions [m] of R_e in R_b.

    Raises
    ------
    DidNotConverge
        If the machine cannot move inside its travel.
    """
    closing = _Closing(legs, frame_legs)
    R0, t0 = _one(home)
    R0, t0 = closing.close(R0, t0, None, _LAST_ITERATIONS)
    closing.drive(R0, t0)
    home_lengths = closing.lengths(R0, t0)[0]
    found_R, found_t = np.zeros((0, 3, 3)), np.zeros((0, 3))
    share, tried, near_singular = 1.0, 0, 0
    for _ in range(_ATTEMPTS):
        n = 2 * (count - len(found_t)) + 10
        wanted = rng.uniform(travel[:, 0], travel[:, 1], (n, len(legs)))
        wanted = home_lengths + share * (wanted - home_lengths)
        R, t = closing.wander(R0, t0, n, share, rng)
        first, good = closing.lengths(R, t), np.ones(n, dtype=np.bool_)
        for part in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
            R, t = closing.close(R, t, first + part * (wanted - first), _ITERATIONS)
            good &= closing.is_regular(R, t, R0, t0)
        tried, near_singular = tried + n, near_singular + int(np.sum(~good))
        R, t = closing.close(R, t, wanted, _LAST_ITERATIONS - _ITERATIONS)
        good &= closing.is_closed(R, t, wanted)
        good &= _inside(closing.lengths(R, t), travel, home_lengths)
        found_R, found_t = np.concatenate([found_R, R[good]]), np.concatenate([found_t, t[good]])
        if len(found_t) >= count:
            return found_R[:count], found_t[:count]
        share = max(_SHRINKING * share, _LEAST_SHARE)
    found = f"found {len(found_t)} of {count} random poses inside the travel"
    if 2 * near_singular > tried and closing.hold(R0, t0) < _LOOSE:
        raise DidNotConverge(
            f"The observations could not be predicted: {found}, needed all; most ways there come "
            "near a singular pose, in which motors and joints do not hold the platform: choose a "
            "home further from it, or joints that do not make the same figure on base and platform."
        )
    raise DidNotConverge(
        f"The observations could not be predicted: {found}, needed all; check the travel (limit "
        "lower, upper) and the home pose of the model."
    )


class _Closing:
    """The equations of legs with lengths, as a system for many poses at once."""

    def __init__(self, legs: Sequence[LegGeometry], frame_legs: Sequence[int]) -> None:
        self.legs = tuple(legs)
        self.columns = list(freedoms(frame_legs))
        self.driven = {j for j, leg in enumerate(legs) if leg.kind is LegKind.ACTUATED}

    def drive(self, R: Array, t: Array) -> None:
        """Let only motors that are independent at a pose draw their lengths; others follow.

        Those are taken that say most beside each other, of what the other demands leave open.
        """
        motors, rank = sorted(self.driven), self.rank(R, t)
        self.driven = set()
        count = rank - self.rank(R, t)
        if count < len(motors):
            size = np.where(np.array(self.columns) < 3, self.lengths(R, t).mean(), 1.0)
            rows = [
                demanded(self.legs[j], R, t, by_local=False).by_pose[0, 0, self.columns]
                for j in motors
            ]
            held = self.system(R, t, None)[1][0] / size
            left = np.eye(len(size)) - np.linalg.pinv(held, rcond=_RANK) @ held
            order = qr((np.array(rows) / size @ left).T, mode="r", pivoting=True)[1]
            motors = [motors[k] for k in order[:count]]
        self.driven = set(motors)

    def rank(self, R: Array, t: Array) -> int:
        """Return the number of independent equations at a pose."""
        slopes = self.system(R, t, self.lengths(R, t))[1][0]
        return int(np.linalg.matrix_rank(slopes, tol=_DEPENDENT)) if slopes.size else 0

    def hold(self, R: Array, t: Array) -> float:
        """Return how well motors and joints hold the platform at a pose: 0 where singular."""
        lengths = self.lengths(R, t)
        scale = np.where(np.array(self.columns) < 3, 1.0 / lengths.mean(), 1.0)
        slopes = self.system(R, t, lengths)[1][0] * scale
        return float(np.linalg.svd(slopes, compute_uv=False)[-1]) if slopes.size else 0.0

    def lengths(self, R: Array, t: Array) -> Array:
        """Return the leg lengths, (k, n_legs) [m]."""
        A, B = np.array([leg.A for leg in self.legs]), np.array([leg.B for leg in self.legs])
        vector = np.einsum("kij,nj->kni", R, B) + t[:, None] - A
        return np.asarray(np.linalg.norm(vector, axis=2))

    def system(self, R: Array, t: Array, wanted: Array | None) -> tuple[Array, Array]:
        """Return residuals (k, m), derivatives (k, m, f); without lengths motors are free."""
        values, slopes = [np.zeros((len(t), 0))], [np.zeros((len(t), 0, 6))]
        for j, leg in enumerate(self.legs):
            found = demanded(leg, R, t, by_local=False)
            value, slope = found.values, found.by_pose
            if leg.kind is LegKind.ACTUATED and j in self.driven and wanted is not None:
                value[:, 0] += leg.q0 - wanted[:, j]
            elif leg.kind is LegKind.ACTUATED:
                value, slope = value[:, 1:], slope[:, 1:]
            values.append(value)
            slopes.append(slope)
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)[:, :, self.columns]

    def close(
        self, R: Array, t: Array, wanted: Array | None, iterations: int
    ) -> tuple[Array, Array]:
        """Return poses after some iterations of Newton's method, shortest steps."""
        for _ in range(iterations):
            values, slopes = self.system(R, t, wanted)
            if values.shape[1] == 0:
                break
            step = -(np.linalg.pinv(slopes, rcond=_RANK) @ values[..., None])[..., 0]
            R, t = self.moved(R, t, step)
            if np.abs(step).max(initial=0.0) < 1e-14:
                break
        return R, t

    def moved(self, R: Array, t: Array, step: Array) -> tuple[Array, Array]:
        """Return poses after a step of their possible motions."""
        full = np.zeros((len(t), 6))
        full[:, self.columns] = np.clip(step, -0.3, 0.3)
        return Rotation.from_rotvec(full[:, :3]).as_matrix() @ R, t + full[:, 3:]

    def wander(
        self, R: Array, t: Array, n: int, share: float, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return n poses that differ from home as far as no motor holds the platform."""
        lengths = self.lengths(R, t)
        size = float(lengths.mean())
        _, slopes = self.system(R, t, lengths)
        J = slopes[0] if slopes.shape[1] else np.zeros((1, len(self.columns)))
        null = np.eye(len(self.columns)) - np.linalg.pinv(J, rcond=1e-6) @ J
        step = rng.normal(size=(n, len(self.columns))) * share * _FREE @ null.T
        scale = np.where(np.array(self.columns) < 3, 1.0, size)
        return self.moved(np.repeat(R, n, axis=0), np.repeat(t, n, axis=0), step * scale)

    def is_closed(self, R: Array, t: Array, wanted: Array) -> BoolArray:
        """Return which poses meet what legs and lengths demand."""
        values, _ = self.system(R, t, wanted)
        redundant = values.shape[1] > len(self.columns)
        limit = (_NEARLY_CLOSED if redundant else _CLOSED) * self.lengths(R, t).mean(axis=1)
        return np.asarray(np.abs(values).max(axis=1, initial=0.0) <= limit)

    def is_regular(self, R: Array, t: Array, R0: Array, t0: Array) -> BoolArray:
        """Return which poses are as far from singular as a share of home is, on the same side."""
        J = self.system(R, t, self.lengths(R, t))[1]
        J0 = self.system(R0, t0, self.lengths(R0, t0))[1]
        if J.shape[1] == 0:
            return np.ones(len(t), dtype=np.bool_)
        s, s0 = np.linalg.svd(J, compute_uv=False), np.linalg.svd(J0, compute_uv=False)[0]
        last = int(np.sum(s0 > 1e-6 * s0[0])) - 1
        good = s[:, last] > _SINGULAR * s0[last]
        if J.shape[1] == J.shape[2]:
            good &= np.linalg.det(J) * np.linalg.det(J0) >= 0.0
        return np.asarray(good)


def _inside(lengths: Array, travel: Array, home: Array) -> BoolArray:
    """Return which rows of lengths lie inside the travel; home counts as inside."""
    slack = 1e-6 + 0.05 * (travel[:, 1] - travel[:, 0])
    low, high = np.minimum(travel[:, 0], home) - slack, np.maximum(travel[:, 1], home) + slack
    return np.asarray(np.all((lengths >= low) & (lengths <= high), axis=1))


def _one(T: RigidTransform) -> tuple[Array, Array]:
    """Return a pose as arrays of one."""
    return T.rotation.as_matrix()[None], np.asarray(T.translation)[None]
