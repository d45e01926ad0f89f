"""Predicted visibility of legs in an image: outlines, bands along legs, occlusion."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import moment
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder, main_cylinders
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

EQUAL_RADII = 0.01  # maximum relative difference of radii without a visible step
END_COVER = 2.0  # length that may be hidden at a joint and beside a thicker cylinder [radii]
N_SAMPLES = 64  # points along a leg that are tested for visibility
MIN_DEPTH_SHARE = 0.05  # minimum depth of points, in leg lengths: nearer points are cut off
MIN_LENGTH = (30.0, 1.0)  # minimum length of a measured outline: [px], and in widths of the leg


def least_length(width: float | Array) -> Array:
    """Return the minimum visible length [px] of cylinders to measure, by width in the image."""
    return np.maximum(MIN_LENGTH[0], MIN_LENGTH[1] * np.asarray(width))


@dataclass(frozen=True)
class Segment:
    """A visible stretch of one cylinder of a leg."""

    link: str  # the URDF link that names the part
    radius: float  # [m]
    start: float  # distance from A along the leg to the start of the outline [m]
    end: float  # distance from A to its end [m]


def visible_segments(
    cylinders: Sequence[Cylinder],
    length: float,  # leg length AB [m]
) -> tuple[Segment, ...]:
    """Return the visible segment of every part of a leg, from base to platform."""
    main = main_cylinders(cylinders)
    parts = _merge_equal(cylinders, length)
    segments = []
    for link, radius, start, end in parts:
        cover = END_COVER * radius
        stretches = [(max(start, cover), min(end, length - cover))]
        hiding = [
            (END_COVER * thicker, first, last)
            for _, thicker, first, last in parts
            if thicker > radius
        ]
        inside = {
            c
            for cylinder in cylinders
            if look_alike(cylinder.radius, radius)
            for c in cylinder.covers
        }
        hiding += [(cover, *solid.span(length)) for solid in inside]
        for gap, first, last in hiding:
            stretches = [
                stretch
                for low, high in stretches
                for stretch in ((low, min(high, first - gap)), (max(low, last + gap), high))
            ]
        low, high = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
        if high > low and look_alike(radius, main[link].radius):
            segments.append(Segment(link, radius, low, high))
    return tuple(sorted(segments, key=lambda segment: (segment.start, segment.link)))


def _merge_equal(
    cylinders: Sequence[Cylinder], length: float
) -> list[tuple[str, float, float, float]]:
    """Return spans (link, radius, start, end) of cylinders, with joined spans of equal radius."""
    spans = [((c.end - c.start, c.link), c.radius, *c.span(length)) for c in cylinders]
    merged: list[tuple[tuple[float, str], float, float, float]] = []
    for name, radius, start, end in sorted(spans, key=lambda span: (span[2], span[3], span[0])):
        for i, (other_name, other_radius, low, high) in enumerate(merged):
            if look_alike(radius, other_radius) and start <= high + radius:
                longest = max(name, other_name)  # of equal lengths the later name, in any pose
                merged[i] = (longest, max(radius, other_radius), low, max(high, end))
                break
        else:
            merged.append((name, radius, start, end))
    return [(link, radius, start, end) for (_, link), radius, start, end in merged]


def look_alike(radius: float, other_radius: float) -> bool:
    """Return whether two radii are too close to show a step between cylinders."""
    return abs(radius - other_radius) <= EQUAL_RADII * max(radius, other_radius)


@dataclass(frozen=True, eq=False)
class Band:
    """A frame on the sensor plane along a leg: coordinates t along it and v across it [px]."""

    origin: Array  # (2,) the point with t = v = 0
    along: Array  # (2,) unit direction of t
    normal: Array  # (2,) unit direction of v
    scale: float  # pixels per unit of the sensor plane
    length: float  # the predicted leg is visible for 0 <= t <= length [px]

    def points(self, t: Array, v: Array) -> Array:
        """Return the points (x, y) of the sensor plane with coordinates t, v [px], (..., 2)."""
        along = self.origin + t[..., None] * (self.along / self.scale)
        return np.asarray(along + v[..., None] * (self.normal / self.scale))

    def coordinates(self, xy: Array) -> tuple[Array, Array]:
        """Return t and v [px] of points (..., 2) of the sensor plane, both (...)."""
        from_origin = self.scale * (xy - self.origin)
        return np.asarray(from_origin @ self.along), np.asarray(from_origin @ self.normal)

    def offsets(self, h: Array, t: Array) -> Array:
        """Return the coordinate v of lines h (..., 3) of eq (2) at t (...) [px]."""
        on_axis = self.points(t, np.zeros(()))
        value = np.sum(h[..., :2] * on_axis, axis=-1) + h[..., 2]
        return np.asarray(-self.scale * value / (h[..., :2] @ self.normal))

    def line(self, v0: Array | float, v1: Array | float) -> Array:
        """Return the unit (a, b, c) of the line through (0, v0) and (length, v1), eq (2).

        The sign follows eq (3): positive on the side of greater v.
        """
        ends = np.stack([np.asarray(v0, dtype=np.float64), np.asarray(v1, dtype=np.float64)], -1)
        (x0, y0), (x1, y1) = np.moveaxis(
            self.points(np.array([0.0, self.length]), ends), (-2, -1), (0, 1)
        )
        h = np.stack([y0 - y1, x1 - x0, x0 * y1 - x1 * y0], axis=-1)  # the vector product of rays
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        return np.asarray(h * np.sign(h[..., :2] @ self.normal)[..., None])


def bands_of_legs(
    camera: Camera,
    A_camera: Array,  # (n, 3)
    B_camera: Array,  # (n, 3)
    start: Array,  # (n,) distance from A [m]
    end: Array,  # (n,) the same
) -> list[Band | None]:
    """Return the bands along stretches of legs where they are visible, None outside the image."""
    length = np.linalg.norm(B_camera - A_camera, axis=1)
    u = (B_camera - A_camera) / length[:, None]
    s = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, N_SAMPLES)
    axis = A_camera[:, None] + s[..., None] * u[:, None]
    inside = in_picture(camera, axis, MIN_DEPTH_SHARE * length[:, None])
    m = moment(u, A_camera)
    first, last = np.zeros((2, len(axis)), dtype=np.intp)
    n_inside = np.count_nonzero(inside, axis=1)
    last[n_inside == N_SAMPLES] = N_SAMPLES - 1
    cut = np.flatnonzero((n_inside > 1) & (n_inside < N_SAMPLES))
    if len(cut):
        first[cut], last[cut] = longest_runs(inside[cut])
    legs = np.arange(len(axis))
    shown = last > first
    ends = np.stack([axis[legs, first], axis[legs, last]], axis=1)
    ends = ends[..., :2] / np.where(shown[:, None, None], ends[..., 2:], 1.0)
    along = ends[:, 1] - ends[:, 0]
    distance, offset = np.linalg.norm(along, axis=1), np.linalg.norm(m, axis=1)
    shown &= (distance > 0.0) & (offset >= 1e-6 * length)  # others are seen end-on
    middle = np.where(shown[:, None], ends.mean(axis=1), 0.0)
    scale = np.sqrt(np.abs(np.linalg.det(camera.pixels_per_unit(middle))))
    along = along / np.where(shown, distance, 1.0)[:, None]
    normal = m[:, :2] / np.where(shown, np.linalg.norm(m[:, :2], axis=1), 1.0)[:, None]
    sizes = zip(scale.tolist(), (distance * scale).tolist(), shown.tolist(), strict=True)
    return [
        Band(ends[i, 0], along[i], normal[i], *size) if is_shown else None
        for i, (*size, is_shown) in enumerate(sizes)
    ]


def in_picture(
    camera: Camera, P_camera: Array, nearest: Array | float, margin: float = 0.0
) -> BoolArray:
    """Return whether points (..., 3) are in front of the camera and inside its image, (...).

    They are at least ``margin`` px from its border.
    """
    depth = P_camera[..., 2]
    front = depth > nearest
    xy = P_camera[..., :2] / np.where(front, depth, 1.0)[..., None]
    inside = front & pixels_inside(camera, camera.distort(xy), margin)
    if camera.has_distortion:  # the polynomials fold far points back into the image
        far = inside & (np.sum(xy**2, axis=-1) > camera.unfolded**2)
        if far.any():
            back = camera.undistort(camera.distort(xy[far]))
            inside[far] = np.linalg.norm(back - xy[far], axis=-1) < 1e-3
    return np.asarray(inside)


def pixels_inside(camera: Camera, pixels: Array, margin: float = 0.0) -> BoolArray:
    """Return whether pixels (..., 2) lie in the image, at least ``margin`` px from its border."""
    x, y = pixels[..., 0], pixels[..., 1]
    inside = (x >= margin) & (x <= camera.width - 1.0 - margin)
    return np.asarray(inside & (y >= margin) & (y <= camera.height - 1.0 - margin))


def longest_runs(flags: BoolArray) -> tuple[IntArray, IntArray]:
    """Return first and last index (...) of the longest run of true values of flags (..., m).

    Both are zero where none is true.
    """
    place = np.arange(flags.shape[-1])
    run = place - np.maximum.accumulate(np.where(flags, -1, place), axis=-1)
    last = np.argmax(run, axis=-1)
    return last - np.maximum(run.max(axis=-1) - 1, 0), last


@dataclass(frozen=True, eq=False)
class PredictedLeg:
    """The predicted appearance of one leg in one image."""

    row: int  # of the image
    leg: int  # index of the leg
    A_camera: Array  # (3,) its base joint in the camera frame [m]
    B_camera: Array  # (3,) its platform joint [m]
    segments: tuple[Segment, ...]  # the parts that can be seen, from base to platform
    outlines: Array  # (n_segments, 2, 3) their outlines h1, h2, eq (3)
    bands: tuple[Band | None, ...]  # the frames along them, None for a part outside the image
    band: Band  # the frame along the visible stretch of the whole leg

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
    A_base: Array,  # (n_legs, 3)
    B_base: Array,  # (n_legs, 3)
    cylinders: Sequence[Sequence[Cylinder]],
    row: int,
) -> list[PredictedLeg]:
    """Predict every leg that an image should show."""
    T = T_base_camera.as_matrix()
    A_camera, B_camera = ((X - T[:3, 3]) @ T[:3, :3] for X in (A_base, B_base))
    length = np.linalg.norm(B_camera - A_camera, axis=1)
    u = (B_camera - A_camera) / length[:, None]
    segments = [
        visible_segments(of_leg, leg_of_axis)
        for of_leg, leg_of_axis in zip(cylinders, length, strict=True)
    ]
    whole = [(some[0].start, max(p.end for p in some)) if some else (0.0, 0.0) for some in segments]
    parts = [(leg, segment) for leg, some in enumerate(segments) for segment in some]
    leg_of_axis = [*range(len(segments)), *(leg for leg, _ in parts)]
    ends = np.array([*whole, *((part.start, part.end) for _, part in parts)]).reshape(-1, 2).T
    bands = bands_of_legs(camera, A_camera[leg_of_axis], B_camera[leg_of_axis], *ends)
    of_parts = iter(bands[len(segments) :])
    bands_of_parts = [tuple(islice(of_parts, len(some))) for some in segments]
    radius = np.array([max((segment.radius for segment in some), default=0.0) for some in segments])
    distance = np.linalg.norm(A_camera - u * np.sum(u * A_camera, axis=1, keepdims=True), axis=1)
    visible_bands = {
        leg: band
        for leg, band in enumerate(bands[: len(segments)])
        if band is not None and distance[leg] > 1.01 * radius[leg]
    }
    axes = [leg for leg in visible_bands for _ in segments[leg]]
    radii = np.array([segment.radius for leg in visible_bands for segment in segments[leg]])
    outlines = outlines_of_axis(u[axes], A_camera[axes], radii)
    of_leg = np.split(outlines, np.cumsum([len(segments[leg]) for leg in visible_bands])[:-1])
    return [
        PredictedLeg(
            row,
            leg,
            A_camera[leg],
            B_camera[leg],
            segments[leg],
            leg_outlines,
            bands_of_parts[leg],
            band,
        )
        for (leg, band), leg_outlines in zip(visible_bands.items(), of_leg, strict=False)
    ]


def rays_past_axes(
    P_camera: Array,  # (..., n, 3) observed points [m]
    A: Array,  # (..., n_legs, 3) one end of the axis of each leg [m]
    u: Array,  # (..., n_legs, 3) its unit direction
    length: Array,  # (..., n_legs) [m]
) -> tuple[Array, Array, Array]:
    """Return the distances of points (..., n) [m], and the closest approach of rays to leg axes.

    The approach has the depth along the ray and the squared gap, (..., n, n_legs) each [m, m^2].
    """
    distance = np.linalg.norm(P_camera, axis=-1)
    ray = P_camera / distance[..., None]
    c, to_A = ray @ np.swapaxes(u, -1, -2), ray @ np.swapaxes(A, -1, -2)
    sine2 = np.maximum(1.0 - c**2, 1e-12)
    from_foot = np.sum(u * A, axis=-1)[..., None, :]
    along = np.clip((c * to_A - from_foot) / sine2, 0.0, length[..., None, :])
    depth = to_A + along * c
    of_A = np.sum(A * A, axis=-1)[..., None, :]
    return distance, depth, of_A + along * (along + 2.0 * from_foot) - depth**2


def hidden_by(
    legs: Sequence[PredictedLeg],
    leg_of_point: IntArray,  # (n,) the leg to whose outline each point belongs
    P_camera: Array,  # (n, 3) the points [m]
    margin: Array,  # (n,) points this near to another leg's outline count as hidden
) -> IntArray:
    """Return the index (n,) of another leg in front of points of legs, -1 for none."""
    u, A, B = (
        np.array(x) for x in zip(*((o.u, o.A_camera, o.B_camera) for o in legs), strict=True)
    )
    length = np.linalg.norm(B - A, axis=1)
    radius = np.array([max(segment.radius for segment in other_leg.segments) for other_leg in legs])
    distance, depth, square = rays_past_axes(P_camera, A, u, length)
    reach = radius + margin[:, None] * depth
    hides = (reach > 0.0) & (square < reach**2) & (depth < distance[:, None])
    front = np.full(len(P_camera), -1, dtype=np.intp)
    for k, other_leg in enumerate(legs):
        front[hides[:, k] & (leg_of_point != other_leg.leg)] = other_leg.leg
    return front
