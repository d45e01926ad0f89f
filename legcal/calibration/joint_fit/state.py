"""The choices of the fit of everything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry import Array, BoolArray, IntArray, motions_of, turned
from legcal.machine import (
    LegGeometry,
    Mechanism,
    Parametrization,
    geometries,
    moved_legs,
    parametrize,
    vector_of,
)
from legcal.vision import Camera, intrinsic_names, intrinsic_values, with_intrinsics


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of the unknowns in x; ``size`` marks what is no unknown.

    Attributes
    ----------
    place : (n_legs, 12) array of int
        The numbers of each leg, in the order of :class:`legcal.machine.parameters`.
    kinematic : (p,) array of int
        The kinematic parameters, in the order of their parametrization.
    radius : (n_radii,) array of int
        Radii, one for each of ``parts``.
    bias : (n_biases,) array of int
        Shifts of outlines.
    intrinsic : (n_views, n_keys) array of int
        Intrinsics of each view; views with one camera share them.
    camera : (n_views, 6) array of int
        Rotation and translation of each camera; cameras that show nothing are no unknowns.
    board_scale : (1,) array of int
        The factor on the dimensions of the calibration board.
    board : (6,) array of int
        Rotation and translation of the calibration board.
    n_poses : int
        Number of platform poses; each has six numbers at the end of x.
    n_kept : int
        Number of unknowns other than platform poses; they come first.
    parts : tuple of (int, str)
        Leg index and part of each radius.
    intrinsic_keys : tuple of str
        What the columns of ``intrinsic`` are.
    """

    place: IntArray
    kinematic: IntArray
    radius: IntArray
    bias: IntArray
    intrinsic: IntArray
    camera: IntArray
    board_scale: IntArray
    board: IntArray
    n_poses: int
    n_kept: int
    parts: tuple[tuple[int, str], ...]
    intrinsic_keys: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.n_kept + 6 * self.n_poses

    @property
    def n_kinematic(self) -> int:
        """Number of kinematic parameters that are unknowns; they come first of all."""
        return int(np.sum(self.kinematic < self.size))

    @property
    def n_named(self) -> int:
        """Number of unknowns that have a name and a prior: all but cameras, board and poses."""
        without = np.concatenate([self.camera.ravel(), self.board])
        without = without[without < self.size]
        return int(without.min()) if without.size else self.n_kept

    def of_poses(self, n_poses: int) -> Layout:
        """Return the layout of the same unknowns with another number of platform poses."""
        size = self.n_kept + 6 * n_poses

        def marked(position: IntArray) -> IntArray:
            return np.where(position < self.size, position, size)

        return replace(
            self,
            place=marked(self.place),
            kinematic=marked(self.kinematic),
            radius=marked(self.radius),
            intrinsic=marked(self.intrinsic),
            camera=marked(self.camera),
            board_scale=marked(self.board_scale),
            board=marked(self.board),
            n_poses=n_poses,
        )


def lay_out(
    place: IntArray,
    is_free: BoolArray,
    radius_is_free: BoolArray,
    parts: Sequence[tuple[int, str]],
    intrinsic: IntArray,
    intrinsic_keys: Sequence[str],
    camera_is_seen: BoolArray,
    board_is_free: tuple[bool, bool],
    n_poses: int,
) -> Layout:
    """Return the layout of the unknowns, without shifts of outlines.

    Parameters
    ----------
    place : (n_legs, 12) array of int
        Where each leg's numbers stand in the vector of kinematic parameters; -1 for none.
    is_free : (p,) array of bool
        Which kinematic parameters are unknowns.
    radius_is_free : (n_radii,) array of bool
        Which radii are.
    parts : sequence of (int, str)
        Leg index and part of each radius.
    intrinsic : (n_views, n_keys) array of int
        Number of the unknown intrinsic of each view, counted from zero; -1 for none.
    intrinsic_keys : sequence of str
        What its columns are.
    camera_is_seen : (n_views,) array of bool
        Which views have outlines, axes or corners of a calibration board.
    board_is_free : (bool, bool)
        Whether the size and the place of the calibration board are unknowns.
    n_poses : int
        Number of platform poses.
    """
    n_intrinsics = int(intrinsic.max(initial=-1)) + 1
    scale, place_of_board = (
        np.full(n, free) for n, free in zip((1, 6), board_is_free, strict=True)
    )
    counts = [
        is_free.sum(),
        radius_is_free.sum(),
        n_intrinsics,
        scale.sum(),
        6 * camera_is_seen.sum(),
        place_of_board.sum(),
    ]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
    n_kept = int(first[-1])
    size = n_kept + 6 * n_poses
    kinematic = _numbered(is_free, 0, size)
    extended = np.append(kinematic, size)
    return Layout(
        place=extended[place],
        kinematic=kinematic,
        radius=_numbered(radius_is_free, first[1], size),
        bias=np.zeros(0, dtype=np.intp),
        intrinsic=np.where(intrinsic < 0, size, first[2] + intrinsic),
        board_scale=_numbered(scale, first[3], size),
        camera=_numbered(np.repeat(camera_is_seen[:, None], 6, axis=1), first[4], size),
        board=_numbered(place_of_board, first[5], size),
        n_poses=n_poses,
        n_kept=n_kept,
        parts=tuple(parts),
        intrinsic_keys=tuple(intrinsic_keys),
    )


def _numbered(mask: BoolArray, first: int, size: int) -> IntArray:
    """Return positions from *first* on where the mask is true, *size* elsewhere."""
    position = np.full(mask.shape, size, dtype=np.intp)
    position[mask] = first + np.arange(int(mask.sum()))
    return position


@dataclass(frozen=True, eq=False)
class State:
    """Values of everything that the fit moves.

    Attributes
    ----------
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    radii : (n_radii,) array
        Radii [m] of the layout's parts.
    biases : (n_biases,) array
        Shifts of outlines that several of them share [px].
    cameras : tuple of Camera
        The intrinsics of each view.
    R_camera, t_camera : (n_views, 3, 3) and (n_views, 3) array
        Rotation and translation [m] of T_camera_Rb.
    R_pose, t_pose : (n_poses, 3, 3) and (n_poses, 3) array
        Rotation and translation [m] of T_Rb_Re.
    R_board, t_board : (1, 3, 3) and (1, 3) array
        Rotation and translation [m] of T_Rb_board, the calibration board in R_b.
    board_scale : (1,) array
        Factor on the dimensions of the board.
    """

    legs: tuple[LegGeometry, ...]
    radii: Array
    biases: Array
    cameras: tuple[Camera, ...]
    R_camera: Array
    t_camera: Array
    R_pose: Array
    t_pose: Array
    R_board: Array
    t_board: Array
    board_scale: Array

    @cached_property
    def A(self) -> Array:
        """Base joint centres in R_b, (n_legs, 3) [m]."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def B(self) -> Array:
        """Platform joint centres in R_e, (n_legs, 3) [m]."""
        return np.array([leg.B for leg in self.legs])

    @cached_property
    def lengths(self) -> Array:
        """Offsets and constant lengths, (n_legs,) [m]."""
        return np.array([leg.q0 for leg in self.legs])

    @property
    def T_camera_Rb(self) -> tuple[RigidTransform, ...]:
        """Camera poses, one a view."""
        return motions_of(self.R_camera, self.t_camera)

    @property
    def T_Rb_board(self) -> RigidTransform:
        """The calibration board in R_b; of no meaning where no image shows one."""
        return motions_of(self.R_board, self.t_board)[0]

    @property
    def T_Rb_Re(self) -> tuple[RigidTransform, ...]:
        """Platform poses."""
        return motions_of(self.R_pose, self.t_pose)

    def moved(self, x: Array, layout: Layout) -> State:
        """Return the state after a change x of its unknowns [m, rad, px]."""
        change = np.append(x, 0.0)
        legs = self.legs
        if np.any(layout.place < layout.size):
            legs = moved_legs(legs, layout.place, x)
        camera, pose = change[layout.camera], x[layout.n_kept :].reshape(-1, 6)
        board = change[layout.board]
        return State(
            legs,
            self.radii + change[layout.radius],
            self.biases + change[layout.bias],
            _changed(self.cameras, change[layout.intrinsic], layout.intrinsic_keys),
            turned(self.R_camera, camera[:, :3]),
            self.t_camera + camera[:, 3:],
            turned(self.R_pose, pose[:, :3]),
            self.t_pose + pose[:, 3:],
            turned(self.R_board, board[None, :3]),
            self.t_board + board[3:],
            self.board_scale + change[layout.board_scale],
        )


def _changed(
    cameras: tuple[Camera, ...], change: Array, keys: tuple[str, ...]
) -> tuple[Camera, ...]:
    """Return cameras whose intrinsics have changed by (n_views, n_keys)."""
    if not np.any(change):
        return cameras
    changed = []
    for camera, by in zip(cameras, change, strict=True):
        moved = dict(zip(keys, by.tolist(), strict=True))
        values = {key: intrinsic_of(camera, key) + d for key, d in moved.items() if d != 0.0}
        changed.append(with_intrinsics(camera, values))
    return tuple(changed)


def intrinsic_of(camera: Camera, key: str) -> float:
    """Return one number of a camera by its name."""
    return float(intrinsic_values(camera)[intrinsic_names(camera).index(key)])


@dataclass(frozen=True, eq=False)
class FittedLegs:
    """The legs of a mechanism as the fit sees them.

    Attributes
    ----------
    names : tuple of str
        Leg names in the mechanism's order.
    nominal : tuple of LegGeometry
        The nominal legs in R_b and R_e: what the axes count from, and what stays as it is where it
        is fixed or held.
    sign : (n_legs,) array of int
        +1 where the leg grows with the reading, -1 where it shrinks: L = sign q + q0.
    frame_legs : tuple of int
        The legs whose joint centres define R_b and R_e: three in space, two in a plane.
    radii : dict
        Radius of the model [m] for each (leg index, part).
    """

    names: tuple[str, ...]
    nominal: tuple[LegGeometry, ...]
    sign: IntArray
    frame_legs: tuple[int, ...]
    radii: dict[tuple[int, str], float]

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.names)

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return len(self.frame_legs) == 3

    @cached_property
    def parametrization(self) -> Parametrization:
        """The kinematic parameters, twists among them."""
        return parametrize(self.names, self.nominal, self.frame_legs, twists=True)

    def vector(self, legs: tuple[LegGeometry, ...]) -> Array:
        """Return the kinematic parameters of legs [m, rad]; axes count from the nominal ones."""
        return vector_of(self.parametrization, legs, self.nominal)


def fitted_legs(mechanism: Mechanism) -> FittedLegs:
    """Return the fit's view of the legs of a mechanism."""
    return FittedLegs(
        tuple(leg.name for leg in mechanism.legs),
        geometries(mechanism),
        np.array([leg.sign for leg in mechanism.legs], dtype=np.intp),
        tuple(mechanism.frame_legs),
        {
            (i, part): r
            for i, leg in enumerate(mechanism.legs)
            for part, r in leg.radius_of_part.items()
        },
    )


@dataclass(frozen=True)
class RefinementSettings:
    """Choices of the fit.

    Attributes
    ----------
    radius_sigma : float
        Standard deviation of the prior on radii, as a part of the radius.
    board_scale_sigma : float
        Standard deviation of the dimensions of a calibration board, as a part of them: what
        printers and paper do.
    loss_width : float
        Whitened distance at which the loss of an outline turns from quadratic to linear.
    rejection : float
        Whitened distance beyond which an outline is rejected; a right one in 25,000 is, at 4.5.
    rejection_rounds : int
        Rounds, at most, until the rejected outlines stay the same.
    noise_rounds : int
        Rounds, at most, in which the errors of outlines are estimated after that.
    settled : float
        Relative change of these below which the rounds end.
    axis_disagreement : float
        Whitened distance of an axis beyond which it disagrees; a fit in which most do is
        refused. Sigmas that are too small by less are told by chi2 alone.
    largest_rms_px : float
        Root mean square of the offsets of accepted outlines beyond which a fit is refused [px].
    max_iterations : int
        Steps to try in each solve, at most.
    """

    radius_sigma: float = 0.02
    board_scale_sigma: float = 0.001
    loss_width: float = 3.0
    rejection: float = 4.5
    rejection_rounds: int = 6
    noise_rounds: int = 10
    settled: float = 0.02
    axis_disagreement: float = 20.0
    largest_rms_px: float = 3.0
    max_iterations: int = 200


DEFAULT_SETTINGS = RefinementSettings()
