"""Simulated observations of a machine in its poses: outlines, axes, corners, exact or noisy.

A :class:`Scene` is the truth of a session: the joints, and the visible legs in each image. Legs are
seen as the method sees them, but rays at solids say what hides them (:func:`take_images`); the
method predicts that from a model, in another way (:mod:`legcal.vision.visibility`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.corners import Corners, found_corners, join_corners
from legcal.data.outlines import Outlines, join_outlines, outlines_in_sight
from legcal.errors import NotVisible, UsageError
from legcal.geometry.lines import cross
from legcal.geometry.motions import matrix_applied
from legcal.geometry.tables import Table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Leg, cylinder_of_arm
from legcal.machine.shapes import Occluder
from legcal.perception.body_edges import predicted_edges
from legcal.progress import Report, no_progress
from legcal.simulation.solids import PosedMachine
from legcal.vision.camera import Camera
from legcal.vision.visibility import Bodies, Seen, in_picture, least_length, visible_parts

MIN_SHARE = 0.4  # minimum share of a leg's length that is visible
SAMPLES = 96  # points along a part
BORDER_PX = 2.0  # width of the image border where nothing counts as seen
_BESIDE = 0.01  # distance of tested points outside the outline, in radii
_IN_FRONT = 0.1  # minimum distance in front of an outline, in radii, of a hit that hides it
NEAREST = 1e-6  # [m] before a camera


def legs_in_image(
    legs: Sequence[Leg],
    posed: PosedMachine,
    camera: Camera,
    T_base_camera: RigidTransform,
    *,
    samples: int = SAMPLES,
    least: float = MIN_SHARE,
    nothing_hides: bool = False,
) -> Seen:
    """Return the visible segments of legs and arms of which at least a share is visible."""
    T = T_base_camera.as_matrix()
    arms = {j: leg.arm for j, leg in enumerate(legs) if leg.arm is not None and j in posed.arms}
    A, B = (
        np.concatenate([ends, *(posed.arms[j][None, k] for j in arms)])
        for k, ends in enumerate((posed.A, posed.B))
    )
    bodies = Bodies(
        A[None],
        B[None],
        (*(leg.cylinders for leg in legs), *([cylinder_of_arm(arm)] for arm in arms.values())),
        np.array([*range(len(legs)), *arms], dtype=np.intp),
        np.zeros(len(legs), dtype=np.bool_),
        NEAREST,
        (),
    )

    def are_clear(radius: Array, axis: Array, steps: Array) -> BoolArray:
        free = in_picture(camera, axis[:, :, None] + steps[:, None], NEAREST, BORDER_PX)
        if not nothing_hides:
            beside = matrix_applied(T, (axis[:, :, None] + (1.0 + _BESIDE) * steps[:, None])[free])
            margin = np.broadcast_to(_IN_FRONT * radius[:, None, None], free.shape)[free]
            free[free] = ~posed.hidden(T[:3, 3], beside, margin)
        return np.asarray(free.all(axis=-1))

    seen = visible_parts(camera, T_base_camera, bodies, are_clear=are_clear, n_along=samples)
    return seen.choose(shares(seen, len(legs))[seen.is_arm.astype(np.intp), seen.leg] >= least)


def shares(seen: Seen, n_legs: int) -> Array:
    """Return the visible parts of legs and arms, relative to their lengths, (2, n_legs)."""
    share = np.zeros((2, n_legs))
    np.add.at(share, (seen.is_arm.astype(np.intp), seen.leg), np.diff(seen.span)[:, 0])
    return share


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A simulated camera and its pose."""

    name: str
    camera: Camera  # its intrinsics
    T_base_camera: RigidTransform  # its true pose in the base link
    legs: tuple[str, ...] | None = None  # measured in its images; None for all visible legs


@dataclass(frozen=True, eq=False)
class Images(Table):
    """The images of a dataset, in the order of its rows."""

    # view, pose, repeat: (n_rows,) indices; ``repeat`` counts the images of one pose in one view
    view: IntArray
    pose: IntArray
    repeat: IntArray
    # visible legs and arms by row; equal for all images of one pose in one view
    shown: tuple[Seen, ...]

    def seen(self, row: int) -> list[int]:
        """Return the legs that are measurable in an image."""
        seen = self.shown[row]
        return sorted({*seen.leg[~seen.is_arm].tolist()})

    def seen_in_view(self, view: int, least: float = 0.0) -> list[int]:
        """Return the legs that more than a fraction *least* of the images of a view show."""
        rows = np.flatnonzero(self.view == view).tolist()
        counts = Counter(j for row in rows for j in self.seen(row))
        return sorted(j for j, n in counts.items() if n > least * len(rows))


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
    shown: list[Seen] = []
    problems = []
    for v, (viewpoint, poses) in enumerate(zip(viewpoints, poses_of, strict=True)):
        progress("Views", v, len(viewpoints))
        camera, T = viewpoint.camera, viewpoint.T_base_camera
        _refuse_inside(viewpoint, [posed_machines[p] for p in poses])
        views = [legs_in_image(legs, posed_machines[p], camera, T) for p in poses]
        if viewpoint.legs is not None:
            named = np.array([leg.name in viewpoint.legs for leg in legs])
            views = [view.choose(named[view.leg]) for view in views]
        if all(view.is_arm.all() for view in views):
            problems.append(_sees_nothing(viewpoint.name, legs))
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


def _sees_nothing(name: str, legs: Sequence[Leg]) -> str:
    start = f"view {name}: its images could not be simulated: found"
    if not any(leg.cylinders for leg in legs):
        return (
            f"{start} no leg with a visible cylinder in the model, needed URDF visuals that are "
            "cylinders coaxial with the legs; add them, or write a model with: legcal "
            "inspect FILE --leg-radius MM --write DIR."
        )
    return (
        f"{start} that no image shows a leg, needed {100.0 * MIN_SHARE:.0f} % of one unhidden and "
        f"at least {least_length(0.0):g} px long in them; turn or move the camera (its place is in "
        "metres), or give it a longer focal length."
    )


EXACT_PX = 1e-3  # stated standard deviation of outlines and corners without noise
_MIN_UPRIGHT_AXIS = 1e-3  # component along the image y axis below which a leg has no point M_LS
_MIN_UPRIGHT = 1e-9  # component below which its numbers cannot be computed


@dataclass(frozen=True, eq=False)
class Scene:
    """A machine in its poses, its cameras and images, in a frame L: the base link or R_b."""

    A: Array  # (n_poses, n_legs, 3) base joint centres in L [m]
    B: Array  # (n_poses, n_legs, 3) platform joint centres in L [m]
    views: tuple[Viewpoint, ...]  # with T_L_camera
    images: Images

    def leg_in_camera(self, row: int, leg: int) -> tuple[Array, Array]:
        """Return direction u (3,) and base joint A (3,) [m] of a leg in the camera of an image."""
        A, B = (joints[self.images.pose[row], leg] for joints in (self.A, self.B))
        T = self.views[self.images.view[row]].T_base_camera.as_matrix()
        R = T[:3, :3].T
        return R @ ((B - A) / np.linalg.norm(B - A)), R @ (A - T[:3, 3])


# Outlines


@dataclass(frozen=True)
class OutlineNoise:
    """White noise of the edge points of an outline, to which a line is fitted."""

    sigma_px: float = 0.1  # standard deviation of each point [px]
    n_points: int | None = 300  # equally spaced; None for a point in every pixel

    def covariance(self, length_px: float) -> Array:
        """Return the covariance of the line's offsets at its ends, (2, 2) [px^2]."""
        n = max(2, round(length_px)) if self.n_points is None else self.n_points
        t = np.linspace(0.0, 1.0, n)
        design = np.stack([1.0 - t, t], axis=-1)
        return np.asarray(self.sigma_px**2 * np.linalg.inv(design.T @ design))


EVERY_PIXEL = OutlineNoise(n_points=None)


def outlines_of(
    scene: Scene, noise: OutlineNoise = EVERY_PIXEL, rng: np.random.Generator | None = None
) -> Outlines:
    """Return the outlines of all visible segments by row, leg and edge; exact without *rng*.

    Outlines of arms follow the outlines of legs. They carry the covariance of the noise in
    either case.
    """
    claimed = replace(noise, sigma_px=max(noise.sigma_px, EXACT_PX))
    images, seen = scene.images, Seen.joined(scene.images.shown)
    row = np.repeat(np.arange(len(images)), [len(shown) for shown in images.shown])
    covariance = [claimed.covariance(length) for length in seen.length_px.tolist()]
    outlines = outlines_in_sight(seen, row, np.array(covariance).reshape(-1, 2, 2))
    if rng is None or noise.sigma_px == 0.0:
        return outlines
    errors = [rng.multivariate_normal(np.zeros(2), C, size=2) for C in covariance]
    offsets, h, ends = np.reshape(errors, (-1, 2)), outlines.h.copy(), outlines.ends.copy()
    for v, view in enumerate(scene.views):
        some = images.view[outlines.row] == v
        h[some], ends[some] = shifted_outlines(view.camera, h[some], ends[some], offsets[some])
    return replace(outlines, h=h, ends=ends)


def edges_of_bodies(
    scene: Scene, occluders: Sequence[Occluder], noise: OutlineNoise, rng: np.random.Generator
) -> Outlines:
    """Return the edges of the bodies of legs that images show, with errors."""
    images, tables = scene.images, list[Outlines]()
    ends = scene.A[images.pose], scene.B[images.pose]
    wanted = np.ones((len(scene.views), scene.A.shape[1]), dtype=np.bool_)
    places = [(view.camera, view.T_base_camera) for view in scene.views]
    exact = predicted_edges(occluders, places, images.view, ends, wanted)
    covariances = [noise.covariance(length) for length in exact.length.tolist()]
    exact = replace(exact, covariance=np.array(covariances).reshape(-1, 2, 2))
    for v, view in enumerate(scene.views):
        of_view = exact.choose(images.view[exact.row] == v)
        tables.append(noisy_outlines(of_view, view.camera, rng) if noise.sigma_px else of_view)
    return join_outlines(tables)


def noisy_outlines(exact: Outlines, camera: Camera, rng: np.random.Generator) -> Outlines:
    """Return exact outlines of one camera with errors drawn from their covariance."""
    root = np.linalg.cholesky(exact.covariance)
    return moved_outlines(
        exact, camera, np.einsum("nij,nj->ni", root, rng.normal(size=(len(exact), 2)))
    )


def moved_outlines(outlines: Outlines, camera: Camera, offsets: Array) -> Outlines:
    """Return outlines of one camera with ends moved across them by (n, 2) pixels."""
    h, ends = shifted_outlines(camera, outlines.h, outlines.ends, offsets)
    return replace(outlines, h=h, ends=ends)


def shifted_outlines(camera: Camera, h: Array, ends: Array, offsets: Array) -> tuple[Array, Array]:
    """Return normals h (..., 3) and ends (..., 2, 2) moved across the line by (..., 2) pixels.

    Offsets are positive where h . (x, y, 1) > 0.
    """
    xy = camera.undistort(ends)
    J = camera.pixels_per_unit(xy)
    ab = np.broadcast_to(h[..., None, :2], xy.shape)
    normal = np.linalg.solve(np.swapaxes(J, -1, -2), ab[..., None])[..., 0]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    moved = ends + offsets[..., None] * normal
    rays = camera.rays(moved)
    n = cross(rays[..., 0, :], rays[..., 1, :])
    n *= np.sign(np.sum(n * h, axis=-1, keepdims=True))
    return n / np.linalg.norm(n, axis=-1, keepdims=True), moved


# Axes


@dataclass(frozen=True)
class TableNoise:
    """The noise of Table 1, on the Euler angles of an axis and on its point M_LS = (x, 0, z).

    The paper prints 0.05 and 0.06 "rad"; its results fit degrees only, so the default reads
    them as degrees. :meth:`in_radians` is the table to the letter.

    Attributes
    ----------
    psi, theta : float
        Standard deviations of the angles (:mod:`legcal.vision.cylinder`) [rad].
    x, z : float
        Standard deviations of the coordinates of M_LS [m].
    """

    psi: float = float(np.deg2rad(0.05))
    theta: float = float(np.deg2rad(0.06))
    x: float = 0.05e-3
    z: float = 0.10e-3

    @classmethod
    def in_radians(cls) -> TableNoise:
        """Return the table with its angles read as radians."""
        return cls(psi=0.05, theta=0.06)

    @property
    def sigmas(self) -> Array:
        """The four standard deviations, (4,) [rad, rad, m, m]."""
        return np.array([self.psi, self.theta, self.x, self.z])


class AxisTable(NamedTuple):
    """Axes of legs as Table 1 states them."""

    row: IntArray  # (n,) image
    leg: IntArray  # (n,)
    values: Array  # (n, 4) psi, theta, x, z [rad, rad, m, m]
    sigmas: Array  # (n, 4) their standard deviations


def axes_in_images(
    scene: Scene, noise: TableNoise, rng: np.random.Generator | None = None
) -> AxisTable:
    """Return the axes of all visible legs, by row and leg; exact without *rng*.

    A leg parallel to the image x axis has no point M_LS = (x, 0, z) and is left out.
    """
    row, leg, u, A = [], [], [], []
    for r in range(len(scene.images)):
        for j in scene.images.seen(r):
            direction, joint = scene.leg_in_camera(r, j)
            if abs(direction[1]) > _MIN_UPRIGHT_AXIS:
                row.append(r)
                leg.append(j)
                u.append(direction)
                A.append(joint)
    place = np.array([row, leg], dtype=np.intp)
    line = np.array([u, A]).reshape(2, -1, 3)
    return table_of(place[0], place[1], line[0], line[1], noise, rng)


def table_of(
    row: IntArray,
    leg: IntArray,
    u: Array,  # (n, 3) in the camera frame
    A: Array,
    noise: TableNoise,
    rng: np.random.Generator | None,
) -> AxisTable:
    """Return the table of axes with noise; exact without *rng*."""
    values = table_of_lines(u, A)
    if rng is not None:
        values += rng.normal(size=values.shape) * noise.sigmas
        values[:, 0], values[:, 1] = _wrapped(values[:, 0], values[:, 1])
    return AxisTable(row, leg, values, np.broadcast_to(noise.sigmas, values.shape))


def _wrapped(psi: Array, theta: Array) -> tuple[Array, Array]:
    """Return psi in [-pi/2, pi/2] and theta in [-pi, pi] of the directions of any angles."""
    psi = np.remainder(psi + np.pi, 2.0 * np.pi) - np.pi
    beyond = np.abs(psi) > 0.5 * np.pi  # past the optical axis: the same direction from behind
    psi = np.where(beyond, np.copysign(np.pi, psi) - psi, psi)
    theta = np.remainder(theta + np.where(beyond, 2.0, 1.0) * np.pi, 2.0 * np.pi) - np.pi
    return psi, theta


def table_of_lines(u: Array, A: Array) -> Array:
    """Return psi, theta [rad] and x, z of M_LS [m] of lines u, A (n, 3), by way of their moments.

    The direction u is at 90 deg - psi to the optical axis, and its picture u_y - i u_x as a complex
    number is at theta to the image's y axis. M_LS is in the plane y = 0 and has the moment of
    the line, M x u = A x u. The method goes back to the line by another way, so that a mistake
    shows.
    """
    u_x, u_y, u_z = u.T
    if np.any(np.abs(u_y) < _MIN_UPRIGHT):
        raise NotVisible(
            "The axis of a simulated leg could not be tabulated: found it parallel to the image x "
            "axis, needed a leg that crosses the plane y = 0 of its camera; turn the camera."
        )
    # The angle to the optical axis from the chords to both of its ends: exact for all angles.
    across = np.hypot(u_x, u_y)
    psi = 0.5 * np.pi - 2.0 * np.arctan2(np.hypot(across, u_z - 1.0), np.hypot(across, u_z + 1.0))
    theta = np.angle(u_y - 1j * u_x)
    moment = cross(A, u)
    return np.stack([psi, theta, moment[:, 2] / u_y, -moment[:, 0] / u_y], axis=-1)


# Corners


def corners_in_images(
    scene: Scene,
    posed_machines: Sequence[PosedMachine],  # in every pose, with the boards beside them
    sigma_px: float,
    rng: np.random.Generator | None = None,
) -> Corners:
    """Return the visible corners of boards, by board, row and number; exact without *rng*."""
    tables = []
    for board, row in product(range(len(posed_machines[0].boards)), range(len(scene.images))):
        v, k = scene.images.view[row], scene.images.pose[row]
        camera, T = scene.views[v].camera, scene.views[v].T_base_camera
        placed = posed_machines[k].boards[board]
        corner = np.flatnonzero(placed.seen(posed_machines[k], camera, T))
        if not len(corner):
            continue
        P_base = placed.T_base_board.apply(placed.board.points[corner])
        px = camera.project(T.inv().apply(P_base))
        if rng is not None:
            px = px + sigma_px * rng.normal(size=px.shape)
            size = np.array([camera.width, camera.height]) - 0.5
            inside = np.all((px >= -0.5) & (px <= size), axis=1)
            corner, px = corner[inside], px[inside]
        sigma = np.full(len(corner), max(sigma_px, EXACT_PX))
        of_row = np.full(len(corner), row, dtype=np.intp)
        tables.append(found_corners(of_row, placed.first + corner, px, sigma))
    return join_corners(tables)
