"""Observations as they will be made: which legs each camera position shows, at which poses.

A :class:`Session` is planned (default cameras, random poses) or that of a dataset; what it shows
across each leg is given with the standard deviation of an outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import N_LOCAL, Leg, LegKind, Parametrization, joined, leg_labels

_TIMES = {2: "two", 3: "three", 4: "four"}
SIGMA_PX = 0.1  # of an outline across a leg, in the image
_ALONG = 1e-6  # a leg that points at the camera shows no lateral direction: least |u x ray|


@dataclass(frozen=True, eq=False)
class Session:
    """Observations as they will be made, of a machine that is nearly the nominal one."""

    leg_names: tuple[str, ...]
    legs: tuple[Leg, ...]  # in R_b and R_e
    frame_legs: tuple[int, ...]  # those that define R_b and R_e
    parametrization: Parametrization
    radius: Array  # (n_legs,): radius of the cylinder that is seen of each leg [m]
    R: Array  # R, t: (k, 3, 3) and (k, 3): platform poses: rotation and position [m] of R_e in R_b
    t: Array
    # R_reached, t_reached: (w, 3, 3) and (w, 3): poses over which errors of the platform are
    # judged: those above, and more if they are few
    R_reached: Array
    t_reached: Array
    view: IntArray  # view, pose: (n_images,): the view and the pose of each image
    pose: IntArray
    seen: BoolArray  # (n_views, n_legs): the legs that each view shows
    camera: Array  # (n_views, 3): where the cameras stand in R_b [m]
    focal: Array  # (n_views,): their focal lengths [px]
    sigma_q: float  # standard deviation of a reading [m]
    # (n_views,): the views whose images show a calibration board on the base: how these cameras
    # stand to each other is known
    board: BoolArray

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @property
    def n_views(self) -> int:
        """Number of camera positions."""
        return len(self.seen)

    @cached_property
    def frame(self) -> IntArray:
        """The frame in which each view shows the legs, (n_views,): with a board one for all."""
        first = int(np.argmax(self.board))
        frame = np.where(self.board, first, np.arange(self.n_views))
        return np.asarray(np.unique(frame, return_inverse=True)[1])

    @property
    def n_frames(self) -> int:
        """Number of frames: of cameras that nothing ties to others, and of the board."""
        return int(self.frame.max(initial=-1)) + 1

    @cached_property
    def frames(self) -> tuple[tuple[int, ...], ...]:
        """The legs that are seen in each frame."""
        seen = [self.seen[self.frame == f].any(axis=0) for f in range(self.n_frames)]
        return tuple(tuple(np.flatnonzero(row).tolist()) for row in seen)

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return len(self.frame_legs) == 3

    @cached_property
    def views(self) -> tuple[tuple[int, ...], ...]:
        """The legs of each view."""
        return tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in self.seen)

    @cached_property
    def A(self) -> Array:
        """Base joint centres in R_b, (n_legs, 3) [m]."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def arm(self) -> Array:
        """From the origin of R_e to B in the directions of R_b, (k, n_legs, 3) [m]."""
        B = np.array([leg.B for leg in self.legs])
        return np.asarray(np.einsum("kij,nj->kni", self.R, B))

    @cached_property
    def length(self) -> Array:
        """Leg lengths at every pose, (k, n_legs) [m]."""
        return np.asarray(np.linalg.norm(self.arm + self.t[:, None] - self.A, axis=2))

    @cached_property
    def u(self) -> Array:
        """Leg directions in R_b at every pose, (k, n_legs, 3)."""
        return (self.arm + self.t[:, None] - self.A) / self.length[..., None]

    @cached_property
    def mean_length(self) -> float:
        """Mean leg length, by which angles become lengths [m]."""
        return float(self.length.mean())

    @cached_property
    def unit(self) -> Array:
        """A metre of every parameter in its own unit, (p,): angles at the leg's length."""
        lengths = np.array([unit == "m" for unit in self.parametrization.units], dtype=np.bool_)
        return np.where(lengths, 1.0, 1.0 / self.mean_length)

    @cached_property
    def local_to_parameters(self) -> Array:
        """Derivative of each leg's twelve numbers by the parameters in metres, (n_legs, 12, p)."""
        eye = np.eye(N_LOCAL)
        scattered = [self.parametrization.scatter(eye, j) for j in range(self.n_legs)]
        return np.array(scattered).reshape(self.n_legs, N_LOCAL, len(self.unit)) * self.unit

    @cached_property
    def with_length(self) -> BoolArray:
        """Which legs have a length that is measured or constant, (n_legs,)."""
        return np.array([leg.kind is not LegKind.PASSIVE for leg in self.legs], dtype=np.bool_)

    def with_board(self, *, board: bool = True) -> Session:
        """Return the same with a calibration board in all images, or in none."""
        return replace(self, board=np.full(self.n_views, board, dtype=np.bool_))

    def columns(self, kinds: Sequence[int]) -> IntArray:
        """Return the parameters that stand for given ones of the legs' twelve numbers."""
        place = self.parametrization.place[:, list(kinds)]
        return np.unique(place[place >= 0])


@dataclass(frozen=True, eq=False)
class Across:
    """Two directions across each leg at a point of its axis, over their standard deviations."""

    # (n_images, n_legs, 2, 3): n_lat and n_dep in R_b by their sigma [1/m]; zero where the leg is
    # not seen
    gradient: Array
    point: Array  # (n_images, n_legs, 3): the points in R_b [m]

    def by_camera(self) -> Array:
        """Return the derivative (n_images, n_legs, 2, 6) by the camera's turn and displacement."""
        turn = -np.cross(self.point[:, :, None], self.gradient)
        return np.concatenate([turn, -self.gradient], axis=3)


def at_base_joints(session: Session) -> Across:
    """Return what is seen at the base joint centres."""
    images = len(session.view)
    return _across(session, np.broadcast_to(session.A, (images, *session.A.shape)))


def at_platform_joints(session: Session) -> Across:
    """Return what is seen at the platform joint centres."""
    return _across(session, (session.arm + session.t[:, None])[session.pose])


def _across(session: Session, point: Array) -> Across:
    """Return the directions across legs at points (n_images, n_legs, 3)."""
    u = session.u[session.pose]
    ray = point - session.camera[session.view][:, None]
    distance = np.linalg.norm(ray, axis=2)
    lateral = np.cross(u, ray / distance[..., None])
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), _ALONG)[..., None]
    depth = np.cross(u, lateral)
    sigma_lateral = SIGMA_PX * distance / session.focal[session.view][:, None]
    sigma_depth = sigma_lateral * distance / session.radius
    gradient = np.stack(
        [lateral / sigma_lateral[..., None], depth / sigma_depth[..., None]], axis=2
    )
    gradient[~session.seen[session.view]] = 0.0
    return Across(gradient, point)


def legs_around(session: Session) -> list[int]:
    """Return the legs in their order around the base."""
    points = session.A + (session.arm + session.t[:, None]).mean(axis=0)
    centred = points - points.mean(axis=0)
    _, _, basis = np.linalg.svd(session.A - session.A.mean(axis=0))
    angle = np.arctan2(centred @ basis[1], centred @ basis[0])
    return [int(j) for j in np.argsort(angle, kind="stable")]


def neighbours(ring: Sequence[int], size: int) -> list[tuple[int, ...]]:
    """Return all groups of so many neighbours, (size,) each, in the order of the legs."""
    n = len(ring)
    groups = (
        tuple(sorted(ring[(start + k) % n] for k in range(min(size, n)))) for start in range(n)
    )
    return list(dict.fromkeys(groups))


def steps_apart(ring: Sequence[int], leg: int, others: Sequence[int]) -> int:
    """Return how many places around the base a leg is from the nearest of others."""
    place = {j: k for k, j in enumerate(ring)}
    steps = (abs(place[leg] - place[other]) for other in others)
    return min((min(s, len(ring) - s) for s in steps), default=0)


def legs_in_words(legs: Sequence[int], leg_names: Sequence[str]) -> str:
    """Return legs as a sentence names them: ``legs 1, 2 and 5``."""
    labels = leg_labels(leg_names)
    return f"leg{'s' * (len(legs) > 1)} {joined([labels[leg_names[j]] for j in legs])}"


def views_in_words(views: Sequence[str]) -> str:
    """Return views one after the other, equal ones once: ``1,2,3 from two places``."""
    said = []
    for view in dict.fromkeys(views):
        times = list(views).count(view)
        said.append(view if times == 1 else f"{view} from {_TIMES.get(times, times)} places")
    return "; ".join(said)
