"""Where a fitted model puts the outlines of legs at given poses of the platform."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.observed import feet_of_ends
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis


@dataclass(frozen=True, eq=False)
class FittedModel:
    """Everything but the poses of the platform.

    Attributes
    ----------
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    frame_legs : tuple of int
        The legs that define R_b and R_e.
    T_camera_Rb : tuple of RigidTransform
        Camera poses, one a view.
    cameras : tuple of Camera
        Their intrinsics.
    radii : mapping
        Radius [m] for each (leg index, part).
    """

    legs: tuple[LegGeometry, ...]
    frame_legs: tuple[int, ...]
    T_camera_Rb: tuple[RigidTransform, ...]
    cameras: tuple[Camera, ...]
    radii: Mapping[tuple[int, str], float]


class ForetoldOutlines:
    """Measured outlines, ready to be compared with those of a model.

    Parameters
    ----------
    model : FittedModel
        The model.
    measurements : Measurements
        The images.
    outlines : Outlines
        Their outlines; all are taken.

    Attributes
    ----------
    pose : (n,) array of int
        The pose of each outline.
    """

    def __init__(self, model: FittedModel, measurements: Measurements, outlines: Outlines) -> None:
        self.pose = measurements.pose[outlines.row]
        leg, view = outlines.leg, measurements.view[outlines.row]
        self._A = np.array([leg.A for leg in model.legs])[leg]
        self._B = np.array([leg.B for leg in model.legs])[leg]
        parts = zip(leg.tolist(), outlines.part, strict=True)
        self._radius = np.array([model.radii[key] for key in parts]).reshape(-1)
        self._edge = outlines.edge - 1
        T = np.array([T.as_matrix() for T in model.T_camera_Rb]).reshape(-1, 4, 4)[view]
        self._R, self._t = T[:, :3, :3], T[:, :3, 3]
        self._feet = np.zeros((len(leg), 2, 2))
        self._to_pixels = np.zeros((len(leg), 2, 2, 2))
        for v in np.unique(view).tolist():
            here = view == v
            self._feet[here], self._to_pixels[here] = feet_of_ends(
                model.cameras[v], outlines.h[here], outlines.ends[here]
            )

    def offsets(self, R: Array, t: Array) -> Array:
        """Return how far measured outlines are from the foretold ones at both ends, (n, 2) [px].

        Parameters
        ----------
        R, t : (n_poses, 3, 3) and (n_poses, 3) array
            Rotation and position [m] of R_e in R_b.

        Raises
        ------
        NotVisible
            If a camera stands inside a leg.
        """
        B = (R[self.pose] @ self._B[..., None])[..., 0] + t[self.pose]
        A_camera, B_camera = (
            (self._R @ point[..., None])[..., 0] + self._t for point in (self._A, B)
        )
        u = B_camera - A_camera
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        both = outlines_of_axis(u, A_camera, self._radius)
        h = both[np.arange(len(both)), self._edge]
        value = np.einsum("nei,ni->ne", self._feet, h[:, :2]) + h[:, 2:]
        normal = np.einsum("neij,nj->nei", self._to_pixels, h[:, :2])
        return np.asarray(value / np.sqrt(np.sum(normal**2, axis=2)))


def arrays(motions: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotation matrices (n, 3, 3) and translations (n, 3) [m] of motions."""
    T = np.array([T.as_matrix() for T in motions]).reshape(-1, 4, 4)
    return T[:, :3, :3].copy(), T[:, :3, 3].copy()
