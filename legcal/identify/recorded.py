"""The session that a dataset records: its readings, its cameras and the legs of its views."""

from __future__ import annotations

import numpy as np

from legcal.dataset.folder import Dataset
from legcal.geometry.types import Array, BoolArray
from legcal.identify.cameras import default_cameras
from legcal.identify.intrinsics import looking_at
from legcal.identify.planned import REACHED, joints_at, machine_near, radii, travel_of
from legcal.identify.poses import random_poses
from legcal.identify.session import Session
from legcal.mechanism.parametrization import parametrization_of
from legcal.refinement.nominal_poses import nominal_poses
from legcal.refinement.state import components
from legcal.vision.intrinsics import shared_cameras


def recorded_session(dataset: Dataset, *, twists: bool = False) -> Session:
    """Return the session of a dataset.

    Where readings do not give its poses, random ones inside the travel take their place.

    Parameters
    ----------
    dataset : Dataset
        A view is taken to show the legs that have axes in it; without a table of axes those
        that it names, or all.
    twists : bool
        Count the twists of legs among the parameters.

    Raises
    ------
    DatasetError
        If readings are out of reach of the model by more than its errors may be.
    """
    mechanism, m = dataset.mechanism, dataset.measurements
    to_Rb, from_Re = mechanism.T_base_Rb.inv(), mechanism.T_platform_Re
    home = to_Rb * mechanism.home * from_Re
    legs, length, rng = machine_near(mechanism, home)
    if mechanism.is_determined:
        R, t = components(nominal_poses(mechanism, m).T_Rb_Re)
    else:
        travel = travel_of(mechanism)
        R, t = random_poses(legs, mechanism.frame_legs, home, travel, m.n_poses, rng)
    parametrization = parametrization_of(mechanism, twists=twists)
    R_reached, t_reached = R, t
    if 3 * len(t) < len(parametrization):  # too few to tell what no pose would show
        more = random_poses(
            legs, mechanism.frame_legs, home, travel_of(mechanism), REACHED - len(t), rng
        )
        R_reached, t_reached = np.concatenate([R, more[0]]), np.concatenate([t, more[1]])
    used = np.unique(m.view)
    views = [m.views[v] for v in used]
    seen = np.array(
        [[view.legs is None or name in view.legs for name in mechanism.leg_names] for view in views]
    )
    if dataset.axes is not None:
        shown_legs = np.zeros((len(m.views), len(mechanism.leg_names)), dtype=np.bool_)
        shown_legs[m.view[dataset.axes.row], dataset.axes.leg] = True
        seen = shown_legs[used]
    A, B = joints_at(legs, home)
    shown = [np.flatnonzero(row).tolist() for row in seen]
    camera = default_cameras(A, B, shown, mechanism.spatial, rng)
    for v, view in enumerate(views):
        if view.T_base_camera is not None:
            camera[v] = (to_Rb * view.T_base_camera).translation
    return Session(
        leg_names=mechanism.leg_names,
        legs=legs,
        frame_legs=mechanism.frame_legs,
        parametrization=parametrization,
        radius=radii(mechanism.legs, length),
        R=R,
        t=t,
        R_reached=R_reached,
        t_reached=t_reached,
        view=np.searchsorted(used, m.view),
        pose=m.pose,
        seen=seen,
        camera=camera,
        focal=np.array([_focal(view.camera.K) for view in views]),
        sigma_q=m.sigma_q,
        board=_with_board(dataset)[used],
    )


def orientations_of(dataset: Dataset, session: Session) -> Array:
    """Return R of the camera of every used view in R_b, (n_views, 3, 3).

    Cameras whose place the dataset does not give look at the legs.
    """
    to_Rb, views = dataset.mechanism.T_base_Rb.inv(), dataset.measurements.views
    found = looking_at(session)
    for v, view in enumerate(views[i] for i in np.unique(dataset.measurements.view).tolist()):
        if view.T_base_camera is not None:
            found[v] = (to_Rb * view.T_base_camera).rotation.as_matrix()
    return found


def cameras_of(dataset: Dataset) -> tuple[str, ...]:
    """Return the name of the camera of every used view: that of the first view that has it."""
    m = dataset.measurements
    owners = shared_cameras([view.name for view in m.views], [view.camera for view in m.views])
    return tuple(owners[v] for v in np.unique(m.view).tolist())


def _with_board(dataset: Dataset) -> BoolArray:
    """Return which views show the board, (n_views,): all of them where nobody has looked yet."""
    m = dataset.measurements
    shown = np.full(len(m.views), dataset.board is not None, dtype=np.bool_)
    if dataset.board is not None and dataset.corners is not None:
        corners = dataset.corners
        shown[:] = False
        shown[m.view[corners.row[corners.used]]] = True
    return shown


def _focal(K: Array) -> float:
    """Return the mean focal length [px]."""
    return float(np.sqrt(K[0, 0] * K[1, 1]))
