"""The pose of the camera of a view, from candidate strips of all its images together.

One pose serves all images of a view. Three legs and a candidate strip of each give a pose near
the rough one (two numbers a strip, six unknowns); the pose on which most legs of all
images agree is kept and refined by robust Gauss-Newton steps. Wrong candidates, be they
neighbouring legs or clutter, agree on nothing. All legs of a view are tried as brighter than what
is behind them and as darker: one edge of a leg, lit from one side, may be all that is seen of it,
and must not pass for the other edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.detection.prediction import PredictedLeg
from legcal.detection.strips import Strips
from legcal.errors import NotVisible
from legcal.geometry.types import Array

SIGMA_POSE = np.array([2e-2, 2e-2, 2e-2, 0.015, 0.015, 0.015])  # rough pose [rad, m]
N_TRIALS = 3000
SEED = 20020721
BEST = 8  # trials that are refined
N_STEPS = 10
REACH = (2.0, 1.2)  # of a candidate that counts in a step, in tolerances: first, last
LEAST_AGREEMENT = 0.35  # share of the legs that must agree
LEAST_LEGS = 3


@dataclass(frozen=True, eq=False)
class _Votes:
    """All candidates of a view as arrays, padded with zero scores."""

    shift: Array  # (n_legs, n_kept, 2) [px]
    score: Array  # (n_legs, n_kept)
    jacobian: Array  # (n_legs, 2, 6) [px per rad, m]
    tolerance: Array  # (n_legs,) [px]


@dataclass(frozen=True, eq=False)
class _Ends:
    """The predicted legs of a view as arrays: joint centres, and both ends of their bands."""

    A: Array  # (n_legs, 3) [m]
    B: Array  # (n_legs, 3) [m]
    rays: Array  # (n_legs, 2, 3) points (x, y, 1) of the axes
    normal: Array  # (n_legs, 2)
    scale: Array  # (n_legs,)

    @classmethod
    def of(cls, legs: Sequence[PredictedLeg]) -> "_Ends":
        """Gather the legs."""
        xy = [leg.band.points(np.array([0.0, leg.band.length]), np.zeros(2)) for leg in legs]
        return cls(
            np.array([leg.A_camera for leg in legs]),
            np.array([leg.B_camera for leg in legs]),
            np.concatenate([np.array(xy), np.ones((len(legs), 2, 1))], axis=-1),
            np.array([leg.band.normal for leg in legs]),
            np.array([leg.band.scale for leg in legs]),
        )


def align_camera(
    view: str,
    T_base_camera: RigidTransform,
    legs: Sequence[PredictedLeg],
    strips: Sequence[Strips],
    tolerance: Array,
) -> RigidTransform:
    """Return the camera pose on which the legs of a view agree.

    Parameters
    ----------
    view : str
        The name of the view, for messages.
    T_base_camera : RigidTransform
        The rough pose.
    legs : sequence of PredictedLeg
        All legs of all images of the view, predicted with the rough pose.
    strips : sequence of Strips
        Candidates for each of them.
    tolerance : (n,) array
        How far a leg may lie from its prediction by the right pose [px].

    Returns
    -------
    RigidTransform
        The pose T_base_camera.

    Raises
    ------
    NotVisible
        If no leg is predicted inside an image, or too few agree on one pose.
    """
    if len(legs) < LEAST_LEGS:
        raise NotVisible(
            f"The camera of view {view!r} could not be aligned: found {len(legs)} legs inside its "
            f"images as its pose has it, needed {LEAST_LEGS}; check T_base_camera of the view, and "
            "the dimensions of the calibration board if there is one."
        )
    ends = _Ends.of(legs)
    best, best_gain, agreeing = np.zeros(6), -np.inf, 0
    for score in ([s.if_brighter for s in strips], [s.if_darker for s in strips]):
        votes = _collect(ends, strips, score, tolerance)
        for start in _trials(votes):
            xi = _refine(ends, votes, start)
            agreement = _agreeing(votes, _shifts(ends, xi))
            gain = float(agreement.sum()) - _prior(xi)
            if gain > best_gain + 1e-9:
                best, best_gain = xi, gain
                agreeing = int(np.count_nonzero(agreement > 0.0))
    needed = max(LEAST_LEGS, int(np.ceil(LEAST_AGREEMENT * len(legs))))
    if agreeing < needed:
        raise NotVisible(
            f"The camera of view {view!r} could not be aligned: found {agreeing} of {len(legs)} "
            f"legs predicted in its images that agree on one camera pose, needed {needed}; check "
            "T_base_camera of the view, the dimensions of the calibration board if there is one, "
            "and that the images belong to their readings."
        )
    return T_base_camera * _motion(best)


def _motion(xi: Array) -> RigidTransform:
    """Return the motion of the camera (rotation vector, translation) in its own frame."""
    return RigidTransform.from_components(xi[3:], Rotation.from_rotvec(xi[:3]))


def _shifts(legs: _Ends, xi: Array) -> Array:
    """Return the sideways shifts (n_legs, 2) [px] of the axes at both ends of their bands."""
    T = _motion(xi).inv()
    A, B = T.apply(legs.A), T.apply(legs.B)
    moments = np.cross(B - A, A)
    value = np.einsum("nki,ni->nk", legs.rays, moments)
    across = np.einsum("ni,ni->n", moments[:, :2], legs.normal)
    return np.asarray(-(legs.scale / across)[:, None] * value)


def _jacobian(legs: _Ends, xi: Array) -> Array:
    """Return the derivative (n_legs, 2, 6) of the shifts by central differences."""
    step = 1e-5
    return np.stack(
        [(_shifts(legs, xi + d) - _shifts(legs, xi - d)) / (2 * step) for d in step * np.eye(6)],
        axis=-1,
    )


def _collect(
    legs: _Ends, strips: Sequence[Strips], scores: Sequence[Array], tolerance: Array
) -> _Votes:
    """Pad the candidates to one array."""
    n_kept = max(1, max(len(s.score) for s in strips))
    shift, score = np.zeros((len(strips), n_kept, 2)), np.zeros((len(strips), n_kept))
    for i, candidates in enumerate(strips):
        n = len(candidates.score)
        shift[i, :n], score[i, :n] = candidates.shift, scores[i]
    return _Votes(shift, score, _jacobian(legs, np.zeros(6)), tolerance)


def _trials(votes: _Votes) -> list[Array]:
    """Return the most promising poses (6,) among those given by three candidates each."""
    rng = np.random.default_rng(SEED)
    n_legs = len(votes.score)
    best = votes.score.max(axis=1) + 1e-6
    keys = rng.exponential(size=(N_TRIALS, n_legs)) / best  # smallest three: drawn by weight
    chosen = np.argpartition(keys, 2, axis=1)[:, :3]
    weight = votes.score[chosen] ** 2 + 1e-12
    cumulative = np.cumsum(weight, axis=-1)
    draw = rng.random((N_TRIALS, 3, 1)) * cumulative[..., -1:]
    candidate = np.minimum((draw > cumulative).sum(axis=-1), votes.score.shape[1] - 1)
    target = votes.shift[chosen, candidate].reshape(N_TRIALS, 6)
    J = votes.jacobian[chosen].reshape(N_TRIALS, 6, 6)
    sigma = np.repeat(votes.tolerance[chosen] / 3.0, 2, axis=1)
    J_w = J / sigma[..., None]
    normal = J_w.swapaxes(1, 2) @ J_w + np.diag(SIGMA_POSE**-2)
    xi = np.linalg.solve(normal, (J_w.swapaxes(1, 2) @ (target / sigma)[..., None]))[..., 0]
    gain = np.empty(N_TRIALS)
    for chunk in np.array_split(np.arange(N_TRIALS), max(1, N_TRIALS * n_legs // 30000)):
        predicted = np.einsum("nij,hj->hni", votes.jacobian, xi[chunk])
        gain[chunk] = _agreeing(votes, predicted).sum(axis=1)
    gain -= np.sum(0.1 * (xi / SIGMA_POSE) ** 2, axis=1)
    order = np.argsort(-gain, kind="stable")[:BEST]
    return [np.zeros(6), *xi[order]]


def _agreeing(votes: _Votes, predicted: Array) -> Array:
    """Return the best score (..., n_legs) of candidates that agree with shifts (..., n_legs, 2)."""
    gap = np.abs(votes.shift - predicted[..., None, :]).max(axis=-1)
    closeness = np.maximum(1.0 - (gap / votes.tolerance[:, None]) ** 2, 0.0)
    return np.asarray((votes.score * closeness).max(axis=-1))


def _prior(xi: Array) -> float:
    """Return the penalty of a pose far from the rough one."""
    return 0.1 * float(np.sum((xi / SIGMA_POSE) ** 2))


def _refine(legs: _Ends, votes: _Votes, xi: Array) -> Array:
    """Return the pose that fits the agreeing candidates, by Gauss-Newton steps."""
    sigma = votes.tolerance / 3.0
    J = _jacobian(legs, xi)  # changes little within the few degrees of a rough pose
    for reach in np.linspace(*REACH, N_STEPS):
        predicted = _shifts(legs, xi)
        residual = votes.shift - predicted[:, None, :]
        gap = np.abs(residual).max(axis=-1) / (reach * votes.tolerance[:, None])
        closeness = np.maximum(1.0 - gap**2, 0.0) ** 2 * votes.score
        nearest = np.argmax(closeness, axis=1)
        rows = np.arange(len(nearest))
        weight = closeness[rows, nearest] / sigma**2
        normal = np.einsum("nki,n,nkj->ij", J, weight, J) + np.diag(SIGMA_POSE**-2)
        right = np.einsum("nki,n,nk->i", J, weight, residual[rows, nearest])
        change = np.linalg.solve(normal, right - xi / SIGMA_POSE**2)
        xi = xi + change
    return xi
