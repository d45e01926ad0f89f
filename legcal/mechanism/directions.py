"""Directions in the space of parameters: which of them move the platform, and a readable basis."""

from __future__ import annotations

import numpy as np
from scipy.linalg import qr

from legcal.geometry.types import Array

SHOWN = 0.02  # of the largest component


def split_by_motion(
    motion: Array | None, basis: Array, length: float, harmless: float
) -> tuple[Array, Array]:
    """Return a space of directions as that which moves the platform and that which does not.

    Parameters
    ----------
    motion : (k, 6, p) array or None
        Rotation [rad] and displacement [m] of the platform at k poses by each parameter, all
        in metres; None where the motors do not determine the pose, and everything counts.
    basis : (w, p) array
        Orthonormal basis of the space.
    length : float
        Mean leg length, by which rotations become displacements [m].
    harmless : float
        Motion of the platform, as a part of the change of the parameters, that counts as none.

    Returns
    -------
    moving, still : (a, p) and (b, p) array
        Orthonormal bases, a + b = w.
    """
    if motion is None or len(basis) == 0:
        return basis, basis[:0]
    moved = motion @ basis.T
    moved[:, :3] *= length
    flat = moved.reshape(-1, len(basis)) / np.sqrt(len(moved))
    singular, turn = np.linalg.eigh(flat.T @ flat)
    still = singular < harmless**2
    return turn.T[~still] @ basis, turn.T[still] @ basis


def sparse_basis(basis: Array) -> Array:
    """Return a basis of the same space in which each direction has a parameter for itself."""
    if len(basis) == 0:
        return basis
    _, upper, order = qr(basis, mode="economic", pivoting=True)
    w = len(basis)
    sparse = np.zeros_like(basis)
    sparse[:, order] = np.linalg.solve(upper[:, :w], upper)
    sparse[np.abs(sparse) < 1e-9] = 0.0
    first = np.argmax(np.abs(sparse) > SHOWN * np.abs(sparse).max(axis=1, keepdims=True), axis=1)
    return np.asarray(sparse[np.argsort(first, kind="stable")])
