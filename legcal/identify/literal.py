"""The paper's own criteria (9), (14) and (16): what their equations say, as printed.

Scalar products and distances are even in an error that is normal to coplanar joints, so that
their ranks can be smaller than those of the default steps.
"""

from __future__ import annotations

from itertools import combinations, combinations_with_replacement

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.identify.session import Session
from legcal.identify.steps import Located, Step, identify_base

_FLOOR = 1e-12  # of a variance [m^2]


def scalar_products(session: Session, located: Located) -> Step:
    """Return what (9) says: all products of vectors A_j A_g and revolute axes of each frame."""
    columns = identify_base(session, located).columns
    scatter = session.local_to_parameters
    rows = [np.zeros((0, len(session.unit)))]
    for f in range(session.n_frames):
        vectors, slopes = _vectors_of(session, located, f)
        pairs = [
            (p, q)
            for p, q in combinations_with_replacement(range(len(vectors)), 2)
            if p != q or slopes[p][:, :3].any()  # v . v = 1 says nothing
        ]
        if not pairs:
            continue
        G = np.array([vectors[p] @ slopes[q] + vectors[q] @ slopes[p] for p, q in pairs])
        variance = np.einsum("pi,ij,pj->p", G, _covariance(session, located, f), G)
        by_local = np.concatenate([scatter[:, :3], session.mean_length * scatter[:, 7:9]], axis=1)
        rows.append(G @ by_local.reshape(G.shape[1], -1) / np.sqrt(variance + _FLOOR)[:, None])
    return Step("base_joints", columns, np.concatenate(rows)[:, columns])


def consecutive_distances(rows: Array, weight: Array, key: IntArray, columns: IntArray) -> Step:
    """Return what (14) says: distances equal those of the next position of the frame.

    The rows, weights and keys are those of :func:`legcal.identify.steps.distance_rows`.
    """
    last: dict[tuple[int, int, int], int] = {}
    found = [np.zeros((0, len(columns)))]
    for k, (f, _, j, g) in enumerate(key.tolist()):
        before = last.get((f, j, g))
        if before is not None:
            change = rows[k] / weight[k] - rows[before] / weight[before]
            found.append((change / np.hypot(1.0 / weight[k], 1.0 / weight[before]))[None])
        last[f, j, g] = k
    return Step("offsets", columns, np.concatenate(found))


def mean_distances(session: Session, weight: Array, key: IntArray) -> Step:
    """Return what (16) says: mean distances of leg ends in each frame are those of the joints."""
    columns = session.columns((3, 4, 5))
    B = np.array([leg.B for leg in session.legs])
    distinct, which = np.unique(key[:, [0, 2, 3]], axis=0, return_inverse=True)
    number = np.bincount(which.ravel(), weights=weight**2)
    rows = np.zeros((len(distinct), len(session.unit)))
    scatter = session.local_to_parameters[:, 3:6]
    for row, (_, j, g), n in zip(rows, distinct, number, strict=True):
        apart = B[g] - B[j]
        row += np.sqrt(n) * (apart / np.linalg.norm(apart)) @ (scatter[g] - scatter[j])
    return Step("platform_joints", columns, rows[:, columns])


def _vectors_of(session: Session, located: Located, f: int) -> tuple[list[Array], list[Array]]:
    """Return the set V of (8) and the derivative of each by A and axes of all legs, (3, 5 n)."""
    vectors, slopes = [], []
    eye = np.eye(3 * session.n_legs).reshape(session.n_legs, 3, -1)
    n_axes = 2 * session.n_legs
    for j, g in combinations(np.flatnonzero(located.joint[f]).tolist(), 2):
        vectors.append(session.A[g] - session.A[j])
        slopes.append(_by_leg(eye[g] - eye[j], np.zeros((3, n_axes))))
    for j in np.flatnonzero(located.axis[f]).tolist():
        axis = np.asarray(session.legs[j].base_axis)
        turn = np.zeros((3, n_axes))
        turn[:, 2 * j : 2 * j + 2] = np.cross(normal_basis(axis), axis).T / session.mean_length
        vectors.append(axis)
        slopes.append(_by_leg(np.zeros_like(eye[0]), turn))
    return vectors, slopes


def _by_leg(by_joints: Array, by_axes: Array) -> Array:
    """Return derivatives by A and the axis of each leg in turn, (3, 5 n)."""
    both = np.concatenate([by_joints.reshape(3, -1, 3), by_axes.reshape(3, -1, 2)], axis=2)
    return both.reshape(3, -1)


def _covariance(session: Session, located: Located, f: int) -> Array:
    """Return the covariance of A and axes of a frame as step 1 found them, (5 n, 5 n) [m^2]."""
    n = session.n_legs
    covariance = np.zeros((5 * n, 5 * n))
    for j in np.flatnonzero(located.joint[f]).tolist():
        F = located.information[f, j]
        inverse = np.linalg.pinv(F.T @ F, hermitian=True)
        covariance[5 * j : 5 * j + 5, 5 * j : 5 * j + 5] = inverse
    return covariance
