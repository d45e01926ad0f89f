"""What a fit of a view says of legs that have no outlines yet, and of the pose that it may hide."""

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.recognition.agreement import NEAREST
from legcal.recognition.exchange import exchanged
from legcal.recognition.fitted_lines import derivatives_by, metric_of, offsets_of
from legcal.recognition.groups import Group
from legcal.recognition.searching import Search
from legcal.recognition.view_fit import ViewFit


def sideways_sigmas(search: Search, group: Group, fit: ViewFit) -> Array:
    """Return how well a fit knows where legs are seen, (n_rows, n_legs) [px].

    One standard deviation across each leg, at the joint where it is known worse; infinite for
    legs that reach behind the camera, and in images of other views.
    """
    m, n_legs = search.measurements, search.n_legs
    A, B = fit.joints(search.A_base, search.B_base)
    T_group_base = fit.T_base_group.inv()
    centre = T_group_base.apply(fit.middle)
    sigma = np.full((m.n_rows, n_legs), np.inf)
    for v in group.views:
        rows = [row for row in group.rows if m.view[row] == v]
        T, camera = group.T_group_camera[v].inv(), m.views[v].camera
        X_group = T_group_base.apply(np.stack([A[rows], B[rows]], axis=2).reshape(-1, 3))
        X = T.apply(X_group).reshape(-1, 2, 3)
        front = X[..., 2].min(axis=1) > NEAREST
        X = np.where(front[:, None, None], X, [[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
        ends = X[..., :2] / X[..., 2:]
        thin, edge = np.zeros(len(X)), np.zeros(len(X), dtype=np.intp)
        D = offsets_of(X, thin, edge, ends, metric_of(camera, ends))[1] @ T.rotation.as_matrix()
        J = derivatives_by(D, X_group.reshape(-1, 2, 3) - centre, T_group_base.rotation.as_matrix())
        leg = np.tile(np.arange(n_legs), len(rows))
        place = np.concatenate(
            [np.broadcast_to(np.arange(6), (len(leg), 6)), 6 + 6 * leg[:, None] + np.arange(6)], 1
        )
        of_leg = fit.covariance[place[:, :, None], place[:, None, :]]
        variance = np.einsum("nei,nij,nej->ne", J[..., :12], of_leg, J[..., :12])
        variance += fit.image_sigma**2 * np.sum(J[..., 12:] ** 2, axis=-1)
        worst = np.sqrt(variance.max(axis=1))
        sigma[rows] = np.where(front, worst, np.inf).reshape(len(rows), n_legs)
    return sigma


def reversed_pose(search: Search, group: Group, T_base_group: RigidTransform) -> RigidTransform:
    """Return the pose at which a flat machine looks alike from far: near and far exchanged."""
    X = np.concatenate([search.A_base[group.rows], search.B_base[group.rows]]).reshape(-1, 3)
    T = T_base_group.inv()
    R, t = exchanged(T.rotation.as_matrix()[None], T.translation[None], X)
    return RigidTransform.from_components(t[0], Rotation.from_matrix(R[0])).inv()
