"""What a calibration session will see: poses, cameras, legs, and how exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.leg import LegKind
from legcal.mechanism.leg_geometry import N_LOCAL, LegGeometry
from legcal.mechanism.parametrization import Parametrization

SIGMA_PX = 0.1  # of an outline across a leg, in the image


@dataclass(frozen=True, eq=False)
class Session:
    """Observations as they will be made, of a machine that is nearly the nominal one.

    Attributes
    ----------
    leg_names : tuple of str
        Names of the legs.
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    frame_legs : tuple of int
        The legs that define R_b and R_e.
    parametrization : Parametrization
        The parameters.
    radius : (n_legs,) array
        Radius of the cylinder that is seen of each leg [m].
    R, t : (k, 3, 3) and (k, 3) array
        Platform poses: rotation and position [m] of R_e in R_b.
    R_reached, t_reached : (w, 3, 3) and (w, 3) array
        Poses over which errors of the platform are judged: those above, and more if they are few.
    view, pose : (n_images,) array of int
        The view and the pose of each image.
    seen : (n_views, n_legs) array of bool
        The legs that each view shows.
    camera : (n_views, 3) array
        Where the cameras stand in R_b [m].
    focal : (n_views,) array
        Their focal lengths [px].
    sigma_q : float
        Standard deviation of a reading [m].
    board : (n_views,) array of bool
        The views whose images show a calibration board on the base: how these cameras stand to
        each other is known.
    """

    leg_names: tuple[str, ...]
    legs: tuple[LegGeometry, ...]
    frame_legs: tuple[int, ...]
    parametrization: Parametrization
    radius: Array
    R: Array
    t: Array
    R_reached: Array
    t_reached: Array
    view: IntArray
    pose: IntArray
    seen: BoolArray
    camera: Array
    focal: Array
    sigma_q: float
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
