"""A whole simulated measurement: readings, outlines, axes, and the truth behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.observations.leg_axes import LegAxes, axes_from_outlines
from legcal.observations.measurements import Measurements, View
from legcal.observations.outlines import Outlines
from legcal.observations.table_axes import axes_of_table
from legcal.simulation.cameras import LegCamera
from legcal.simulation.hints import rough_pose
from legcal.simulation.leg_vectors import leg_vectors
from legcal.simulation.machine import Machine
from legcal.simulation.observe import OutlineNoise, observe_outlines, outline_table
from legcal.simulation.poses import extreme_poses
from legcal.simulation.table_noise import TableNoise, observe_axes


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """Measurements of a simulated machine, and what is true of it.

    Attributes
    ----------
    measurements : Measurements
        Images, readings and rough camera poses. The base link's frame is R_b.
    outlines : Outlines or None
        Outlines in the images; None where Table 1 gave the noise of the axes.
    axes : LegAxes
        Axes of the legs.
    machine : Machine
        The true machine.
    cameras : tuple of LegCamera
        The true cameras.
    T_Rb_Re : RigidTransform, n_poses of them
        The true platform poses, by index of pose.
    """

    measurements: Measurements
    outlines: Outlines | None
    axes: LegAxes
    machine: Machine
    cameras: tuple[LegCamera, ...]
    T_Rb_Re: RigidTransform


def simulate_session(
    machine: Machine,
    cameras: Sequence[LegCamera],
    rng: np.random.Generator,
    *,
    noise: OutlineNoise | TableNoise,
    noisy: bool = True,
    sigma_q: float = 2e-6,
    uniform_readings: bool = False,
    n_poses: int = 15,
    n_images: int = 1,
    share_poses: bool = False,
) -> SimulatedSession:
    """Simulate readings and observations of a machine (section 4.3).

    Parameters
    ----------
    machine : Machine
        The true machine.
    cameras : sequence of LegCamera
        The true cameras and the legs that they see.
    rng : numpy.random.Generator
        Source of poses and noise.
    noise : OutlineNoise or TableNoise
        What disturbs the observations, and the covariance that they carry.
    noisy : bool
        False leaves observations, readings and rough camera poses exact; the covariances stay.
    sigma_q : float
        Standard deviation of the readings [m].
    uniform_readings : bool
        Errors of readings are uniform (of that standard deviation) instead of normal.
    n_poses : int
        Platform poses for each view.
    n_images : int
        Images of each pose in each view.
    share_poses : bool
        Every view sees the same poses (several cameras at once) instead of its own.

    Returns
    -------
    SimulatedSession
    """
    n_views = len(cameras)
    T_Rb_Re = extreme_poses(machine, n_poses if share_poses else n_views * n_poses, rng)
    view = np.repeat(np.arange(n_views), n_poses * n_images)
    pose = np.repeat(np.arange(n_views * n_poses), n_images)
    pose = (pose % n_poses if share_poses else pose).astype(np.intp)
    lengths = np.linalg.norm(leg_vectors(machine.parameters, T_Rb_Re), axis=-1)
    q = (lengths - machine.parameters.offsets) * machine.sign
    if noisy:
        q = q + _reading_errors(rng, sigma_q, q.shape, uniform=uniform_readings)
    measurements = Measurements(
        views=tuple(_view(i, c, machine, rng if noisy else None) for i, c in enumerate(cameras)),
        image=("",) * len(view),
        view=view.astype(np.intp),
        pose=pose,
        q=q[pose],
        sigma_q=sigma_q,
    )
    outlines, axes = observe_session(
        machine, cameras, T_Rb_Re, measurements, noise, rng if noisy else None
    )
    return SimulatedSession(measurements, outlines, axes, machine, tuple(cameras), T_Rb_Re)


def _reading_errors(
    rng: np.random.Generator, sigma: float, shape: tuple[int, ...], *, uniform: bool
) -> Array:
    """Return errors of readings with a given standard deviation [m]."""
    if uniform:
        half_width = np.sqrt(3.0) * sigma
        return rng.uniform(-half_width, half_width, shape)
    return rng.normal(scale=sigma, size=shape)


def observe_session(
    machine: Machine,
    cameras: Sequence[LegCamera],
    T_Rb_Re: RigidTransform,
    measurements: Measurements,
    noise: OutlineNoise | TableNoise,
    rng: np.random.Generator | None,
) -> tuple[Outlines | None, LegAxes]:
    """Return what all images of a session show.

    Parameters
    ----------
    machine : Machine
        The true machine.
    cameras : sequence of LegCamera
        The true cameras and the legs that they see.
    T_Rb_Re : RigidTransform, n_poses of them
        The true platform poses, by index of pose.
    measurements : Measurements
        The view and the pose of each image; images of one view stand together.
    noise : OutlineNoise or TableNoise
        What disturbs the observations, and the covariance that they carry.
    rng : numpy.random.Generator or None
        Source of the noise; None leaves the observations exact.

    Returns
    -------
    Outlines or None
        Outlines; None where Table 1 gives the noise of the axes.
    LegAxes
        Axes, by image and then by leg.
    """
    seen = [np.array(cameras[v].legs, dtype=np.intp) for v in measurements.view]
    legs = [
        _legs_in_camera(machine, camera, T_Rb_Re[measurements.pose[measurements.view == v]])
        for v, camera in enumerate(cameras)
    ]
    if isinstance(noise, TableNoise):
        row = np.repeat(np.arange(len(seen)), [len(s) for s in seen])
        u, A, _, _ = (np.concatenate(part) for part in zip(*legs, strict=True))
        table = observe_axes(row, np.concatenate(seen), u, A, noise, rng)
        return None, axes_of_table(table.row, table.leg, table.values, table.sigmas)
    images = [
        observe_outlines(camera.camera, of_view, noise, rng)
        for camera, of_view in zip(cameras, legs, strict=True)
    ]
    h, ends = zip(*images, strict=True)
    outlines = outline_table(range(len(seen)), seen, h, ends, machine.parts, noise)
    return outlines, axes_from_outlines(outlines, measurements, machine.radius_of_part())


def _legs_in_camera(
    machine: Machine, camera: LegCamera, T_Rb_Re: RigidTransform
) -> tuple[Array, Array, Array, Array]:
    """Return u, A (camera frame), length and radius of the legs in images, by image, then leg."""
    seen = list(camera.legs)
    legs = leg_vectors(machine.parameters, T_Rb_Re)[:, seen].reshape(-1, 3)
    length = np.linalg.norm(legs, axis=-1)
    T_camera_Rb = camera.T_Rb_camera.inv()
    u = T_camera_Rb.rotation.apply(legs / length[:, None])
    A = T_camera_Rb.apply(machine.parameters.base_joints[seen])
    n_images = len(T_Rb_Re)
    return u, np.tile(A, (n_images, 1)), length, np.tile(machine.radius[seen], n_images)


def _view(index: int, camera: LegCamera, machine: Machine, rng: np.random.Generator | None) -> View:
    """Return the view with a rough camera pose; the true one without a source of chance."""
    T = camera.T_Rb_camera if rng is None else rough_pose(camera.T_Rb_camera, rng)
    names = tuple(f"leg{j + 1}" for j in camera.legs)
    everything = len(names) == machine.n_legs
    return View(f"c{index + 1}", camera.camera, T, None if everything else names)
