"""What a camera sees of a machine: the visible segments of legs and arms, and their outlines.

:func:`predict_legs` says for one image where to look: outlines and the bands along them, within
which images are searched; :func:`hidden_by` which leg is in front of a point.

:func:`visible_parts` says for many poses at once what is in sight. A segment is visible if it is in
the picture with a margin, in front of the camera, and not behind another leg or arm, another solid
of the model or a plate. The joints of base and platform span plates; joints on carriages and arms
do not. Points of the axes are tested along rays; outlines follow from eqs (3) and (5). Where
somebody states which legs a camera shows, nothing hides them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import moment
from legcal.geometry.tables import Table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder, Leg, cylinder_of_arm, main_cylinders
from legcal.machine.rods import arms_at, ends_in_base, readings_of_rods
from legcal.machine.shapes import Occluder, PlacedOccluders
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis, steps_to_outlines

EQUAL_RADII = 0.01  # maximum relative difference of radii without a visible step
END_COVER = 2.0  # length that may be hidden at a joint and beside a thicker cylinder [radii]
N_ALONG_LEG = 64  # points along a leg that are tested for visibility
MIN_DEPTH_SHARE = 0.05  # minimum depth of points, in leg lengths: nearer points are cut off
MIN_LENGTH = (30.0, 1.0)  # minimum length of a measured outline: [px], and in widths of the leg
MIN_WIDTH = 5.0  # least width of a measured part [px]


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
    s = start[:, None] + (end - start)[:, None] * np.linspace(0.0, 1.0, N_ALONG_LEG)
    axis = A_camera[:, None] + s[..., None] * u[:, None]
    inside = in_picture(camera, axis, MIN_DEPTH_SHARE * length[:, None])
    m = moment(u, A_camera)
    first, last = np.zeros((2, len(axis)), dtype=np.intp)
    n_inside = np.count_nonzero(inside, axis=1)
    last[n_inside == N_ALONG_LEG] = N_ALONG_LEG - 1
    cut = np.flatnonzero((n_inside > 1) & (n_inside < N_ALONG_LEG))
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

    def points_of(self, part: int, edge: int, n: int) -> Array | None:
        """Return points (n, 2) of edge 1 or 2 of a part; None where the part is outside."""
        band, h = self.bands[part], self.outlines[part, edge - 1]
        if band is None:
            return None
        t = np.linspace(0.0, band.length, n)
        return band.points(t, band.offsets(h, t))

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


def _before(
    P_camera: Array,  # (..., n, 3) points [m]
    A: Array,  # (..., n_legs, 3) one end of each leg [m]
    u: Array,  # (..., n_legs, 3) its unit direction
    length: Array,  # (..., n_legs) [m]
    radius: Array,  # (n_legs,) [m]
    margin: Array,  # (..., n) angles by which rays to points must pass a leg [rad]
) -> BoolArray:
    """Return a mask (..., n, n_legs) of the legs in front of points, own ones as well."""
    distance, depth, square = rays_past_axes(P_camera, A, u, length)
    reach = radius + margin[..., None] * depth
    return np.asarray(
        (reach > 0.0) & (square < reach**2) & (depth > 0.0) & (depth < distance[..., None])
    )


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
    radius = np.array([max(segment.radius for segment in other_leg.segments) for other_leg in legs])
    hides = _before(P_camera, A, u, np.linalg.norm(B - A, axis=1), radius, margin)
    front = np.full(len(P_camera), -1, dtype=np.intp)
    for k, other_leg in enumerate(legs):
        front[hides[:, k] & (leg_of_point != other_leg.leg)] = other_leg.leg
    return front


N_ALONG_PART = 24  # points along a part that are tested
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
        q = readings_of_rods(legs, R, t)
        A, B = ends_in_base(legs, T, R, t, q)
        arms = arms_at(legs, q)
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
class Seen(Table):
    """The n visible segments of legs and arms in images of one camera."""

    image: IntArray  # (n,)
    leg: IntArray  # (n,)
    is_arm: BoolArray  # (n,) whether it is the arm of the leg, and not along it
    part: tuple[str, ...]  # the URDF link of the cylinder
    h: Array  # (n, 2, 3) both outlines, eq (3)
    ends: Array  # (n, 2, 2, 2) of both outlines, both ends [px], the first nearer to the base joint
    span: Array  # (n, 2) where it starts and ends, from A, as parts of the length of leg or arm
    length_px: Array  # (n,)

    def only(self, image: int) -> Seen:
        """Select the segments of one image."""
        seen = self.choose(self.image == image)
        return replace(seen, image=np.zeros_like(seen.image))

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
    are_clear: Callable[[Array, Array, Array], BoolArray] | None = None,
    n_along: int = N_ALONG_PART,
    least_width: float = 0.0,  # of parts [px]
) -> Seen:
    """Return the visible segments of legs and arms in images of one camera.

    *are_clear* says what is in sight in place of the bodies: of parts with radii (k,) and points
    (k, n_along, 3) of their axes, from which steps (k, 2, 3) lead to both outlines, (k, n_along).
    """
    bodies = bodies.before(T_base_camera)
    A, (u, length) = bodies.A, bodies.axes
    body, link, radius, start, end = _parts(bodies.cylinders, length)
    share = np.linspace(0.0, 1.0, n_along)
    s = start[..., None] + (end - start)[..., None] * share
    u_part = u[:, body]
    P = A[:, body, None] + s[..., None] * u_part[:, :, None]  # (n_images, n_parts, n_along, 3)
    margin_px = margin_px if stated is None else -np.inf
    is_visible = (end > start)[..., None] & in_picture(camera, P, bodies.nearest, margin_px)
    foot = A[:, body] - u_part * np.sum(u_part * A[:, body], axis=-1, keepdims=True)
    is_visible &= (np.linalg.norm(foot, axis=-1) > _OUTSIDE * radius)[..., None]
    if stated is not None:
        is_visible &= stated[bodies.leg[body]][:, None]
    elif are_clear is None:
        is_visible &= ~_hidden(bodies, P, body, radius)
    else:
        shown = np.nonzero(is_visible.any(axis=-1))
        R, axis = radius[shown[1]], P[shown]
        steps = steps_to_outlines(outlines_of_axis(u_part[shown], axis[:, 0], R), R)
        is_visible[shown] &= are_clear(R, axis, steps)
    first, last = longest_runs(is_visible)
    image, part = np.nonzero(last > first)
    first_end, last_end = (s[image, part, k[image, part]] for k in (first, last))
    u_seen, M = u_part[image, part], A[image, body[part]]
    h = outlines_of_axis(u_seen, M, radius[part])
    axis = M[:, None] + np.stack([first_end, last_end], axis=1)[..., None] * u_seen[:, None]
    ends = camera.project(axis[:, None] + steps_to_outlines(h, radius[part])[:, :, None])
    length_px = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1).mean(axis=1)
    width_px = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=-1).mean(axis=1)
    is_long = (length_px >= least_length(width_px)) & (width_px >= least_width)
    is_long |= stated is not None
    parts = part[is_long]
    return Seen(
        image[is_long],
        bodies.leg[body[parts]],
        body[parts] >= bodies.n_legs,
        tuple(link[k] for k in parts),
        h[is_long],
        ends[is_long],
        (np.stack([first_end, last_end], axis=1) / length[image, body[part]][:, None])[is_long],
        length_px[is_long],
    )


def _hidden(bodies: Bodies, P: Array, body: IntArray, radius: Array) -> BoolArray:
    """Return a mask of the points P (n_images, n_parts, m, 3) of parts that something hides."""
    largest_radius = np.zeros(len(bodies.leg))
    np.maximum.at(largest_radius, body, radius)
    # A ray to the edge of a body itself passes at its radius, as far as the other is nearer.
    flat = P.reshape(len(P), -1, 3)
    beside = np.repeat(radius, P.shape[2]) / np.linalg.norm(flat, axis=-1)
    hides = _before(flat, bodies.A, *bodies.axes, largest_radius, beside)
    hides &= np.repeat(body, P.shape[2])[:, None] != np.arange(bodies.A.shape[1])
    hidden: BoolArray = np.any(hides, axis=-1).reshape(P.shape[:-1])
    own_leg, reach = (
        np.repeat(x, N_ALONG_PART) for x in (np.where(body < bodies.n_legs, body, -1), radius)
    )
    for k, placed in enumerate(bodies.occluders):
        hides = placed.hide(P[k].reshape(-1, 3), own_leg, reach, reach) >= 0
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
