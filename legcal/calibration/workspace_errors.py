"""What a calibration means at the platform, all over the workspace.

At the poses that stand for the workspace, and on a grid of places at the orientation of home, where
the machine can be there: how far the nominal model is off by the calibrated one, eq (20), and the
error that the covariance predicts for the calibrated one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
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

N_ACROSS, N_LEVELS = 7, 3  # places of the grid in x and y, and in z
MIN_PLACES = 6  # of a grid that the machine reaches, for it to say anything
_FLAT = 1e-3  # of the largest extent: a machine that moves in a plane
_CLOSED = 2.5e-6  # mean leg lengths, [rad] between a place and the pose that its readings give


@brief
@dataclass(frozen=True, eq=False)
class PlatformMap:
    """Platform errors over the workspace.

    Attributes
    ----------
    position : (n, 3) array
        The origin of the platform link in the base link [m].
    change, sigma : PlatformError
        At these places: from the nominal to the calibrated model at the same readings, and the
        predicted error of the calibrated model, one standard deviation.
    x, y, z : (n_x,), (n_y,), (n_z,) arrays
        The grid [m]; empty where the machine cannot keep the orientation of home at other places.
    index : (n_z, n_y, n_x) array of int
        Which place stands at each point of the grid, -1 where the machine does not reach it.
    """

    position: Array
    change: PlatformError
    sigma: PlatformError
    x: Array
    y: Array
    z: Array
    index: Array


def platform_map(calibration: Calibration) -> PlatformMap | None:
    """Return the platform errors over the workspace; None where no reading gives a pose.

    None too where the travels or home of the model forbid random poses.
    """
    machine = calibration.dataset.machine
    if calibration.platform is None:
        return None
    try:
        q, drawn = workspace(machine)
    except DidNotConverge:
        return None
    position = np.array([T.translation for T in drawn])
    axes = _grid(position)
    grids = np.meshgrid(*axes[::-1], indexing="ij")
    places = np.stack([grid.ravel() for grid in grids[::-1]], axis=1)
    R = np.broadcast_to(machine.home.rotation.as_matrix(), (len(places), 3, 3))
    poses = list(motions_of(R, places))
    readings = readings_at_poses(machine, np.concatenate([R, places[..., None]], axis=2))
    inside = _inside(machine, readings)
    every = [*drawn, *(poses[k] for k in np.flatnonzero(inside))]
    found = _errors(calibration, np.concatenate([q, readings[inside]]), every)
    if found is None:
        return None
    reached, change, sigma = found
    number = np.full(len(every), -1)
    number[reached] = np.arange(reached.sum())
    index = np.full(len(places), -1)
    index[inside] = number[len(drawn) :]
    if np.count_nonzero(index >= 0) < MIN_PLACES:
        axes, index = [np.zeros(0)] * 3, np.zeros(0, dtype=np.intp)
    shape = tuple(len(axis) for axis in axes[::-1])
    where = np.concatenate([position, places[inside]])[reached]
    x, y, z = axes
    return PlatformMap(where, change, sigma, x, y, z, index.reshape(shape))


def _grid(position: Array) -> list[Array]:
    """Return places along x and y over the whole workspace, and levels of z inside it."""
    low, high = position.min(axis=0), position.max(axis=0)
    flat = high - low < _FLAT * float(np.max(high - low))
    x, y = (np.linspace(a, b, N_ACROSS) for a, b in zip(low[:2], high[:2], strict=True))
    z = np.quantile(position[:, 2], np.arange(1, N_LEVELS + 1) / (N_LEVELS + 1.0))
    return [axis[:1] if is_flat else axis for axis, is_flat in zip((x, y, z), flat, strict=True)]


def _inside(machine: Machine, q: Array) -> BoolArray:
    """Return which rows of readings (n, n_legs) are within the travels."""
    inside = np.ones(len(q), dtype=np.bool_)
    for j, leg in enumerate(machine.legs):
        if leg.is_motor:
            inside &= (q[:, j] >= leg.travel[0]) & (q[:, j] <= leg.travel[1])
    return inside


def _errors(
    calibration: Calibration, q: Array, T_base_platform: list[RigidTransform]
) -> tuple[BoolArray, PlatformError, PlatformError] | None:
    """Return which poses both models have, and change and predicted error there."""
    machine, solution = calibration.dataset.machine, calibration.solution
    wanted = platforms_in_base(machine, T_base_platform)
    nominal = poses_at_readings(machine, geometries(machine), q, wanted)
    calibrated = poses_at_readings(machine, solution.legs, q, nominal)
    apart, turned = pose_differences(nominal, wanted)
    reached = (apart < _CLOSED * machine.size) & (turned < _CLOSED)
    reached &= reach_readings(machine, solution.legs, q, calibrated)
    kept = np.flatnonzero(reached)
    if not len(kept):
        return None
    here = [calibrated[k] for k in kept]
    try:
        moves = platform_by_parameters(
            solution.legs, solution.kinematic.parametrization, machine.frame_legs, here
        )
    except NotIdentifiable:  # a place of the grid is singular
        return None
    sigma = expected_error(moves, solution.kinematic.total_covariance)
    change = PlatformError(*pose_differences(here, [nominal[k] for k in kept]))
    return reached, change, sigma
