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
    radius = np.array([max((piece.radius for piece in some), default=0.0) for some in pieces])
    distance = np.linalg.norm(A_camera - u * np.sum(u * A_camera, axis=1, keepdims=True), axis=1)
    seen = {
        leg: band
        for leg, band in enumerate(bands)
        if band is not None and distance[leg] > 1.01 * radius[leg]
    }
    axes = [leg for leg in seen for _ in pieces[leg]]
    radii = np.array([piece.radius for leg in seen for piece in pieces[leg]])
    outlines = outlines_of_axis(u[axes], A_camera[axes], radii)
    of_leg = np.split(outlines, np.cumsum([len(pieces[leg]) for leg in seen])[:-1])
    return [
        PredictedLeg(row, leg, A_camera[leg], B_camera[leg], pieces[leg], own, band)
        for (leg, band), own in zip(seen.items(), of_leg, strict=False)
    ]


def hidden_by(
    legs: Sequence[PredictedLeg], own: IntArray, P_camera: Array, margin: Array
) -> IntArray:
    """Return which other leg stands in front of points of legs.

    Parameters
    ----------
    legs : sequence of PredictedLeg
        The legs of one image.
    own : (n,) array of int
        The leg to whose outline each point belongs.
    P_camera : (n, 3) array
        The points [m].
    margin : (n,) array
        Points this near to another leg's outline count as hidden, as an angle [rad].

    Returns
    -------
    (n,) array of int
        Index of the leg in front, -1 where the view is free.
    """
    distance = np.linalg.norm(P_camera, axis=1)
    ray = P_camera / distance[:, None]
    u, A, B = (
        np.array(x) for x in zip(*((o.u, o.A_camera, o.B_camera) for o in legs), strict=True)
    )
    length = np.linalg.norm(B - A, axis=1)
    radius = np.array([max(piece.radius for piece in other.pieces) for other in legs])
    # The points of the legs' axes nearest to the viewing rays, and the rays' nearest points.
    c, to_A = ray @ u.T, ray @ A.T  # (n, n_legs)
    sine2 = np.maximum(1.0 - c**2, 1e-12)
    along = np.clip((c * to_A - np.sum(u * A, axis=1)) / sine2, 0.0, length)
    depth = to_A + along * c
    nearest = A + along[..., None] * u
    gap = np.linalg.norm(nearest - depth[..., None] * ray[:, None], axis=-1)
    hides = (gap < radius + margin[:, None] * depth) & (depth < distance[:, None])
    front = np.full(len(P_camera), -1, dtype=np.intp)
    for k, other in enumerate(legs):
        front[hides[:, k] & (own != other.leg)] = other.leg
    return front
