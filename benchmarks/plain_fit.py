"""What a user would write to fit everything: residuals in NumPy, for SciPy's least_squares.

Nothing of the refinement is used but its starting values, so that an equal minimum says something.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.sparse import coo_array, csr_array

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.geometry.types import Array, BoolArray
from legcal.machine.parameters import free_coordinates


@dataclass(frozen=True, eq=False)
class PlainFit:
    """Residuals of a hexapod's fit as a function of one vector [m, rad].

    The vector is free joint coordinates, offsets, radii, cameras (rotation vector and place) and
    platform poses, as changes of the start.
    """

    problem: FitProblem
    start: State
    whitening: Array

    @property
    def n_free(self) -> int:
        """Number of free coordinates of one body."""
        return int(self._free.sum())

    @property
    def _free(self) -> BoolArray:
        legs = self.problem.legs
        return free_coordinates(legs.n_legs, legs.frame_legs)

    @property
    def sizes(self) -> Array:
        """Numbers of base and platform coordinates, offsets, radii, and of cameras and poses."""
        legs, n = self.problem.legs.n_legs, self.n_free
        views, poses = len(self.start.camera_pose.R), len(self.start.platform_pose.R)
        return np.array([n, n, legs, len(self.start.radii), 6 * views, 6 * poses])

    def residuals(self, x: Array) -> Array:
        """Return all whitened residuals."""
        A, B, q0, radius, (R_c, t_c), (R_p, t_p) = self._parts(x)
        o, e = self.problem.outlines, self.problem.readings
        in_base = np.einsum("nij,nj->ni", R_p[o.pose], B[o.leg]) + t_p[o.pose]
        a = np.einsum("nij,nj->ni", R_c[o.view], A[o.leg]) + t_c[o.view]
        b = np.einsum("nij,nj->ni", R_c[o.view], in_base) + t_c[o.view]
        u = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
        foot = a - u * np.sum(u * a, axis=1, keepdims=True)
        distance = np.linalg.norm(foot, axis=1, keepdims=True)
        sine = radius[o.radius, None] / distance
        h = np.sqrt(1.0 - sine**2) * np.cross(u, a) / distance
        h = h + o.epsilon[:, None] * sine * foot / distance
        lens = o.lens  # by end, J^-T transposed
        normal = np.einsum("neji,nj->nei", lens, h[:, :2])
        offset = np.einsum("nei,ni->ne", o.feet, h[:, :2]) + h[:, 2:]
        offset = offset / np.linalg.norm(normal, axis=2)
        in_base = np.einsum("nij,nj->ni", R_p[e.pose], B[e.leg]) + t_p[e.pose]
        closure = np.linalg.norm(in_base - A[e.leg], axis=1) - e.length - q0[e.leg]
        priors = self.problem.priors
        return np.concatenate(
            [
                np.einsum("nij,nj->ni", self.whitening, offset).ravel(),
                closure / e.sigma,
                (radius - priors.mean) / priors.sigma,
            ]
        )

    def sparsity(self) -> csr_array:
        """Return which residuals depend on which unknowns."""
        o, e = self.problem.outlines, self.problem.readings
        first = np.concatenate([[0], np.cumsum(self.sizes)])
        n_legs = self.problem.legs.n_legs
        joint = np.full((n_legs, 3), -1)
        joint[self._free] = np.arange(self.n_free)
        base, platform = joint, np.where(joint >= 0, joint + self.n_free, -1)
        six = np.arange(6)
        of_outlines = np.hstack(
            [
                base[o.leg],
                platform[o.leg],
                first[3] + o.radius[:, None],
                first[4] + 6 * o.view[:, None] + six,
                first[5] + 6 * o.pose[:, None] + six,
            ]
        )
        of_readings = np.hstack(
            [
                base[e.leg],
                platform[e.leg],
                first[2] + e.leg[:, None],
                first[5] + 6 * e.pose[:, None] + six,
            ]
        )
        of_priors = first[3] + np.arange(self.sizes[3])[:, None]
        rows, columns, begin = [], [], 0
        for index in (np.repeat(of_outlines, 2, axis=0), of_readings, of_priors):
            row = begin + np.repeat(np.arange(len(index)), index.shape[1])
            rows.append(row[index.ravel() >= 0])
            columns.append(index.ravel()[index.ravel() >= 0])
            begin += len(index)
        row, column = np.concatenate(rows), np.concatenate(columns)
        shape = (begin, int(first[-1]))
        return csr_array(coo_array((np.ones(len(row)), (row, column)), shape=shape))

    def solve(self, *, sparse: bool) -> OptimizeResult:
        """Return what SciPy finds: 2-point differences, of every column or of groups of them."""
        x0 = np.zeros(int(self.sizes.sum()))
        how: dict[str, Any] = {"ftol": 1e-15, "xtol": 1e-15, "gtol": 1e-8, "x_scale": "jac"}
        if sparse:
            how |= {
                "jac_sparsity": self.sparsity(),
                "tr_options": {"atol": 1e-15, "btol": 1e-15, "maxiter": 5000},
            }
        return least_squares(self.residuals, x0, jac="2-point", method="trf", **how)

    def joints_and_offsets(self, x: Array) -> Array:
        """Return the joints and offsets [m] that a solution stands for."""
        A, B, q0, *_ = self._parts(x)
        return np.concatenate([A.ravel(), B.ravel(), q0])

    def _parts(
        self, x: Array
    ) -> tuple[Array, Array, Array, Array, tuple[Array, Array], tuple[Array, Array]]:
        base, platform, offsets, radii, cameras, poses = np.split(x, np.cumsum(self.sizes)[:-1])
        A, B = self.start.A.copy(), self.start.B.copy()
        A[self._free] += base
        B[self._free] += platform
        return (
            A,
            B,
            self.start.lengths + offsets,
            self.start.radii + radii,
            _moved(*self.start.camera_pose, cameras),
            _moved(*self.start.platform_pose.frames, poses),
        )


def _moved(R: Array, t: Array, change: Array) -> tuple[Array, Array]:
    """Return frames changed by rotation vectors and displacements."""
    from scipy.spatial.transform import Rotation

    six = change.reshape(-1, 6)
    return Rotation.from_rotvec(six[:, :3]).as_matrix() @ R, t + six[:, 3:]
