"""Where the model says that the legs are seen in an image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.detection.band import Band, bands_of_legs
from legcal.detection.pieces import Piece, visible_pieces
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.leg import Cylinder
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis


@dataclass(frozen=True, eq=False)
class PredictedLeg:
    """One leg as it should appear in one image.

    Attributes
    ----------
    row, leg : int
        The image and the leg.
    A_camera, B_camera : (3,) array
        Joint centres in the camera frame [m].
    pieces : tuple of Piece
        The parts that can be seen, from base to platform.
    outlines : (n_pieces, 2, 3) array
        Their outlines h1, h2, eq (3).
    band : Band
        The frame along the visible stretch of the whole leg.
    """

    row: int
    leg: int
    A_camera: Array
    B_camera: Array
    pieces: tuple[Piece, ...]
    outlines: Array
    band: Band

    @cached_property
    def u(self) -> Array:
        """Unit direction from base to platform, (3,)."""
        AB = self.B_camera - self.A_camera
        return np.asarray(AB / np.linalg.norm(AB))

    def distance_along(self, band: Band, t: Array) -> Array:
        """Return the distance from A [m] of the axis points seen at t [px] of a band."""
        ray = band.along @ band.origin + t / band.scale
        u, A = self.u, self.A_camera
        return np.asarray((ray * A[2] - band.along @ A[:2]) / (band.along @ u[:2] - ray * u[2]))


def predict_legs(
    camera: Camera,
    T_base_camera: RigidTransform,
    A_base: Array,
    B_base: Array,
    cylinders: Sequence[Sequence[Cylinder]],
    row: int,
) -> list[PredictedLeg]:
    """Predict every leg that an image should show.

    Parameters
    ----------
    camera : Camera
        The camera of the image.
    T_base_camera : RigidTransform
        Its pose in the base link.
    A_base, B_base : (n_legs, 3) array
        Joint centres at the reading of the image, in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs.
    row : int
        Index of the image.

    Returns
    -------
    list of PredictedLeg
        In the order of the legs; legs outside the image are missing.
    """
    T_camera_base = T_base_camera.inv()
    A_camera, B_camera = T_camera_base.apply(A_base), T_camera_base.apply(B_base)
    length = np.linalg.norm(B_camera - A_camera, axis=1)
    u = (B_camera - A_camera) / length[:, None]
    pieces = [visible_pieces(of_leg, of) for of_leg, of in zip(cylinders, length, strict=True)]
    ends = [(some[0].start, max(p.end for p in some)) if some else (0.0, 0.0) for some in pieces]
    bands = bands_of_legs(camera, A_camera, B_camera, *np.array(ends).reshape(-1, 2).T)
    legs = []
    for leg, (some, band) in enumerate(zip(pieces, bands, strict=True)):
        radii = np.array([piece.radius for piece in some])
        A = A_camera[leg]
        if band is None or np.linalg.norm(A - u[leg] * (u[leg] @ A)) <= 1.01 * radii.max():
            continue
        outlines = outlines_of_axis(u[leg : leg + 1], A[None], radii)
        legs.append(PredictedLeg(row, leg, A, B_camera[leg], some, outlines, band))
    return legs


def hidden_by(
    leg: PredictedLeg, others: Sequence[PredictedLeg], P_camera: Array, margin: float
) -> IntArray:
    """Return which other leg stands in front of points of a leg.

    Parameters
    ----------
    leg : PredictedLeg
        The leg.
    others : sequence of PredictedLeg
        The legs of the same image.
    P_camera : (n, 3) array
        Points of the leg's outline [m].
    margin : float
        Points this near to another leg's outline count as hidden, as an angle [rad].

    Returns
    -------
    (n,) array of int
        Index of the leg in front, -1 where the view is free.
    """
    others = [other for other in others if other.leg != leg.leg]
    front = np.full(len(P_camera), -1, dtype=np.intp)
    if not others:
        return front
    distance = np.linalg.norm(P_camera, axis=1)
    ray = P_camera / distance[:, None]
    u, A, B = (
        np.array(x) for x in zip(*((o.u, o.A_camera, o.B_camera) for o in others), strict=True)
    )
    length = np.linalg.norm(B - A, axis=1)
    radius = np.array([max(piece.radius for piece in other.pieces) for other in others])
    # The points of other legs' axes nearest to the viewing rays, and the rays' nearest points.
    c, to_A = ray @ u.T, ray @ A.T  # (n, n_others)
    sine2 = np.maximum(1.0 - c**2, 1e-12)
    along = np.clip((c * to_A - np.sum(u * A, axis=1)) / sine2, 0.0, length)
    depth = to_A + along * c
    nearest = A + along[..., None] * u
    gap = np.linalg.norm(nearest - depth[..., None] * ray[:, None], axis=-1)
    is_hidden = (gap < radius + margin * depth) & (depth < distance[:, None])
    for k, other in enumerate(others):
        front[is_hidden[:, k]] = other.leg
    return front
