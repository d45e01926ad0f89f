"""What a camera sees of each leg: the stretches of its cylinders that nothing hides.

Rays go from the camera to points of both outlines of a leg. A point is seen where it is inside the
image and no solid stands before it. A leg counts as seen in an image where one unbroken stretch
with both outlines makes up at least 40 % of its length; less is hard to measure in a photograph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray
from legcal.mechanism.leg import Cylinder, Leg, main_cylinders
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.silhouette import contact_offsets
from legcal.vision.camera import Camera

SEEN = 0.4  # of a leg's length that one stretch must show
SHORTEST_PX = 20.0  # a stretch of one cylinder that gives an outline
SAMPLES = 96  # points along a leg
_BORDER_PX = 2.0  # of the image, where nothing counts as seen
_ALIKE = 0.01  # relative difference of radii that shows no step
_ASIDE = 0.01  # of the radius: how far beside its outline a leg is looked past
_END_ON = 1.01  # radii from the axis within which a leg shows its end and no outline
_IN_FRONT = 0.1  # radii before an outline from which on a hit hides it


@dataclass(frozen=True)
class Stretch:
    """A visible stretch of one cylinder of a leg.

    Attributes
    ----------
    leg : int
        The leg.
    part : str
        The URDF link of the cylinder.
    radius : float
        Its radius [m].
    start, end : float
        Distances from A along the leg [m].
    """

    leg: int
    part: str
    radius: float
    start: float
    end: float


@dataclass(frozen=True)
class LegView:
    """What an image shows of one leg.

    Attributes
    ----------
    share : float
        The longest unbroken stretch, as part of the leg's length.
    length_px : float
        Its length in the image [px].
    stretches : tuple of Stretch
        The longest stretch of each cylinder, from base to platform.
    """

    share: float
    length_px: float
    stretches: tuple[Stretch, ...]

    @property
    def is_seen(self) -> bool:
        """Whether the leg counts as seen."""
        return self.share >= SEEN and len(self.stretches) > 0


@dataclass(frozen=True, eq=False)
class _Skin:
    """The outer radius of a leg along its axis, sampled; zero where there is no cylinder."""

    s: Array
    radius: Array
    name: tuple[str, ...]


def legs_in_image(
    legs: Sequence[Leg],
    machine: PosedMachine,
    camera: Camera,
    T_base_camera: RigidTransform,
    *,
    samples: int = SAMPLES,
) -> tuple[LegView, ...]:
    """Return what an image shows of every leg.

    Parameters
    ----------
    legs : sequence of Leg
        The legs of the true machine.
    machine : PosedMachine
        The machine in its pose.
    camera : Camera
        The camera.
    T_base_camera : RigidTransform
        Its pose; outside the machine.
    samples : int
        Points along each leg.
    """
    length = np.linalg.norm(machine.B - machine.A, axis=-1)
    u = (machine.B - machine.A) / length[:, None]
    skins = [_skin(leg.cylinders, float(L), samples) for leg, L in zip(legs, length, strict=True)]
    s, radius = (np.array([getattr(skin, x) for skin in skins]) for x in ("s", "radius"))
    T_camera_base = T_base_camera.inv()
    u_camera = u @ T_camera_base.as_matrix()[:3, :3].T
    A_camera = np.asarray(T_camera_base.apply(machine.A))
    axis = A_camera[:, None] + s[..., None] * u_camera[:, None]
    from_axis = np.linalg.norm(np.cross(u_camera, A_camera), axis=-1)
    radius = np.where(from_axis[:, None] > _END_ON * radius, radius, 0.0)
    offsets = contact_offsets(u_camera[:, None], axis, radius)
    pixels, inside = pixels_in_image(camera, axis[:, :, None] + offsets)
    tested = inside & (radius > 0.0)[..., None]
    beside = axis[:, :, None] + (1.0 + _ASIDE) * offsets
    margin = np.broadcast_to(_IN_FRONT * radius[..., None], tested.shape)
    free = tested.copy()
    free[tested] = ~machine.hidden(
        T_base_camera.translation, T_base_camera.apply(beside[tested]), margin[tested]
    )
    both = np.all(free, axis=-1)
    middle = pixels.mean(axis=-2)
    return tuple(
        _leg_view(j, skin, both[j], middle[j], float(length[j])) for j, skin in enumerate(skins)
    )


def _leg_view(leg: int, skin: _Skin, free: BoolArray, pixels: Array, length: float) -> LegView:
    """Return what is seen of a leg whose samples are free or not."""
    first, last = _longest(free)
    if last <= first:
        return LegView(0.0, 0.0, ())
    share = float(skin.s[last] - skin.s[first]) / length
    stretches = []
    for name in dict.fromkeys(skin.name):
        chosen = free & np.array([other == name for other in skin.name])
        start, end = _longest(chosen)
        if name and end > start and np.linalg.norm(pixels[end] - pixels[start]) >= SHORTEST_PX:
            piece = float(skin.radius[start]), float(skin.s[start]), float(skin.s[end])
            stretches.append(Stretch(leg, name, *piece))
    length_px = float(np.linalg.norm(pixels[last] - pixels[first]))
    return LegView(share, length_px, tuple(stretches))


def _longest(chosen: BoolArray) -> tuple[int, int]:
    """Return the first and the last index of the longest run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    if len(edges) == 0:
        return 0, 0
    starts, ends = edges[::2], edges[1::2] - 1
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest])


@lru_cache(maxsize=4096)  # many cameras look at one machine
def _skin(cylinders: tuple[Cylinder, ...], length: float, samples: int) -> _Skin:
    """Return the outer radius along a leg, and the cylinder that each stretch is named by.

    Touching cylinders of one radius look like one; the longest of them names it, and of equally
    long ones the last in the alphabet.
    """
    spans = [cylinder.span(length) for cylinder in cylinders]
    low = min((start for start, _ in spans), default=0.0)
    high = max((end for _, end in spans), default=length)
    s = np.linspace(low, high, samples)
    covered = np.zeros((len(cylinders), samples))
    for i, (cylinder, (start, end)) in enumerate(zip(cylinders, spans, strict=True)):
        covered[i, (s >= start) & (s <= end)] = cylinder.radius
    radius = covered.max(axis=0, initial=0.0)
    change = np.abs(np.diff(radius)) > _ALIKE * np.maximum(radius[1:], radius[:-1])
    group = np.concatenate([[0], np.cumsum(change)])
    names = [_name_of(cylinders, covered, radius, group == g) for g in range(group[-1] + 1)]
    return _Skin(s, radius, tuple(names[g] for g in group))


def _name_of(
    cylinders: Sequence[Cylinder], covered: Array, radius: Array, chosen: BoolArray
) -> str:
    """Return the link that names a stretch of one radius; none for a gap or a minor cylinder."""
    R = float(radius[chosen].max())
    alike = [
        (c.end - c.start, c.link)
        for c, row in zip(cylinders, covered, strict=True)
        if R > 0.0 and np.any(np.abs(row[chosen] - R) <= _ALIKE * R)
    ]
    if not alike:
        return ""
    name = max(alike)[1]
    return name if abs(main_cylinders(cylinders)[name].radius - R) <= _ALIKE * R else ""


def pixels_in_image(camera: Camera, points: Array) -> tuple[Array, BoolArray]:
    """Return the pixels of points (..., 3) in the camera frame, and which are in the image."""
    depth = points[..., 2]
    before = depth > 1e-6
    xy = points[..., :2] / np.where(before, depth, 1.0)[..., None]
    low, high = field_of_view(camera)
    near = before & np.all((xy > 1.1 * low) & (xy < 1.1 * high), axis=-1)  # lenses fold beyond
    pixels = camera.distort(np.where(near[..., None], xy, 0.0))
    limit = np.array([camera.width, camera.height]) - 1.0 - _BORDER_PX
    return pixels, near & np.all((pixels >= _BORDER_PX) & (pixels <= limit), axis=-1)


@lru_cache(maxsize=64)  # a camera is asked for the same at every place that it might stand at
def field_of_view(camera: Camera) -> tuple[Array, Array]:
    """Return the least and the largest (x, y) of the sensor plane on the image's border."""
    x, y = camera.width - 1.0, camera.height - 1.0
    t = np.linspace(0.0, 1.0, 9)[:, None]
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y], [0.0, 0.0]])
    border = np.concatenate([a + t * (b - a) for a, b in pairwise(corners)])
    xy = camera.undistort(border)
    low, high = xy.min(axis=0), xy.max(axis=0)
    low.flags.writeable = high.flags.writeable = False
    return low, high
