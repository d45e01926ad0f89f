"""Platform errors of a calibration on a grid over the workspace, at the orientation of home.

They are the change from the nominal to the calibrated model, eq (20), and the error of the
calibrated model predicted by its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.platform import (
    PlatformError,
    expected_error,
    platform_by_parameters,
    poses_at_readings,
    reach_readings,
)
from legcal.calibration.result import Calibration
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.motions import motions_of
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import platforms_in_base, pose_differences
from legcal.machine.model import Machine, readings_at_poses
from legcal.machine.parameters import geometries

N_ACROSS, N_LEVELS = 7, 3  # points of the grid in x and y, and in z
MIN_PLACES = 6  # smallest number of reachable points of a grid
_FLAT = 1e-3  # extent of a planar workspace, relative to the largest extent
_CLOSED = 2.5e-6  # largest difference of a point and the pose by its readings [leg lengths, rad]


@dataclass(frozen=True, eq=False)
class PlatformMap:
    """Displacements of the platform at places of the workspace.

    Attributes
    ----------
    x, y, z : (n_x,), (n_y,), (n_z,) arrays
        The grid of origins of the platform link in the base link [m].
    change, sigma : (n_z, n_y, n_x) arrays
        Change from the nominal to the calibrated model at the same readings, and predicted error of
        the calibrated model, one standard deviation [m]; NaN out of reach.
    """

    x: Array
    y: Array
    z: Array
    change: Array
    sigma: Array


def platform_map(calibration: Calibration) -> PlatformMap | None:
    """Return the platform errors over the workspace; None if readings do not determine the pose.

    None also if no random poses can be drawn within the travels of the model, or if it reaches few
    places in the orientation of home.
    """
    machine = calibration.dataset.machine
    if calibration.platform is None:
        return None
    try:
        _, drawn = workspace(machine)
    except DidNotConverge:
        return None
    x, y, z = _grid(np.array([T.translation for T in drawn]))
    grids = np.meshgrid(z, y, x, indexing="ij")
    places = np.stack([grid.ravel() for grid in grids[::-1]], axis=1)
    R = np.broadcast_to(machine.home.rotation.as_matrix(), (len(places), 3, 3))
    readings = readings_at_poses(machine, np.concatenate([R, places[..., None]], axis=2))
    inside = np.flatnonzero(_inside(machine, readings))
    poses = motions_of(R[inside], places[inside])
    errors = _errors(calibration, readings[inside], list(poses)) if len(inside) else None
    if errors is None:
        return None
    reached, change, sigma = errors
    if len(change.displacement) < MIN_PLACES:
        return None
    maps = np.full((2, len(places)), np.nan)
    maps[:, inside[reached]] = change.displacement, sigma.displacement
    return PlatformMap(x, y, z, *maps.reshape(2, *grids[0].shape))


def _grid(position: Array) -> list[Array]:
    """Return points along x and y over the whole workspace, and levels of z inside it."""
    low, high = position.min(axis=0), position.max(axis=0)
    flat = high - low < _FLAT * float(np.max(high - low))
    x, y = (np.linspace(a, b, N_ACROSS) for a, b in zip(low[:2], high[:2], strict=True))
    z = np.quantile(position[:, 2], np.arange(1, N_LEVELS + 1) / (N_LEVELS + 1.0))
    return [axis[:1] if is_flat else axis for axis, is_flat in zip((x, y, z), flat, strict=True)]


def _inside(machine: Machine, q: Array) -> BoolArray:
    """Return a mask of the rows of readings (n, n_legs) within the travels."""
    inside = np.ones(len(q), dtype=np.bool_)
    for j, leg in enumerate(machine.legs):
        if leg.is_motor:
            inside &= (q[:, j] >= leg.travel[0]) & (q[:, j] <= leg.travel[1])
    return inside


def _errors(
    calibration: Calibration, q: Array, T_base_platform: list[RigidTransform]
) -> tuple[BoolArray, PlatformError, PlatformError] | None:
    """Return a mask of the poses that both models reach, and change and predicted error there."""
    machine, solution = calibration.dataset.machine, calibration.solution
    wanted = platforms_in_base(machine, T_base_platform)
    nominal = poses_at_readings(machine, geometries(machine), q, wanted)
    calibrated = poses_at_readings(machine, solution.legs, q, nominal)
    distance, angle = pose_differences(nominal, wanted)
    reached = (distance < _CLOSED * machine.size) & (angle < _CLOSED)
    reached &= reach_readings(machine, solution.legs, q, calibrated)
    indices = np.flatnonzero(reached)
    if not len(indices):
        return None
    reached_poses = [calibrated[k] for k in indices]
    try:
        moves = platform_by_parameters(
            solution.legs, solution.kinematic.parametrization, machine.frame_legs, reached_poses
        )
    except NotIdentifiable:  # a point of the grid is singular
        return None
    sigma = expected_error(moves, solution.kinematic.total_covariance)
    change = PlatformError(*pose_differences(reached_poses, [nominal[k] for k in indices]))
    return reached, change, sigma
