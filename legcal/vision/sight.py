"""Sight: the visible segment of every part of legs and arms in an image, and its outlines.

A segment is visible if it is in the picture with a margin, in front of the camera, and not behind
another leg or arm, another solid of the model or a plate. The joints of base and platform span
plates; joints on carriages and arms do not. Points of the axes are tested along rays, for many
poses at once; outlines follow from eqs (3) and (5). Where somebody states which legs a camera
shows, nothing hides them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder, Leg, cylinder_of_arm
from legcal.machine.rods import arms_at, ends_in_base, readings_of_rods
from legcal.machine.shapes import Occluder, PlacedOccluders
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis, steps_to_outlines
from legcal.vision.visibility import (
    in_picture,
    least_length,
    longest_runs,
    rays_past_axes,
    visible_segments,
)

N_SAMPLES = 24  # points along a part that are tested
NEAREST = 0.25  # mean leg lengths before the camera
_OUTSIDE = 1.2  # radii between the camera and an axis, at least
_PLATE = 1.1  # size of a plate, over that of its joints
_ROUND = 1.3  # radius of a plate of unknown shape, over that of the circle around its joints
_IN_PLATE = 3.0  # radii of the thickest leg: nearer to a plate, points are in it
_THIN = 1e-3  # of the largest extent of joints that span no plate


@dataclass(frozen=True, eq=False)
class Bodies:
    """The legs of a machine, followed by its cylindrical arms."""

    A: Array  # (n_images, n, 3) one end of each in the base link [m]
    B: Array  # (n_images, n, 3) the other
    cylinders: tuple[Sequence[Cylinder], ...]  # of each
    leg: IntArray  # (n,) of an arm the leg that has it as a part
    is_moved: BoolArray  # (n_legs,) whether a motor moves A
    size: float  # mean leg length of the machine [m]
    occluders: Sequence[PlacedOccluders]  # what else hides, in each image

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.is_moved)

    @classmethod
    def at(
        cls,
        legs: Sequence[Leg],  # in R_b and R_e
        R: Array,  # R, t: (n_images, 3, 3) and (n_images, 3): poses T_Rb_Re
        t: Array,
        size: float,
        *,
        T_base_Rb: RigidTransform | None = None,  # without it R_b is the base link
        occluders: Sequence[Occluder] = (),
    ) -> Bodies:
        """Place legs at poses."""
        T = RigidTransform.identity() if T_base_Rb is None else T_base_Rb
        A, B = ends_in_base(legs, T, R, t)
        arms = arms_at(legs, readings_of_rods(legs, R, t))
        ends = [T.apply(arm.reshape(-1, 3)).reshape(arm.shape) for arm in arms.values()]
        near, far = ([arm[:, k : k + 1] for arm in ends] for k in (0, 1))
        cylinders = ([cylinder_of_arm(arm)] for leg in legs if (arm := leg.arm) is not None)
        return cls(
            np.concatenate([A, *near], axis=1),
            np.concatenate([B, *far], axis=1),
            (*(leg.cylinders for leg in legs), *cylinders),
            np.array([*range(len(legs)), *arms], dtype=np.intp),
            np.array([leg.actuator is not None for leg in legs], dtype=np.bool_),
            size,
            PlacedOccluders.at(occluders, A, B) if occluders else (),
        )

    def before(self, T_base_camera: RigidTransform) -> Bodies:
        """Transform to the frame of a camera."""
        T = T_base_camera.as_matrix()
        A, B = ((X - T[:3, 3]) @ T[:3, :3] for X in (self.A, self.B))
        occluders = [placed.before(T) for placed in self.occluders]
        return replace(self, A=A, B=B, occluders=occluders)

    @property
    def nearest(self) -> float:
        """Least depth of visible points [m]."""
        return NEAREST * self.size

    @property
    def radius(self) -> Array:
        """Largest radius of each body, (n,) [m]."""
        return np.array([max((c.radius for c in some), default=0.0) for some in self.cylinders])

    @property
    def axes(self) -> tuple[Array, Array]:
        """Direction (n_images, n, 3) and length (n_images, n) [m] of each body."""
        along = self.B - self.A
        length = np.linalg.norm(along, axis=-1)
        return along / length[..., None], length


@dataclass(frozen=True, eq=False)
class Seen:
    """The n visible segments of legs and arms in images of one camera."""

    image: IntArray  # (n,)
    leg: IntArray  # (n,)
    is_arm: BoolArray  # (n,) whether it is the arm of the leg, and not along it
    part: tuple[str, ...]  # the URDF link of the cylinder
    h: Array  # (n, 2, 3) both outlines, eq (3)
    ends: Array  # (n, 2, 2, 2) of both outlines, both ends [px], the first nearer to the base joint
    length_px: Array  # (n,)

    def only(self, image: int) -> Seen:
        """Select the segments of one image."""
        selected = np.flatnonzero(self.image == image)
        return Seen(
            np.zeros(len(selected), dtype=np.intp),
            self.leg[selected],
            self.is_arm[selected],
            tuple(self.part[i] for i in selected),
            self.h[selected],
            self.ends[selected],
            self.length_px[selected],
        )

    def visible_legs(self, n_images: int, n_legs: int) -> BoolArray:
        """Return a mask of the legs in each image, (n_images, n_legs)."""
        shown, along = np.zeros((n_images, n_legs), dtype=np.bool_), ~self.is_arm
        shown[self.image[along], self.leg[along]] = True
        return shown


def visible_parts(
    camera: Camera,
    T_base_camera: RigidTransform,
    bodies: Bodies,
    margin_px: float = 0.0,  # free margin at the border of the picture
    stated: BoolArray | None = None,  # (n_legs,) the legs that the camera shows, if somebody says
) -> Seen:
    """Return the visible segments of legs and arms in images of one camera."""
    bodies = bodies.before(T_base_camera)
    A, (u, length) = bodies.A, bodies.axes
    body, link, radius, start, end = _parts(bodies.cylinders, length)
    share = np.linspace(0.0, 1.0, N_SAMPLES)
    s = start[..., None] + (end - start)[..., None] * share
    u_part = u[:, body]
    P = A[:, body, None] + s[..., None] * u_part[:, :, None]  # (n_images, n_parts, N_SAMPLES, 3)
    margin_px = margin_px if stated is None else -np.inf
    is_visible = (end > start)[..., None] & in_picture(camera, P, bodies.nearest, margin_px)
    foot = A[:, body] - u_part * np.sum(u_part * A[:, body], axis=-1, keepdims=True)
    is_visible &= (np.linalg.norm(foot, axis=-1) > _OUTSIDE * radius)[..., None]
    if stated is None:
        is_visible &= ~_hidden(bodies, P, body, radius)
    else:
        is_visible &= stated[bodies.leg[body]][:, None]
    first, last = longest_runs(is_visible)
    image, part = np.nonzero(last > first)
    first_end, last_end = (s[image, part, k[image, part]] for k in (first, last))
    u_seen, M = u_part[image, part], A[image, body[part]]
    h = outlines_of_axis(u_seen, M, radius[part])
    axis = M[:, None] + np.stack([first_end, last_end], axis=1)[..., None] * u_seen[:, None]
    ends = camera.project(axis[:, None] + steps_to_outlines(h, radius[part])[:, :, None])
    length_px = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1).mean(axis=1)
    width_px = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1).mean(axis=1)
    is_long = (length_px >= least_length(width_px)) | (stated is not None)
    parts = part[is_long]
    return Seen(
        image[is_long],
        bodies.leg[body[parts]],
        body[parts] >= bodies.n_legs,
        tuple(link[k] for k in parts),
        h[is_long],
        ends[is_long],
        length_px[is_long],
    )


def _hidden(bodies: Bodies, P: Array, body: IntArray, radius: Array) -> BoolArray:
    """Return a mask of the points P (n_images, n_parts, m, 3) of parts that something hides."""
    largest_radius = np.zeros(len(bodies.leg))
    np.maximum.at(largest_radius, body, radius)
    hidden = _behind_others(P, body, radius, bodies.A, *bodies.axes, largest_radius)
    own_leg, beside = (
        np.repeat(x, N_SAMPLES) for x in (np.where(body < bodies.n_legs, body, -1), radius)
    )
    for k, placed in enumerate(bodies.occluders):
        hides = placed.hide(P[k].reshape(-1, 3), own_leg, beside, beside) >= 0
        hidden[k] |= hides.reshape(hidden.shape[1:])
    thick, n = _IN_PLATE * float(largest_radius[: bodies.n_legs].max(initial=0.0)), bodies.n_legs
    hidden |= behind_plate(P, bodies.A[:, :n][:, ~bodies.is_moved], thick)
    return hidden | behind_plate(P, bodies.B[:, :n], thick)


def _parts(
    cylinders: Sequence[Sequence[Cylinder]], length: Array
) -> tuple[IntArray, list[str], Array, Array, Array]:
    """Body, link and radius of all parts, and starts and ends (n_images, n_parts) each [m].

    Segments are empty where the leg is too short for a part.
    """
    segments_of_images = [
        [visible_segments(some, float(long)) for some, long in zip(cylinders, row, strict=True)]
        for row in length
    ]
    index: dict[tuple[int, str], int] = {}
    radius: list[float] = []
    for row in segments_of_images:
        for j, segments in enumerate(row):
            for segment in segments:
                if index.setdefault((j, segment.link), len(index)) == len(radius):
                    radius.append(segment.radius)
    start, end = np.zeros((2, len(length), len(index)))
    for k, row in enumerate(segments_of_images):
        for j, segments in enumerate(row):
            for segment in segments:
                i = index[j, segment.link]
                start[k, i], end[k, i] = segment.start, segment.end
    leg = np.array([j for j, _ in index], dtype=np.intp)
    return leg, [link for _, link in index], np.array(radius), start, end


def _behind_others(
    P: Array,  # (k, n_parts, m, 3)
    own: IntArray,  # (n_parts,)
    radius: Array,  # (n_parts,)
    A: Array,  # (n_images, n, 3)
    u: Array,  # (k, n, 3)
    length: Array,  # (k, n)
    of_body: Array,  # (n,) the largest radius that is seen
) -> BoolArray:
    """Mask of points occluded by another leg or arm, at least partly."""
    rays = rays_past_axes(P.reshape(len(P), -1, 3), A, u, length)
    distance, depth, square = (x.reshape(*P.shape[:-1], *x.shape[2:]) for x in rays)
    # A ray to the edge of a body itself passes at its radius, as far as the other is nearer.
    beside = radius[:, None, None] * depth / distance[..., None]
    hides = (square < (of_body + beside) ** 2) & (depth > 0.0) & (depth < distance[..., None])
    hides &= own[:, None, None] != np.arange(A.shape[1])
    return np.asarray(hides.any(axis=-1))


def behind_plate(P: Array, joints: Array, thick: float, *, surely: bool = True) -> BoolArray:
    """Return a mask of points (k, n, m, 3) occluded by the plate spanned by joints (k, n_legs, 3).

    Points within the thickness *thick* [m] of the plate are not occluded, as legs of a planar
    machine. Without *surely*, also points that a plate of another shape may occlude.
    """
    if joints.shape[1] < 3:
        return np.zeros(P.shape[:-1], dtype=np.bool_)
    middle = joints.mean(axis=1, keepdims=True)
    _, extent, axes = np.linalg.svd(joints - middle)
    if extent[:, 1].min() < _THIN * extent[:, 0].max():
        return np.zeros(P.shape[:-1], dtype=np.bool_)
    x, y, normal = (axes[:, i] for i in range(3))
    across = np.einsum("kpmx,kx->kpm", P, normal)
    depth_ratio = np.sum(normal * middle[:, 0], axis=-1)[:, None, None] / np.where(
        np.abs(across) < 1e-12, 1e-12, across
    )
    is_in_front = (depth_ratio > 0.0) & ((1.0 - depth_ratio) * np.linalg.norm(P, axis=-1) > thick)
    hit = depth_ratio[..., None] * P - middle[:, :, None]
    inside = np.ones(P.shape[:-1], dtype=np.bool_)
    flat = np.stack([np.einsum("klx,kx->kl", joints - middle, axis) for axis in (x, y)], axis=-1)
    hit_flat = np.stack([np.einsum("kpmx,kx->kpm", hit, axis) for axis in (x, y)], axis=-1)
    for k, corners in enumerate(flat):
        if not surely:
            reach = _ROUND * np.linalg.norm(corners, axis=-1).max()
            inside[k] = np.linalg.norm(hit_flat[k], axis=-1) < reach
            continue
        try:
            sides = ConvexHull(corners * _PLATE).equations
        except QhullError:
            return np.zeros(P.shape[:-1], dtype=np.bool_)
        inside[k] = np.all(hit_flat[k] @ sides[:, :2].T + sides[:, 2] < 0.0, axis=-1)
    return np.asarray(is_in_front & inside)
