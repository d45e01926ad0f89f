"""What the measurements tell each other: predicted offsets by unknowns, and what a fit takes up."""

from __future__ import annotations

import numpy as np

from legcal.geometry.types import Array
from legcal.refinement.normal import NormalEquations
from legcal.refinement.rows import Places, Rows


def reduced_jacobian(where: Places, rows: Rows, normal: NormalEquations) -> Array:
    """Return whitened residuals (n, q, n_kept) by the kept unknowns, poses following them."""
    n, q, _ = rows.J.shape
    G = np.zeros((n, q, where.n_kept + 1))
    measurement, row = np.arange(n)[:, None, None], np.arange(q)[None, :, None]
    np.add.at(G, (measurement, row, where.index[:, None, :]), rows.J)
    G = G[..., :-1]
    J_pose = rows.J_pose
    motion, pose = normal.tangent, where.pose
    if motion is not None:
        G = G + J_pose @ np.moveaxis(motion.Q, 0, 2)[pose]
        J_pose = J_pose @ motion.Z[pose]
    follow = normal.V_inverse @ np.moveaxis(normal.W, 0, 2)
    return np.asarray(G - J_pose @ follow[pose])


def explained_share(
    where: Places, rows: Rows, normal: NormalEquations, covariance: Array | None = None
) -> Array:
    """Return the covariance (n, q, q) of the predicted whitened residuals of every measurement.

    The residuals of a right fit have covariance one minus this, those of what it has not seen one
    plus this.

    Parameters
    ----------
    where, rows
        Of the measurements.
    normal : NormalEquations
        Of what tells their poses.
    covariance : (n_kept, n_kept) array, optional
        Of the kept unknowns, if it is not that of these equations.
    """
    G = reduced_jacobian(where, rows, normal)
    if covariance is None:
        covariance = normal.kept_covariance()
    J_pose = rows.J_pose
    if normal.tangent is not None:
        J_pose = J_pose @ normal.tangent.Z[where.pose]
    share = (G @ covariance) @ np.swapaxes(G, -1, -2)
    through_pose = J_pose @ normal.V_inverse[where.pose]
    return np.asarray(share + through_pose @ np.swapaxes(J_pose, -1, -2))


def response(where: Places, rows: Rows, normal: NormalEquations, change: Array) -> Array:
    """Return how a fit moves when what was measured changes.

    Parameters
    ----------
    where, rows
        Of the measurements that change; rows whitened, as the normal equations have them.
    normal : NormalEquations
    change : (n, q, c) array
        Whitened changes of their residuals, c different ones.

    Returns
    -------
    (n_kept, c) array
        Changes of the kept unknowns.
    """
    n, n_changes = len(change), change.shape[-1]
    gradient = np.zeros((where.n_kept + 1, n_changes))
    for member, column in where.groups:
        gradient[column] += np.einsum("nqm,nqc->mc", rows.J[member], change[member], optimize=True)
    gradient = gradient[:-1]
    of_pose = np.einsum("nqi,nqc->nic", rows.J_pose, change).reshape(n, 6 * n_changes)
    of_pose = (where.to_pose @ of_pose).reshape(where.n_poses, 6, n_changes)
    if normal.tangent is not None:
        gradient += np.einsum("akp,kpc->ac", normal.tangent.Q, of_pose, optimize=True)
        of_pose = np.swapaxes(normal.tangent.Z, 1, 2) @ of_pose
    gradient -= np.einsum("akf,kfc->ac", normal.W, normal.V_inverse @ of_pose, optimize=True)
    return np.asarray(-normal.kept_covariance() @ gradient)
