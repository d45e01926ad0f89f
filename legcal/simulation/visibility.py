"""The visible parts of simulated legs: their stretches that no solid hides, by rays.

This is what photographs show. The method predicts it from a model, in another way
(:mod:`legcal.vision.visibility`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotVisible, UsageError
from legcal.geometry.lines import cross
from legcal.geometry.motions import matrix_applied
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder, Leg, cylinder_of_arm, main_cylinders
from legcal.progress import Report, no_progress
from legcal.simulation.solids import PosedMachine
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis, steps_to_outlines
from legcal.vision.visibility import least_length, longest_runs

MIN_SHARE = 0.4  # minimum share of a leg's length in one stretch
SAMPLES = 96  # points along a leg
_BORDER_PX = 2.0  # width of the image border where nothing counts as seen
_RADIUS_TOLERANCE = 0.01  # maximum relative difference of radii without a visible step
_BESIDE = 0.01  # distance of tested points outside the outline, in radii
_END_ON = 1.01  # distance of a camera from the axis, in radii, up to which a leg has no outline
_IN_FRONT = 0.1  # minimum distance in front of an outline, in radii, of a hit that hides it


@dataclass(frozen=True)
class Stretch:
    """A visible stretch of one cylinder of a leg."""

    leg: int
    part: str  # the URDF link of the cylinder
    radius: float  # [m]
    start: float  # from A along the leg [m]
    end: float


@dataclass(frozen=True)
class LegView:
    """The visible part of one leg in an image."""

    share: float  # the longest unbroken stretch, as part of the leg's length
    length_px: float  # its length in the image [px]
    stretches: tuple[Stretch, ...]  # the longest stretch of each cylinder, from base to platform
    arm: Stretch | None = None  # stretch along the arm that the leg has as a part

    @property
    def is_seen(self) -> bool:
        """Whether the leg counts as seen."""
        return self.share >= MIN_SHARE and len(self.stretches) > 0


def legs_in_image(
    legs: Sequence[Leg],
    posed: PosedMachine,
    camera: Camera,
    T_base_camera: RigidTransform,
    *,
    samples: int = SAMPLES,
) -> tuple[LegView, ...]:
    """Return the visible part of every leg in an image."""
    arms = {j: leg.arm for j, leg in enumerate(legs) if leg.arm is not None and j in posed.arms}
    A, B = (
        np.concatenate([ends, *(posed.arms[j][None, k] for j in arms)])
        for k, ends in enumerate((posed.A, posed.B))
    )
    cylinders = [*(leg.cylinders for leg in legs), *((cylinder_of_arm(a),) for a in arms.values())]
    T = T_base_camera.as_matrix()
    length, skins = _skins(A, B, cylinders, samples)
    axis, offsets, radius, pixels, tested = _sampled(A, B, skins, camera, T)
    beside = axis[:, :, None] + (1.0 + _BESIDE) * offsets
    margin = np.broadcast_to(_IN_FRONT * radius[..., None], tested.shape)
    free = tested.copy()
    free[tested] = ~posed.hidden(T[:3, 3], matrix_applied(T, beside[tested]), margin[tested])
    are_both_free = np.all(free, axis=-1)
    views = [
        _leg_view(j, *skin, are_both_free[i], pixels[i], float(length[i]))
        for i, (j, skin) in enumerate(zip([*range(len(legs)), *arms], skins, strict=True))
    ]
    of_arms = {j: view for j, view in zip(arms, views[len(legs) :], strict=True) if view.is_seen}
    return tuple(
        replace(view, arm=of_arms[j].stretches[0]) if j in of_arms else view
        for j, view in enumerate(views[: len(legs)])
    )


def longest_in_images(
    legs: Sequence[Leg],
    posed: PosedMachine,
    camera: Camera,
    T_base_camera: Array,  # (n, 4, 4)
    *,
    samples: int = SAMPLES,
) -> Array:
    """Return upper bounds of the lengths of :func:`legs_in_image` at n places, (n, n_legs) [px].

    They are the lengths from the first to the last sample in the image, as if nothing hid any.
    """
    _, skins = _skins(posed.A, posed.B, [leg.cylinders for leg in legs], samples)
    *_, pixels, tested = _sampled(posed.A, posed.B, skins, camera, T_base_camera)
    inside = np.all(tested, axis=-1)
    steps = np.linalg.norm(np.diff(pixels.mean(axis=-2), axis=-2), axis=-1)
    begun = np.logical_or.accumulate(inside, axis=-1)[..., :-1]
    goes_on = np.logical_or.accumulate(inside[..., ::-1], axis=-1)[..., -2::-1]
    return np.asarray(np.sum(steps, axis=-1, where=begun & goes_on))


def _skins(
    A: Array,  # (n, 3) both ends of legs and arms [m]
    B: Array,
    cylinders: Sequence[tuple[Cylinder, ...]],
    samples: int,
) -> tuple[Array, list[tuple[Array, Array, tuple[str, ...]]]]:
    """Return the lengths of legs and arms (n,) [m], and the skin of each."""
    length = np.linalg.norm(B - A, axis=-1)
    return length, [
        _skin(leg_cylinders, L, samples)
        for leg_cylinders, L in zip(cylinders, length.tolist(), strict=True)
    ]


def _sampled(
    A: Array,  # (n, 3) both ends of legs and arms [m]
    B: Array,
    skins: Sequence[tuple[Array, Array, tuple[str, ...]]],
    camera: Camera,
    T_base_camera: Array,  # (..., 4, 4)
) -> tuple[Array, Array, Array, Array, BoolArray]:
    """Return axes (..., n_legs, n, 3) of legs at their samples, in the camera's frame [m].

    With them come the steps (..., 2, 3) to both outlines, radii (...) [m], pixels (..., 2, 2) and
    whether these can be seen where nothing hides them (..., 2).
    """
    s, radius = (np.array([skin[k] for skin in skins]) for k in (0, 1))
    R, t = T_base_camera[..., :3, :3], T_base_camera[..., None, :3, 3]
    length = np.linalg.norm(B - A, axis=-1)
    u_camera, A_camera = (B - A) / length[:, None] @ R, (A - t) @ R
    axis = A_camera[..., None, :] + s[..., None] * u_camera[..., None, :]
    from_axis = np.linalg.norm(cross(u_camera, A_camera), axis=-1)
    radius = np.where(from_axis[..., None] > _END_ON * radius, radius, 0.0)
    h = outlines_of_axis(u_camera[..., None, :], axis, radius)
    offsets = steps_to_outlines(h, radius)
    pixels, inside = pixels_in_image(camera, axis[..., None, :] + offsets)
    return axis, offsets, radius, pixels, inside & (radius > 0.0)[..., None]


def _leg_view(
    leg: int,
    s: Array,  # (n,) samples along the axis [m]
    radius: Array,
    names: Sequence[str],  # of the cylinder at each sample
    free: BoolArray,
    pixels: Array,  # (n, 2, 2) of both outlines
    length: float,
) -> LegView:
    """Return the visible part of a leg from the mask of its free samples."""
    middle, width = pixels.mean(axis=1), np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1)
    first, last = map(int, longest_runs(free))
    if last <= first:
        return LegView(0.0, 0.0, ())
    share = round(float(s[last] - s[first]) / length, 9)  # 38 of 95 steps are MIN_SHARE, no less
    stretches = []
    for name in dict.fromkeys(names):
        chosen = free & np.array([sample_name == name for sample_name in names])
        start, end = map(int, longest_runs(chosen))
        least = least_length(width[[start, end]].mean())
        if name and end > start and np.linalg.norm(middle[end] - middle[start]) >= least:
            piece = float(radius[start]), float(s[start]), float(s[end])
            stretches.append(Stretch(leg, name, *piece))
    length_px = float(np.linalg.norm(middle[last] - middle[first]))
    return LegView(share, length_px, tuple(stretches))


@lru_cache(maxsize=4096)  # many cameras look at one machine
def _skin(
    cylinders: tuple[Cylinder, ...], length: float, samples: int
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return samples along a leg, the outer radius there (0 for a gap), and cylinders' names.

    Touching cylinders of one radius look like one cylinder, with the name of the longest of them,
    or of the last in the alphabet if they are equally long.
    """
    spans = [cylinder.span(length) for cylinder in cylinders]
    low = min((start for start, _ in spans), default=0.0)
    high = max((end for _, end in spans), default=length)
    s = np.linspace(low, high, samples)
    covered = np.zeros((len(cylinders), samples))
    for i, (cylinder, (start, end)) in enumerate(zip(cylinders, spans, strict=True)):
        covered[i, (s >= start) & (s <= end)] = cylinder.radius
    radius = covered.max(axis=0, initial=0.0)
    change = np.abs(np.diff(radius)) > _RADIUS_TOLERANCE * np.maximum(radius[1:], radius[:-1])
    group = np.concatenate([[0], np.cumsum(change)])
    names = [_name_of(cylinders, covered, radius, group == g) for g in range(group[-1] + 1)]
    return s, radius, tuple(names[g] for g in group)


def _name_of(
    cylinders: Sequence[Cylinder], covered: Array, radius: Array, chosen: BoolArray
) -> str:
    """Return the link that names a stretch of one radius; "" for a gap or a minor cylinder."""
    R = float(radius[chosen].max())
    alike = [
        (c.end - c.start, c.link)
        for c, row in zip(cylinders, covered, strict=True)
        if R > 0.0 and np.any(np.abs(row[chosen] - R) <= _RADIUS_TOLERANCE * R)
    ]
    if not alike:
        return ""
    name = max(alike)[1]
    return name if abs(main_cylinders(cylinders)[name].radius - R) <= _RADIUS_TOLERANCE * R else ""


def pixels_in_image(camera: Camera, points: Array) -> tuple[Array, BoolArray]:
    """Return the pixels of points (..., 3) in the camera frame, and whether the image has them."""
    depth = points[..., 2]
    before = depth > 1e-6
    xy = points[..., :2] / np.where(before, depth, 1.0)[..., None]
    low, high = field_of_view(camera)
    near = before & np.all((xy > 1.1 * low) & (xy < 1.1 * high), axis=-1)  # lenses fold beyond
    pixels = camera.distort(np.where(near[..., None], xy, 0.0))
    limit = np.array([camera.width, camera.height]) - 1.0 - _BORDER_PX
    return pixels, near & np.all((pixels >= _BORDER_PX) & (pixels <= limit), axis=-1)


@lru_cache(maxsize=64)  # the same at every candidate place of a camera
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


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A simulated camera and its pose."""

    name: str
    camera: Camera  # its intrinsics
    T_base_camera: RigidTransform  # its true pose in the base link
    legs: tuple[str, ...] | None = None  # measured in its images; None for all visible legs


@dataclass(frozen=True, eq=False)
class Images:
    """The images of a dataset, in the order of its rows."""

    # view, pose, repeat: (n_rows,) indices; ``repeat`` counts the images of one pose in one view
    view: IntArray
    pose: IntArray
    repeat: IntArray
    # visible legs by row; equal for all images of one pose in one view
    shown: tuple[tuple[LegView, ...], ...]

    def __len__(self) -> int:
        return len(self.view)

    def seen(self, row: int) -> list[int]:
        """Return the legs that are measurable in an image."""
        return [j for j, leg in enumerate(self.shown[row]) if leg.is_seen]

    def seen_in_view(self, view: int, least: float = 0.0) -> list[int]:
        """Return the legs that more than a fraction *least* of the images of a view show."""
        rows = np.flatnonzero(self.view == view)
        is_seen = np.array([[leg.is_seen for leg in self.shown[row]] for row in rows])
        return [int(j) for j in np.flatnonzero(is_seen.mean(axis=0) > least)]

    def chosen(self, rows: Sequence[int]) -> Images:
        """Return some of the images."""
        index = np.asarray(rows, dtype=np.intp)
        shown = tuple(self.shown[row] for row in rows)
        return Images(self.view[index], self.pose[index], self.repeat[index], shown)


def take_images(
    legs: Sequence[Leg],
    posed_machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    poses_of: Sequence[Sequence[int]],  # poses that each view sees
    n_images: int,  # of each pose in each view
    progress: Report = no_progress,
    *,
    all_views: bool = True,  # whether each view must show a leg, or only one of them
) -> Images:
    """Return the images that cameras take of a machine in its poses."""
    rows: list[tuple[int, int, int]] = []
    shown: list[tuple[LegView, ...]] = []
    problems = []
    for v, (viewpoint, poses) in enumerate(zip(viewpoints, poses_of, strict=True)):
        progress("Views", v, len(viewpoints))
        camera, T = viewpoint.camera, viewpoint.T_base_camera
        _refuse_inside(viewpoint, [posed_machines[p] for p in poses])
        views = [legs_in_image(legs, posed_machines[p], camera, T) for p in poses]
        if viewpoint.legs is not None:
            views = [
                tuple(
                    leg_view if leg.name in viewpoint.legs else LegView(0.0, 0.0, ())
                    for leg, leg_view in zip(legs, view, strict=True)
                )
                for view in views
            ]
        if not any(leg.is_seen for view in views for leg in view):
            problems.append(_sees_nothing(viewpoint.name, legs, views))
        for p, view in zip(poses, views, strict=True):
            rows += [(v, p, k) for k in range(n_images)]
            shown += [view] * n_images
    progress("Views", len(viewpoints), len(viewpoints))
    if problems and (all_views or len(problems) == len(viewpoints)):
        raise NotVisible(problems)
    view_of_row, pose_of_row, repeat_of_row = np.array(rows, dtype=np.intp).T
    return Images(view_of_row, pose_of_row, repeat_of_row, tuple(shown))


def _refuse_inside(viewpoint: Viewpoint, posed_machines: Sequence[PosedMachine]) -> None:
    """Raise UsageError if a camera is inside the machine in one of the poses."""
    centre = viewpoint.T_base_camera.translation
    if any(posed.encloses(centre) for posed in posed_machines):
        x, y, z = centre
        raise UsageError(
            f"view {viewpoint.name}: its camera could not be placed: found it inside the machine, "
            f"at ({x:.3f}, {y:.3f}, {z:.3f}) m in the base link, needed a place outside in all "
            "poses; move the camera."
        )


def _sees_nothing(name: str, legs: Sequence[Leg], views: Sequence[Sequence[LegView]]) -> str:
    """Return the problem of a view without a leg, with the visible parts in words."""
    start = f"view {name}: its images could not be simulated: found"
    if not any(leg.cylinders for leg in legs):
        return (
            f"{start} no leg with a visible cylinder in the model, needed URDF visuals that are "
            "cylinders coaxial with the legs; add them, or write a model with: legcal "
            "inspect FILE --leg-radius MM --write DIR."
        )
    most = max(leg.share for view in views for leg in view)
    if most >= MIN_SHARE:
        longest = max(leg.length_px for view in views for leg in view)
        return (
            f"{start} that legs are at most {longest:.1f} px long in them, needed "
            f"{least_length(0.0):g} px, and as much as their width; move the camera nearer (its "
            "place is in metres), or give it a longer focal length."
        )
    return (
        f"{start} that no image shows a leg (at best {100.0 * most:.0f} % of one), needed "
        f"{100.0 * MIN_SHARE:.0f} % of one unhidden; turn or move the camera."
    )
