"""Where each unknown sits in the vector x that the solver moves.

The vector is kinematic parameters, radii, biases, intrinsics, the size of the calibration board,
cameras, the place of that board, platform poses, in this order; it holds changes of a state
[m, rad, px].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import BoolArray, IntArray


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of the unknowns in x; ``size`` marks what is no unknown.

    Attributes
    ----------
    place : (n_legs, 12) array of int
        The numbers of each leg, in the order of :class:`legcal.mechanism.parametrization`.
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
