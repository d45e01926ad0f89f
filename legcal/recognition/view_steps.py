"""Steps of the fit of a view: its camera, the joints as it sees them, and the images' own parts.

Each image adds something of its own to the platform joint of each leg, since its platform is not
quite where the model has it; these parts are eliminated from the normal equations.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.types import Array
from legcal.recognition.fitted_lines import Lines, derivatives_by, offsets_of
from legcal.recognition.groups import Group

JOINT_SIGMA = 6e-3  # of the joint centres of the nominal model in all images, at first [m]
JOINT_SIGMAS = 1.5e-3, 12e-3  # the least and the largest that legs may show
IMAGE_SIGMA = 2e-3  # of the platform joints in an image besides, at first [m]
IMAGE_SIGMAS = 0.7e-3, 12e-3  # the least and the largest that images may show
TURN_SIGMA, PLACE_SIGMA = 0.3, 0.15  # of the pose that was recognised: angle, part of the distance
MOST_TURN, MOST_PLACE = 0.2, 0.1  # of a step: angle, part of the distance


@dataclass(frozen=True, eq=False)
class State:
    """Where everything is.

    Attributes
    ----------
    R, t : (3, 3) and (3,) array
        T_group_base.
    shift : (n_legs, 2, 3) array
        Of A and B of the legs against the model, in the base link [m].
    own : (n_items, 3) array
        What its image adds to B of each leg [m].
    """

    R: Array
    t: Array
    shift: Array
    own: Array


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the model's joint centres, and of what images add to B [m]."""

    joint: float
    image: float


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of the pose and the shifts, and what gives the images' own parts."""

    H: Array
    b: Array
    back: Array  # (n_items, 3, 12) own part by the other unknowns
    start: Array  # (n_items, 3) own part without them


def equations_of(group: Group, lines: Lines, state: State, middle: Array) -> tuple[Array, Array]:
    """Return whitened offsets (n, 2) and their derivatives (n, 2, 15).

    By the motion of the machine about its middle, the shifts of A and B of the leg, and the own
    part of B.
    """
    A = (lines.A + state.shift[lines.leg, 0]) @ state.R.T + state.t
    B = (lines.B + state.shift[lines.leg, 1] + state.own[lines.item]) @ state.R.T + state.t
    offset, D = np.empty((len(A), 2)), np.empty((len(A), 2, 2, 3))
    for v in np.unique(lines.view).tolist():
        own, T = lines.view == v, group.T_group_camera[v].inv()
        R = T.rotation.as_matrix()
        X = np.stack([A[own], B[own]], axis=1) @ R.T + T.translation
        args = lines.radius[own], lines.edge[own], lines.ends[own], lines.metric[own]
        offset[own], at_camera = offsets_of(X, *args)
        D[own] = at_camera @ R
    centre = state.R @ middle + state.t
    J = derivatives_by(D, np.stack([A, B], axis=1) - centre, state.R)
    return (lines.whitening @ offset[..., None])[..., 0], lines.whitening @ J


def normal_equations(
    lines: Lines,
    equations: tuple[Array, Array],
    state: State,
    begin: State,
    weight: Array,
    spread: Spread,
    middle: Array,
) -> Normal:
    """Return the normal equations without the images' own parts."""
    M, b = _by_item(lines, *equations)
    M[:, 12:, 12:] += np.eye(3) / spread.image**2
    b[:, 12:] -= state.own / spread.image**2
    solved = np.linalg.solve(M[:, 12:, 12:], np.concatenate([M[:, 12:, :12], b[:, 12:, None]], -1))
    back, start = solved[..., :12], solved[..., 12]
    S = (M[:, :12, :12] - M[:, :12, 12:] @ back) * weight[:, None, None]
    c = (b[:, :12] - (M[:, :12, 12:] @ start[..., None])[..., 0]) * weight[:, None]
    n = 6 + state.shift.size
    H, g = np.zeros((n, n)), np.zeros(n)
    for leg in np.unique(lines.item_leg).tolist():
        own = lines.item_leg == leg
        place = np.r_[0:6, 6 + 6 * leg : 12 + 6 * leg]
        H[np.ix_(place, place)] += S[own].sum(axis=0)
        g[place] += c[own].sum(axis=0)
    turned = Rotation.from_matrix(state.R @ begin.R.T).as_rotvec()
    centre, before = (one.R @ middle + one.t for one in (state, begin))
    distance = float(np.linalg.norm(before))
    known = np.concatenate([np.full(3, TURN_SIGMA), np.full(3, PLACE_SIGMA * distance)]) ** -2
    H[np.arange(6), np.arange(6)] += known
    g[:6] -= known * np.concatenate([turned, centre - before])
    joints = np.arange(6, n)
    H[joints, joints] += spread.joint**-2
    g[6:] -= state.shift.ravel() / spread.joint**2
    return Normal(H, g, back, start)


def _by_item(lines: Lines, residual: Array, J: Array) -> tuple[Array, Array]:
    """Return J^T J (n_items, 15, 15) and -J^T r (n_items, 15)."""
    Jt = J.swapaxes(1, 2)
    return lines.summed(Jt @ J), -lines.summed((Jt @ residual[..., None])[..., 0])


def moved(state: State, normal: Normal, lines: Lines, middle: Array) -> State:
    """Return the state after a step, not too far."""
    step = np.linalg.solve(normal.H, normal.b)
    centre = state.R @ middle + state.t
    distance = float(np.linalg.norm(centre))
    reach = max(
        float(np.linalg.norm(step[:3])) / MOST_TURN,
        float(np.linalg.norm(step[3:6])) / (MOST_PLACE * distance),
        1.0,
    )
    step = step / reach
    shifts = step[6:].reshape(-1, 6)
    of_item = np.concatenate([np.broadcast_to(step[:6], (lines.n_items, 6)),
                              shifts[lines.item_leg]], axis=1)  # fmt: skip
    own = state.own + normal.start - (normal.back @ of_item[..., None])[..., 0]
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    t = turn @ (state.t - centre) + centre + step[3:6]
    return State(turn @ state.R, t, state.shift + shifts.reshape(state.shift.shape), own)


def spread_of(
    lines: Lines, normal: Normal, state: State, weight: Array, own_square: Array
) -> Spread:
    """Return the standard deviations that the legs show, most of them alike."""
    variance = np.diag(np.linalg.inv(normal.H))[6:].reshape(state.shift.shape)
    of_leg = np.mean(state.shift**2 + variance, axis=(1, 2))[np.unique(lines.item_leg)]
    of_image = np.sum(weight * own_square) / (3.0 * weight.sum())
    return Spread(
        float(np.clip(np.sqrt(np.median(of_leg)), *JOINT_SIGMAS)),
        float(np.clip(np.sqrt(of_image), *IMAGE_SIGMAS)),
    )


def squared_distances(
    lines: Lines, equations: tuple[Array, Array], state: State, sigma: float
) -> tuple[Array, Array]:
    """Return squared distances of items from the fit, and squares of their own parts [m^2]."""
    residual, J = equations
    Jo = J[..., 12:]
    r = residual - (Jo @ state.own[lines.item][..., None])[..., 0]
    Jt = Jo.swapaxes(1, 2)
    H, g = lines.summed(Jt @ Jo), lines.summed((Jt @ r[..., None])[..., 0])
    square = lines.summed(np.sum(r**2, axis=1))
    V = np.linalg.inv(H + np.eye(3) / sigma**2)
    own = -(V @ g[..., None])[..., 0]
    return square + np.sum(g * own, axis=1), np.sum(own**2, axis=1) + np.trace(V, axis1=1, axis2=2)
